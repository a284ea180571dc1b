"""Class, depth and epipolar line in one rule."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    ACROSS,
    BOX,
    SEGMENTATION,
    SIDEWAYS,
    box_instance,
    on_box,
    scene,
)

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import build
from dynslam_bench.culling.class_rule import ClassRuleFilter
from dynslam_bench.culling.settings import ClassRuleSettings


def test_class_rule_drops_people_and_only_those_movable_things_that_move() -> None:
    moving, still = scene(SIDEWAYS, motion=ACROSS), scene(SIDEWAYS)
    block = ClassRuleFilter(ClassRuleSettings(), SEGMENTATION)
    for made in (moving, still):
        made.frame.instances = box_instance(*BOX, name="chair")
    verdict = block.apply(moving.frame, moving.state)
    assert not verdict.keep[moving.moving].any() and verdict.keep[~on_box(moving)].all()
    assert block.apply(still.frame, still.state).keep.all()
    still.frame.instances = box_instance(*BOX)
    x, y = np.rint(still.frame.keypoints.xy).T
    on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    np.testing.assert_array_equal(block.apply(still.frame, still.state).keep, ~on)


def test_class_rule_fits_f_to_static_labelled_points_only() -> None:
    made = scene(SIDEWAYS, n_static=160, n_moving=300, motion=ACROSS)
    made.frame.instances = box_instance(200, 100, 331, 381, name="chair")
    verdict = ClassRuleFilter(ClassRuleSettings(), SEGMENTATION).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any(), "a chair with most of the points does not become the reference"
    only_tv = ClassRuleFilter(ClassRuleSettings(movable="tv"), SEGMENTATION).apply(made.frame, made.state)
    assert only_tv.keep.all() and only_tv.stats["on_movable"] == 0
    with pytest.raises(DynslamError, match="char"):
        build(ClassRuleSettings, {"movable": "char"})
