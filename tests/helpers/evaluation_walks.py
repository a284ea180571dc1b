"""Trajectories to evaluate: a random walk, a noisy estimate of it, and another world frame."""

import itertools

import numpy as np

from dynslam_bench.geometry import Trajectory, se3


def walk(seed=0, n=200, rate=30.0):
    rng = np.random.default_rng(seed)
    steps = np.vstack([rng.normal(size=6), rng.normal(0, 0.01, (n - 1, 6))])
    return Trajectory(np.round(1311868163.0 + np.arange(n) / rate, 6), chained(se3.exp(steps)))


def chained(steps):
    """Poses ``[N, 4, 4]`` of steps ``[N, 4, 4]``, each from the pose before."""
    return np.array(list(itertools.accumulate(steps, np.matmul)))


def noisy(truth, seed=1, size=0.01):
    return truth.with_poses(
        truth.T_world_cam @ se3.exp(np.random.default_rng(seed).normal(0, size, (len(truth), 6)))
    )


def turned(trajectory, seed):
    """The trajectory in another world frame."""
    return trajectory.with_poses(
        se3.exp(np.random.default_rng(seed).normal(0, 2, 6)) @ trajectory.T_world_cam
    )


def scaled(trajectory, factor):
    return trajectory.with_poses(
        se3.from_matrix(factor * trajectory.positions, trajectory.T_world_cam[:, :3, :3])
    )


def written_w_first(trajectory):
    """As it is read from a file that holds qw qx qy qz."""
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    return trajectory.with_poses(se3.from_quaternion(position, np.roll(quaternion, 1, axis=1)))


def lap(n=150, rate=30.0):
    """A camera that swings along all axes and turns; stamps from 0, seconds."""
    t = np.arange(n) / rate
    places = np.stack([0.5 * np.sin(1.1 * t), 0.3 * np.cos(1.7 * t), 0.18 * t], axis=1)
    turns = np.stack([0.2 * np.sin(0.9 * t), 0.26 * t, 0.1 * np.cos(1.3 * t)], axis=1)
    return Trajectory(t, se3.exp(np.concatenate([places, turns], axis=1)))


def followed(truth, seed=3):
    """An estimate with errors of a centimetre that last for some frames."""
    rng = np.random.default_rng(seed)
    size = 0.01 * np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    waves = np.sin(np.outer(np.arange(len(truth)) / 9, np.ones(6)) + rng.uniform(0, 6, 6))
    return truth.with_poses(
        truth.T_world_cam @ se3.exp(size * (waves + 0.2 * rng.normal(size=waves.shape)))
    )


def rows_of(trajectory, stamps, separator=" ", order=(0, 1, 2, 3, 4, 5, 6)):
    """Lines of a trajectory file: stamps as they are to be written, then ``tx ty tz qx qy qz qw`` in an order."""
    numbers = np.concatenate(se3.to_quaternion(trajectory.T_world_cam), axis=1)[
        :, list(order)
    ].tolist()
    lines = [
        separator.join([stamp, *(f"{value:.9f}" for value in row)])
        for stamp, row in zip(stamps, numbers, strict=True)
    ]
    return "\n".join(lines) + "\n"
