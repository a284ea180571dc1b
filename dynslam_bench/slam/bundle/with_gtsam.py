"""The same local bundle adjustment through gtsam: the reference that the own solver is measured against."""

from __future__ import annotations

from typing import Any

import numpy as np

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.version import install_hint

from ..localisation.pose import CHI2_DEPTH, CHI2_MONO
from .schur import BundleProblem, BundleResult, reprojection_chi2

FIXED_SIGMA = 1e-5
"""Standard deviation (rad, m) of the prior that holds a fixed pose; an equality constraint is seven times slower."""


def adjust_bundle_gtsam(problem: BundleProblem, iterations: int) -> BundleResult:
    """Minimise the Huber reprojection error with gtsam's Levenberg-Marquardt.

    Args:
        problem: As for `bundle.adjust_bundle`.
        iterations: Levenberg-Marquardt iterations at most.

    Raises:
        TrackerError: gtsam is not installed.
    """
    gtsam = load_gtsam("backend.bundle_adjustment.solver = gtsam")
    camera = problem.camera
    mono = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    stereo = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.baseline_m)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose_keys = [gtsam.symbol("x", i) for i in range(len(problem.poses))]
    point_keys = [gtsam.symbol("l", i) for i in range(len(problem.points))]
    hold = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    for i, pose in enumerate(np.linalg.inv(problem.poses)):
        start = gtsam.Pose3(pose)
        values.insert(pose_keys[i], start)
        if i >= problem.variable:
            graph.add(gtsam.PriorFactorPose3(pose_keys[i], start, hold))
    for key, point in zip(point_keys, problem.points, strict=True):
        values.insert(key, point)
    models: dict[tuple[float, float], Any] = {}
    for k in range(len(problem.obs_pose)):
        info, info_right = float(problem.info[k]), float(problem.info_right[k])
        if (info, info_right) not in models:
            models[info, info_right] = _noise(gtsam, info, info_right)
        keys = pose_keys[problem.obs_pose[k]], point_keys[problem.obs_point[k]]
        u, v = problem.uv[k]
        if info_right > 0:
            measured = gtsam.StereoPoint2(u, problem.right[k], v)
            graph.add(gtsam.GenericStereoFactor3D(measured, models[info, info_right], *keys, stereo))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(problem.uv[k], models[info, info_right], *keys, mono))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    result = optimiser.optimize()
    poses = problem.poses.copy()
    for i in range(problem.variable):
        poses[i] = np.linalg.inv(result.atPose3(pose_keys[i]).matrix())
    points = np.array([result.atPoint3(key) for key in point_keys]).reshape(-1, 3)
    limit = np.where(problem.info_right > 0, CHI2_DEPTH, CHI2_MONO)
    before, _ = reprojection_chi2(problem, problem.poses, problem.points)
    after, chi2 = reprojection_chi2(problem, poses, points)
    return BundleResult(poses, points, chi2 <= limit, before, after)


def load_gtsam(wanted_by: str) -> Any:
    """The module.

    Args:
        wanted_by: The setting that needs it.

    Raises:
        TrackerError: It is not installed.
    """
    try:
        import gtsam
    except ImportError as error:
        message = f"{wanted_by} needs a package that cannot be imported: {error}"
        raise TrackerError(message, f"{install_hint('gtsam')}, or leave the setting") from error
    return gtsam


def _noise(gtsam: Any, info: float, info_right: float) -> Any:
    sigma = info**-0.5
    if info_right > 0:
        base = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma, info_right**-0.5, sigma]))
        limit = CHI2_DEPTH
    else:
        base, limit = gtsam.noiseModel.Isotropic.Sigma(2, sigma), CHI2_MONO
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(float(np.sqrt(limit))), base)
