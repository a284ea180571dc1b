"""``demo``: rendered sequences, runs, a report and a small study; all steps on a fresh machine."""

from __future__ import annotations

import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynslam_bench.cli.options import Jobs, Results
from dynslam_bench.cli.output import (
    SOME_RUNS_FAILED,
    announce,
    note,
    progress,
    report_table,
    wrapped,
    write,
)
from dynslam_bench.cli.running import WatchedRuns
from dynslam_bench.cli.studies import StudyBar, silence_optuna
from dynslam_bench.core import find_data_root, write_atomic
from dynslam_bench.core.folders import kernel_files
from dynslam_bench.core.number_text import mm
from dynslam_bench.core.plugins import python_command

if TYPE_CHECKING:
    from dynslam_bench.api import StudyResult
    from dynslam_bench.reports import ReportPaths, RunRow
    from dynslam_bench.runs import RunStore
    from dynslam_bench.tuning import StudySpec

PROTOCOL = "tum-rgbd/v1"
STUDIED = "mask-rcnn"
"""The tracker of the study."""
UNDILATED = (
    "# masks that are not grown: wrong on purpose\n[settings]\nsegmentation.dilation_px = 0\n"
)
"""The baseline of the study: features at the edges of people stay, so there is something to find."""
TUNED = ("segmentation.dilation_px",)
"""The setting of the study."""
MASKS = "oracle-classes"
"""The masks of the study: exact ones, so that no network runs on its 240 frames."""
STUDY_SHARE = 0.5
"""Frames of a problem instance of the study, as a share of the runs' frames."""
MIN_STUDY_FRAMES = 20
"""Frames of a problem instance of the study at least."""
STATIC = "orb-slam2"
"""The tracker without culling."""
CULLING = {"mask-rcnn": "masks of people", "emfoa-oft": "masks, flow and depth tests"}
"""The trackers with culling, and by what they cull."""
MIN_FACTOR = 1.5
"""Single runs scatter by some 30 %: a smaller ratio of errors shows nothing."""
COMPILED = "emfoa-oft?masks=none"
"""The tracker whose kernels are compiled ahead: it uses those of all others, too."""
BAR_S = 1.0
"""The bar of the compilation moves this often."""
KERNEL_FRAMES = 12
"""Frames in which every kernel is used once: keyframes, bundle adjustment, all phases of the flow."""


def demo(
    results: Results = Path("results"),
    frames: Annotated[int, typer.Option(min=20, help="Frames of each sequence.")] = 60,
    jobs: Jobs = 2,
    trials: Annotated[int, typer.Option(min=2, help="Trials of the small study.")] = 5,
) -> None:
    """Run trackers on rendered sequences, report them, tune one: all steps, with no download."""
    from functools import partial

    from dynslam_bench.api import report, run_specs
    from dynslam_bench.runs import RunStore
    from dynslam_bench.suites import load_suite

    store = RunStore(results)
    store.prepare()  # before the rendering: an unwritable folder is reported at once

    # what is run, and what is tuned
    specs = [
        spec.model_copy(update={"sequence": f"{spec.sequence}&frames={frames}", "frames": None})
        for spec in load_suite("demo").specs(snapshots=True)
    ]
    baseline = store.root / "study" / "undilated.toml"
    write_atomic(baseline, UNDILATED)
    study = study_spec(max(MIN_STUDY_FRAMES, int(STUDY_SHARE * frames)), trials, baseline)
    write(
        f"{len(specs)} runs of {frames} frames, and a study of {trials} trials: about three minutes on two cores"
    )

    # render while the kernels are compiled, then track
    with compiled_ahead():
        render({spec.sequence for spec in specs})
    made = WatchedRuns(store, jobs, PROTOCOL).make(
        partial(run_specs, specs, results=store.root, jobs=jobs)
    )

    note("making the report")
    paths = report(store.root, title="Demo: walking people and a balloon, rendered")

    tuned = tune_small_study(study, store.root / "study", jobs)
    show_outcome(store, paths, tuned)
    if any(run.record.failed for run in made):
        raise typer.Exit(SOME_RUNS_FAILED)


def tune_small_study(study: StudySpec, results: Path, jobs: int) -> StudyResult:
    """Render the study's own scenes, and tune on them with a bar on standard error."""
    from dynslam_bench.api import tune

    silence_optuna()
    instances = study.instances(*study.tune, *study.confirm, *study.held_out)
    render({instance.sequence for instance in instances})
    with progress(f"study {study.name}") as advance:
        bar = StudyBar(advance)
        return tune(
            study,
            results=results,
            jobs=jobs,
            on_event=bar.event,
            on_run=bar.run,
            on_note=note,
        )


def show_outcome(store: RunStore, paths: ReportPaths, tuned: StudyResult) -> None:
    """Print the tables, sentences on them, and where the pages lie.

    Args:
        store: Where the runs are stored.
        paths: The report.
        tuned: The study.
    """
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports import load_board
    from dynslam_bench.reports.tables.leaderboard import per_sequence

    # the leaderboard, and every sequence
    board = load_board(store)
    protocol = get_protocol(PROTOCOL)
    for table in (paths.leaderboard, per_sequence(board, protocol)):
        write(f"\n{table.title}\n{report_table(table)}")
    write(f"\nProtocol: {protocol.describe()}\n")

    # what they show, and what the study found
    conclusion = (
        f"The study, whose baseline does not grow its masks, on purpose: {tuned.summary.conclusion}"
    )
    for line in (*culling_effect(board.rows), conclusion):
        write(wrapped(line))

    # where to look further
    write(f"\nreport: {paths.html}\nstudy:  {tuned.page}")
    write("next:   dynslam-bench run 'emfoa-oft?masks=none' FOLDER --camera tum-fr3")


def study_spec(frames: int, trials: int, baseline: Path) -> StudySpec:
    """A study of the error, which does not depend on the machine's load, on two scenes, judged on six others."""
    from dynslam_bench.core.records import digest
    from dynslam_bench.runs.own_code import package_code
    from dynslam_bench.tuning import SpaceSpec, StudySpec

    code = digest([frames, package_code()], 6)  # other code is another study
    return StudySpec(
        name=f"demo-{code}",
        tracker=STUDIED,
        baseline=str(baseline),
        tune=(f"synthetic/walking_xyz?scene=1-2&frames={frames}",),
        held_out=(f"synthetic/walking_xyz?scene=101-106&frames={frames}",),
        recorded=(),
        objectives=("accuracy",),
        space=SpaceSpec(include=TUNED, fixed={"segmentation.source": MASKS}),
        offsets=(0,),
        trials=trials,
        top=1,
        min_coverage=0.9,
    )


def render(sequences: set[str]) -> None:
    """Render sequences ahead of the runs, so that no run waits for another's frames."""
    from dynslam_bench.sequences.synthetic import render_synthetic

    for name in sorted(sequences):
        with progress(f"rendering {name}") as advance:
            render_synthetic(name, find_data_root(None), progress=advance)


def culling_effect(rows: Iterable[RunRow]) -> list[str]:
    """Sentences on the effect of culling, one a sequence, and on the weight of single runs."""
    # errors in metres by sequence and tracker; a name is `walking_xyz?scene=1`, without the frames
    errors: dict[str, dict[str, float]] = defaultdict(dict)
    for row in rows:
        if row.score_m is not None:
            name = row.sequence.id.partition("&")[0].rpartition("/")[2]
            errors[name][row.tracker.id] = row.score_m

    lines = []
    for name, by_tracker in sorted(errors.items(), reverse=True):
        culled = {tracker: by_tracker[tracker] for tracker in CULLING if tracker in by_tracker}
        if STATIC not in by_tracker or not culled:
            continue
        # the error without culling is so many times that of the best tracker with it
        factor = by_tracker[STATIC] / min(culled.values())
        verdict = "Culling changes nothing that one run could show."
        if factor >= MIN_FACTOR:
            verdict = f"Culling makes the error {factor:.1f} times smaller."
        elif factor <= 1 / MIN_FACTOR:
            verdict = f"Culling makes the error {1 / factor:.1f} times larger."
        shown = [
            f"{mm(error)} mm with {CULLING[tracker]} ({tracker})"
            for tracker, error in culled.items()
        ]
        without = f"{mm(by_tracker[STATIC])} mm without culling ({STATIC})"
        lines.append(f"{name}: {without}, {', '.join(shown)}. {verdict}")
    return [
        *lines,
        "One run each shows, and proves nothing: `dynslam-bench bench dynamic` repeats.",
    ]


def compile_kernels(tracker: str = COMPILED, *, rendering: bool = True) -> None:
    """Use all kernels of a tracker once: then they lie compiled in the user's cache.

    Args:
        tracker: Its id.
        rendering: Whether those of the renderer are used, too.
    """
    from dynslam_bench.envs.slam_env import SlamEnv
    from dynslam_bench.sequences.synthetic import open_synthetic
    from dynslam_bench.testing import CornerSequence

    if rendering:
        open_synthetic("synthetic/walking_xyz?frames=2", None)[0]
    env = SlamEnv(CornerSequence(KERNEL_FRAMES), tracker)
    env.reset(seed=0)
    for _ in range(KERNEL_FRAMES - 1):
        env.step(env.neutral_action)


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Compile the trackers' kernels in a process while the body renders; stop it if the body fails.

    Two runs at a time would otherwise compile the same kernels twice. Kernels that cannot be
    compiled here are left to the first runs; a line says so.
    """
    command = python_command(
        f"from {__name__} import compile_kernels; compile_kernels(rendering=False)"
    )
    with (
        tempfile.TemporaryFile("w+", errors="replace") as log,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log) as process,
    ):
        before = set(kernel_files())
        try:
            yield
            with progress("compiling kernels, once") as advance:
                while not _has_ended(process):
                    advance(len(set(kernel_files()) - before), None)
        finally:
            process.kill()
        if process.returncode:
            log.seek(0)
            last = log.read().strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
            announce(f"kernels were not compiled ahead, so the first runs do it: {last[0]}")


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Wait for a process, for `BAR_S` at most; returns whether it has ended."""
    try:
        process.wait(BAR_S)
    except subprocess.TimeoutExpired:
        return False
    return True
