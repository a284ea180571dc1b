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
    return truth.with_poses(truth.T_world_cam @ se3.exp(np.random.default_rng(seed).normal(0, size, (len(truth), 6))))


def turned(trajectory, seed):
    """The trajectory in another world frame."""
    return trajectory.with_poses(se3.exp(np.random.default_rng(seed).normal(0, 2, 6)) @ trajectory.T_world_cam)


def scaled(trajectory, factor):
    return trajectory.with_poses(se3.from_matrix(factor * trajectory.positions, trajectory.T_world_cam[:, :3, :3]))


def written_w_first(trajectory):
    """As it is read from a file that holds qw qx qy qz."""
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    return trajectory.with_poses(se3.from_quaternion(position, np.roll(quaternion, 1, axis=1)))
