"""Robust pose optimisation against known points: Levenberg-Marquardt on SE(3) with the right coordinate of depth.

The residual of a point is ``(u - u', v - v', ur - (u' - b f / z'))``; features without depth have
the first two rows only. Rounds of a Huber-weighted Levenberg-Marquardt alternate with a chi-square test
that sets outliers aside, as in motion-only bundle adjustment of ORB-SLAM2 (Mur-Artal and Tardos,
2017, Section III-C). The last round weighs the inliers by Cauchy's kernel, as wide as their own
residuals are: most features are located far more exactly than the assumed pixel, and those that are
not would move the pose by centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.ordering import median
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.gauss_newton import (
    add_normal_equation,
    apply_twist,
    cholesky_solve,
    transform_point,
)

Array = NDArray[np.float64]

CHI2_MONO = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""
CHI2_DEPTH = 7.815
"""95 % quantile of chi-square with three degrees of freedom."""
CAUCHY = 5.0
"""Squared width of Cauchy's kernel over the variance of the residuals: their weights are those of Student's t with five
degrees of freedom (Kerl, Sturm and Cremers, Robust Odometry Estimation for RGB-D Cameras, ICRA
2013)."""
MEDIAN_CHI2 = 1.386
"""Median of chi-square with two degrees of freedom."""
LEAST_VARIANCE = 0.01
"""The residuals' variance is at least this share of the assumed one."""
COVARIANCE_FACTOR = 1.57
"""Calibrated factor on the covariance of a pose fitted to the map, which is given as that of the motion to it.

It stands mostly for the error of the pose before: two independent fits would have the sum of both
covariances, the earlier one transported by the motion's adjoint. The rest are errors of the map.
"""
NEAR_M = 0.05
"""Points nearer than this to the camera plane are never inliers."""
MIN_POINTS = 6
"""Fewer points, or inliers after a round, give no pose."""
DAMPING = 1e-6
"""Levenberg-Marquardt's damping at the start of a round, relative to the diagonal."""
LEAST_DAMPING = 1e-9
"""Steps that reduce the cost lower the damping down to this."""
MOST_DAMPING = 1e3
"""A round ends when steps that do not reduce the cost raised the damping above this."""
CONVERGED_GAIN = 1e-4
"""A round ends when a step reduces the cost by less than this share."""


class Intrinsics(NamedTuple):
    """A pinhole camera with depth, as compiled loops take it.

    Attributes:
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        bf: Stereo baseline times `fx`, metres times pixels: the right coordinate of a point at
            depth z is ``u - bf / z``.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    bf: float


class Measurements(NamedTuple):
    """Measured places of N points in an image, and how exact they are.

    Attributes:
        uv: float64 ``[N, 2]``, undistorted pixels.
        right: float64 ``[N]``, right coordinates; ignored where `info_right` is 0.
        info: float64 ``[N]``, inverse variances of the pixels, 1/px^2.
        info_right: float64 ``[N]``, inverse variances of the right coordinates, 0 without depth.
    """

    uv: Array
    right: Array
    info: Array
    info_right: Array


def intrinsics_of(camera: Camera) -> Intrinsics:
    """The intrinsics of a camera for compiled loops."""
    return Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline_m)


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Outcome of `optimise_pose`.

    Attributes:
        T_cam_world: World-to-camera pose ``[4, 4]``.
        inliers: bool ``[N]``.
        count: Number of inliers.
        residual_px: Median reprojection error of the inliers in pixels of octave 0; NaN without
            any.
        information: Gauss-Newton matrix ``[6, 6]`` of (translation, rotation) in the camera frame.
    """

    T_cam_world: Array
    inliers: NDArray[np.bool_]
    count: int
    residual_px: float
    information: Array


def motion_covariance(estimate: PoseEstimate) -> Array | None:
    """Covariance ``[6, 6]`` of a pose's fit to the image, as that of the motion to it; None if it is not determined.

    It is the inverse of the pose's information, scaled by the variance of the residuals over the
    assumed one, and by `COVARIANCE_FACTOR`, which stands mostly for the error of the pose before.
    The map counts as known. What the motion model, bundle adjustment or a loop make of the pose
    afterwards is not in it.
    ``exp(xi) T_cam_world`` is ``T_world_cam exp(-xi)`` seen from the other side, so that the
    matrix is that of a right perturbation of ``T_prev_cur``, too.
    """
    variance = max(estimate.residual_px**2 / MEDIAN_CHI2, LEAST_VARIANCE)
    try:
        covariance = np.linalg.inv(estimate.information)
    except np.linalg.LinAlgError:
        return None
    scaled = COVARIANCE_FACTOR * variance * covariance
    return np.asarray(0.5 * (scaled + scaled.T))


@kernel
def cauchy_width(chi2: Array) -> float:
    """Squared width of Cauchy's kernel for observations with these chi-squares.

    Their variance over the assumed one is estimated by the median of those that are finite (of
    points in front of the camera).
    """
    # chi-squares of points in front of the camera
    finite = np.empty(len(chi2))
    count = 0
    for value in chi2:
        if np.isfinite(value):
            finite[count] = value
            count += 1
    # the median is robust against outliers: it exceeds that of pure noise as the variance does
    if count == 0:
        return CAUCHY
    return CAUCHY * max(median(finite[:count]) / MEDIAN_CHI2, LEAST_VARIANCE)


@kernel
def _linearise(
    pose: Array,
    points: Array,
    measured: Measurements,
    active: NDArray[np.bool_],
    width: float,
    camera: Intrinsics,
    h: Array,
    g: Array,
) -> float:
    """Fill the Gauss-Newton system ``h x = g`` ``[6, 6]``, ``[6]`` of the active points; returns the cost.

    The cost is that of Cauchy's kernel of a squared width, or of Huber's where that is 0.

    Args:
        pose: World to camera ``[4, 4]``.
        points: World points ``[N, 3]``, metres.
        measured: Where the image shows them.
        active: bool ``[N]``, points that count.
        width: Squared width of Cauchy's kernel; 0 for Huber's.
        camera: Intrinsics.
        h: Filled with the Gauss-Newton matrix, lower triangle.
        g: Filled with the gradient.
    """
    h[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(points.shape[0]):
        if not active[i]:
            continue
        # a point behind the camera costs as much as an outlier, and tells no direction
        x, y, z = transform_point(pose, points[i])
        depth = measured.info_right[i] > 0.0
        limit = CHI2_DEPTH if depth else CHI2_MONO
        if z < NEAR_M:
            cost += limit
            continue

        # residuals of the pixel and of the right coordinate
        iz = 1.0 / z
        u = camera.fx * x * iz + camera.cx
        du = measured.uv[i, 0] - u
        dv = measured.uv[i, 1] - (camera.fy * y * iz + camera.cy)
        dr = measured.right[i] - (u - camera.bf * iz) if depth else 0.0
        info = measured.info[i]
        info_right = measured.info_right[i]
        chi2 = info * (du * du + dv * dv) + (info_right * dr * dr if depth else 0.0)

        # weight and cost by the robust kernel: Cauchy's, or Huber's
        w = 1.0
        if width > 0.0:
            w = 1.0 / (1.0 + chi2 / width)
            cost += width * np.log1p(chi2 / width)
        elif chi2 > limit:
            w = np.sqrt(limit / chi2)
            cost += 2.0 * np.sqrt(limit * chi2) - limit
        else:
            cost += chi2

        # derivatives of u and v along and about the camera's axes (translation, rotation)
        du_along_x = camera.fx * iz
        du_along_z = -du_along_x * x * iz
        du_about_x = -camera.fx * x * y * iz * iz
        du_about_y = camera.fx * (1.0 + x * x * iz * iz)
        du_about_z = -du_along_x * y
        dv_along_y = camera.fy * iz
        dv_along_z = -dv_along_y * y * iz
        dv_about_x = -camera.fy * (1.0 + y * y * iz * iz)
        dv_about_y = camera.fy * x * y * iz * iz
        dv_about_z = dv_along_y * x

        # a row of the Jacobian each: of u, of v, and of the right coordinate, u less the disparity
        add_normal_equation(
            h,
            g,
            w * info,
            du_along_x,
            0.0,
            du_along_z,
            du_about_x,
            du_about_y,
            du_about_z,
            du,
        )
        add_normal_equation(
            h,
            g,
            w * info,
            0.0,
            dv_along_y,
            dv_along_z,
            dv_about_x,
            dv_about_y,
            dv_about_z,
            dv,
        )
        if depth:
            by_depth = camera.bf * iz * iz
            add_normal_equation(
                h,
                g,
                w * info_right,
                du_along_x,
                0.0,
                du_along_z + by_depth,
                du_about_x + by_depth * y,
                du_about_y - by_depth * x,
                du_about_z,
                dr,
            )
    return cost


@kernel
def observation_chi2(
    pose: Array,
    point: Array,
    uv: Array,
    right: float,
    info: float,
    info_right: float,
    camera: Intrinsics,
) -> tuple[float, float]:
    """Chi-square of one observation by its pixel alone, and with its right coordinate; inf behind the camera.

    Args:
        pose: World to camera ``[4, 4]``.
        point: World point ``[3]``, metres.
        uv: Undistorted pixel ``[2]`` that shows it.
        right: Its right coordinate; ignored where `info_right` is 0.
        info: Inverse variance of the pixel, 1/px^2.
        info_right: Inverse variance of the right coordinate, 0 without depth.
        camera: Intrinsics.
    """
    # the point in the camera frame
    x, y, z = transform_point(pose, point)
    if z < NEAR_M:
        return np.inf, np.inf
    # residuals of the pixel, weighted by their information
    u = camera.fx * x / z + camera.cx
    du = uv[0] - u
    dv = uv[1] - (camera.fy * y / z + camera.cy)
    pixel = info * (du * du + dv * dv)
    # with depth the right coordinate, u less the disparity, counts, too
    if info_right <= 0.0:
        return pixel, pixel
    dr = right - (u - camera.bf / z)
    return pixel, pixel + info_right * dr * dr


@kernel
def _classify(
    pose: Array,
    points: Array,
    measured: Measurements,
    camera: Intrinsics,
    inlier: NDArray[np.bool_],
    error: Array,
) -> int:
    """Fill which observations fit, ``[N]``, and their reprojection errors ``[N]`` in standard deviations.

    Returns how many fit.

    Args:
        pose: World to camera ``[4, 4]``.
        points: World points ``[N, 3]``.
        measured: Where the image shows them.
        camera: Intrinsics.
        inlier: Filled.
        error: Filled; infinite behind the camera.
    """
    count = 0
    # chi-square tests at 95 %, with two degrees of freedom or, with depth, three
    for i in range(points.shape[0]):
        pixel, whole = observation_chi2(
            pose,
            points[i],
            measured.uv[i],
            measured.right[i],
            measured.info[i],
            measured.info_right[i],
            camera,
        )
        error[i] = np.sqrt(pixel)
        inlier[i] = whole <= (CHI2_DEPTH if measured.info_right[i] > 0.0 else CHI2_MONO)
        count += inlier[i]
    return count


@kernel
def _optimise(
    pose: Array,
    points: Array,
    measured: Measurements,
    camera: Intrinsics,
    rounds: int,
    iterations: int,
) -> tuple[Array, NDArray[np.bool_], Array, Array]:
    """Pose ``[4, 4]``, inliers ``[N]``, their errors ``[N]`` and the lower triangle of the information ``[6, 6]``.

    Args:
        pose: World to camera ``[4, 4]`` to start from.
        points: World points ``[N, 3]``.
        measured: Where the image shows them.
        camera: Intrinsics.
        rounds: Optimisations, each followed by a new sorting into inliers and outliers.
        iterations: Steps a round at most.
    """
    # every point is an inlier at first
    inlier = np.ones(len(points), np.bool_)
    error = np.zeros(len(points))
    chi2 = np.empty(len(points))
    h = np.zeros((6, 6))
    g = np.zeros(6)
    for number in range(rounds):
        # Huber's kernel, and in the last round Cauchy's, as wide as the inliers' residuals
        width = 0.0
        if number == rounds - 1:
            for i in range(len(points)):
                chi2[i] = error[i] * error[i] if inlier[i] else np.inf
            width = cauchy_width(chi2)

        # Levenberg-Marquardt on the inliers of the last round
        damping = DAMPING
        cost = _linearise(pose, points, measured, inlier, width, camera, h, g)
        for _ in range(iterations):
            # a step of Levenberg and Marquardt: the damping grows the diagonal
            work = h.copy()
            for m in range(6):
                work[m, m] += damping * h[m, m] + 1e-9
            step = g.copy()
            if not cholesky_solve(work, step):
                break
            candidate = apply_twist(pose, step)

            # take it if the cost does not grow, else damp more
            new_h = np.zeros((6, 6))
            new_g = np.zeros(6)
            new_cost = _linearise(candidate, points, measured, inlier, width, camera, new_h, new_g)
            if new_cost <= cost:
                gain = cost - new_cost
                damping = max(damping * 0.1, LEAST_DAMPING)
                pose = candidate
                cost = new_cost
                h = new_h
                g = new_g
                if gain < CONVERGED_GAIN * (cost + 1e-12):
                    break
            else:
                damping *= 100.0
                if damping > MOST_DAMPING:
                    break
        # sort all points into inliers and outliers again
        count = _classify(pose, points, measured, camera, inlier, error)
        if count < MIN_POINTS:
            break
    return pose, inlier, error, h


def optimise_pose(
    T_cam_world: Array,
    points: Array,
    measured: Measurements,
    camera: Camera,
    *,
    rounds: int = 4,
    iterations: int = 6,
) -> PoseEstimate:
    """Fit the world-to-camera pose to the pixels of known points, and tell which of them fit.

    Args:
        T_cam_world: Where to start ``[4, 4]``.
        points: World points ``[N, 3]``, metres.
        measured: Where the image shows them.
        camera: Intrinsics and baseline.
        rounds: Optimisations, each followed by a new sorting into inliers and outliers.
        iterations: Steps a round at most.

    Returns:
        The pose; with fewer than six points the start pose and no inliers.
    """
    if len(points) < MIN_POINTS:
        return PoseEstimate(T_cam_world, np.zeros(len(points), bool), 0, np.nan, np.zeros((6, 6)))
    # compiled loops take contiguous arrays
    start = np.ascontiguousarray(T_cam_world, np.float64)
    contiguous = Measurements(*map(np.ascontiguousarray, measured))
    pose, inliers, error, h = _optimise(
        start,
        np.ascontiguousarray(points),
        contiguous,
        intrinsics_of(camera),
        rounds,
        iterations,
    )
    # errors in standard deviations are pixels of octave 0; the kernel fills the lower triangle only
    residual_px = float(np.median(error[inliers])) if inliers.any() else np.nan
    information = np.tril(h) + np.tril(h, -1).T
    return PoseEstimate(pose, inliers, int(np.count_nonzero(inliers)), residual_px, information)
