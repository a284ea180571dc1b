"""Moving things are regions."""

from __future__ import annotations

import numpy as np

from dynslam_bench.culling.ego_motion import coherent


def test_a_region_that_fails_moves_and_a_lone_point_is_noise() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform((0, 0), (640, 480), (1000, 2))
    region = (np.abs(xy - (320, 240)) < 60).all(axis=1)
    noise = rng.random(1000) < 0.05
    tested = np.ones(1000, bool)
    kept = coherent(region | noise, tested, xy, 0.4, (480, 640))
    inner = (np.abs(xy - (320, 240)) < 40).all(axis=1)
    assert kept[inner].all(), "the whole region moves"
    far = (np.abs(xy - (320, 240)) > 120).any(axis=1)
    assert kept[far & noise].mean() < 0.05, "lone failures do not"
    np.testing.assert_array_equal(coherent(noise, tested, xy, 0.0, (480, 640)), noise)
