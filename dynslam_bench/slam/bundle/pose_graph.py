"""A pose graph: the poses that fit relative poses between them best, by gtsam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

from .with_gtsam import FIXED_SIGMA, load_gtsam

Array = NDArray[np.float64]

SIGMAS = (0.01, 0.01, 0.01, 0.02, 0.02, 0.02)
"""Of a tie: radians, then metres. Only their ratio matters, all ties weigh the same."""
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Edge:
    """A tie between two keyframes.

    Attributes:
        one: Id of the first.
        other: Id of the second.
        T_other_one: Pose ``[4, 4]`` from the first one's camera frame to the other's.
    """

    one: int
    other: int
    T_other_one: Array


def optimise_poses(ids: NDArray[np.int64], poses: Array, edges: Sequence[Edge]) -> Array:
    """The poses that fit the ties best; the first one stays.

    Args:
        ids: Of the poses, ``[N]``.
        poses: World to camera ``[N, 4, 4]``, where the search starts.
        edges: Ties between them; the graph must be connected.

    Returns:
        World to camera ``[N, 4, 4]``.

    Raises:
        TrackerError: gtsam is not installed.
    """
    gtsam = load_gtsam("backend.loop_closing.enabled")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in zip(ids.tolist(), se3.inverse(poses), strict=True):
        values.insert(key, gtsam.Pose3(pose))
    hold = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    graph.add(gtsam.PriorFactorPose3(int(ids[0]), values.atPose3(int(ids[0])), hold))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(SIGMAS))
    for edge in edges:
        T_one_other = gtsam.Pose3(se3.inverse(edge.T_other_one))
        graph.add(gtsam.BetweenFactorPose3(edge.one, edge.other, T_one_other, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return se3.inverse(np.array([result.atPose3(key).matrix() for key in ids.tolist()]))
