"""Local bundle adjustment against a general least-squares solver."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.bundle_adjustment import BundleProblem, adjust_bundle

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
POSES, VARIABLE, POINTS = 5, 3, 30


def measured(poses, points):
    """Pixels and right coordinates ``[N, 3]`` of all points in all views, point by point."""
    local = np.einsum("pij,qj->qpi", poses[:, :3, :3], points) + poses[:, :3, 3]
    uv = CAMERA.project(local)
    return np.concatenate([uv, uv[..., :1] - CAMERA.fx * CAMERA.baseline_m / local[..., 2:]], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("with_depth", [0.6, 1.0])
def test_bundle_adjustment_agrees_with_general_least_squares(with_depth):
    rng = np.random.default_rng(0)
    true, points = se3.exp(rng.normal(0, 0.06, (POSES, 6))), rng.uniform([-1, -1, 2], [1, 1, 4], (POINTS, 3))
    values = measured(true, points) + rng.normal(0, 0.3, (POSES * POINTS, 3))
    info, has_depth = np.ones(len(values)), rng.random(len(values)) < with_depth
    start = np.concatenate([se3.exp(rng.normal(0, 0.01, (VARIABLE, 6))) @ true[:VARIABLE], true[VARIABLE:]])
    problem = BundleProblem(
        start, VARIABLE, points + rng.normal(0, 0.02, points.shape), np.tile(np.arange(POSES), POINTS),
        np.repeat(np.arange(POINTS), POSES), values[:, :2], values[:, 2], info, info * has_depth, CAMERA,
    )  # fmt: skip

    def moved(x):
        twists, offsets = np.split(x, [6 * VARIABLE])
        poses = np.concatenate([se3.exp(twists.reshape(-1, 6)) @ start[:VARIABLE], start[VARIABLE:]])
        return poses, problem.points + offsets.reshape(-1, 3)

    def residuals(x):
        return (np.where([True, True, False], True, has_depth[:, None]) * (measured(*moved(x)) - values)).ravel()

    solution = least_squares(residuals, np.zeros(6 * VARIABLE + 3 * POINTS), xtol=1e-12, ftol=1e-12)
    poses, _ = moved(solution.x)
    result = adjust_bundle(problem, 40)
    assert result.inliers.all() and result.cost == pytest.approx(2 * solution.cost, rel=1e-4)
    np.testing.assert_allclose(result.poses, poses, atol=1e-4)
    assert adjust_bundle(replace(problem, poses=true), 0).cost > result.cost
