"""The fundamental matrix and its distances against the definition and the true motion."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    CAMERA,
    SIDEWAYS,
    scene,
)

from dynslam_bench.culling.matches import Estimator, epipolar_distance, fundamental_matrix
from dynslam_bench.geometry import se3


def test_epipolar_distance_agrees_with_the_definition() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(3, 3))
    first, second = rng.uniform(0, 600, (2, 20, 2))
    expected = []
    for (u1, v1), (u2, v2) in zip(first, second, strict=True):
        x, y, w = matrix @ (u1, v1, 1)
        expected.append(abs(x * u2 + y * v2 + w) / np.hypot(x, y))
    np.testing.assert_allclose(epipolar_distance(matrix, first, second), expected, rtol=1e-12)


@pytest.mark.parametrize("estimator", ["ransac", "lmeds", "magsac"])
def test_fundamental_matrix_is_that_of_the_true_motion(estimator: str) -> None:
    made = scene(SIDEWAYS, n_moving=0, noise_px=0.05)
    matrix = fundamental_matrix(made.state.flow.xy.astype(float), made.frame.xy, Estimator(estimator))
    assert matrix is not None
    T_cur_prev = se3.inverse(SIDEWAYS)
    essential = se3.hat(T_cur_prev[:3, 3]) @ T_cur_prev[:3, :3]
    inverse = np.linalg.inv(CAMERA.matrix)
    true = inverse.T @ essential @ inverse
    clean = scene(SIDEWAYS, n_moving=0, noise_px=0.0, seed=5)
    assert epipolar_distance(true, clean.state.flow.xy.astype(float), clean.frame.xy).max() < 1e-3
    assert np.median(epipolar_distance(matrix, clean.state.flow.xy.astype(float), clean.frame.xy)) < 0.1
