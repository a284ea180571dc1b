"""Trajectories to evaluate: a random walk, a noisy estimate of it, and another world frame."""

import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory


def walk(seed=0, n=200, rate=30.0):
    rng = np.random.default_rng(seed)
    poses = [se3.exp(rng.normal(size=6))]
    for _ in range(n - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(0, 0.01, 6)))
    return Trajectory(np.round(1311868163.0 + np.arange(n) / rate, 6), np.array(poses))


def noisy(truth, seed=1, size=0.01):
    rng = np.random.default_rng(seed)
    return Trajectory(truth.timestamps, truth.T_world_cam @ se3.exp(rng.normal(0, size, (len(truth), 6))))


def turned(trajectory, seed):
    return moved(trajectory, se3.exp(np.random.default_rng(seed).normal(0, 2, 6)))


def moved(trajectory, T_new_world):
    """The trajectory in another world frame."""
    return Trajectory(trajectory.timestamps, T_new_world @ trajectory.T_world_cam)
