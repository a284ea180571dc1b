"""The frames of an episode so far, the ``info`` of one, and its reward, by name or as a callable of the user's."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Trajectory
from dynslam_bench.core import EvaluationError, SettingsError
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.geometry import se3

if TYPE_CHECKING:
    from dynslam_bench.evaluation import OnlineSample, Protocol

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
        timings: Seconds: ``read`` (decoding or rendering), ``total`` (the tracker's step,
            segmentation included, reading excluded), ``processor`` (processor time of this process
            in that step, all threads together; what a foreign program or a GPU does is no part of
            it) and the tracker's stages.
        error: Causal errors against the ground truth; None where there is none.
        reward: What the frame earned.
        motion_covariance: What the tracker gave, see `TrackResult`; None where it gave none.
    """

    index: int
    timestamp: float
    state: FrameState
    T_world_cam: NDArray[np.float64] | None
    stats: Mapping[str, float]
    timings: Mapping[str, float]
    error: OnlineSample | None
    reward: float = 0.0
    motion_covariance: NDArray[np.float64] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> FrameOutcome:
        """Itself: nothing changes it."""
        return self


@dataclass(eq=False)
class Episode:
    """The frames so far.

    Attributes:
        outcomes: One entry a frame, in order.
        lost_streak: Frames without a tracked pose in a row, up to the last one; an initialising
            tracker is not lost, and a dropped frame changes nothing.
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
        tracked = [outcome for outcome in self.outcomes if outcome.T_world_cam is not None]
        stamps = np.array([outcome.timestamp for outcome in tracked], dtype=np.float64)
        poses = np.array([outcome.T_world_cam for outcome in tracked], dtype=np.float64)
        poses = poses.reshape(-1, 4, 4)
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

    What the stage cache answered is no part of the stats: it differs between two episodes that are
    otherwise equal.
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
    """The ``info`` of a step with every key that may be missing: 0 with a flag ``has_<key>`` that is False.

    Args:
        info: The ``info`` dictionary of a step.
        protocol: Protocol of the episode's metrics.
    """
    missing: dict[str, Any] = {"pose": np.zeros(7)} | dict.fromkeys(_ERRORS, 0.0)
    metrics = _flagged(info.get("episode_metrics", {}), dict.fromkeys(metric_names(protocol), 0.0))
    return {**info, "protocol": protocol.id, "episode_metrics": metrics} | _flagged(info, missing)


def _flagged(given: Mapping[str, Any], missing: Mapping[str, Any]) -> dict[str, Any]:
    """Values by name, those of `missing` where none is given, with a flag ``has_<name>`` for each."""
    values = {name: given.get(name, nothing) for name, nothing in missing.items()}
    return values | {f"has_{name}": name in given for name in missing}


@cache
def metric_names(protocol: Protocol) -> tuple[str, ...]:
    """The metrics that an episode may have: those of a long path and of a camera that stands still."""
    from dynslam_bench.evaluation import evaluate

    # twists [2000, 6] of a long path at 30 Hz: translations along a helix, and turns
    stamps = np.arange(2000) / 30.0
    helix = np.stack([np.cos(stamps), np.sin(stamps), stamps], axis=1) * 40.0
    turns = np.stack([0.0 * stamps, 0.1 * np.sin(stamps), 0.0 * stamps], axis=1)
    moving = np.concatenate([helix, turns], axis=1)
    names = ["coverage", "frames", "tracked_frames"]
    for twists in (moving, np.zeros_like(moving)):
        path = Trajectory(stamps, se3.exp(twists))
        with suppress(EvaluationError):  # the protocol cannot align a camera that stands still
            names += evaluate(path, path, protocol, input_timestamps=stamps).metrics
    return tuple(dict.fromkeys(names))


# Rewards: what the newest frame of an episode earns.

Reward = Callable[[Episode], float]
"""Reward of the newest frame of an episode, in metres."""
Cost = Literal["network_calls", "keypoints", "processor_s"]
RewardKind = Literal["neg_rpe", "neg_pose_error", "neg_window_error", "accuracy_minus_cost"]


def neg_rpe(episode: Episode) -> float:
    """Minus the translational error of the motion since the previous frame, metres."""
    error = episode.outcomes[-1].error
    if error is None:
        return 0.0
    # of a frame without a pose this is the true motion: it counts as not having moved
    motion_error_m = error.frame_trans_m or 0.0
    if not error.tracked:
        return -2.0 * motion_error_m
    # the way of the lost frames was charged already
    return -max(motion_error_m - error.lost_way_m, 0.0)


def neg_pose_error(episode: Episode) -> float:
    """Minus the causal translational pose error, at most the length of the true path so far, metres."""
    error = episode.outcomes[-1].error
    if error is None:
        return 0.0
    return -min(error.trans_m, error.path_length_m) if error.tracked else -error.path_length_m


@names_wrong_arguments
@dataclass(frozen=True)
class NegWindowError:
    """Minus the translational error of the motion over the last `frames` frames, metres.

    Drift that hides in the noise of one frame shows. Both ends need ground truth; the window is
    shorter where the episode is. A frame without a tracked pose counts as standing at the last one.

    Attributes:
        frames: Length of the window.
    """

    frames: int = 30

    def __post_init__(self) -> None:
        if operator.index(self.frames) < 1:
            raise SettingsError(f"a window has {self.frames} frames", "give 1 or more")

    def __call__(self, episode: Episode) -> float:
        """Reward of the newest frame."""
        now = episode.outcomes[-1].error
        before = episode.outcomes[-1 - self.frames :][0].error
        if now is None or before is None:
            return 0.0
        # motion over the window, from the camera before to the camera now
        T_true = se3.inverse(before.T_world_true) @ now.T_world_true
        T_estimated = se3.inverse(before.T_world_held) @ now.T_world_held
        error = se3.inverse(T_true) @ T_estimated
        return -float(np.linalg.norm(error[:3, 3]))


@names_wrong_arguments
@dataclass(frozen=True)
class AccuracyMinusCost:
    """``neg_rpe`` minus what the frame cost.

    Attributes:
        weight: Metres that one unit of the cost counts as on the episode's first frame.
        cost: ``network_calls``: 1 where the segmentation network ran (``segmented`` of the
            tracker's stats); ``keypoints``: thousands of extracted keypoints (``keypoints``), which
            processor time grows with; both are the same on every machine. ``processor_s``: seconds
            of processor time, which differ from run to run.
        growth: Share of `weight` that is added to it with every frame: the budget of a frame falls.
    """

    weight: float = 0.001
    cost: Cost = "network_calls"
    growth: float = 0.0

    def __post_init__(self) -> None:
        if self.cost not in get_args(Cost):
            raise SettingsError(
                f"unknown cost '{self.cost}'", f"choose {', '.join(get_args(Cost))}"
            )
        if not math.isfinite(self.weight * self.growth):
            raise SettingsError(
                f"weight {self.weight} and growth {self.growth} are no finite numbers"
            )

    def __call__(self, episode: Episode) -> float:
        """Reward of the newest frame."""
        return neg_rpe(episode) - self.charge(episode.outcomes[-1])

    def charge(self, outcome: FrameOutcome) -> float:
        """Metres that a frame's cost counts as; the weight grows with the frame's index."""
        return self.weight * (1.0 + self.growth * outcome.index) * self.cost_of(outcome)

    def cost_of(self, outcome: FrameOutcome) -> float:
        """Cost of a frame: network calls, thousands of keypoints, or seconds of the processor."""
        costs: dict[Cost, float] = {
            "network_calls": outcome.stats.get("segmented", 0.0),
            "keypoints": outcome.stats.get("keypoints", 0.0) / 1000.0,
            "processor_s": outcome.timings.get("processor", 0.0),
        }
        return costs[self.cost]


REWARDS: dict[str, Reward] = {
    "neg_rpe": neg_rpe,
    "neg_pose_error": neg_pose_error,
    "neg_window_error": NegWindowError(),
    "accuracy_minus_cost": AccuracyMinusCost(),
}
"""Reward in metres of a frame that has ground truth, by name; other frames earn 0.

- ``neg_rpe``: minus the translational error of the motion since the previous frame; needs no alignment and adds up.
  A frame without a tracked pose costs twice the true motion: it did not move, and it has to catch
  up. The first tracked pose after it is a jump from the last one (see `OnlineError`), which costs
  only the error beyond the charged path. So reporting a loss never earns more than repeating the
  last pose, and staying lost never more than recovering.
- ``neg_pose_error``: minus the causal translational pose error, at most the length of the true path so far (an error of
  100 %). A frame without a tracked pose earns minus that length: no pose, however far it has
  drifted, earns less, so that getting lost pays only before the first tracked pose, which begins
  the episode's frame of reference.
- ``neg_window_error``: see `NegWindowError`; a loss earns what repeating the last pose does.
- ``accuracy_minus_cost``: see `AccuracyMinusCost`; 1 mm for every frame on which the segmentation network ran.

A callable takes the `Episode` after each frame; ``episode.outcomes[-1]`` is the frame's
`FrameOutcome`.

The sum over an episode is not the ATE, which the last step's ``episode_metrics`` give under the
protocol.
"""
