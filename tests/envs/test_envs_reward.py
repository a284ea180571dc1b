"""What episodes earn, over random ones: with `neg_pose_error`, getting lost never pays."""

from __future__ import annotations

import numpy as np
import pytest

from dynslam_bench.envs import REWARDS
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

EPISODES = 12


def walk(rng: np.random.Generator, step: float, frames: int = 40) -> np.ndarray:
    """Random poses ``[N, 4, 4]``; `step` metres and radians a frame."""
    poses = [se3.exp(rng.normal(size=6))]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(0, step, 6)))
    return np.array(poses)


def episode(seed: int) -> tuple[Trajectory, np.ndarray, np.ndarray]:
    """A true path with holes, estimates that drift little or wildly, and which frames are tracked."""
    rng = np.random.default_rng(seed)
    true = walk(rng, 0.02)
    drift = np.cumsum(rng.normal(0, 10 ** rng.uniform(-4, 0), (len(true), 6)), axis=0)
    stamps = np.arange(len(true)) / 30.0
    known = rng.random(len(true)) > rng.choice([0.0, 0.3])
    known[0] = True
    return Trajectory(stamps[known], true[known]), true @ se3.exp(drift), rng.random(len(true)) > rng.choice([0.0, 0.4])


def rewards(name: str, truth: Trajectory, poses: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    stamps, online = np.arange(len(poses)) / 30.0, OnlineError(truth)
    errors = [online.update(t, p if ok else None) for t, p, ok in zip(stamps, poses, tracked, strict=True)]
    return np.array([0.0 if error is None else REWARDS[name](error) for error in errors])


@pytest.mark.parametrize("seed", range(EPISODES))
def test_losing_a_tracked_frame_raises_no_frames_reward(seed: int) -> None:
    """Of every frame but the one that begins the frame of reference, alone, and from it on to the end."""
    truth, poses, tracked = episode(seed)
    earned = rewards("neg_pose_error", truth, poses, tracked)
    first = int(np.argmax(tracked))
    for frame in range(first + 1, len(poses)):
        once, ever = tracked.copy(), tracked.copy()
        once[frame] = ever[frame:] = False
        for lost in (once, ever):
            assert (rewards("neg_pose_error", truth, poses, lost) <= earned + 1e-12).all()


@pytest.mark.parametrize("seed", range(EPISODES))
def test_no_episode_earns_less_than_one_that_is_lost_throughout(seed: int) -> None:
    truth, poses, tracked = episode(seed)
    nothing = rewards("neg_pose_error", truth, poses, np.zeros(len(poses), bool))
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))]
    known = np.isin(np.arange(len(poses)) / 30.0, truth.timestamps)
    assert nothing[known] == pytest.approx(-way, abs=1e-12) and not nothing[~known].any()
    assert (rewards("neg_pose_error", truth, poses, tracked) >= nothing - 1e-12).all()
    still = rewards("neg_pose_error", truth, np.repeat(np.eye(4)[None], len(poses), axis=0), np.ones(len(poses), bool))
    assert (still >= nothing - 1e-12).all()


@pytest.mark.parametrize("seed", range(EPISODES))
def test_under_neg_rpe_admitting_a_loss_never_earns_more_than_repeating_the_last_pose(seed: int) -> None:
    truth, poses, tracked = episode(seed)
    tracked[0] = True
    repeated = poses[np.maximum.accumulate(np.where(tracked, np.arange(len(poses)), 0))]
    admitted = rewards("neg_rpe", truth, poses, tracked)
    kept = rewards("neg_rpe", truth, repeated, np.ones(len(poses), bool))
    assert (np.cumsum(admitted) <= np.cumsum(kept) + 1e-12).all(), "wherever the episode ends"
    assert admitted[tracked & np.r_[True, tracked[:-1]]] == pytest.approx(kept[tracked & np.r_[True, tracked[:-1]]])
    if not tracked.all():
        assert admitted.sum() < kept.sum()


def test_under_neg_rpe_the_way_back_costs_nothing_and_a_wrong_one_its_error() -> None:
    stamps = np.arange(60) / 30.0
    true = np.repeat(np.eye(4)[None], 60, axis=0)
    true[:, 0, 3] = np.cumsum(np.r_[0, np.full(59, 0.01)])
    tracked = np.ones(60, bool)
    tracked[20:50] = False
    truth = Trajectory(stamps, true)
    earned = rewards("neg_rpe", truth, true, tracked)
    assert earned[20:50] == pytest.approx(-0.02) and not np.delete(earned, np.s_[20:50]).any()
    wrong = true.copy()
    wrong[50:, 0, 3] += 0.3
    assert rewards("neg_rpe", truth, wrong, tracked)[50] == pytest.approx(-0.3)
    tracked[50:] = False
    assert rewards("neg_rpe", truth, true, tracked).sum() < earned.sum(), "to stay lost does not pay"
