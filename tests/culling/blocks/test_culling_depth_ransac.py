"""YOLO-SLAM's depth RANSAC."""

from __future__ import annotations

import numpy as np
from scenes import (
    BOX,
    CAMERA,
    SEGMENTATION,
    box_instance,
    bundle,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.depth_ransac import DepthRansacFilter
from dynslam_bench.culling.settings import DepthRansacSettings


def test_depth_ransac_takes_the_person_and_leaves_the_wall_behind() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform((210, 110), (320, 370), (100, 2))
    z = np.concatenate([rng.normal(1.5, 0.05, 70), rng.normal(4.0, 0.05, 30)])
    frame = bundle(xy, z, np.ones((480, 640), np.float32), 1.0)
    frame.instances = box_instance(*BOX)
    state = FilterState(camera=CAMERA, keep=np.ones(100, bool))
    verdict = DepthRansacFilter(DepthRansacSettings(variance_m2=0.05), SEGMENTATION).apply(frame, state)
    np.testing.assert_array_equal(verdict.keep, np.arange(100) >= 70)
    frame.instances = box_instance(400, 100, 500, 200)
    assert DepthRansacFilter(DepthRansacSettings(), SEGMENTATION).apply(frame, state).keep.all()
