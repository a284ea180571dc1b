"""The camera's motion since the previous frame, from the flow of points with depth, robustly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from .filter import FilterState, FrameBundle

MIN_POINTS = 12
KERNEL_PX = (12.0, 6.0, 4.0, 2.0, 2.0, 2.0)
"""Scale of the redescending kernel in each Gauss-Newton step: wide to catch a poor prediction, then narrow."""
CELL = 32


def depth_sigma(z: NDArray[np.floating]) -> NDArray[np.float64]:
    """Standard deviation of a structured-light depth camera at depth z, metres (Nguyen et al. 2012, axial noise)."""
    return np.asarray(0.0012 + 0.0019 * np.square(np.maximum(z, 0.4) - 0.4), dtype=np.float64)


def trust(frame: FrameBundle, state: FilterState, before: NDArray[np.floating]) -> NDArray[np.float64]:
    """How far the previous frame held the surroundings of each point's origin for static.

    Args:
        frame: The current frame.
        state: With the previous frame and its verdict.
        before: Raw pixels of the points in the previous image, ``[N, 2]``; not finite gives 1.

    Returns:
        Share of kept keypoints in the cell of the previous image, ``[N]`` in [0, 1]; 1 where there were none.
    """
    ones = np.ones(len(before))
    if state.previous is None or state.previous_keep is None or not len(state.previous):
        return ones
    rows, columns = -(-frame.gray.shape[0] // CELL), -(-frame.gray.shape[1] // CELL)

    def cell(xy: NDArray[np.floating]) -> NDArray[np.intp]:
        index = np.floor(np.nan_to_num(xy) / CELL).astype(np.intp)
        return np.asarray(index[:, 1].clip(0, rows - 1) * columns + index[:, 0].clip(0, columns - 1))

    home = cell(state.previous.keypoints.xy)
    count = np.bincount(home, minlength=rows * columns)
    kept = np.bincount(home, weights=state.previous_keep, minlength=rows * columns)
    share = np.where(count > 0, kept / np.maximum(count, 1), 1.0)
    return np.where(np.isfinite(before).all(axis=1), share[cell(before)], ones)


def refine_prediction(frame: FrameBundle, state: FilterState) -> NDArray[np.float64] | None:
    """The pose predicted for this frame, refined by the flow to the previous image.

    Iteratively reweighted Gauss-Newton on the reprojection error of the current points in the previous image, begun
    at the motion model's prediction, with a redescending (Geman-McClure) kernel: what moves against the majority
    that agrees with the prediction loses its say.

    Args:
        frame: The current frame.
        state: With flow, the previous pose and, if known, the predicted one.

    Returns:
        Camera-to-world pose ``[4, 4]``; the unrefined prediction (or None) where there is too little to refine on.
    """
    flow = state.flow
    if flow is None or state.previous is None or state.T_world_prev is None:
        return state.T_world_pred
    use = flow.valid & state.keep & (frame.z > 0)
    if np.count_nonzero(use) < MIN_POINTS:
        return state.T_world_pred
    start = np.eye(4) if state.T_world_pred is None else se3.inverse(state.T_world_prev) @ state.T_world_pred
    points = state.camera.unproject(frame.xy[use], frame.z[use])
    before = state.camera.undistort_points(flow.xy[use])
    T_prev_cur = _align(points, before, state.camera, start, trust(frame, state, flow.xy[use]))
    return state.T_world_pred if T_prev_cur is None else state.T_world_prev @ T_prev_cur


def _align(
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    camera: Camera,
    start: NDArray[np.float64],
    prior: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """The pose T that projects ``T @ points`` ``[N, 3]`` onto `pixels` ``[N, 2]``; None if it does not hold."""
    pose = start
    weight = prior
    for scale in KERNEL_PX:
        moved = se3.transform(pose, points)
        z = np.maximum(moved[:, 2], 0.05)
        error = camera.project(moved) - pixels
        error = np.where(moved[:, 2:3] > 0.05, np.nan_to_num(error, posinf=1e4, neginf=-1e4), 1e4)
        weight = prior / np.square(1 + (error**2).sum(axis=1) / scale**2)
        x, y = moved[:, 0] / z, moved[:, 1] / z
        zero = np.zeros_like(x)
        # derivative of the pixel by a left perturbation exp(rho, phi) of the pose
        du = camera.fx * np.stack([1 / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=1)
        dv = camera.fy * np.stack([zero, 1 / z, -y / z, -1 - y * y, x * y, x], axis=1)
        hessian = (du * weight[:, None]).T @ du + (dv * weight[:, None]).T @ dv
        gradient = du.T @ (weight * error[:, 0]) + dv.T @ (weight * error[:, 1])
        try:
            step = np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(6), -gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all() or np.linalg.norm(step[3:]) > 1.0:
            return None
        pose = se3.exp(step) @ pose
    return pose if weight.sum() >= 0.5 * MIN_POINTS else None
