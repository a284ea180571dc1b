"""Robust pose optimisation against known points: Gauss-Newton on SE(3) with the right coordinate of depth.

The residual of a point is ``(u - u', v - v', ur - (u' - b f / z'))``; features without depth have
the first two rows only. Rounds of a Huber-weighted Gauss-Newton alternate with a chi-square test
that sets outliers aside, as in motion-only bundle adjustment of ORB-SLAM2 (Mur-Artal and Tardos,
2017, Section III-C). The last round weighs the inliers by Cauchy's kernel, as wide as their own
residuals are: most features are located far more exactly than the assumed pixel, and those that are
not would move the pose by centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
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
NEAR_M = 0.05
"""Points nearer than this to the camera plane are never inliers."""


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


@kernel
def cauchy_width(chi2: Array) -> float:
    """Squared width of the kernel for observations with these chi-squares, by the median of those in front."""
    finite = chi2[np.isfinite(chi2)]
    return CAUCHY * (max(np.median(finite) / MEDIAN_CHI2, LEAST_VARIANCE) if len(finite) else 1.0)


@kernel
def _linearise(
    pose: Array,
    points: Array,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    active: NDArray[np.bool_],
    width: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    h: Array,
    g: Array,
) -> float:
    """Fill the Gauss-Newton system; returns the cost.

    The cost is that of Cauchy's kernel of a squared width, or of Huber's where that is 0.
    """
    h[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(points.shape[0]):
        if not active[i]:
            continue
        x, y, z = transform_point(pose, points[i])
        depth = info_right[i] > 0.0
        limit = CHI2_DEPTH if depth else CHI2_MONO
        if z < NEAR_M:
            cost += limit
            continue
        iz = 1.0 / z
        u = fx * x * iz + cx
        du = uv[i, 0] - u
        dv = uv[i, 1] - (fy * y * iz + cy)
        dr = right[i] - (u - bf * iz) if depth else 0.0
        chi2 = info[i] * (du * du + dv * dv) + (info_right[i] * dr * dr if depth else 0.0)
        w = 1.0
        if width > 0.0:
            w = 1.0 / (1.0 + chi2 / width)
            cost += width * np.log1p(chi2 / width)
        elif chi2 > limit:
            w = np.sqrt(limit / chi2)
            cost += 2.0 * np.sqrt(limit * chi2) - limit
        else:
            cost += chi2
        a = fx * iz
        b = fy * iz
        c = bf * iz * iz
        j2 = -a * x * iz
        j3 = -fx * x * y * iz * iz
        j4 = fx * (1.0 + x * x * iz * iz)
        j5 = -a * y
        add_normal_equation(h, g, w * info[i], a, 0.0, j2, j3, j4, j5, du)
        turned = -fy * (1.0 + y * y * iz * iz)
        add_normal_equation(
            h, g, w * info[i], 0.0, b, -b * y * iz, turned, fy * x * y * iz * iz, b * x, dv
        )
        if depth:
            add_normal_equation(
                h, g, w * info_right[i], a, 0.0, j2 + c, j3 + c * y, j4 - c * x, j5, dr
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
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
) -> tuple[float, float]:
    """Chi-square of one observation by its pixel alone, and with its right coordinate; inf behind the camera."""
    x, y, z = transform_point(pose, point)
    if z < NEAR_M:
        return np.inf, np.inf
    u = fx * x / z + cx
    du = uv[0] - u
    dv = uv[1] - (fy * y / z + cy)
    pixel = info * (du * du + dv * dv)
    if info_right <= 0.0:
        return pixel, pixel
    dr = right - (u - bf / z)
    return pixel, pixel + info_right * dr * dr


@kernel
def _classify(
    pose: Array,
    points: Array,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    inlier: NDArray[np.bool_],
    error: Array,
) -> None:
    for i in range(points.shape[0]):
        pixel, whole = observation_chi2(
            pose, points[i], uv[i], right[i], info[i], info_right[i], fx, fy, cx, cy, bf
        )
        error[i] = np.sqrt(pixel)
        inlier[i] = whole <= (CHI2_DEPTH if info_right[i] > 0.0 else CHI2_MONO)


@kernel
def _optimise(
    pose: Array,
    points: Array,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    rounds: int,
    iterations: int,
) -> tuple[Array, NDArray[np.bool_], Array, Array]:
    inlier = np.ones(len(points), np.bool_)
    error = np.zeros(len(points))
    h = np.zeros((6, 6))
    g = np.zeros(6)
    for turn in range(rounds):
        width = cauchy_width(error[inlier] ** 2) if turn == rounds - 1 else 0.0
        damping = 1e-6
        cost = _linearise(
            pose, points, uv, right, info, info_right, inlier, width, fx, fy, cx, cy, bf, h, g
        )
        for _ in range(iterations):
            work = h.copy()
            for m in range(6):
                work[m, m] += damping * h[m, m] + 1e-9
            step = g.copy()
            if not cholesky_solve(work, step):
                break
            candidate = apply_twist(pose, step)
            h2 = np.zeros((6, 6))
            g2 = np.zeros(6)
            new = _linearise(
                candidate,
                points,
                uv,
                right,
                info,
                info_right,
                inlier,
                width,
                fx,
                fy,
                cx,
                cy,
                bf,
                h2,
                g2,
            )
            if new <= cost:
                gain = cost - new
                damping = max(damping * 0.1, 1e-9)
                pose = candidate
                cost = new
                h = h2
                g = g2
                if gain < 1e-4 * (cost + 1e-12):
                    break
            else:
                damping *= 100.0
                if damping > 1e3:
                    break
        _classify(pose, points, uv, right, info, info_right, fx, fy, cx, cy, bf, inlier, error)
        if inlier.sum() < 6:
            break
    return pose, inlier, error, h


def optimise_pose(
    T_cam_world: Array,
    points: Array,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    camera: Camera,
    *,
    rounds: int = 4,
    iterations: int = 6,
) -> PoseEstimate:
    """The world-to-camera pose that fits the points to the pixels, and which of them fit.

    Args:
        T_cam_world: Where to start ``[4, 4]``.
        points: World points ``[N, 3]``, metres.
        uv: Undistorted pixels ``[N, 2]``.
        right: Right coordinates ``[N]``; ignored where `info_right` is 0.
        info: Inverse variances of the pixels ``[N]``, 1/px^2.
        info_right: Inverse variances of the right coordinates ``[N]``, 0 without depth.
        camera: Intrinsics and baseline.
        rounds: Optimisations, each followed by a new sorting into inliers and outliers.
        iterations: Gauss-Newton steps a round at most.

    Returns:
        The pose; with fewer than six points the start pose and no inliers.
    """
    if len(points) < 6:
        return PoseEstimate(T_cam_world, np.zeros(len(points), bool), 0, np.nan, np.zeros((6, 6)))
    start = np.ascontiguousarray(T_cam_world, np.float64)
    points, uv, right, info, info_right = map(
        np.ascontiguousarray, (points, uv, right, info, info_right)
    )
    lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline_m
    pose, inliers, error, h = _optimise(
        start, points, uv, right, info, info_right, *lens, rounds, iterations
    )
    residual_px = float(np.median(error[inliers])) if inliers.any() else np.nan
    return PoseEstimate(
        pose, inliers, int(np.count_nonzero(inliers)), residual_px, np.tril(h) + np.tril(h, -1).T
    )
