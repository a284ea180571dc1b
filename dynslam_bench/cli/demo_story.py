"""What the demonstration will take, and what it showed, in sentences that its own numbers make."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import mean
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dynslam_bench.reports.model.row import RunRow
    from dynslam_bench.runs import RunRecord

PLAIN, CULLING = "orb-slam2", {"mask-rcnn": "masks of people", "emfoa-oft": "masks, flow and depth tests"}
TELLING = 1.5
"""Single runs scatter by some thirty per cent: a smaller factor shows nothing."""
SEQUENCES, STUDY_SCENES, SINGLE_RUNS = 2, 6, 24
RENDER_S, START_S, REPORT_S = 0.12, 1.0, 15.0
"""Processor seconds of a rendered frame, of a run's start, and of the pages, on a two-core machine."""
TRACK_S = {"never-move": 0.015, PLAIN: 0.035, "mask-rcnn": 0.13, "emfoa-oft": 0.16}
STUDIED_S = 0.09
"""Processor seconds of a frame, reading it included: of the runs, and of those of the study."""
COMPILE_S = 80.0
"""Processor seconds until all kernels are compiled."""


def estimate(frames: int, study_frames: int, trials: int, jobs: int) -> str:
    """How long the demonstration takes on a quiet machine, and what it does in that time.

    Args:
        frames: Of each sequence.
        study_frames: Of a block of the study.
        trials: Of the study, trial 0 included.
        jobs: Runs at a time.
    """
    rendered = SEQUENCES * frames + STUDY_SCENES * study_frames
    runs = SEQUENCES * len(TRACK_S)
    studied = SINGLE_RUNS + 3 * (trials - 2)
    seconds = rendered * RENDER_S + (runs + studied) * START_S + REPORT_S
    seconds += SEQUENCES * frames * sum(TRACK_S.values()) + studied * study_frames * STUDIED_S
    minutes, first = (max(1, math.ceil(each / max(jobs, 1) / 60)) for each in (seconds, seconds + COMPILE_S))
    machine = f"{jobs} quiet core{'s' * (jobs != 1)}"
    return (
        f"about {minutes} minute{'s' * (minutes > 1)} on {machine}, {first} when it first compiles; "
        f"{rendered} frames are rendered, {runs} runs made, and {trials} trials of a study"
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
    """Milliseconds of the median frame, of systems that ran; a mean would count the compiling of a first run."""
    spent: dict[str, list[float]] = {}
    for record in records:
        if not record.failed and record.frame_time_s is not None and record.tracker.id in (PLAIN, *CULLING):
            spent.setdefault(record.tracker.id, []).append(1e3 * record.frame_time_s)
    costs = [f"{mean(spent[name]):.0f} ms ({name})" for name in (PLAIN, *CULLING) if name in spent]
    return [f"What it costs, at the median frame: {', '.join(costs)}."] if len(costs) > 1 else []
