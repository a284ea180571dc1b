"""What the demonstration will take, and what it showed, in sentences that its own numbers make."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from dynslam_bench.cli.output import aligned, complain, note, progress, write
from dynslam_bench.cli.running import make_runs
from dynslam_bench.cli.studies import hush_optuna, run_trials

if TYPE_CHECKING:
    from dynslam_bench.reports.model.board import Board
    from dynslam_bench.reports.model.row import RunRow
    from dynslam_bench.runs import RunRecord, RunStore


PLAIN, CULLING = "orb-slam2", {"mask-rcnn": "masks of people", "emfoa-oft": "masks, flow and depth tests"}
TELLING = 1.5
"""Single runs scatter by some thirty per cent: a smaller factor shows nothing."""
SEQUENCES, STUDY_SCENES, SINGLE_RUNS = 2, 6, 24
RENDER_S, START_S, REPORT_S = 0.12, 1.0, 15.0
"""Processor seconds of a rendered and stored frame, of a run's start, and of the pages, on our machine."""
TRACK_S = {"never-move": 0.015, PLAIN: 0.035, "mask-rcnn": 0.13, "emfoa-oft": 0.16}
STUDIED_S = 0.09
"""Processor seconds of a frame, reading it included: of the runs, and of those of the study."""
COMPILE_S = 80.0
"""Processor seconds until all kernels are compiled."""
PROBE_FRAMES, PROBE_S = 16, 0.075
"""Frames that `measure` renders, and processor seconds of one on the same machine."""


def measure(jobs: int) -> tuple[float, bool]:
    """Render a few frames, `jobs` at a time.

    Returns:
        How many times as long as on our machine a job takes now, beside whatever else this one does; and
        whether kernels had to be compiled.
    """
    from dynslam_bench.sequences.synthetic import open_synthetic
    from dynslam_bench.sequences.synthetic.kernels import shade_pixels

    kernel: Any = shade_pixels  # what numba adds to it no annotation says
    sequence = open_synthetic(f"synthetic/walking_xyz?frames={PROBE_FRAMES + 1}", None, threads=1)
    sequence[0]
    with ThreadPoolExecutor(jobs) as pool:
        begun = time.perf_counter()
        list(pool.map(sequence.__getitem__, range(1, PROBE_FRAMES + 1)))
        took = time.perf_counter() - begun
    return took * jobs / (PROBE_FRAMES * PROBE_S), bool(kernel.stats.cache_misses)


def estimate(frames: int, study_frames: int, trials: int, jobs: int, *, slowness: float, compiles: bool) -> str:
    """How long the demonstration takes, and what it does in that time.

    Args:
        frames: Of each sequence.
        study_frames: Of a block of the study.
        trials: Of the study, trial 0 included.
        jobs: Runs at a time.
        slowness: See `measure`.
        compiles: Whether kernels have to be compiled.
    """
    rendered = SEQUENCES * frames + STUDY_SCENES * study_frames
    runs = SEQUENCES * len(TRACK_S)
    studied = SINGLE_RUNS + 3 * (trials - 2)
    seconds = rendered * RENDER_S + (runs + studied) * START_S + REPORT_S
    seconds += SEQUENCES * frames * sum(TRACK_S.values()) + studied * study_frames * STUDIED_S
    minutes = max(1, math.ceil((seconds + COMPILE_S * compiles) * slowness / jobs / 60))
    return (
        f"about {minutes} minute{'s' * (minutes > 1)} at the speed at which this machine rendered {PROBE_FRAMES} "
        f"frames just now{', compiling included' * compiles}; {rendered} frames are rendered, {runs} runs "
        f"made, and {trials} trials of a study"
    )


def tell(rows: Iterable[RunRow], records: Sequence[RunRecord]) -> list[str]:
    """What the runs show: one sentence a sequence, what culling costs, and how much to believe of it.

    Args:
        rows: The runs with their errors.
        records: The same runs, with their times.
    """
    errors: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.score_m is not None:
            errors.setdefault(row.sequence.id.partition("&")[0].rpartition("/")[2], {})[row.tracker.id] = row.score_m
    lines = [_sequence(name, found) for name, found in sorted(errors.items(), reverse=True) if PLAIN in found]
    return [*lines, *_costs(records), "One run each shows, and proves nothing: `dynslam-bench bench dynamic` repeats."]


def _sequence(name: str, errors: dict[str, float]) -> str:
    """What culling brought on one sequence; errors in metres by tracker."""
    people = next((word for word in ("walk", "sit") if name.startswith(word)), "")
    shown = [f"{1e3 * errors[key]:.1f} mm with {what} ({key})" for key, what in CULLING.items() if key in errors]
    culled = [errors[key] for key in CULLING if key in errors]
    text = f"{f'Where people {people} ({name})' if people else name}: {1e3 * errors[PLAIN]:.1f} mm without culling"
    if not culled:
        return f"{text} ({PLAIN})."
    return f"{text} ({PLAIN}), {', '.join(shown)}. {_verdict(errors[PLAIN] / min(culled))}"


def _verdict(factor: float) -> str:
    if factor >= TELLING:
        return f"Culling makes the error {factor:.1f} times smaller."
    if factor <= 1 / TELLING:
        return f"Culling makes the error {1 / factor:.1f} times larger."
    return "Culling changes nothing that one run could show."


def _costs(records: Sequence[RunRecord]) -> list[str]:
    """Processor time of the median frame: a mean would count the compiling of a first run, a frame time other work."""
    spent: dict[str, list[float]] = {}
    for record in records:
        times = record.timings.get("processor")
        if not record.failed and times is not None and record.tracker.id in (PLAIN, *CULLING):
            spent.setdefault(record.tracker.id, []).append(1e3 * times.median_s)
    costs = [f"{mean(spent[name]):.0f} ms ({name})" for name in (PLAIN, *CULLING) if name in spent]
    return [f"What it costs, in processor time of the median frame: {', '.join(costs)}."] if len(costs) > 1 else []


# Kernels compiled ahead, by processes of their own: two runs at a time would otherwise compile the same ones twice.

FRAMES = 12
"""Of the made-up scene: enough for keyframes and bundle adjustment."""
POINTS = 64
"""Whose flow is looked for: enough for every phase of the search."""


def compile_kernels() -> None:
    """Use all kernels once, so that they lie compiled beside their sources (or in the user's cache folder)."""
    compile_rendering()
    compile_flow()
    compile_tracking()


def compile_rendering() -> None:
    """Use the kernels that render sequences."""
    from dynslam_bench.sequences.synthetic import open_synthetic

    open_synthetic("synthetic/walking_xyz?frames=2", None)[0]


def compile_flow() -> None:
    """Use the kernels of the flow of `emfoa-oft`, about half of all that track."""
    import numpy as np

    from dynslam_bench.flow.registry import build_flow
    from dynslam_bench.testing import CornerSequence
    from dynslam_bench.trackers.systems.emfoa_oft import EmfoaOftSettings

    scene = CornerSequence(2)
    flow = build_flow(EmfoaOftSettings().flow)
    target, reference = (flow.prepare(np.ascontiguousarray(scene[index].rgb[:, :, 1])) for index in (0, 1))
    size = scene.camera.width - 1, scene.camera.height - 1
    points = (np.random.default_rng(0).random((POINTS, 2)) * size).astype(np.float32)
    flow.track(reference, target, points, guess=points)


def compile_tracking() -> None:
    """Use the kernels of features and of the map."""
    from dynslam_bench.envs import SlamEnv
    from dynslam_bench.testing import CornerSequence

    env = SlamEnv(CornerSequence(FRAMES), "orb-slam2")
    env.reset(seed=0)
    over = False
    while not over:
        outcome = env.step(env.neutral_action)
        over = outcome[2] or outcome[3]
    env.close()


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Compile the kernels of flow and tracking while the body runs, and wait; if the body fails they are given up."""
    with ExitStack() as started:
        processes = [
            started.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", f"from {__name__} import {work.__name__} as work; work()"],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
            for work in (compile_flow, compile_tracking)
        ]
        try:
            yield
        except BaseException:
            for process in processes:
                process.kill()
            raise
        if failed := [str(code) for process in processes if (code := process.wait())]:
            complain(
                f"kernels could not be compiled ahead (exit code {', '.join(failed)}): the first runs compile them"
            )


# The whole way on rendered sequences: trackers through environments in processes of their own, then the report.

DEFAULT_PROTOCOL = "tum-rgbd/v1"
STUDIED = "emfoa-oft?masks=none"
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
    render({instance.sequence for instance in spec.instances(*spec.tune, *spec.held_out)})
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
    from dynslam_bench.reports.model.load import load_runs

    return make_board(load_runs([store], get_protocol(DEFAULT_PROTOCOL)).rows)


def leaderboard_text(board: Board) -> str:
    """The leaderboard and the errors by sequence, as aligned text without the captions of the page."""
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports.tables.errors import per_sequence
    from dynslam_bench.reports.tables.leaderboard import leaderboard

    chosen = get_protocol(DEFAULT_PROTOCOL)
    parts = []
    for table in (leaderboard(board, chosen).displayed(), per_sequence(board, chosen).displayed()):
        rows = [[column.name for column in table.columns]]
        rows += [[f"{cell.text} {cell.small}".strip() for cell in row] for row in table.rows]
        parts.append(f"{table.title}\n{aligned(rows)}")
    return "\n\n".join([*parts, f"Protocol: {chosen.describe()}"])
