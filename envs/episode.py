"""What an environment remembers of the episode that runs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.checks import check_frame, check_result, tracker_code
from dynslam_bench.contracts.sequence import Frame, Sequence
from dynslam_bench.contracts.tracker import Tracker, TrackResult
from dynslam_bench.core.errors import DynslamError, EvaluationError, SequenceError
from dynslam_bench.evaluation.evaluate import evaluate
from dynslam_bench.evaluation.online import OnlineSample
from dynslam_bench.evaluation.prepare import tracked_frames
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

FrameState = Literal["initialising", "ok", "lost", "dropped"]


@dataclass(frozen=True, eq=False)
class FrameOutcome:
    """One frame of the episode.

    Attributes:
        index: Index of the frame in the sequence (after `frames` and `stride`).
        timestamp: Seconds.
        state: The tracker's state, or ``dropped`` if the frame never reached it.
        T_world_cam: Tracked pose ``[4, 4]``; None unless the state is ``ok``.
        stats: The tracker's diagnostics.
        timings: Seconds: ``read`` (decoding or rendering), ``total`` (the tracker's step, segmentation included,
            reading excluded), ``processor`` (processor time of this process in that step, all threads together; what a
            foreign program or a GPU does is no part of it) and the tracker's stages.
        error: Causal errors against the ground truth; None where there is none.
        reward: What the frame earned.
    """

    index: int
    timestamp: float
    state: FrameState
    T_world_cam: NDArray[np.float64] | None
    stats: Mapping[str, float]
    timings: Mapping[str, float]
    error: OnlineSample | None
    reward: float


@dataclass(eq=False)
class Episode:
    """The frames so far.

    Attributes:
        outcomes: One entry a frame, in order.
        lost_streak: Frames without a tracked pose in a row, up to the last one; an initialising tracker is not lost.
        over: Whether the last step ended the episode.
    """

    outcomes: list[FrameOutcome] = field(default_factory=list)
    lost_streak: int = 0
    over: bool = False

    def add(self, outcome: FrameOutcome) -> None:
        """Append a frame's outcome."""
        self.outcomes.append(outcome)
        self.lost_streak = self.lost_streak + 1 if outcome.state == "lost" else 0

    @property
    def next_index(self) -> int:
        """Index of the frame that comes next."""
        return len(self.outcomes)

    @property
    def tracked(self) -> int:
        """How many frames have state ``ok``."""
        return sum(outcome.state == "ok" for outcome in self.outcomes)

    def trajectory(self) -> Trajectory:
        """The online trajectory: the poses of the frames with state ``ok``, each as it was when the frame came."""
        tracked = [(o.timestamp, o.T_world_cam) for o in self.outcomes if o.T_world_cam is not None]
        stamps = np.array([stamp for stamp, _ in tracked], dtype=np.float64)
        poses = np.array([pose for _, pose in tracked], dtype=np.float64).reshape(-1, 4, 4)
        return Trajectory(stamps, poses)


# One frame through the tracker, timed and checked.

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


# What an environment tells of a frame: the ``info`` of `reset` and `step`.


def frame_info(outcome: FrameOutcome) -> dict[str, Any]:
    """Index, stamp, state and stats of a frame, its pose if it was tracked, its errors where they are defined."""
    info: dict[str, Any] = {
        "frame_index": outcome.index,
        "timestamp": float(outcome.timestamp),
        "tracking_state": str(outcome.state),
        "stats": dict(outcome.stats),
    }
    if outcome.T_world_cam is not None:
        info["pose"] = np.concatenate(se3.to_quaternion(outcome.T_world_cam))
    return info | _defined(outcome.error)


def _defined(error: OnlineSample | None) -> dict[str, float]:
    if error is None:
        return {}
    named = {
        "pose_error_trans_m": error.trans_m,
        "pose_error_rot_deg": error.rot_deg,
        "frame_error_trans_m": error.frame_trans_m,
        "frame_error_rot_deg": error.frame_rot_deg,
    }
    return {name: float(value) for name, value in named.items() if value is not None}


# The metrics of an episode under a protocol.


def episode_metrics(
    protocol: Protocol,
    trajectory: Trajectory,
    timestamps: NDArray[np.float64],
    ground_truth: Trajectory | None,
) -> dict[str, float]:
    """Plain floats by name; what is not defined is left out.

    Args:
        protocol: How to evaluate.
        trajectory: Poses of the tracked frames, online or final: coverage is that of what is scored.
        timestamps: Stamps in seconds of all frames that were due, tracked or not.
        ground_truth: True poses; None leaves only the coverage and the counts.

    Returns:
        ``coverage``, ``frames``, ``tracked_frames`` and the metrics of `evaluate` (``ate_rmse_m``, ...); these are
        missing if there is no ground truth or the protocol finds nothing to evaluate.
    """
    frames = len(timestamps)
    try:
        tracked = int(tracked_frames(trajectory, timestamps).sum())
    except EvaluationError:  # a final trajectory whose poses are of no frame
        tracked = 0
    counts = {
        "coverage": tracked / frames if frames else 0.0,
        "frames": float(frames),
        "tracked_frames": float(tracked),
    }
    if ground_truth is None:
        return counts
    try:
        evaluation = evaluate(trajectory, ground_truth, protocol, input_timestamps=timestamps)
    except EvaluationError:  # too little was tracked; the coverage says so
        return counts
    return counts | {name: float(value) for name, value in evaluation.metrics.items() if math.isfinite(value)}
