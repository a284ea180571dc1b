"""The rectangle of a box in the image holds every point of it that the camera can see."""

import numpy as np

from dynslam_bench.sequences.synthetic.renderer import bounds_of
from dynslam_bench.sequences.synthetic.settings import CAMERA


def test_bounds_hold_all_points_before_the_camera_and_no_more() -> None:
    rng = np.random.default_rng(3)
    unit = np.array([[(i >> a & 1) * 2.0 - 1 for a in range(3)] for i in range(8)])
    turns = np.linalg.qr(rng.normal(size=(400, 3, 3)))[0]
    half, centre = rng.uniform(0.02, 1.5, (400, 1, 3)), rng.uniform(-2, 2, (400, 1, 3))
    corners = (unit * half) @ turns + centre
    nearest, *rectangle = bounds_of(corners)
    assert np.array_equal(nearest, corners[:, :, 2].min(axis=1))
    low_u, low_v, high_u, high_v = rectangle
    inside = rng.uniform(-1, 1, (400, 4000, 3))
    inside[:, :2000] /= np.abs(inside[:, :2000]).max(axis=2, keepdims=True)  # half of them on the surface
    points = (inside * half) @ turns + centre
    seen = points[:, :, 2] > 0.05
    crossing = seen.any(axis=1) & ~seen.all(axis=1)
    assert crossing.sum() > 50 and (~seen).all(axis=1).sum() > 50
    z = np.where(seen, points[:, :, 2], np.nan)
    u, v = points[:, :, 0] / z * CAMERA.fx + CAMERA.cx, points[:, :, 1] / z * CAMERA.fy + CAMERA.cy
    for value, low, high in ((u, low_u, high_u), (v, low_v, high_v)):
        assert not (value < low[:, None]).any() and not (value > high[:, None]).any()
    hidden = (corners[:, :, 2] <= 0.05).all(axis=1)
    assert (low_u[hidden] > high_u[hidden]).all()
    wholly = (corners[:, :, 2] > 0.05).all(axis=1)
    exact = (corners[..., 0] / corners[..., 2] * CAMERA.fx + CAMERA.cx)[wholly]
    assert np.abs(low_u[wholly] - exact.min(axis=1) + 2).max() < 1e-9
