"""Local bundle adjustment: Levenberg-Marquardt with the Schur complement over the points.

Residuals weigh by Cauchy's kernel, as wide as they are at the start (see `pose_optimisation`).

The work is a function of the number of observations and iterations only, and everything runs in one
thread in a fixed order: equal input gives equal bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.gauss_newton import apply_twist, cholesky_solve, transform_point
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.pose_optimisation import (
    CHI2_DEPTH,
    CHI2_MONO,
    MEDIAN_CHI2,
    cauchy_width,
    observation_chi2,
)

FIXED_KEYFRAMES = 6
"""Further keyframes that observe the same points and stay where they are."""
DEPTH_SHARE = MEDIAN_CHI2 / 2.366
"""Median of chi-square with two degrees of freedom over that with three, which observations with depth have."""
MAX_OBSERVATIONS = 6000
"""Observations used at most: the budget that bounds the time of a keyframe."""


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """Poses, points and observations of a local bundle adjustment.

    Attributes:
        poses: World-to-camera ``[P, 4, 4]``; the first `variable` ones are refined, the others stay
            fixed.
        variable: How many poses are refined.
        points: World points ``[Q, 3]``, metres.
        obs_pose: int64 ``[N]``, observing pose.
        obs_point: int64 ``[N]``, observed point, ascending.
        uv: Undistorted pixels ``[N, 2]``.
        right: Right coordinates ``[N]``.
        info: Inverse variances of the pixels ``[N]``.
        info_right: Inverse variances of the right coordinates ``[N]``, 0 without depth.
        camera: Intrinsics and baseline.
    """

    poses: Array
    variable: int
    points: Array
    obs_pose: Slots
    obs_point: Slots
    uv: Array
    right: Array
    info: Array
    info_right: Array
    camera: Camera


@dataclass(frozen=True, eq=False)
class BundleResult:
    """Refined poses ``[P, 4, 4]`` and points ``[Q, 3]``, and how the observations fit them.

    Attributes:
        poses: World to camera.
        points: World points, metres.
        chi2: Chi-square of each observation ``[N]``; inf behind the camera.
        inliers: bool ``[N]``, which observations fit.
        cost: Sum of the costs of Cauchy's kernel.
    """

    poses: Array
    points: Array
    chi2: Array
    inliers: NDArray[np.bool_]
    cost: float


@kernel
def _cost(
    poses: Array,
    points: Array,
    obs_pose: Slots,
    obs_point: Slots,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    width: float,
    chi2: Array,
) -> float:
    """Cost of all observations under a kernel of this squared width; fills `chi2` (inf behind the camera)."""
    total = 0.0
    for k in range(obs_pose.shape[0]):
        _, chi2[k] = observation_chi2(
            poses[obs_pose[k]],
            points[obs_point[k]],
            uv[k],
            right[k],
            info[k],
            info_right[k],
            fx,
            fy,
            cx,
            cy,
            bf,
        )
        total += 100.0 * CHI2_DEPTH if chi2[k] == np.inf else width * np.log1p(chi2[k] / width)
    return total


@kernel
def _step(
    poses: Array,
    variable: int,
    points: Array,
    obs_pose: Slots,
    obs_point: Slots,
    start: Slots,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    width: float,
    damping: float,
    chi2: Array,
    new_poses: Array,
    new_points: Array,
) -> bool:
    """One damped Gauss-Newton step from (poses, points) into (new_poses, new_points); False if it cannot be solved."""
    n = obs_pose.shape[0]
    q = points.shape[0]
    size = 6 * variable
    s = np.zeros((size, size))
    g = np.zeros(size)
    w = np.zeros((n, 6, 3))  # J_pose^T Lambda J_point
    inverse = np.zeros((q, 3, 3))
    b = np.zeros((q, 3))
    jc = np.zeros((3, 6))
    jl = np.zeros((3, 3))
    e = np.zeros(3)
    hll = np.zeros((3, 3))
    y = np.zeros((6, 3))
    for i in range(q):
        hll[:] = 0.0
        for k in range(start[i], start[i + 1]):
            if chi2[k] == np.inf:
                continue
            depth = info_right[k] > 0.0
            weight = 1.0 / (1.0 + chi2[k] / width)
            c = obs_pose[k]
            r = poses[obs_pose[k]]
            xc, yc, zc = transform_point(r, points[i])
            iz = 1.0 / zc
            a = fx * iz
            d = fy * iz
            au = -a * xc * iz
            dv = -d * yc * iz
            u = fx * xc * iz + cx
            e[0] = uv[k, 0] - u
            e[1] = uv[k, 1] - (fy * yc * iz + cy)
            e[2] = right[k] - (u - bf * iz) if depth else 0.0
            ar = au + bf * iz * iz
            for m in range(3):
                jl[0, m] = a * r[0, m] + au * r[2, m]
                jl[1, m] = d * r[1, m] + dv * r[2, m]
                jl[2, m] = a * r[0, m] + ar * r[2, m]
            lu = weight * info[k]
            lr = weight * info_right[k]
            for m in range(3):
                f0 = lu * jl[0, m]
                f1 = lu * jl[1, m]
                f2 = lr * jl[2, m] if depth else 0.0
                b[i, m] += f0 * e[0] + f1 * e[1] + f2 * e[2]
                for o in range(m + 1):
                    hll[m, o] += f0 * jl[0, o] + f1 * jl[1, o] + f2 * jl[2, o]
            if c < variable:
                jc[0, 0] = a
                jc[0, 1] = 0.0
                jc[0, 2] = au
                jc[0, 3] = au * yc
                jc[0, 4] = a * zc - au * xc
                jc[0, 5] = -a * yc
                jc[1, 0] = 0.0
                jc[1, 1] = d
                jc[1, 2] = dv
                jc[1, 3] = dv * yc - d * zc
                jc[1, 4] = -dv * xc
                jc[1, 5] = d * xc
                jc[2, 0] = a
                jc[2, 1] = 0.0
                jc[2, 2] = ar
                jc[2, 3] = ar * yc
                jc[2, 4] = a * zc - ar * xc
                jc[2, 5] = -a * yc
                base = 6 * c
                for m in range(6):
                    f0 = lu * jc[0, m]
                    f1 = lu * jc[1, m]
                    f2 = lr * jc[2, m] if depth else 0.0
                    g[base + m] += f0 * e[0] + f1 * e[1] + f2 * e[2]
                    for o in range(m + 1):
                        s[base + m, base + o] += f0 * jc[0, o] + f1 * jc[1, o] + f2 * jc[2, o]
                    for o in range(3):
                        w[k, m, o] = f0 * jl[0, o] + f1 * jl[1, o] + f2 * jl[2, o]
        for m in range(3):
            hll[m, m] += damping * hll[m, m] + 1e-9
        # inverse of the symmetric 3x3 block
        h00 = hll[0, 0]
        h10 = hll[1, 0]
        h11 = hll[1, 1]
        h20 = hll[2, 0]
        h21 = hll[2, 1]
        h22 = hll[2, 2]
        c00 = h11 * h22 - h21 * h21
        c10 = h20 * h21 - h10 * h22
        c20 = h10 * h21 - h20 * h11
        det = h00 * c00 + h10 * c10 + h20 * c20
        if not det > 1e-18:
            continue
        t = 1.0 / det
        v = inverse[i]
        v[0, 0] = c00 * t
        v[0, 1] = c10 * t
        v[0, 2] = c20 * t
        v[1, 0] = c10 * t
        v[1, 1] = (h00 * h22 - h20 * h20) * t
        v[1, 2] = (h10 * h20 - h00 * h21) * t
        v[2, 0] = c20 * t
        v[2, 1] = (h10 * h20 - h00 * h21) * t
        v[2, 2] = (h00 * h11 - h10 * h10) * t
    for i in range(size):  # damp the pose blocks before the points are eliminated
        s[i, i] += damping * s[i, i] + 1e-9
    for i in range(q):
        v = inverse[i]
        for k in range(start[i], start[i + 1]):
            c = obs_pose[k]
            if c >= variable:
                continue
            wk = w[k]
            for m in range(6):
                for o in range(3):
                    y[m, o] = wk[m, 0] * v[0, o] + wk[m, 1] * v[1, o] + wk[m, 2] * v[2, o]
            base = 6 * c
            for m in range(6):
                g[base + m] -= y[m, 0] * b[i, 0] + y[m, 1] * b[i, 1] + y[m, 2] * b[i, 2]
            for k2 in range(start[i], start[i + 1]):
                c2 = obs_pose[k2]
                if c2 > c:
                    continue
                wl = w[k2]
                other = 6 * c2
                for m in range(6):
                    y0 = y[m, 0]
                    y1 = y[m, 1]
                    y2 = y[m, 2]
                    for o in range(6):
                        s[base + m, other + o] -= y0 * wl[o, 0] + y1 * wl[o, 1] + y2 * wl[o, 2]
    if not cholesky_solve(s, g):
        return False
    for c in range(variable):
        moved = apply_twist(poses[c], g[6 * c : 6 * c + 6])
        for m in range(4):
            for o in range(4):
                new_poses[c, m, o] = moved[m, o]
    for i in range(q):
        b0 = b[i, 0]
        b1 = b[i, 1]
        b2 = b[i, 2]
        for k in range(start[i], start[i + 1]):
            c = obs_pose[k]
            if c < variable:
                for m in range(6):
                    x = g[6 * c + m]
                    b0 = b0 - w[k, m, 0] * x
                    b1 = b1 - w[k, m, 1] * x
                    b2 = b2 - w[k, m, 2] * x
        v = inverse[i]
        for m in range(3):
            new_points[i, m] = points[i, m] + v[m, 0] * b0 + v[m, 1] * b1 + v[m, 2] * b2
    return True


@kernel
def _adjust(
    poses: Array,
    variable: int,
    points: Array,
    obs_pose: Slots,
    obs_point: Slots,
    start: Slots,
    uv: Array,
    right: Array,
    info: Array,
    info_right: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    iterations: int,
    chi2: Array,
) -> tuple[Array, Array, float]:
    _cost(
        poses,
        points,
        obs_pose,
        obs_point,
        uv,
        right,
        info,
        info_right,
        fx,
        fy,
        cx,
        cy,
        bf,
        1.0,
        chi2,
    )
    width = cauchy_width(np.where(info_right > 0.0, chi2 * DEPTH_SHARE, chi2))
    cost = _cost(
        poses,
        points,
        obs_pose,
        obs_point,
        uv,
        right,
        info,
        info_right,
        fx,
        fy,
        cx,
        cy,
        bf,
        width,
        chi2,
    )
    damping = 1e-5
    trial = np.empty_like(chi2)
    for _ in range(iterations):
        new_poses = poses.copy()
        new_points = points.copy()
        solved = _step(
            poses,
            variable,
            points,
            obs_pose,
            obs_point,
            start,
            uv,
            right,
            info,
            info_right,
            fx,
            fy,
            cx,
            cy,
            bf,
            width,
            damping,
            chi2,
            new_poses,
            new_points,
        )
        if solved:
            new = _cost(
                new_poses,
                new_points,
                obs_pose,
                obs_point,
                uv,
                right,
                info,
                info_right,
                fx,
                fy,
                cx,
                cy,
                bf,
                width,
                trial,
            )
            if new < cost:
                gain = cost - new
                damping = max(damping * 0.2, 1e-8)
                poses = new_poses
                points = new_points
                cost = new
                chi2[:] = trial
                if gain < 1e-5 * cost:
                    break
                continue
        damping *= 30.0
    return poses, points, cost


def adjust_bundle(problem: BundleProblem, iterations: int) -> BundleResult:
    """Minimise the robust reprojection error over the variable poses and all points.

    Args:
        problem: Start values and observations; every point should have two observations or depth.
        iterations: Levenberg-Marquardt iterations at most.
    """
    c = problem.camera
    chi2 = np.zeros(len(problem.obs_pose))
    start = np.searchsorted(problem.obs_point, np.arange(len(problem.points) + 1)).astype(np.int64)
    guess = (
        np.ascontiguousarray(problem.poses),
        problem.variable,
        np.ascontiguousarray(problem.points),
    )
    measured = problem.uv, problem.right, problem.info, problem.info_right
    lens = c.fx, c.fy, c.cx, c.cy, c.fx * c.baseline_m
    poses, points, cost = _adjust(
        *guess, problem.obs_pose, problem.obs_point, start, *measured, *lens, iterations, chi2
    )
    limit = np.where(problem.info_right > 0, CHI2_DEPTH, CHI2_MONO)
    return BundleResult(poses, points, chi2, chi2 <= limit, float(cost))


# ---------------------------------------------------------------------- the bundle of a map


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle adjustment, and where its parts are stored in the map.

    Attributes:
        problem: What is to be solved.
        poses: Slots of its keyframes ``[P]``.
        points: Slots of its points ``[Q]``.
        features: Feature number of each observation ``[N]``.
    """

    problem: BundleProblem
    poses: Slots
    points: Slots
    features: Slots


def local_bundle(world: Map, slot: int, window: int) -> Bundle | None:
    """The local window around a keyframe, cut to the observation budget; None if there is nothing to refine.

    Variable are the keyframe and its most covisible ones; fixed are further keyframes that observe
    the same points, and always at least one. The oldest keyframe of all is never variable.
    """
    near, _ = world.covisible(slot)
    variable = np.concatenate([[slot], near[: window - 1]]).astype(np.int64)
    variable = variable[world.kf_id[variable] > 0]
    if not len(variable):
        return None
    points = world.points_of(variable)
    fixed, _ = world.covisible_of(points)
    fixed = fixed[~np.isin(fixed, variable)][:FIXED_KEYFRAMES]
    if not len(fixed):
        if len(variable) < 2:
            return None
        fixed = variable[-1:]
        variable = variable[:-1]
    return _bundle(world, variable, fixed, points, MAX_OBSERVATIONS)


def full_bundle(world: Map) -> Bundle | None:
    """All keyframes and points; the oldest keyframe stays. None if there are no two keyframes."""
    keyframes = world.keyframes
    if len(keyframes) < 2:
        return None
    return _bundle(
        world, keyframes[1:], keyframes[:1], world.points, int(world.n_obs[world.points].sum())
    )


def _bundle(
    world: Map, variable: Slots, fixed: Slots, points: Slots, max_observations: int
) -> Bundle | None:
    poses = np.concatenate([variable, fixed])
    pose_number = np.full(world.kf_alive.size, -1, np.int64)
    pose_number[poses] = np.arange(len(poses))
    keyframes, all_features = world.observations(points)
    of_point = np.repeat(np.arange(len(points)), world.n_obs[points])
    pose = pose_number[keyframes]
    support = np.bincount(of_point[pose >= 0], minlength=len(points))
    supported = np.flatnonzero(support >= 2)
    # long tracks first
    order = supported[np.lexsort((world.id[points[supported]], -support[supported]))]
    order = np.sort(order[np.cumsum(support[order]) <= max_observations])
    if not len(order):
        return None
    point_number = np.full(len(points), -1, np.int64)
    point_number[order] = np.arange(len(order))
    used = (pose >= 0) & (point_number[of_point] >= 0)
    obs_point = point_number[of_point[used]]
    obs_pose = pose[used]
    points = points[order]
    features = all_features[used].astype(np.int64)
    at = poses[obs_pose]
    problem = BundleProblem(
        world.kf_pose[poses],
        len(variable),
        world.position[points],
        obs_pose,
        obs_point,
        world.kf_xy[at, features],
        world.kf_right[at, features],
        world.kf_info[at, features],
        world.kf_info_right[at, features],
        world.camera,
    )
    return Bundle(problem, poses, points, features)
