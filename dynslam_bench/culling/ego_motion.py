"""The camera's motion since the previous frame, from optical flow and depth.

`refine_prediction` is the stage ``ego_motion`` of a frame's timings. The filter that tests points
against this motion is in `rigid_motion`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterState, FrameBundle
from dynslam_bench.core.compiled import kernel
from dynslam_bench.culling.moving_regions import cell_index
from dynslam_bench.geometry import at_width, se3
from dynslam_bench.geometry.gauss_newton import (
    add_normal_equation,
    apply_twist,
    cholesky_solve,
    transform_point,
    twist_of,
)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

MIN_POINTS = 12
"""Points with flow and depth without which the prediction is not refined."""
NEAR_M = 0.05
"""Points nearer than this to the camera plane have no weight."""
MIN_AGREEING = 6.0
"""Least sum of the points' weights in a fit."""
ROTATION_STEPS_PX = (12.0, 6.0, 4.0)
"""Scale of the redescending kernel in the first Gauss-Newton steps, which change the rotation only."""
POSE_STEPS_PX = (4.0, 2.0, 1.0, 1.0)
"""Scale of the kernel in the later steps; narrow, since the flow is exact and moving points must not influence it."""
STEPS_PX = np.array(ROTATION_STEPS_PX + POSE_STEPS_PX)
"""Scale of the kernel in all steps."""
NO_PRIOR = np.zeros((6, 6))
"""Information of a motion that nothing is known of."""
NEAR_FAR = (0.1, 0.9)
"""Quantiles of the depths whose geometric mean separates near points from distant ones."""
LOWER_COST = 0.95
"""The motion of the distant points is taken if it costs less than this share of the other one's."""
NOISE_PX = (0.2, 1.0)
"""Least and greatest scale of the kernel that the residuals of distant points ask for."""
ROLLING_SHUTTER_SHARE = 0.05
"""Added to the scale, as a share of a point's flow: a rolling shutter distorts fast motion."""
STATIC_CELL = 32
"""Side of the cells of `static_share`, pixels at an image width of 640."""
CORRELATION = 100.0
"""Factor on the information of the motion model against that of the flow: errors of points on one object are correlated
(the back end inflates the covariance of its poses for the same reason)."""

PATCH_3X3 = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
"""Offsets of the 3x3 pixels around a pixel, row by row."""


class Intrinsics(NamedTuple):
    """A pinhole camera, as compiled loops take it.

    Attributes:
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float


def depth_sigma(z: NDArray[np.floating]) -> NDArray[np.float64]:
    """Standard deviation of a structured-light depth camera at depth z, metres (Nguyen et al. 2012, axial noise)."""
    return np.asarray(0.0012 + 0.0019 * np.square(np.maximum(z, 0.4) - 0.4), dtype=np.float64)


def static_share(
    frame: FrameBundle, state: FilterState, previous_xy: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Share of static keypoints around each point's origin in the previous frame.

    Args:
        frame: The current frame.
        state: With the previous frame and which of its keypoints were kept.
        previous_xy: Raw pixels of the points in the previous image, ``[N, 2]``.

    Returns:
        Share of kept keypoints in the cell of the previous image, ``[N]`` in [0, 1]; 1 where there
        were none.
    """
    if state.previous is None or state.previous_keep is None:
        return np.ones(len(previous_xy))
    # kept keypoints and all keypoints by cell of the previous image
    shape = frame.gray.shape
    side = at_width(STATIC_CELL, shape[1])
    cell, cells = cell_index(state.previous.keypoints.xy, side, shape)
    count = np.bincount(cell, minlength=np.prod(cells))
    kept = np.bincount(cell, weights=state.previous_keep, minlength=np.prod(cells))
    # the share at the cell of each point
    share = np.where(count > 0, kept / np.maximum(count, 1), 1.0)
    return np.asarray(share[cell_index(previous_xy, side, shape)[0]])


def rigid_flow(
    frame: FrameBundle, state: FilterState, rows: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions that points would have had in the previous frame if only the camera moved.

    Args:
        frame: The current frame.
        state: With the previous and the predicted pose.
        rows: bool ``[N]``, K points, all with depth.

    Returns:
        Points ``[K, 3]`` in the previous camera's frame, metres, and their undistorted pixels
        ``[K, 2]``.
    """
    assert state.T_world_prev is not None
    assert state.T_world_pred is not None
    # the points in this camera's frame, then in the previous one's
    points = state.camera.unproject(frame.xy[rows], frame.z[rows])
    moved = se3.transform(se3.inverse(state.T_world_prev) @ state.T_world_pred, points)
    return moved, state.camera.project(moved)


def refine_prediction(frame: FrameBundle, state: FilterState) -> NDArray[np.float64] | None:
    """The pose predicted for this frame, refined by the flow to the previous image.

    Iteratively reweighted Gauss-Newton on the reprojection error of the current points in the
    previous image, with a redescending (Geman-McClure) kernel. It starts at the motion model's
    prediction, which is also the prior (maximum a posteriori). Without the prior a person nearby
    would bias the estimate even where most points are static: a far background of one depth hardly
    separates rotation from sideways translation, so that near points determine the translation. For
    the same reason the first steps, with a wide kernel, change the rotation only. An object nearby
    that begins to move takes this estimate along all the same, and then the prior. A second one
    therefore begins with the distant points alone, without the prior. It is taken if clearly more
    points agree with it.

    Args:
        frame: The current frame.
        state: With flow, the previous pose and, if known, the predicted one.

    Returns:
        Camera-to-world pose ``[4, 4]``; the unrefined prediction (or None) with too few points.
    """
    flow = state.flow
    if flow is None or state.previous is None or state.T_world_prev is None:
        return state.T_world_pred
    use = flow.valid & state.keep & (frame.z > 0)
    if np.count_nonzero(use) < MIN_POINTS:
        return state.T_world_pred

    # points in this camera's frame, their pixels in the previous image, and how static their origin was
    points = state.camera.unproject(frame.xy[use], frame.z[use])
    pixels = state.flow_xy[use]
    weight = static_share(frame, state, flow.xy[use])
    camera = Intrinsics(state.camera.fx, state.camera.fy, state.camera.cx, state.camera.cy)

    # the motion model's prediction is the start and the prior
    start = np.eye(4)
    prior = NO_PRIOR
    if state.T_world_pred is not None:
        start = se3.inverse(state.T_world_prev) @ state.T_world_pred
        prior = prior_information(state, start)

    # maximum a posteriori estimate, from the rotation to the pose
    rotation_steps = len(ROTATION_STEPS_PX)
    T_prev_cur, agreeing = _align(
        start, points, pixels, weight, prior, STEPS_PX, rotation_steps, camera
    )
    if agreeing < MIN_AGREEING:
        return state.T_world_pred

    # the motion of the distant points, if clearly more points agree with it
    distant = _motion_of_distant_points(start, points, pixels, weight, camera)
    if distant is not None:
        T_distant, scale = distant
        cost = _geman_mcclure_cost(T_prev_cur, points, pixels, weight, scale, camera)
        if _geman_mcclure_cost(T_distant, points, pixels, weight, scale, camera) < (
            LOWER_COST * cost
        ):
            T_prev_cur = T_distant
    return state.T_world_prev @ T_prev_cur


def _motion_of_distant_points(
    start: Array, points: Array, pixels: Array, weight: Array, camera: Intrinsics
) -> tuple[Array, float] | None:
    """The motion ``T_prev_cur`` ``[4, 4]`` by the distant points first, and the scale of its kernel, pixels.

    Distant points are rarely on a moving object, so nothing nearby can take this estimate along;
    it has no prior. None where too few points agree.

    Args:
        start: The motion to begin with ``[4, 4]``.
        points: ``[N, 3]`` in this camera's frame, metres.
        pixels: Undistorted pixels ``[N, 2]`` in the previous image.
        weight: Share of static keypoints around each, ``[N]`` in [0, 1].
        camera: Intrinsics.
    """
    # distant: beyond the geometric mean of near and far depths
    far = points[:, 2] > np.sqrt(np.prod(np.quantile(points[:, 2], NEAR_FAR)))
    rotation_steps = len(ROTATION_STEPS_PX)
    T_prev_cur, agreeing = _align(
        start, points[far], pixels[far], weight[far], NO_PRIOR, STEPS_PX, rotation_steps, camera
    )
    if agreeing < MIN_AGREEING:
        return None

    # all points: two steps of the whole pose, under a kernel as wide as the distant points' residuals
    noise = np.sqrt(np.median(_squared_errors(T_prev_cur, points[far], pixels[far], camera)))
    scale = np.clip(3 * noise, *NOISE_PX)
    T_prev_cur, agreeing = _align(
        T_prev_cur, points, pixels, weight, NO_PRIOR, np.repeat(scale, 2), 0, camera
    )
    return None if agreeing < MIN_AGREEING else (T_prev_cur, scale)


def _geman_mcclure_cost(
    pose: Array, points: Array, pixels: Array, weight: Array, scale: float, camera: Intrinsics
) -> float:
    """Weighted cost of all points under a kernel of a scale in pixels; arguments as of `_align`."""
    errors = _squared_errors(pose, points, pixels, camera)
    return float((weight * (1 - scale**2 / (errors + scale**2))).sum())


def prior_information(state: FilterState, T_prev_cur: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information of the motion model on the motion since the previous frame.

    The model's rotation error r turns the world-to-camera rotation from the left, in the camera
    frame. To first order it is the twist ``((R r) x t, -R r)`` of the motion (R, t) from this
    camera frame to the previous one.

    Args:
        state: With the covariance of the predicted motion.
        T_prev_cur: The predicted motion.

    Returns:
        Information ``[6, 6]`` of (translation, rotation), both in the previous camera's frame,
        times `CORRELATION`; 0 without a covariance of the motion model.
    """
    if state.motion_covariance is None or state.T_world_prev is None:
        return NO_PRIOR
    # how (position in the world, rotation in the camera) turns into the twist of the motion
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = state.T_world_prev[:3, :3].T
    jacobian[3:, 3:] = -T_prev_cur[:3, :3]
    jacobian[:3, 3:] = se3.hat(T_prev_cur[:3, 3]) @ jacobian[3:, 3:]
    covariance = jacobian @ state.motion_covariance @ jacobian.T + 1e-12 * np.eye(6)
    return np.asarray(CORRELATION * np.linalg.inv(covariance))


def _align(
    start: Array,
    points: Array,
    pixels: Array,
    prior_weight: Array,
    information: Array,
    scales: Array,
    rotation_steps: int,
    camera: Intrinsics,
) -> tuple[Array, float]:
    """The pose T that projects ``T @ points`` ``[N, 3]`` onto `pixels` ``[N, 2]``, and the sum of the points' weights.

    `prior_weight` ``[N]`` is each point's weight before its residual counts. `information` ``[6, 6]``
    is that of the prior, the start pose. `scales` are the kernel's, one a step, of which the first
    `rotation_steps` change the rotation only. Where the system cannot be solved the sum is 0.
    """
    pose = start
    total = 0.0
    inverse_start = start.copy()
    inverse_start[:3, :3] = start[:3, :3].T
    inverse_start[:3, 3] = -inverse_start[:3, :3] @ np.ascontiguousarray(start[:3, 3])

    # a rolling shutter distorts fast motion: the kernel is wider for points with a long flow
    shutter = ROLLING_SHUTTER_SHARE**2 * _squared_errors(np.eye(4), points, pixels, camera)
    for number in range(len(scales)):
        # normal equations of the points and of the prior
        hessian, gradient, total = _linearise(
            pose, points, pixels, prior_weight, shutter, scales[number] ** 2, camera
        )
        hessian += information
        gradient += information @ twist_of(pose @ inverse_start)

        # rotation only: no gradient of the translation, and no coupling with it
        if number < rotation_steps:
            hessian[:3] = 0.0
            hessian[:, :3] = 0.0
            gradient[:3] = 0.0
            hessian[:3, :3] = np.trace(hessian) * np.eye(3)

        # Gauss-Newton step; a rotation by more than a radian is no refinement
        step = -gradient
        solved = cholesky_solve(hessian + 1e-9 * np.trace(hessian) * np.eye(6), step)
        if not solved or not np.linalg.norm(step[3:]) <= 1.0:
            return pose, 0.0
        pose = apply_twist(pose, step)
    return pose, total


@kernel
def _squared_errors(pose: Array, points: Array, pixels: Array, camera: Intrinsics) -> Array:
    """Squared distances ``[N]`` of the projected points ``pose @ points`` from their pixels; inf behind the camera.

    Args:
        pose: Transform ``[4, 4]`` into the camera frame.
        points: ``[N, 3]``, metres.
        pixels: Undistorted pixels ``[N, 2]`` that they are compared with.
        camera: Intrinsics.
    """
    errors = np.full(len(points), np.inf)
    for i in range(len(points)):
        x, y, z = transform_point(pose, points[i])
        if z > 0:
            errors[i] = (camera.fx * (x / z) + camera.cx - pixels[i, 0]) ** 2 + (
                camera.fy * (y / z) + camera.cy - pixels[i, 1]
            ) ** 2
    return errors


@kernel
def _linearise(
    pose: Array,
    points: Array,
    pixels: Array,
    prior_weight: Array,
    shutter: Array,
    scale2: float,
    camera: Intrinsics,
) -> tuple[Array, Array, float]:
    """Gauss-Newton matrix ``[6, 6]``, gradient ``[6]`` of a left twist, sum of the weights.

    `shutter` ``[N]`` is added to the squared scale of the Geman-McClure kernel, squared pixels.
    """
    # sums over all points before the camera
    fx = camera.fx
    fy = camera.fy
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    total = 0.0
    for i in range(len(points)):
        x, y, z = transform_point(pose, points[i])
        if z <= NEAR_M:
            continue

        # residual in pixels, weighted by the kernel
        x = x / z
        y = y / z
        du = fx * x + camera.cx - pixels[i, 0]
        dv = fy * y + camera.cy - pixels[i, 1]
        weight = prior_weight[i] / (1 + (du * du + dv * dv) / (scale2 + shutter[i])) ** 2
        total += weight

        # rows of the Jacobian by (translation, rotation): of u and of v
        a = fx / z
        b = fy / z
        add_normal_equation(
            hessian,
            gradient,
            weight,
            a,
            0.0,
            -fx * x / z,
            -fx * x * y,
            fx * (1 + x * x),
            -fx * y,
            du,
        )
        add_normal_equation(
            hessian,
            gradient,
            weight,
            0.0,
            b,
            -fy * y / z,
            -fy * (1 + y * y),
            fy * x * y,
            fy * x,
            dv,
        )
    return hessian, gradient, total
