"""The frames of an episode so far, and the ``info`` of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Trajectory
from dynslam_bench.core import EvaluationError
from dynslam_bench.evaluation import OnlineSample, Protocol, evaluate
from dynslam_bench.geometry import se3

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
    reward: float = 0.0

    def __deepcopy__(self, memo: dict[int, Any]) -> FrameOutcome:
        """Itself: nothing changes it."""
        return self


@dataclass(eq=False)
class Episode:
    """The frames so far.

    Attributes:
        outcomes: One entry a frame, in order.
        lost_streak: Frames without a tracked pose in a row, up to the last one; an initialising tracker is not lost,
            and a dropped frame changes nothing.
        over: Whether the last step ended the episode.
        free_at: Seconds, when the tracker is done with the last frame; of `DropFrames`.
    """

    outcomes: list[FrameOutcome] = field(default_factory=list)
    lost_streak: int = 0
    over: bool = False
    free_at: float = 0.0

    def add(self, outcome: FrameOutcome) -> None:
        """Append a frame's outcome."""
        self.outcomes.append(outcome)
        if outcome.state != "dropped":
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


_ERRORS = {
    "pose_error_trans_m": "trans_m",
    "pose_error_rot_deg": "rot_deg",
    "frame_error_trans_m": "frame_trans_m",
    "frame_error_rot_deg": "frame_rot_deg",
}
"""Field of `OnlineSample` by its name in ``info``."""


def frame_info(outcome: FrameOutcome) -> dict[str, Any]:
    """Index, stamp, state and stats of a frame, its pose if it was tracked, its errors where they are defined.

    What the stage cache answered is no part of the stats: it differs between two episodes that are otherwise equal.
    """
    info: dict[str, Any] = {
        "frame_index": outcome.index,
        "timestamp": float(outcome.timestamp),
        "tracking_state": str(outcome.state),
        "stats": {name: value for name, value in outcome.stats.items() if name != "cached_stages"},
    }
    if outcome.T_world_cam is not None:
        info["pose"] = np.concatenate(se3.to_quaternion(outcome.T_world_cam))
    if outcome.error is not None:
        errors = {name: getattr(outcome.error, attribute) for name, attribute in _ERRORS.items()}
        info |= {name: float(value) for name, value in errors.items() if value is not None}
    return info


def fixed_info(info: Mapping[str, Any], protocol: Protocol) -> dict[str, Any]:
    """The same with every key that may be missing: 0 with a flag ``has_<key>`` that is False.

    Args:
        info: Of a step.
        protocol: Whose metrics are those of the episode.
    """
    fixed = dict(info) | {"protocol": protocol.id}
    missing: dict[str, Any] = {"pose": np.zeros(7)} | dict.fromkeys(_ERRORS, 0.0)
    metrics = info.get("episode_metrics", {})
    fixed["episode_metrics"] = _flagged(metrics, dict.fromkeys(metric_names(protocol), 0.0))
    return fixed | _flagged(info, missing)


def _flagged(given: Mapping[str, Any], missing: Mapping[str, Any]) -> dict[str, Any]:
    values = {name: given.get(name, nothing) for name, nothing in missing.items()}
    return values | {f"has_{name}": name in given for name in missing}


@cache
def metric_names(protocol: Protocol) -> tuple[str, ...]:
    """The metrics that an episode may have: those of a long path and of a camera that stands still."""
    stamps = np.arange(2000) / 30.0
    turns = np.stack([0.0 * stamps, 0.1 * np.sin(stamps), 0.0 * stamps], axis=1)
    moving = np.concatenate([np.stack([np.cos(stamps), np.sin(stamps), stamps], axis=1) * 40.0, turns], axis=1)
    names = ["coverage", "frames", "tracked_frames"]
    for twists in (moving, np.zeros_like(moving)):
        poses = se3.exp(twists)
        try:
            names += evaluate(
                Trajectory(stamps, poses), Trajectory(stamps, poses), protocol, input_timestamps=stamps
            ).metrics
        except EvaluationError:  # the protocol cannot align a camera that stands still
            continue
    return tuple(dict.fromkeys(names))
