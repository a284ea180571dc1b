"""The whole way on rendered sequences: trackers through environments in processes of their own, then the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .demo_story import estimate, measure, tell
from .kernels import compiled_ahead
from .output import aligned, note, progress, write
from .running import make_runs
from .studies import hush_optuna, run_trials

if TYPE_CHECKING:
    from dynslam_bench.reports.model.board import Board
    from dynslam_bench.runs import RunStore

DEFAULT_PROTOCOL = "tum-rgbd/v1"
STUDIED = "emfoa-oft-no-masks"
"""Whom the demo's study tunes: without masks, the flow alone says what moves."""
TUNED = (
    "flow.budget",
    "flow.sweeps",
    "flow.min_correlation",
    "epipolar.threshold_px",
    "motion.threshold_px",
)
"""What the study tunes of it: the flow's search, and from when on a feature counts as moving."""
STUDY_FRAMES = 0.25
"""Frames of a block of the study, as a share of the runs' frames; `FEWEST_FRAMES` at least."""
FEWEST_FRAMES = 20


@dataclass(frozen=True)
class DemoOutcome:
    """What the demo made.

    Attributes:
        leaderboard: Ranking and errors by sequence, as text.
        story: What that shows, in sentences.
        report: The HTML page.
        conclusion: Of the study.
        study: Its page.
        runs: How many runs there are.
        failed: How many of them failed.
    """

    leaderboard: str
    story: list[str]
    report: Path
    conclusion: str
    study: Path
    runs: int
    failed: int


def run_demo(results: Path | str = "results", *, frames: int = 60, jobs: int = 2, trials: int = 6) -> DemoOutcome:
    """Render walking and sitting people, run the suite ``demo`` on them, report it, and tune `STUDIED`.

    Args:
        results: Results folder; the report is ``report/index.html`` in it, the study lies in ``study``.
        frames: Frames of each sequence; blocks of the study have a quarter of them.
        jobs: Runs at a time.
        trials: Trials of the study.

    Raises:
        DynslamError: The results or the cache folder cannot be written.
    """
    from dynslam_bench.reports import build_report
    from dynslam_bench.runs import RunStore
    from dynslam_bench.suites import load_suite

    specs = [
        spec.model_copy(update={"sequence": f"{spec.sequence}&frames={frames}", "frames": None})
        for spec in load_suite("demo").specs()
    ]
    store = RunStore(results)
    store.prepare()  # before the rendering: an unwritable folder shows at once
    slowness, compiles = measure(jobs)
    write(estimate(frames, study_frames(frames), trials, jobs, slowness=slowness, compiles=compiles), now=True)
    with compiled_ahead():
        render({spec.sequence for spec in specs})
    records = make_runs(specs, store, jobs=jobs)
    note("making the report")
    paths = build_report(store, store.root / "report", title="Demo: walking and sitting people, rendered")
    summary, page = tune_a_little(store.root / "study", frames=study_frames(frames), jobs=jobs, trials=trials)
    failed = sum(record.failed for record in records)
    board = demo_board(store)
    return DemoOutcome(
        leaderboard_text(board), tell(board.rows, records), paths.html, summary, page, len(records), failed
    )


def study_frames(frames: int) -> int:
    """Frames of a block of the study beside runs of so many frames."""
    return max(FEWEST_FRAMES, int(STUDY_FRAMES * frames))


def tune_a_little(results: Path, *, frames: int, jobs: int, trials: int) -> tuple[str, Path]:
    """A race for a smaller error; returns its conclusion and its page.

    Errors do not depend on what else the machine does, as times would.

    It tunes on three rooms and is judged on three others: enough to conclude honestly, which with so few is mostly that
    nothing was shown. Its runs lie in a results folder of their own, so that they do not crowd the leaderboard.
    """
    from dynslam_bench.core.records import digest
    from dynslam_bench.runs.identity import source_fingerprint
    from dynslam_bench.trackers import TRACKERS
    from dynslam_bench.tuning import StudySpec, finish, write_page
    from dynslam_bench.tuning.study_file import SpaceSpec

    hush_optuna()
    state = digest([frames, source_fingerprint(TRACKERS.get(STUDIED))], 6)  # another state is another study
    spec = StudySpec(
        name=f"demo-{state}",
        tracker=STUDIED,
        tune=(f"synthetic/walking_xyz?scene=1-3&frames={frames}",),
        held_out=(f"synthetic/walking_xyz?scene=101-103&frames={frames}",),
        recorded=(),
        objectives=("accuracy",),
        space=SpaceSpec(include=TUNED),
        offsets=(0,),
        trials=trials,
        top=1,
        min_coverage=0.9,
        pilot=False,
    )
    render({block.sequence for block in spec.blocks(*spec.tune, *spec.held_out)})
    tuner = run_trials(spec, results, jobs)
    summary = finish(tuner, note, jobs=jobs)
    return summary.conclusion, write_page(tuner, summary)


def render(sequences: set[str]) -> None:
    """Render sequences ahead of the runs, so that no run waits for another's frames."""
    from dynslam_bench.core.folders import find_data_root
    from dynslam_bench.sequences.synthetic import render_synthetic

    for name in sorted(sequences):
        with progress(f"rendering {name}") as advance:
            render_synthetic(name, find_data_root(None), progress=advance)


def demo_board(store: RunStore) -> Board:
    """The leaderboard of a store under the default protocol."""
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports.model.board import make_board
    from dynslam_bench.reports.model.rows import load_runs

    return make_board([run.row for run in load_runs([store], get_protocol(DEFAULT_PROTOCOL)).runs])


def leaderboard_text(board: Board) -> str:
    """The leaderboard and the errors by sequence, as aligned text without the captions of the page."""
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports.tables.leaderboard import leaderboard
    from dynslam_bench.reports.tables.sequences import per_sequence

    chosen = get_protocol(DEFAULT_PROTOCOL)
    parts = []
    for table in (leaderboard(board, chosen).displayed(), per_sequence(board, chosen).displayed()):
        rows = [[column.name for column in table.columns]]
        rows += [[f"{cell.text} {cell.small}".strip() for cell in row] for row in table.rows]
        parts.append(f"{table.title}\n{aligned(rows)}")
    return "\n\n".join([*parts, f"Protocol: {chosen.describe()}"])
