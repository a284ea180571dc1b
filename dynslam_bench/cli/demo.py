"""The demonstration: rendered sequences, runs, a report and a small study, with its expected time and its result."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from dynslam_bench.cli.output import aligned, note, progress, warn, write
from dynslam_bench.cli.running import make_runs
from dynslam_bench.cli.studies import StudyBar, silence_optuna

if TYPE_CHECKING:
    from dynslam_bench.reports.model.board import Board
    from dynslam_bench.reports.model.row import RunRow
    from dynslam_bench.runs import RunRecord, RunStore
    from dynslam_bench.tuning import StudySpec

PROTOCOL = "tum-rgbd/v1"
STUDIED = "emfoa-oft?masks=none"
"""The tracker of the study: without masks, the flow alone decides what moves."""
TUNED = ("flow.budget", "flow.sweeps", "flow.min_correlation", "epipolar.threshold_px", "motion.threshold_px")
"""The settings of the study: the flow's search, and the thresholds of moving features."""
STUDY_SHARE, MIN_STUDY_FRAMES = 0.25, 20
"""Frames of a problem instance of the study, as a share of the runs' frames, and at least."""
STATIC, CULLING = "orb-slam2", {"mask-rcnn": "masks of people", "emfoa-oft": "masks, flow and depth tests"}
"""The tracker without culling, and those with it."""
MIN_FACTOR = 1.5
"""Single runs scatter by some 30 %: a smaller ratio of errors shows nothing."""
SEQUENCES, STUDY_SCENES, SINGLE_RUNS = 2, 6, 24
RENDER_S, START_S, REPORT_S, COMPILE_S = 0.12, 1.0, 15.0, 80.0
"""Processor seconds on our machine: of a rendered frame, a run's start, the pages, and compiling all kernels."""
TRACK_S, STUDIED_S = {"never-move": 0.015, STATIC: 0.035, "mask-rcnn": 0.13, "emfoa-oft": 0.16}, 0.09
"""Processor seconds of a tracked frame: in the runs, and in the study."""
PROBE_FRAMES, PROBE_S = 16, 0.075
"""Frames that `measure` renders, and processor seconds of one on the same machine."""
KERNEL_FRAMES, KERNEL_POINTS = 12, 64
"""Frames and points with which every kernel is used once: keyframes, bundle adjustment, all phases of the flow."""


@dataclass(frozen=True)
class DemoOutcome:
    """The results of the demonstration.

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
        frames: Frames of each sequence; problem instances of the study have a quarter of them.
        jobs: Runs at a time.
        trials: Trials of the study.

    Raises:
        DynslamError: The results or the cache folder cannot be written.
    """
    from dynslam_bench.api import report, tune
    from dynslam_bench.runs import RunStore
    from dynslam_bench.suites import load_suite

    store = RunStore(results)
    store.prepare()  # before the rendering: an unwritable folder is reported at once
    study_frames = max(MIN_STUDY_FRAMES, int(STUDY_SHARE * frames))
    write(estimate(frames, study_frames, trials, jobs, *measure(jobs)), now=True)
    specs = [
        spec.model_copy(update={"sequence": f"{spec.sequence}&frames={frames}", "frames": None})
        for spec in load_suite("demo").specs()
    ]
    with compiled_ahead():
        render({spec.sequence for spec in specs})
    records = make_runs(specs, store, jobs=jobs)
    note("making the report")
    paths = report(store.root, title="Demo: walking and sitting people, rendered")
    silence_optuna()
    spec = study_spec(study_frames, trials)
    render({instance.sequence for instance in spec.instances(*spec.tune, *spec.held_out)})
    with progress(f"study {spec.name}") as advance:
        bar = StudyBar(advance)
        study = tune(spec, results=store.root / "study", jobs=jobs, on_event=bar.event, on_run=bar.run, on_note=note)
    board = demo_board(store)
    return DemoOutcome(
        leaderboard_text(board),
        tell(board.rows, records),
        paths.html,
        study.summary.conclusion,
        study.page,
        len(records),
        sum(record.failed for record in records),
    )


def study_spec(frames: int, trials: int) -> StudySpec:
    """A study of the error, which does not depend on the machine's load, on three scenes, checked on three others."""
    from dynslam_bench.core.records import digest
    from dynslam_bench.runs.identity import source_fingerprint
    from dynslam_bench.trackers import TRACKERS
    from dynslam_bench.tuning import SpaceSpec, StudySpec

    code = digest([frames, source_fingerprint(TRACKERS.get(STUDIED))], 6)  # other code is another study
    return StudySpec(
        name=f"demo-{code}",
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

    return make_board(load_runs([store], get_protocol(PROTOCOL)).rows)


def leaderboard_text(board: Board) -> str:
    """The leaderboard and the errors by sequence, as aligned text."""
    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.reports.tables.leaderboard import per_sequence
    from dynslam_bench.reports.tables.leaderboard import leaderboard

    protocol = get_protocol(PROTOCOL)
    parts = []
    for table in (leaderboard(board, protocol).displayed(), per_sequence(board, protocol).displayed()):
        rows = [[column.name for column in table.columns]]
        rows += [[f"{cell.text} {cell.small}".strip() for cell in row] for row in table.rows]
        parts.append(f"{table.title}\n{aligned(rows)}")
    return "\n\n".join([*parts, f"Protocol: {protocol.describe()}"])


def measure(jobs: int) -> tuple[float, bool]:
    """Render a few frames, `jobs` at a time.

    Returns:
        The time of a job in units of that on our machine; and whether kernels had to be compiled.
    """
    from dynslam_bench.sequences.synthetic import open_synthetic
    from dynslam_bench.sequences.synthetic.kernels import shade_pixels

    kernel: Any = shade_pixels  # numba's attributes are in no annotation
    sequence = open_synthetic(f"synthetic/walking_xyz?frames={PROBE_FRAMES + 1}", None, threads=1)
    sequence[0]
    with ThreadPoolExecutor(jobs) as pool:
        began = time.perf_counter()
        list(pool.map(sequence.__getitem__, range(1, PROBE_FRAMES + 1)))
        took = time.perf_counter() - began
    return took * jobs / (PROBE_FRAMES * PROBE_S), bool(kernel.stats.cache_misses)


def estimate(frames: int, study_frames: int, trials: int, jobs: int, slowness: float, compiles: bool) -> str:
    """How long the demonstration takes, and what it does in that time.

    Args:
        frames: Of each sequence.
        study_frames: Of a problem instance of the study.
        trials: Of the study, trial 0 included.
        jobs: Runs at a time.
        slowness: See `measure`.
        compiles: Whether kernels have to be compiled.
    """
    rendered = SEQUENCES * frames + STUDY_SCENES * study_frames
    runs, study_runs = SEQUENCES * len(TRACK_S), SINGLE_RUNS + 3 * (trials - 2)
    seconds = rendered * RENDER_S + (runs + study_runs) * START_S + REPORT_S + COMPILE_S * compiles
    seconds += SEQUENCES * frames * sum(TRACK_S.values()) + study_runs * study_frames * STUDIED_S
    minutes = max(1, math.ceil(seconds * slowness / jobs / 60))
    return (
        f"about {minutes} minute{'s' * (minutes > 1)} at the speed at which this machine rendered {PROBE_FRAMES} "
        f"frames just now{', compiling included' * compiles}; {rendered} frames are rendered, {runs} runs "
        f"made, and {trials} trials of a study"
    )


def tell(rows: Iterable[RunRow], records: Sequence[RunRecord]) -> list[str]:
    """What the runs show: one sentence a sequence, the costs of culling, and the weight of single runs.

    Args:
        rows: The runs with their errors.
        records: The same runs, with their times.
    """
    errors: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.score_m is not None:
            errors.setdefault(row.sequence.id.partition("&")[0].rpartition("/")[2], {})[row.tracker.id] = row.score_m
    lines = [_sentence(name, e) for name, e in sorted(errors.items(), reverse=True) if STATIC in e]
    return [*lines, *_costs(records), "One run each shows, and proves nothing: `dynslam-bench bench dynamic` repeats."]


def _sentence(name: str, errors: dict[str, float]) -> str:
    """The effect of culling on one sequence; errors in metres by tracker."""
    people = next((word for word in ("walk", "sit") if name.startswith(word)), "")
    place = f"Where people {people} ({name})" if people else name
    text = f"{place}: {1e3 * errors[STATIC]:.1f} mm without culling ({STATIC})"
    culled = {key: errors[key] for key in CULLING if key in errors}
    if not culled:
        return f"{text}."
    factor = errors[STATIC] / min(culled.values())
    verdict = "Culling changes nothing that one run could show."
    if factor >= MIN_FACTOR:
        verdict = f"Culling makes the error {factor:.1f} times smaller."
    elif factor <= 1 / MIN_FACTOR:
        verdict = f"Culling makes the error {1 / factor:.1f} times larger."
    shown = [f"{1e3 * error:.1f} mm with {CULLING[key]} ({key})" for key, error in culled.items()]
    return f"{text}, {', '.join(shown)}. {verdict}"


def _costs(records: Sequence[RunRecord]) -> list[str]:
    """Processor time of the median frame: a mean would count compiling in a first run, a frame time other programs."""
    spent: dict[str, list[float]] = {}
    for record in records:
        times = record.timings.get("processor")
        if not record.failed and times is not None:
            spent.setdefault(record.tracker.id, []).append(1e3 * times.median_s)
    costs = [f"{mean(spent[name]):.0f} ms ({name})" for name in (STATIC, *CULLING) if name in spent]
    return [f"What it costs, in processor time of the median frame: {', '.join(costs)}."] if len(costs) > 1 else []


def compile_kernels() -> None:
    """Use all kernels once, so that they lie compiled beside their sources (or in the user's cache folder)."""
    from dynslam_bench.sequences.synthetic import open_synthetic

    open_synthetic("synthetic/walking_xyz?frames=2", None)[0]
    compile_flow()
    compile_tracking()


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
    points = (np.random.default_rng(0).random((KERNEL_POINTS, 2)) * size).astype(np.float32)
    flow.track(reference, target, points, guess=points)


def compile_tracking() -> None:
    """Use the kernels of features and of the map."""
    from dynslam_bench.envs import SlamEnv
    from dynslam_bench.testing import CornerSequence

    env = SlamEnv(CornerSequence(KERNEL_FRAMES), "orb-slam2")
    env.reset(seed=0)
    for _ in range(KERNEL_FRAMES - 1):
        env.step(env.neutral_action)
    env.close()


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Compile the kernels of flow and tracking in two processes while the body runs; stop them if the body fails.

    Two runs at a time would otherwise compile the same kernels twice.
    """
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import {work.__name__} as work; work()"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for work in (compile_flow, compile_tracking)
    ]
    try:
        yield
    except BaseException:
        for process in processes:
            process.kill()
            process.wait()
        raise
    if failed := [str(code) for process in processes if (code := process.wait())]:
        warn(f"kernels could not be compiled ahead (exit code {', '.join(failed)}): the first runs compile them")
