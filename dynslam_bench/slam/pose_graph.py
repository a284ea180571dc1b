"""A pose graph: the poses that fit relative poses between them best.

Levenberg-Marquardt on sparse normal equations, which scipy solves. gtsam, an optional package, gives the
same poses in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

Array = NDArray[np.float64]

SIGMAS = (0.02, 0.02, 0.02, 0.01, 0.01, 0.01)
"""Of an edge of weight 1: metres, or units of length without depth, then radians; only treplacement ratio matters."""
ITERATIONS = 20
MIN_GAIN = 1e-9
"""The search ends when a step lowers the cost by a smaller share."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A constraint between two keyframes.

    Attributes:
        one: Id of the first.
        other: Id of the second.
        T_other_one: Pose ``[4, 4]`` from the first one's camera frame to the other's.
        weight: Information weight.
    """

    one: int
    other: int
    T_other_one: Array
    weight: float = 1.0

    def scaled(self, factor: float) -> Edge:
        """The same edge after lengths were multiplied by a factor."""
        pose = self.T_other_one.copy()
        pose[:3, 3] *= factor
        return Edge(self.one, self.other, pose, self.weight)


def rescaled_edges(edges: Sequence[Edge], ids: NDArray[np.int64], factors: Array) -> list[Edge]:
    """The edges after lengths at keyframes were multiplied by factors."""
    by_id = dict(zip(ids.tolist(), factors.tolist(), strict=True))
    return [edge.scaled(by_id.get(edge.one, 1.0)) for edge in edges]


def transferred_edges(edges: Sequence[Edge], culled: int, replacement: int, T_culled_replacement: Array) -> list[Edge]:
    """The edges after a keyframe was culled, moved to its replacement; an edge from that to itself is left out.

    Args:
        edges: The edges.
        culled: Id of the culled keyframe.
        replacement: Id of its replacement.
        T_culled_replacement: Pose ``[4, 4]`` from the replacement's camera frame to that of the culled one.
    """
    transferred = []
    for edge in edges:
        one, other, pose = edge.one, edge.other, edge.T_other_one
        if one == culled:
            one, pose = replacement, pose @ T_culled_replacement
        if other == culled:
            other, pose = replacement, se3.inverse(T_culled_replacement) @ pose
        if one != other:
            transferred.append(Edge(one, other, pose, edge.weight))
    return transferred


def edges_within(ids: NDArray[np.int64], edges: Sequence[Edge]) -> list[Edge]:
    """The edges between keyframes of some ids."""
    return [edge for edge in edges if np.isin([edge.one, edge.other], ids).all()]


def spread_scale(ids: NDArray[np.int64], edges: Sequence[Edge], loop_edge: Edge, scale: float) -> Array:
    """What lengths at each keyframe are to be multiplied by, so that a loop edge's scale is met.

    Logarithms of scales are to be equal at both ends of an edge and to differ by that of `scale` at the loop edge's;
    the sum of squared errors is least (Strasdat, Montiel and Davison, Scale Drift-Aware Large Scale Monocular
    SLAM, RSS 2010, solve for scales and poses together).

    Args:
        ids: Of the keyframes, ``[N]``, ascending.
        edges: Edges along which scale was kept. The oldest keyframe of each connected component stays.
        loop_edge: From the keyframe that was recognised to the one that recognises it.
        scale: What lengths at the second are to be multiplied by beside those at the first.

    Returns:
        Factors ``[N]``.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import spsolve

    all_edges = [*edges, loop_edge]
    one = np.searchsorted(ids, [edge.one for edge in all_edges])
    other = np.searchsorted(ids, [edge.other for edge in all_edges])
    wanted = np.zeros(len(all_edges))
    wanted[-1] = np.log(scale)
    row = np.arange(len(all_edges))
    ends = np.r_[row, row], np.r_[one, other]
    values = np.r_[-np.ones(len(row)), np.ones(len(row))]
    _, part = connected_components(coo_array((np.ones(len(row)), (one, other)), shape=(len(ids), len(ids))), False)
    _, oldest = np.unique(part, return_index=True)
    free = np.setdiff1d(np.arange(len(ids)), oldest)
    jacobian = coo_array((values, ends), shape=(len(row), len(ids))).tocsc()[:, free]
    weight = diags_array(np.array([edge.weight for edge in all_edges]))
    logarithms = np.zeros(len(ids))
    logarithms[free] = spsolve((jacobian.T @ weight @ jacobian).tocsc(), jacobian.T @ (weight @ wanted))
    return np.asarray(np.exp(logarithms))


def optimise_poses(ids: NDArray[np.int64], poses: Array, edges: Sequence[Edge]) -> Array:
    """The poses that fit the edges best; the first one stays.

    Args:
        ids: Of the poses, ``[N]``, ascending.
        poses: World to camera ``[N, 4, 4]``, where the search starts.
        edges: Edges between them; the graph must be connected.

    Returns:
        World to camera ``[N, 4, 4]``.
    """
    one = np.searchsorted(ids, [edge.one for edge in edges])
    other = np.searchsorted(ids, [edge.other for edge in edges])
    back = se3.inverse(np.array([edge.T_other_one for edge in edges]))
    sigmas = SIGMAS / np.sqrt([[edge.weight] for edge in edges])
    error = _errors(poses, one, other, back, sigmas)
    cost, damping = float(np.square(error).sum()), 1e-6
    for _ in range(ITERATIONS):
        trial = se3.exp(_step(poses, one, other, error, sigmas, damping)) @ poses
        trial_error = _errors(trial, one, other, back, sigmas)
        lower = float(np.square(trial_error).sum())
        if not lower < cost:
            damping *= 30.0
            continue
        done = cost - lower <= MIN_GAIN * cost
        poses, error, cost, damping = trial, trial_error, lower, max(damping * 0.2, 1e-12)
        if done:
            break
    return poses


def _errors(poses: Array, one: NDArray[np.int64], other: NDArray[np.int64], back: Array, sigmas: Array) -> Array:
    """Error of each edge ``[E, 6]``: the twist left between it and the poses, in its sigmas."""
    return se3.log(poses[other] @ se3.inverse(poses[one]) @ back) / sigmas


def _step(
    poses: Array, one: NDArray[np.int64], other: NDArray[np.int64], error: Array, sigmas: Array, damping: float
) -> Array:
    """Twists ``[N, 6]`` on the left of the poses that lower the cost; that of the first one is zero."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    jacobian_log = _inverse_left_jacobian(error * sigmas)
    weight = 1.0 / sigmas[:, :, None]
    by_other = weight * jacobian_log
    by_one = -by_other @ _adjoint(poses[other] @ se3.inverse(poses[one]))
    row = np.arange(error.size).reshape(-1, 6, 1)
    rows, columns, values = [], [], []
    for at, block in ((one, by_one), (other, by_other)):
        rows.append(np.broadcast_to(row, block.shape).ravel())
        columns.append(np.broadcast_to(6 * at[:, None, None] + np.arange(6), block.shape).ravel())
        values.append(block.ravel())
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    jacobian = coo_array(entries, shape=(error.size, 6 * len(poses))).tocsc()[:, 6:]
    normal = (jacobian.T @ jacobian).tocsc()
    normal = normal + diags_array(damping * normal.diagonal() + 1e-12)
    twists = np.zeros((len(poses), 6))
    twists[1:] = -spsolve(normal.tocsc(), jacobian.T @ error.ravel()).reshape(-1, 6)
    return twists


def _adjoint(pose: Array) -> Array:
    """Matrices ``[..., 6, 6]`` that turn twists (translation, rotation) into the frame a pose leads to."""
    matrix = np.zeros((*pose.shape[:-2], 6, 6))
    rotation = pose[..., :3, :3]
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., :3, 3:] = se3.hat(pose[..., :3, 3]) @ rotation
    return matrix


def _inverse_left_jacobian(twist: Array) -> Array:
    """``[..., 6, 6]``, to second order: how the logarithm of a pose follows a twist on its left."""
    ad = np.zeros((*twist.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = se3.hat(twist[..., 3:])
    ad[..., :3, 3:] = se3.hat(twist[..., :3])
    return np.eye(6) - ad / 2 + ad @ ad / 12
