"""The epipolar test with boxes: its limits, and what F is fitted to."""

from __future__ import annotations

import numpy as np
from scenes import (
    ACROSS,
    BOX,
    SEGMENTATION,
    SIDEWAYS,
    box_instance,
    on_box,
    scene,
)

from dynslam_bench.culling.box_epipolar import BoxEpipolarFilter
from dynslam_bench.culling.settings import BoxEpipolarSettings


def test_box_epipolar_has_a_limit_of_its_own_inside_boxes() -> None:
    slow = np.array([0.0, 0.0022, 0.0])  # about 0.8 px at 1.5 m
    made = scene(SIDEWAYS, motion=slow, noise_px=0.02)
    made.frame.instances = box_instance(*BOX)
    strict = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=0.3, outside_px=50.0), SEGMENTATION)
    verdict = strict.apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~on_box(made)].all()
    lenient = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=3.0, outside_px=3.0), SEGMENTATION)
    assert lenient.apply(made.frame, made.state).keep.all()


def test_f_is_fitted_outside_the_previous_frame_s_boxes_where_sg_slam_does() -> None:
    made = scene(SIDEWAYS, n_static=200, n_moving=250, motion=ACROSS)  # more moving points than static ones in the box
    made.state.previous.instances = box_instance(180, 80, 350, 400)
    made.frame.instances = box_instance(0, 0, 1, 1)
    block = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=1.0, fit="outside previous"), SEGMENTATION)
    verdict = block.apply(made.frame, made.state)
    x, y = made.state.previous.keypoints.xy.T
    outside = ~((x >= 180) & (x < 350) & (y >= 80) & (y < 400))
    assert verdict.stats["matches"] == np.count_nonzero(outside)
    np.testing.assert_array_equal(verdict.keep, ~made.moving)
    kept = BoxEpipolarFilter(BoxEpipolarSettings(fit="kept"), SEGMENTATION).apply(made.frame, made.state)
    assert kept.stats["matches"] == len(made.frame)
