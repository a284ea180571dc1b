"""Named rewards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from dynslam_bench.core.errors import SettingsError, did_you_mean
from dynslam_bench.evaluation.online import OnlineSample

RewardKind = Literal["neg_rpe", "neg_pose_error"]


def _frame_error(error: OnlineSample) -> float:
    moved = error.frame_trans_m or 0.0
    return -max(moved - error.lost_way_m, 0.0) if error.tracked else -2.0 * moved


def _pose_error(error: OnlineSample) -> float:
    return -min(error.trans_m, error.way_m) if error.tracked else -error.way_m


REWARDS: dict[str, Callable[[OnlineSample], float]] = {
    "neg_rpe": _frame_error,
    "neg_pose_error": _pose_error,
}
"""Reward in metres of a frame that has ground truth, by name; other frames earn 0.

- ``neg_rpe``: minus the translational error of the motion since the previous frame; needs no alignment and adds up.
  A frame without a tracked pose costs twice the true motion: it did not move, and it has to catch up. The first tracked
  pose after it is a jump from the last one (see `OnlineError`), which costs only what goes beyond the way paid for. So
  to admit a loss never earns more than to repeat the last pose, and to stay lost never more than to find the way back.
- ``neg_pose_error``: minus the causal translational pose error, at most the length of the true way so far (an error of
  100 %). A frame without a tracked pose earns minus that length: no pose, however far it has drifted, earns less, so
  that getting lost pays nowhere but before the first tracked pose, which begins the episode's frame of reference.

The sum over an episode is not the ATE, which the last step's ``episode_metrics`` give under the protocol.
"""


def reward_named(name: str) -> Callable[[OnlineSample | None], float]:
    """The reward of a name, as a function of a frame's error (None where there is no ground truth).

    Raises:
        SettingsError: There is none of that name.
    """
    if name not in REWARDS:
        raise SettingsError(f"unknown reward '{name}'", did_you_mean(name, REWARDS))
    of_sample = REWARDS[name]
    return lambda error: 0.0 if error is None else of_sample(error)
