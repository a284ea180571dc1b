"""One frame through the tracker, timed and checked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dynslam_bench.contracts.checks import check_result
from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.contracts.tracker import Tracker

FrameTransform = Callable[[Frame], Frame]


@dataclass(frozen=True, eq=False)
class TimedResult:
    """What became of a frame.

    Attributes:
        frame: The frame as the tracker saw it.
        result: The tracker's checked result.
        timings: Seconds: ``read``, ``total`` and the tracker's stages (see `FrameOutcome`).
    """

    frame: Frame
    result: TrackResult
    timings: dict[str, float]


def track_one(
    tracker: Tracker, name: str, sequence: Sequence, index: int, transforms: Iterable[FrameTransform]
) -> TimedResult:
    """Read a frame and track it.

    Args:
        tracker: Who tracks.
        name: The tracker's id, for messages.
        sequence: Where the frame comes from.
        index: Which one.
        transforms: Applied in order before the tracker sees it.

    Raises:
        TrackerContractError: The tracker broke its contract.
    """
    began = time.perf_counter()
    frame = sequence[index]
    for transform in transforms:
        frame = transform(frame)
    read = time.perf_counter()
    result = tracker.track(frame)
    total = time.perf_counter() - read
    result = check_result(result, frame, name)
    if result.stats.get("cached_stages"):  # the stages report what they cost without the cache
        total = max(total, sum(result.timings.values()))
    own = {"read": read - began, "total": total}
    stages = {stage: float(seconds) for stage, seconds in result.timings.items() if stage not in own}
    return TimedResult(frame, result, own | stages)
