"""What the demonstration will take, and what it showed, in sentences that its own numbers make."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import mean
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.reports.model.row import RunRow
    from dynslam_bench.runs import RunRecord

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
    from dynslam_bench.sequences.synthetic.kernels.raycast import shade_pixels

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
            errors.setdefault(row.sequence.partition("&")[0].rpartition("/")[2], {})[row.tracker] = row.score_m
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
