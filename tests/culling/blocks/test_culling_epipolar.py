"""The epipolar test: exactly what moves goes, and nothing where F means nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    ACROSS,
    ROTATION,
    SIDEWAYS,
    box_instance,
    scene,
)

from dynslam_bench.culling.epipolar import EpipolarFilter
from dynslam_bench.culling.settings import EpipolarSettings
from dynslam_bench.geometry import se3


def test_epipolar_culls_exactly_the_moving_points() -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    verdict = EpipolarFilter(EpipolarSettings(min_share=0.0)).apply(made.frame, made.state)
    np.testing.assert_array_equal(verdict.keep, ~made.moving)
    assert verdict.stats["degenerate"] == 0


def test_epipolar_culls_nothing_in_a_static_scene() -> None:
    made = scene(SIDEWAYS, motion=None)
    assert EpipolarFilter(EpipolarSettings()).apply(made.frame, made.state).keep.all()


@pytest.mark.parametrize("motion", [ROTATION, np.eye(4)], ids=["pure rotation", "static camera"])
def test_epipolar_says_that_it_is_degenerate(motion: np.ndarray) -> None:
    made = scene(motion, motion=ACROSS)
    verdict = EpipolarFilter(EpipolarSettings()).apply(made.frame, made.state)
    assert verdict.keep.all() and verdict.stats["degenerate"] == 1


def test_epipolar_distrusts_an_f_that_depth_contradicts() -> None:
    """People who fill most of the image own the largest set of matches that agree on an F; the walls then fail it."""
    motion = se3.exp(np.array([0.05, 0, 0.01, 0, 0.01, 0]))
    made = scene(motion, n_static=120, n_moving=600, motion=np.array([0, 0.05, 0]))
    settings = EpipolarSettings(min_share=0.0, homography_share=1.0)
    fooled = EpipolarFilter(settings.model_copy(update={"max_contradiction": 1.0})).apply(made.frame, made.state)
    assert (~fooled.keep[~made.moving]).mean() > 0.5, "the scene does fool the plain test"
    verdict = EpipolarFilter(settings).apply(made.frame, made.state)
    assert verdict.keep.all() and verdict.stats["degenerate"] == 1.0 and verdict.stats["contradiction"] > 0.5
    made = scene(motion, motion=np.array([0, 0.1, 0]))
    verdict = EpipolarFilter(settings).apply(made.frame, made.state)
    assert (verdict.keep == ~made.moving).all() and verdict.stats["contradiction"] < 0.05


def test_epipolar_object_mode_drops_whole_objects_and_nothing_else() -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    made.frame.instances = box_instance(200, 100, 331, 381)
    settings = EpipolarSettings(mode="object", vote_share=0.3)
    verdict = EpipolarFilter(settings).apply(made.frame, made.state)
    x, y = np.rint(made.frame.keypoints.xy).T
    on_object = (x >= 200) & (x < 331) & (y >= 100) & (y < 381)
    np.testing.assert_array_equal(verdict.keep, ~on_object)
    made.frame.instances = box_instance(400, 100, 531, 381)
    assert EpipolarFilter(settings).apply(made.frame, made.state).keep.all()
