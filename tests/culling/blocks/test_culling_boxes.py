"""Box removal."""

from __future__ import annotations

import numpy as np
from scenes import (
    BOX,
    SEGMENTATION,
    SIDEWAYS,
    box_instance,
    on_box,
    scene,
)

from dynslam_bench.culling.semantic import BoxFilter
from dynslam_bench.culling.settings import BoxSettings


def test_boxes_drop_what_is_inside_and_nothing_else() -> None:
    made = scene(SIDEWAYS)
    made.frame.instances = box_instance(*BOX)
    verdict = BoxFilter(BoxSettings(), SEGMENTATION).apply(made.frame, made.state)
    np.testing.assert_array_equal(verdict.keep, ~on_box(made))
    made.frame.instances = box_instance(*BOX, name="chair")
    assert BoxFilter(BoxSettings(), SEGMENTATION).apply(made.frame, made.state).keep.all()
