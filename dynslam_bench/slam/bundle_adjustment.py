"""Local bundle adjustment: Levenberg-Marquardt with the Schur complement over the points.

Residuals weigh by Cauchy's kernel, as wide as they are at the start (see `pose_optimisation`).

The work is a function of the number of observations and iterations only, and everything runs in one
thread in a fixed order: equal input gives equal bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import inlined, kernel
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.gauss_newton import apply_twist, cholesky_solve, transform_point
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.pose_optimisation import (
    CHI2_DEPTH,
    CHI2_MONO,
    MEDIAN_CHI2,
    Intrinsics,
    Measurements,
    cauchy_width,
    intrinsics_of,
    observation_chi2,
)

FIXED_KEYFRAMES = 6
"""Further keyframes that observe the same points and stay where they are."""
DEPTH_SHARE = MEDIAN_CHI2 / 2.366
"""Median of chi-square with two degrees of freedom over that with three, which observations with depth have."""
MAX_OBSERVATIONS = 6000
"""Observations used at most: the budget that bounds the time of a keyframe."""
MIN_VIEWS = 2
"""Keyframes of the bundle that must observe a point."""
BEHIND_COST = 100.0 * CHI2_DEPTH
"""Cost of an observation that lies behind the camera."""
DAMPING = 1e-5
"""Levenberg-Marquardt's damping at the start, relative to the diagonal."""
LEAST_DAMPING = 1e-8
"""Steps that reduce the cost lower the damping down to this."""
DAMPING_FLOOR = 1e-9
"""Least addition to the diagonal, so that directions without any information can be solved for."""
CONVERGED_GAIN = 1e-5
"""The optimisation ends when a step reduces the cost by less than this share."""
MIN_DETERMINANT = 1e-18
"""A point whose block has a smaller determinant stays where it is."""


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


class PointObservations(NamedTuple):
    """N observations, sorted by the observed point, as compiled loops take them.

    Attributes:
        pose: int64 ``[N]``, observing pose.
        point: int64 ``[N]``, observed point, ascending.
        start: int64 ``[Q + 1]``, first observation of each point; then N.
        measured: Pixels, right coordinates and their information.
    """

    pose: Slots
    point: Slots
    start: Slots
    measured: Measurements


class NormalEquations(NamedTuple):
    """The Gauss-Newton system of P variable poses and Q points, in blocks.

    ::

        [ poses      coupling ] [twists]   [gradient      ]
        [ coupling^T points   ] [moves ] = [point_gradient]

    Attributes:
        poses: ``[6 P, 6 P]``, of which the lower triangle is used; after the elimination of the
            points the reduced camera system (their Schur complement).
        gradient: ``[6 P]``; after the elimination that of the reduced system.
        coupling: ``[N, 6, 3]``, the block of each observation's pose and point.
        point_inverse: ``[Q, 3, 3]``, inverse of each point's damped block; 0 where that is
            singular.
        point_gradient: ``[Q, 3]``.
    """

    poses: Array
    gradient: Array
    coupling: Array
    point_inverse: Array
    point_gradient: Array


@kernel
def _robust_cost(
    poses: Array,
    points: Array,
    observations: PointObservations,
    camera: Intrinsics,
    width: float,
    chi2: Array,
) -> float:
    """Cost of all observations by Cauchy's kernel of this squared width; fills `chi2` (inf behind the camera).

    Args:
        poses: World to camera ``[P, 4, 4]``.
        points: World points ``[Q, 3]``, metres.
        observations: Which pose observes which point, and where.
        camera: Intrinsics.
        width: Squared width of the kernel, as a chi-square.
        chi2: ``[N]``, filled.
    """
    measured = observations.measured
    # Cauchy's cost of a chi-square c at the squared width w: w log(1 + c / w)
    total = 0.0
    for k in range(observations.pose.shape[0]):
        _, chi2[k] = observation_chi2(
            poses[observations.pose[k]],
            points[observations.point[k]],
            measured.uv[k],
            measured.right[k],
            measured.info[k],
            measured.info_right[k],
            camera,
        )
        total += BEHIND_COST if chi2[k] == np.inf else width * np.log1p(chi2[k] / width)
    return total


@inlined
def _fill_point_jacobian(
    pose: Array, du_dx: float, du_dz: float, dv_dy: float, dv_dz: float, dr_dz: float, out: Array
) -> None:
    """Derivatives ``[3, 3]`` of (u, v, right) by the world point: those in the camera frame times the rotation.

    Args:
        pose: World to camera ``[4, 4]``.
        du_dx: Derivative of u by x in the camera frame, which is that of `right`, too.
        du_dz: Derivative of u by the depth.
        dv_dy: Derivative of v by y.
        dv_dz: Derivative of v by the depth.
        dr_dz: Derivative of the right coordinate by the depth.
        out: Filled.
    """
    # one column a world axis; `right` moves along x as u does
    for m in range(3):
        out[0, m] = du_dx * pose[0, m] + du_dz * pose[2, m]
        out[1, m] = dv_dy * pose[1, m] + dv_dz * pose[2, m]
        out[2, m] = du_dx * pose[0, m] + dr_dz * pose[2, m]


@inlined
def _fill_pose_jacobian(
    x: float,
    y: float,
    z: float,
    du_dx: float,
    du_dz: float,
    dv_dy: float,
    dv_dz: float,
    dr_dz: float,
    out: Array,
) -> None:
    """Derivatives ``[3, 6]`` of (u, v, right) by a twist (translation, rotation) in the camera frame.

    Args:
        x: The point in the camera frame, metres: to the right.
        y: Downwards.
        z: Forwards.
        du_dx: Derivative of u by x, which is that of `right`, too.
        du_dz: Derivative of u by z.
        dv_dy: Derivative of v by y.
        dv_dz: Derivative of v by z.
        dr_dz: Derivative of the right coordinate by z.
        out: Filled.
    """
    # a rotation about an axis moves the point by the cross product: (0, -z, y), (z, 0, -x), (-y, x, 0)
    # u
    out[0, 0] = du_dx
    out[0, 1] = 0.0
    out[0, 2] = du_dz
    out[0, 3] = du_dz * y
    out[0, 4] = du_dx * z - du_dz * x
    out[0, 5] = -du_dx * y
    # v
    # v
    out[1, 0] = 0.0
    out[1, 1] = dv_dy
    out[1, 2] = dv_dz
    out[1, 3] = dv_dz * y - dv_dy * z
    out[1, 4] = -dv_dz * x
    out[1, 5] = dv_dy * x
    # the right coordinate
    out[2, 0] = du_dx
    out[2, 1] = 0.0
    out[2, 2] = dr_dz
    out[2, 3] = dr_dz * y
    out[2, 4] = du_dx * z - dr_dz * x
    out[2, 5] = -du_dx * y


@inlined
def _invert_symmetric(h: Array, out: Array) -> None:
    """The inverse of a symmetric matrix ``[3, 3]``, of which the lower triangle is read; nothing if it is singular."""
    # by the adjugate: cofactors over the determinant
    h00 = h[0, 0]
    h10 = h[1, 0]
    h11 = h[1, 1]
    h20 = h[2, 0]
    h21 = h[2, 1]
    h22 = h[2, 2]
    c00 = h11 * h22 - h21 * h21
    c10 = h20 * h21 - h10 * h22
    c20 = h10 * h21 - h20 * h11
    # expansion along the first column
    determinant = h00 * c00 + h10 * c10 + h20 * c20
    # the other three cofactors are needed only here
    if determinant > MIN_DETERMINANT:
        t = 1.0 / determinant
        out[0, 0] = c00 * t
        out[0, 1] = c10 * t
        out[0, 2] = c20 * t
        out[1, 0] = c10 * t
        out[1, 1] = (h00 * h22 - h20 * h20) * t
        out[1, 2] = (h10 * h20 - h00 * h21) * t
        out[2, 0] = c20 * t
        out[2, 1] = (h10 * h20 - h00 * h21) * t
        out[2, 2] = (h00 * h11 - h10 * h10) * t


@kernel
def _linearise(
    poses: Array,
    variable: int,
    points: Array,
    observations: PointObservations,
    camera: Intrinsics,
    width: float,
    damping: float,
    chi2: Array,
) -> NormalEquations:
    """The damped Gauss-Newton system, each observation weighted by Cauchy's kernel of this squared width.

    Args:
        poses: World to camera ``[P, 4, 4]``.
        variable: How many poses, the first ones, are refined.
        points: World points ``[Q, 3]``.
        observations: Which pose observes which point, and where; sorted by point.
        camera: Intrinsics.
        width: Squared width of the kernel.
        damping: Share of each diagonal element that is added to it.
        chi2: Chi-square of each observation ``[N]`` at these poses and points; infinite ones are
            left out.
    """
    # the blocks of all poses and points, zero at first
    start = observations.start
    measured = observations.measured
    n = observations.pose.shape[0]
    q = points.shape[0]
    size = 6 * variable
    h_poses = np.zeros((size, size))
    gradient = np.zeros(size)
    coupling = np.zeros((n, 6, 3))
    point_inverse = np.zeros((q, 3, 3))
    point_gradient = np.zeros((q, 3))
    # of one observation, of its point's block
    j_pose = np.zeros((3, 6))
    j_point = np.zeros((3, 3))
    residual = np.zeros(3)
    h_point = np.zeros((3, 3))
    # point by point, with all its observations
    for i in range(q):
        h_point[:] = 0.0
        for k in range(start[i], start[i + 1]):
            if chi2[k] == np.inf:
                continue

            # residuals of the pixel and of the right coordinate
            depth = measured.info_right[k] > 0.0
            weight = 1.0 / (1.0 + chi2[k] / width)
            c = observations.pose[k]
            pose = poses[observations.pose[k]]
            x, y, z = transform_point(pose, points[i])
            iz = 1.0 / z
            u = camera.fx * x * iz + camera.cx
            residual[0] = measured.uv[k, 0] - u
            residual[1] = measured.uv[k, 1] - (camera.fy * y * iz + camera.cy)
            residual[2] = measured.right[k] - (u - camera.bf * iz) if depth else 0.0

            # derivatives by the point in the camera frame; those of `right` by x are those of u
            du_dx = camera.fx * iz
            dv_dy = camera.fy * iz
            du_dz = -du_dx * x * iz
            dv_dz = -dv_dy * y * iz
            dr_dz = du_dz + camera.bf * iz * iz

            # the point's block J^T W J and gradient J^T W r; the lower triangle is enough
            _fill_point_jacobian(pose, du_dx, du_dz, dv_dy, dv_dz, dr_dz, j_point)
            w_pixel = weight * measured.info[k]
            w_right = weight * measured.info_right[k]
            for m in range(3):
                f0 = w_pixel * j_point[0, m]
                f1 = w_pixel * j_point[1, m]
                f2 = w_right * j_point[2, m] if depth else 0.0
                point_gradient[i, m] += f0 * residual[0] + f1 * residual[1] + f2 * residual[2]
                for o in range(m + 1):
                    h_point[m, o] += f0 * j_point[0, o] + f1 * j_point[1, o] + f2 * j_point[2, o]

            # the pose's block and gradient, and what couples it with the point; fixed poses have none
            if c < variable:
                _fill_pose_jacobian(x, y, z, du_dx, du_dz, dv_dy, dv_dz, dr_dz, j_pose)
                base = 6 * c
                for m in range(6):
                    f0 = w_pixel * j_pose[0, m]
                    f1 = w_pixel * j_pose[1, m]
                    f2 = w_right * j_pose[2, m] if depth else 0.0
                    gradient[base + m] += f0 * residual[0] + f1 * residual[1] + f2 * residual[2]
                    for o in range(m + 1):
                        h_poses[base + m, base + o] += (
                            f0 * j_pose[0, o] + f1 * j_pose[1, o] + f2 * j_pose[2, o]
                        )
                    for o in range(3):
                        coupling[k, m, o] = (
                            f0 * j_point[0, o] + f1 * j_point[1, o] + f2 * j_point[2, o]
                        )

        # damp the point's block, and invert it
        for m in range(3):
            h_point[m, m] += damping * h_point[m, m] + DAMPING_FLOOR
        _invert_symmetric(h_point, point_inverse[i])

    # damp the pose blocks before the points are eliminated
    for m in range(size):
        h_poses[m, m] += damping * h_poses[m, m] + DAMPING_FLOOR
    return NormalEquations(h_poses, gradient, coupling, point_inverse, point_gradient)


@kernel
def _eliminate_points(
    system: NormalEquations, observations: PointObservations, variable: int
) -> None:
    """Reduce the system to the poses, in place: the Schur complement ``poses - coupling points^-1 coupling^T``."""
    start = observations.start
    y = np.zeros((6, 3))
    # each point couples all poses that observe it
    for i in range(system.point_gradient.shape[0]):
        inverse = system.point_inverse[i]
        b = system.point_gradient[i]
        for k in range(start[i], start[i + 1]):
            c = observations.pose[k]
            if c >= variable:
                continue

            # y = coupling points^-1 of this observation
            w = system.coupling[k]
            for m in range(6):
                for o in range(3):
                    y[m, o] = (
                        w[m, 0] * inverse[0, o] + w[m, 1] * inverse[1, o] + w[m, 2] * inverse[2, o]
                    )
            # gradient -= coupling points^-1 point_gradient
            base = 6 * c
            for m in range(6):
                system.gradient[base + m] -= y[m, 0] * b[0] + y[m, 1] * b[1] + y[m, 2] * b[2]

            # with every pose that observes the point, too; the lower triangle is enough
            for k2 in range(start[i], start[i + 1]):
                c2 = observations.pose[k2]
                if c2 > c:
                    continue
                w2 = system.coupling[k2]
                base2 = 6 * c2
                for m in range(6):
                    y0 = y[m, 0]
                    y1 = y[m, 1]
                    y2 = y[m, 2]
                    for o in range(6):
                        system.poses[base + m, base2 + o] -= (
                            y0 * w2[o, 0] + y1 * w2[o, 1] + y2 * w2[o, 2]
                        )


@kernel
def _move_points(
    points: Array,
    system: NormalEquations,
    twists: Array,
    observations: PointObservations,
    variable: int,
    new_points: Array,
) -> None:
    """Solve for the points by back-substitution: ``points^-1 (point_gradient - coupling^T twists)``.

    Args:
        points: World points ``[Q, 3]`` before the step.
        system: The system whose points were eliminated.
        twists: Solution for the poses ``[6 P]``.
        observations: Which pose observes which point.
        variable: How many poses are refined.
        new_points: ``[Q, 3]``, filled.
    """
    start = observations.start
    # each point by itself: its gradient less what the poses' twists change, times the inverse block
    for i in range(points.shape[0]):
        b0 = system.point_gradient[i, 0]
        b1 = system.point_gradient[i, 1]
        b2 = system.point_gradient[i, 2]
        for k in range(start[i], start[i + 1]):
            c = observations.pose[k]
            if c < variable:
                for m in range(6):
                    x = twists[6 * c + m]
                    b0 = b0 - system.coupling[k, m, 0] * x
                    b1 = b1 - system.coupling[k, m, 1] * x
                    b2 = b2 - system.coupling[k, m, 2] * x
        v = system.point_inverse[i]
        for m in range(3):
            new_points[i, m] = points[i, m] + v[m, 0] * b0 + v[m, 1] * b1 + v[m, 2] * b2


@kernel
def _step(
    poses: Array,
    variable: int,
    points: Array,
    observations: PointObservations,
    camera: Intrinsics,
    width: float,
    damping: float,
    chi2: Array,
    new_poses: Array,
    new_points: Array,
) -> bool:
    """One damped Gauss-Newton step from (poses, points) into (new_poses, new_points); False if it cannot be solved.

    Args:
        poses: World to camera ``[P, 4, 4]``.
        variable: How many poses are refined.
        points: World points ``[Q, 3]``.
        observations: Which pose observes which point, and where.
        camera: Intrinsics.
        width: Squared width of the robust kernel.
        damping: Levenberg-Marquardt's damping.
        chi2: Chi-square of each observation ``[N]`` before the step.
        new_poses: ``[P, 4, 4]``, filled.
        new_points: ``[Q, 3]``, filled.
    """
    system = _linearise(poses, variable, points, observations, camera, width, damping, chi2)

    # the points are many and depend on poses alone: eliminate them, and solve for the poses
    _eliminate_points(system, observations, variable)
    twists = system.gradient
    if not cholesky_solve(system.poses, twists):
        return False
    for c in range(variable):
        moved = apply_twist(poses[c], twists[6 * c : 6 * c + 6])
        for m in range(4):
            for o in range(4):
                new_poses[c, m, o] = moved[m, o]

    # each point follows from the poses
    _move_points(points, system, twists, observations, variable, new_points)
    return True


@kernel
def _adjust(
    poses: Array,
    variable: int,
    points: Array,
    observations: PointObservations,
    camera: Intrinsics,
    iterations: int,
    chi2: Array,
) -> tuple[Array, Array, float]:
    """Poses ``[P, 4, 4]``, points ``[Q, 3]`` and their cost after Levenberg-Marquardt; fills `chi2`.

    Args:
        poses: World to camera ``[P, 4, 4]`` to start from.
        variable: How many poses are refined.
        points: World points ``[Q, 3]`` to start from.
        observations: Which pose observes which point, and where.
        camera: Intrinsics.
        iterations: Steps at most.
        chi2: Chi-square of each observation ``[N]``, filled.
    """
    # the kernel is as wide as the residuals are at the start
    _robust_cost(poses, points, observations, camera, 1.0, chi2)
    # an observation with depth has three degrees of freedom: its chi-square is scaled to two
    trial = np.empty(len(chi2))
    for k in range(len(chi2)):
        depth = observations.measured.info_right[k] > 0.0
        trial[k] = chi2[k] * DEPTH_SHARE if depth else chi2[k]

    # the cost at the start
    width = cauchy_width(trial)
    cost = _robust_cost(poses, points, observations, camera, width, chi2)
    damping = DAMPING
    for _ in range(iterations):
        # try a step
        new_poses = poses.copy()
        new_points = points.copy()
        solved = _step(
            poses,
            variable,
            points,
            observations,
            camera,
            width,
            damping,
            chi2,
            new_poses,
            new_points,
        )
        if solved:
            # take a step that reduces the cost, and damp less
            new = _robust_cost(new_poses, new_points, observations, camera, width, trial)
            if new < cost:
                gain = cost - new
                damping = max(damping * 0.2, LEAST_DAMPING)
                poses = new_poses
                points = new_points
                cost = new
                for k in range(len(chi2)):
                    chi2[k] = trial[k]
                if gain < CONVERGED_GAIN * cost:
                    break
                continue
        # else damp more
        damping *= 30.0
    return poses, points, cost


def adjust_bundle(problem: BundleProblem, iterations: int) -> BundleResult:
    """Minimise the robust reprojection error over the variable poses and all points.

    Args:
        problem: Start values and observations; every point should have two observations or depth.
        iterations: Levenberg-Marquardt iterations at most.
    """
    # where each point's observations begin: they are sorted by point
    chi2 = np.zeros(len(problem.obs_pose))
    start = np.searchsorted(problem.obs_point, np.arange(len(problem.points) + 1)).astype(np.int64)
    measured = Measurements(problem.uv, problem.right, problem.info, problem.info_right)
    observations = PointObservations(problem.obs_pose, problem.obs_point, start, measured)

    # optimise
    poses, points, cost = _adjust(
        np.ascontiguousarray(problem.poses),
        problem.variable,
        np.ascontiguousarray(problem.points),
        observations,
        intrinsics_of(problem.camera),
        iterations,
        chi2,
    )

    # observations within the 95 % quantile are inliers
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


def local_bundle(slam_map: Map, slot: int, window: int) -> Bundle | None:
    """The local window around a keyframe, cut to the observation budget; None if there is nothing to refine.

    Variable are the keyframe and its most covisible ones; fixed are further keyframes that observe
    the same points, and always at least one. The oldest keyframe of all is never variable.

    Args:
        slam_map: The map.
        slot: The keyframe.
        window: Variable keyframes at most.
    """
    # the keyframe and its most covisible ones vary, but for the oldest of all (id 0)
    near, _ = slam_map.covisible(slot)
    variable = np.concatenate([[slot], near[: window - 1]]).astype(np.int64)
    variable = variable[slam_map.kf_id[variable] > 0]
    if not len(variable):
        return None
    # the keyframes that observe the same points hold the window in place
    points = slam_map.points_of(variable)
    fixed, _ = slam_map.covisible_of(points)
    fixed = fixed[~np.isin(fixed, variable)][:FIXED_KEYFRAMES]

    # without any other observer the least covisible keyframe stays
    if not len(fixed):
        if len(variable) < 2:
            return None
        fixed = variable[-1:]
        variable = variable[:-1]
    return _bundle(slam_map, variable, fixed, points, MAX_OBSERVATIONS)


def full_bundle(slam_map: Map) -> Bundle | None:
    """All keyframes and points; the oldest keyframe stays. None if there are no two keyframes."""
    keyframes = slam_map.keyframes
    if len(keyframes) < 2:
        return None
    # no budget: every observation counts
    all_observations = int(slam_map.n_obs[slam_map.points].sum())
    return _bundle(slam_map, keyframes[1:], keyframes[:1], slam_map.points, all_observations)


def _bundle(
    slam_map: Map, variable: Slots, fixed: Slots, points: Slots, max_observations: int
) -> Bundle | None:
    """The bundle of these keyframes and points (slots); None if no point is observed often enough.

    Args:
        slam_map: The map.
        variable: Keyframes that are refined.
        fixed: Keyframes that stay.
        points: Points that they observe; those with too few views are left out.
        max_observations: Observations at most; points with the most views come first.
    """
    # observations of the points, and the number in the bundle of the pose that each is made from
    poses = np.concatenate([variable, fixed])
    pose_number = np.full(slam_map.kf_alive.size, -1, np.int64)
    pose_number[poses] = np.arange(len(poses))
    keyframes, all_features = slam_map.observations(points)
    of_point = np.repeat(np.arange(len(points)), slam_map.n_obs[points])
    pose = pose_number[keyframes]

    # points with the longest tracks first, while the budget lasts
    views = np.bincount(of_point[pose >= 0], minlength=len(points))
    supported = np.flatnonzero(views >= MIN_VIEWS)
    order = supported[np.lexsort((slam_map.id[points[supported]], -views[supported]))]
    order = np.sort(order[np.cumsum(views[order]) <= max_observations])
    if not len(order):
        return None

    # their observations, sorted by point
    point_number = np.full(len(points), -1, np.int64)
    point_number[order] = np.arange(len(order))
    used = (pose >= 0) & (point_number[of_point] >= 0)
    obs_point = point_number[of_point[used]]
    obs_pose = pose[used]
    points = points[order]
    features = all_features[used].astype(np.int64)

    # the measurements of these observations
    observers = poses[obs_pose]
    problem = BundleProblem(
        slam_map.kf_pose[poses],
        len(variable),
        slam_map.position[points],
        obs_pose,
        obs_point,
        slam_map.kf_xy[observers, features],
        slam_map.kf_right[observers, features],
        slam_map.kf_info[observers, features],
        slam_map.kf_info_right[observers, features],
        slam_map.camera,
    )
    return Bundle(problem, poses, points, features)
