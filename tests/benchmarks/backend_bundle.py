"""Local bundle adjustment by the Schur solver and by gtsam on the same problems, in turn: time, cost reached, poses.

    python tests/benchmarks/backend_bundle.py

Needs the extra: ``pip install '.[gtsam]'``.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import time
from dataclasses import replace

import gtsam
import numpy as np
import pandas as pd

from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.bundle_adjustment import (
    DEPTH_SHARE,
    BundleProblem,
    BundleResult,
    adjust_bundle,
)
from dynslam_bench.slam.pose_optimisation import cauchy_width

FIXED_SIGMA = 1e-5
"""Standard deviation (rad, m) of the prior of a fixed pose; an equality constraint is seven times slower."""


REPEATS = 5
OBSERVATIONS = 6000
ITERATIONS = 3


def problem(
    observations: int, seed: int, poses: int = 14, variable: int = 8
) -> tuple[BundleProblem, np.ndarray]:
    """A room seen from `poses` cameras, disturbed; and the true poses."""
    rng = np.random.default_rng(seed)
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    truth = se3.exp(rng.normal(0, 0.06, (poses, 6)))
    each = 5
    points = rng.uniform([-1.5, -1, 1.5], [1.5, 1, 4], (observations // each, 3))
    at = np.sort(np.argsort(rng.random((len(points), poses)), axis=1)[:, :each], axis=1)
    obs_pose = at.ravel()
    obs_point = np.repeat(np.arange(len(points)), each)
    local = (
        np.einsum("nij,nj->ni", truth[obs_pose, :3, :3], points[obs_point]) + truth[obs_pose, :3, 3]
    )
    uv = camera.project(local)
    right = uv[:, 0] - camera.fx * camera.baseline_m / local[:, 2]
    uv = uv + rng.normal(0, 0.7, uv.shape)
    right = right + rng.normal(0, 0.7, right.shape)
    start = truth.copy()
    start[:variable] = se3.exp(rng.normal(0, 0.01, (variable, 6))) @ truth[:variable]
    info = np.ones(len(uv))
    noisy = points + rng.normal(0, 0.02, points.shape)
    return BundleProblem(
        start, variable, noisy, obs_pose, obs_point, uv, right, info, info, camera
    ), truth


def adjust_bundle_gtsam(problem: BundleProblem, iterations: int) -> BundleResult:
    """Minimise the reprojection error by gtsam's Levenberg-Marquardt; all observations have depth."""
    camera = problem.camera
    lens = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.baseline_m)
    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    pose_keys = [gtsam.symbol("x", i) for i in range(len(problem.poses))]
    point_keys = [gtsam.symbol("l", i) for i in range(len(problem.points))]
    prior = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    for i, pose in enumerate(np.linalg.inv(problem.poses)):
        values.insert(pose_keys[i], gtsam.Pose3(pose))
        if i >= problem.variable:
            graph.add(gtsam.PriorFactorPose3(pose_keys[i], gtsam.Pose3(pose), prior))
    for key, point in zip(point_keys, problem.points, strict=True):
        values.insert(key, point)
    width = cauchy_width(adjust_bundle(problem, 0).chi2 * DEPTH_SHARE)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(float(np.sqrt(width)))
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    for k, (u, v) in enumerate(problem.uv):
        keys = pose_keys[problem.obs_pose[k]], point_keys[problem.obs_point[k]]
        graph.add(
            gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(u, problem.right[k], v), noise, *keys, lens
            )
        )
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    poses = np.linalg.inv([result.atPose3(key).matrix() for key in pose_keys])
    points = np.array([result.atPoint3(key) for key in point_keys])
    return adjust_bundle(replace(problem, poses=poses, points=points), 0)


def main() -> None:
    """Print one row a solver."""
    adjust_bundle(problem(200, 0)[0], 1)  # compiles
    rows = []
    for seed in range(REPEATS):
        bundle, truth = problem(OBSERVATIONS, seed)
        for name, solve in (("schur", adjust_bundle), ("gtsam", adjust_bundle_gtsam)):
            begin = time.process_time()
            result = solve(bundle, ITERATIONS)
            spent_ms = 1e3 * (time.process_time() - begin)
            cost = adjust_bundle(replace(bundle, poses=result.poses, points=result.points), 0).cost
            off = se3.inverse(result.poses[: bundle.variable]) @ truth[: bundle.variable]
            rows.append((name, spent_ms, cost, 1e3 * np.linalg.norm(off[:, :3, 3], axis=1).mean()))
    measured = pd.DataFrame(rows, columns=["solver", "ms", "cost", "mm"])
    print(f"{OBSERVATIONS} observations, 8 + 6 poses, {ITERATIONS} iterations, processor time")
    print("| solver | ms median | ms min | cost | camera error mm |")
    print("| --- | --- | --- | --- | --- |")
    for name, part in measured.groupby("solver", sort=False):
        print(
            f"| {name} | {part.ms.median():.1f} | {part.ms.min():.1f} | {part.cost.mean():.0f} | {part.mm.mean():.2f} |"
        )


if __name__ == "__main__":
    main()
