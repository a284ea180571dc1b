"""One frame through the tracker, timed and checked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dynslam_bench.contracts.checks import check_frame, check_result, tracker_code
from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.contracts.tracker import Tracker
from dynslam_bench.core.errors import DynslamError, SequenceError

FrameTransform = Callable[[Frame], Frame]


@dataclass(frozen=True, eq=False)
class TimedResult:
    """What became of a frame.

    Attributes:
        frame: The frame as the tracker saw it.
        result: The tracker's checked result.
        timings: Seconds: ``read``, ``total``, ``processor`` and the tracker's stages (see `FrameOutcome`).
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
        SequenceError: The frame cannot be read, or is none of the sequence's camera.
        TrackerContractError: The tracker broke its contract.
    """
    began = time.perf_counter()
    frame = read_frame(sequence, index)
    for transform in transforms:
        frame = transform(frame)
    read, worked = time.perf_counter(), time.process_time()
    with tracker_code():
        result = tracker.track(frame)
    total, processor = time.perf_counter() - read, time.process_time() - worked
    result = check_result(result, frame, name)
    if result.stats.get("cached_stages"):  # the stages report what they cost without the cache
        uncached = max(total, sum(result.timings.values()))
        total, processor = uncached, processor + uncached - total
    own = {"read": read - began, "total": total, "processor": processor}
    stages = {stage: float(seconds) for stage, seconds in result.timings.items() if stage not in own}
    return TimedResult(frame, result, own | stages)


def read_frame(sequence: Sequence, index: int) -> Frame:
    """A frame, whatever raises while it is read, and only if it is one of the sequence's camera.

    Raises:
        SequenceError: Names the frame, the fault and the cure.
    """
    try:
        frame = sequence[index]
        check_frame(frame, sequence.camera)
    except MemoryError:
        raise
    except Exception as error:  # a data set of the user's may raise anything
        words, hint = (error.args[0], error.hint) if isinstance(error, DynslamError) else (_named(error), "")
        raise SequenceError(f"frame {index} of '{sequence.id}' cannot be read: {words}", hint) from error
    return frame


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")
