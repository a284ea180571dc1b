"""The moving probability: inherited, and spread to new features."""

from __future__ import annotations

import numpy as np
from scenes import (
    BOX,
    CAMERA,
    SEGMENTATION,
    SIDEWAYS,
    box_instance,
    scene,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.moving_probability import ProbabilityFilter, expand
from dynslam_bench.culling.settings import ProbabilitySettings


def test_probability_rises_on_masks_and_is_inherited_along_the_flow() -> None:
    made = scene(SIDEWAYS)
    block = ProbabilityFilter(ProbabilitySettings(), SEGMENTATION)
    made.state.previous.instances = box_instance(*BOX)
    first = FilterState(camera=CAMERA, keep=made.state.keep)
    seen = block.apply(made.state.previous, first)
    x, y = np.rint(made.state.previous.keypoints.xy).T
    was_on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    np.testing.assert_array_equal(seen.keep, ~was_on)
    made.frame.instances = None  # no segmentation on this frame: the verdict is inherited
    inherited = block.apply(made.frame, made.state)
    assert (inherited.keep == ~was_on).mean() > 0.99
    assert ProbabilityFilter(ProbabilitySettings(), SEGMENTATION).apply(made.frame, first).keep.all()


def test_new_features_take_after_near_ones_that_are_sure() -> None:
    xy = np.array([[0.0, 0], [100, 0], [200, 0], [4, 0], [104, 0], [204, 0], [150, 0]])
    probability = np.array([0.9, 0.1, 0.6, 0.5, 0.5, 0.5, 0.5])
    linked = np.arange(7) < 3
    spread = expand(xy, probability, linked, 32.0)
    say = np.exp(-0.5 * (4 / 16) ** 2)
    np.testing.assert_allclose(spread[:3], probability[:3])
    np.testing.assert_allclose(spread[3:], [0.5 + 0.4 * say, 0.5 - 0.4 * say, 0.5, 0.5])
