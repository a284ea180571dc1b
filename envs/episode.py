"""One episode: its frames, tracking one of them, the ``info`` of a step, and the metrics at the end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Sequence, Tracker, TrackResult, Trajectory
from dynslam_bench.contracts.checks import check_frame, check_result, tracker_code
from dynslam_bench.core.errors import DynslamError, EvaluationError, SequenceError
from dynslam_bench.evaluation import OnlineSample, Protocol, evaluate
from dynslam_bench.evaluation.prepare import tracked_frames
from dynslam_bench.geometry import se3

FrameState = Literal["initialising", "ok", "lost", "dropped"]
FrameTransform = Callable[[Frame], Frame]


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

    def trajectory(self) -> Trajectory:
        """The online trajectory: the poses of the frames with state ``ok``, each as it was when the frame came."""
        tracked = [(o.timestamp, o.T_world_cam) for o in self.outcomes if o.T_world_cam is not None]
        stamps = np.array([stamp for stamp, _ in tracked], dtype=np.float64)
        poses = np.array([pose for _, pose in tracked], dtype=np.float64).reshape(-1, 4, 4)
        return Trajectory(stamps, poses)


def track_one(
    tracker: Tracker, name: str, sequence: Sequence, index: int, transforms: Iterable[FrameTransform]
) -> tuple[Frame, TrackResult, dict[str, float]]:
    """Read a frame and track it.

    Args:
        tracker: The tracker.
        name: Its id, for messages.
        sequence: Where the frame comes from.
        index: Which one.
        transforms: Applied in order before the tracker gets it.

    Returns:
        The transformed frame, the checked result, and the times (see `FrameOutcome.timings`).

    Raises:
        SequenceError: The frame cannot be read, or does not fit the sequence's camera.
        TrackerContractError: The tracker broke its contract.
    """
    began = time.perf_counter()
    frame = _read_frame(sequence, index)
    for transform in transforms:
        frame = transform(frame)
    read, processor_began = time.perf_counter(), time.process_time()
    with tracker_code():
        result = tracker.track(frame)
    total, processor = time.perf_counter() - read, time.process_time() - processor_began
    result = check_result(result, frame, name)
    if result.stats.get("cached_stages"):  # the stages report their times without the cache
        uncached = max(total, sum(result.timings.values()))
        total, processor = uncached, processor + uncached - total
    stages = {stage: float(seconds) for stage, seconds in result.timings.items()}
    measured = {"read": read - began, "total": total, "processor": processor}
    return frame, result, measured | {name: value for name, value in stages.items() if name not in measured}


def _read_frame(sequence: Sequence, index: int) -> Frame:
    """A frame that fits the sequence's camera; any error in reading it becomes a `SequenceError`."""
    try:
        frame = sequence[index]
        check_frame(frame, sequence.camera)
    except MemoryError:
        raise
    except Exception as error:  # a data set of the user's may raise anything
        ours = isinstance(error, DynslamError)
        fault = error.args[0] if ours else f"{type(error).__name__}: {error}".rstrip(": ")
        hint = getattr(error, "hint", "") if ours else ""
        raise SequenceError(f"frame {index} of '{sequence.id}' cannot be read: {fault}", hint) from error
    return frame


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
    error = outcome.error
    if error is not None:
        errors = {
            "pose_error_trans_m": error.trans_m,
            "pose_error_rot_deg": error.rot_deg,
            "frame_error_trans_m": error.frame_trans_m,
            "frame_error_rot_deg": error.frame_rot_deg,
        }
        info |= {name: float(value) for name, value in errors.items() if value is not None}
    return info


def episode_metrics(
    protocol: Protocol,
    trajectory: Trajectory,
    timestamps: NDArray[np.float64],
    ground_truth: Trajectory | None,
) -> dict[str, float]:
    """The metrics of an episode under a protocol: plain floats by name, without undefined ones.

    Args:
        protocol: How to evaluate.
        trajectory: Poses of the tracked frames, online or final; coverage is that of this trajectory.
        timestamps: Stamps in seconds of all frames that were due, tracked or not.
        ground_truth: True poses; None leaves only the coverage and the counts.

    Returns:
        ``coverage``, ``frames``, ``tracked_frames`` and the metrics of `evaluate` (``ate_rmse_m``, ...); these are
        missing if there is no ground truth or the protocol finds nothing to evaluate.
    """
    frames = len(timestamps)
    try:
        tracked = int(tracked_frames(trajectory, timestamps).sum())
    except EvaluationError:  # a final trajectory whose stamps are of no frame
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
