"""Masks of people."""

from __future__ import annotations

import numpy as np
from scenes import (
    SIDEWAYS,
    box_instance,
    scene,
)

from dynslam_bench.culling.semantic import SemanticFilter
from dynslam_bench.segmentation.settings import SegmentationSettings


def test_semantic_drops_the_features_on_people_only() -> None:
    made = scene(SIDEWAYS)
    made.frame.instances = box_instance(200, 100, 331, 381)
    verdict = SemanticFilter(SegmentationSettings(dilation_px=0)).apply(made.frame, made.state)
    x, y = np.rint(made.frame.keypoints.xy).T
    np.testing.assert_array_equal(verdict.keep, ~((x >= 200) & (x < 331) & (y >= 100) & (y < 381)))
    made.frame.instances = box_instance(200, 100, 331, 381, name="chair")
    assert SemanticFilter(SegmentationSettings()).apply(made.frame, made.state).keep.all()
