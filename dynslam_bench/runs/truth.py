"""The ground truth laid over a run's trajectory, for pictures of it."""

from __future__ import annotations

import numpy as np

from dynslam_bench.evaluation.alignment import align
from dynslam_bench.evaluation.online import OnlineError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory


def aligned_truth(truth: Trajectory | None, track: Trajectory) -> tuple[Trajectory | None, float | None]:
    """The ground truth at the track's stamps, moved onto the track by least squares, and what is left in metres (RMSE).

    Both are None without enough of it.
    """
    if truth is None:
        return None, None
    errors = OnlineError(truth)
    poses = [errors.truth_at(float(stamp)) for stamp in track.timestamps]
    known = [row for row, pose in enumerate(poses) if pose is not None]
    if len(known) < 3:
        return None, None
    true = np.array([poses[row] for row in known])
    fit = align(track.T_world_cam[known], true, "se3")
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = fit.rotation, fit.translation
    moved = Trajectory(track.timestamps[known], se3.inverse(move) @ true)
    left = moved.positions - track.positions[known]
    return moved, float(np.sqrt(np.square(left).sum(axis=1).mean()))
