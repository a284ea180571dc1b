"""Rewards: what the newest frame of an episode earns, by name or as a callable of the user's."""

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from dynslam_bench.core import SettingsError
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.envs.episode import Episode, FrameOutcome
from dynslam_bench.geometry import se3

Reward = Callable[[Episode], float]
Cost = Literal["network_calls", "keypoints", "processor_s"]
COSTS: tuple[str, ...] = get_args(Cost)
RewardKind = Literal["neg_rpe", "neg_pose_error", "neg_window_error", "accuracy_minus_cost"]


def neg_rpe(episode: Episode) -> float:
    """Minus the translational error of the motion since the previous frame, metres."""
    error = episode.outcomes[-1].error
    if error is None:
        return 0.0
    moved = error.frame_trans_m or 0.0
    return -max(moved - error.lost_way_m, 0.0) if error.tracked else -2.0 * moved


def neg_pose_error(episode: Episode) -> float:
    """Minus the causal translational pose error, at most the length of the true path so far, metres."""
    error = episode.outcomes[-1].error
    if error is None:
        return 0.0
    return -min(error.trans_m, error.way_m) if error.tracked else -error.way_m


@names_wrong_arguments
@dataclass(frozen=True)
class NegWindowError:
    """Minus the translational error of the motion over the last `frames` frames, metres.

    Drift that hides in the noise of one frame shows. Both ends need ground truth; the window is shorter where the
    episode is. A frame without a tracked pose counts as standing at the last one.

    Attributes:
        frames: Length of the window.
    """

    frames: int = 30

    def __post_init__(self) -> None:
        if operator.index(self.frames) < 1:
            raise SettingsError(f"a window has {self.frames} frames", "give 1 or more")

    def __call__(self, episode: Episode) -> float:
        """What the newest frame earns."""
        now, before = episode.outcomes[-1].error, episode.outcomes[-1 - self.frames :][0].error
        if now is None or before is None:
            return 0.0
        moved = se3.inverse(before.T_world_true) @ now.T_world_true
        estimated = se3.inverse(before.T_world_held) @ now.T_world_held
        return -float(np.linalg.norm((se3.inverse(moved) @ estimated)[:3, 3]))


@names_wrong_arguments
@dataclass(frozen=True)
class AccuracyMinusCost:
    """``neg_rpe`` minus what the frame cost.

    Attributes:
        weight: Metres that one unit of the cost counts as on the episode's first frame.
        cost: ``network_calls``: 1 where the segmentation network ran (``segmented`` of the tracker's stats);
            ``keypoints``: thousands of extracted keypoints (``keypoints``), which processor time grows with; both are
            the same on every machine. ``processor_s``: seconds of processor time, which differ from run to run.
        growth: Share of `weight` that is added to it with every frame: the budget of a frame falls.
    """

    weight: float = 0.001
    cost: Cost = "network_calls"
    growth: float = 0.0

    def __post_init__(self) -> None:
        if self.cost not in COSTS:
            raise SettingsError(f"unknown cost '{self.cost}'", f"choose {', '.join(COSTS)}")
        if not math.isfinite(self.weight * self.growth):
            raise SettingsError(f"weight {self.weight} and growth {self.growth} are no finite numbers")

    def __call__(self, episode: Episode) -> float:
        """What the newest frame earns."""
        return neg_rpe(episode) - self.charge(episode.outcomes[-1])

    def charge(self, outcome: FrameOutcome) -> float:
        """Metres that a frame's cost counts as."""
        return self.weight * (1.0 + self.growth * outcome.index) * self.cost_of(outcome)

    def cost_of(self, outcome: FrameOutcome) -> float:
        """What a frame cost, in units of the cost."""
        match self.cost:
            case "network_calls":
                return outcome.stats.get("segmented", 0.0)
            case "keypoints":
                return outcome.stats.get("keypoints", 0.0) / 1000.0
        return outcome.timings.get("processor", 0.0)


REWARDS: dict[str, Reward] = {
    "neg_rpe": neg_rpe,
    "neg_pose_error": neg_pose_error,
    "neg_window_error": NegWindowError(),
    "accuracy_minus_cost": AccuracyMinusCost(),
}
"""Reward in metres of a frame that has ground truth, by name; other frames earn 0.

- ``neg_rpe``: minus the translational error of the motion since the previous frame; needs no alignment and adds up.
  A frame without a tracked pose costs twice the true motion: it did not move, and it has to catch up. The first tracked
  pose after it is a jump from the last one (see `OnlineError`), which costs only the error beyond the charged path. So
  reporting a loss never earns more than repeating the last pose, and staying lost never more than recovering.
- ``neg_pose_error``: minus the causal translational pose error, at most the length of the true path so far (an error of
  100 %). A frame without a tracked pose earns minus that length: no pose, however far it has drifted, earns less, so
  that getting lost pays only before the first tracked pose, which begins the episode's frame of reference.
- ``neg_window_error``: see `NegWindowError`; a loss earns what repeating the last pose does.
- ``accuracy_minus_cost``: see `AccuracyMinusCost`; 1 mm for every frame on which the segmentation network ran.

A callable takes the `Episode` after each frame; ``episode.outcomes[-1]`` is the frame's `FrameOutcome`.

The sum over an episode is not the ATE, which the last step's ``episode_metrics`` give under the protocol.
"""
