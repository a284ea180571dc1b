"""Masks completed by blocks of continuous depth."""

from __future__ import annotations

import numpy as np
from scenes import (
    CAMERA,
    SEGMENTATION,
    box_instance,
    bundle,
)

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.culling.depth_blocks import DepthBlockFilter, covered_blocks
from dynslam_bench.culling.settings import DepthBlockSettings


def person_before_a_wall() -> tuple[FrameBundle, np.ndarray]:
    rng = np.random.default_rng(1)
    depth = np.full((480, 640), 3.0, np.float32)
    depth[100:380, 220:330] = 1.5
    depth[300:460, 400:520] = 2.2  # a cupboard
    xy = rng.uniform((30, 30), (610, 450), (500, 2))
    z = depth[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    return bundle(xy, z, depth, 1.0), z < 1.8


def inner(xy: np.ndarray) -> np.ndarray:
    """Not within 2 px of an edge of the person."""
    x, y = xy.T
    near = (np.abs(x - 220) < 3) | (np.abs(x - 330) < 3) | (np.abs(y - 100) < 3) | (np.abs(y - 380) < 3)
    return ~near


def test_depth_blocks_complete_a_mask_that_misses_half_of_the_person() -> None:
    frame, on_person = person_before_a_wall()
    frame.instances = box_instance(220, 100, 330, 240)
    verdict = DepthBlockFilter(DepthBlockSettings(), SEGMENTATION).apply(frame, FilterState(CAMERA, on_person))
    clear = inner(frame.keypoints.xy)
    np.testing.assert_array_equal(verdict.keep[clear], ~on_person[clear])
    assert verdict.stats["blocks"] == 1


def test_depth_blocks_take_no_block_that_a_mask_hardly_touches() -> None:
    frame, on_person = person_before_a_wall()
    frame.instances = box_instance(220, 100, 330, 140)  # a seventh of it
    verdict = DepthBlockFilter(DepthBlockSettings(), SEGMENTATION).apply(frame, FilterState(CAMERA, on_person))
    x, y = np.rint(frame.keypoints.xy).T
    np.testing.assert_array_equal(verdict.keep, ~((x >= 220) & (x < 330) & (y >= 100) & (y < 140)))
    frame.instances = box_instance(220, 100, 330, 380, name="chair")
    assert DepthBlockFilter(DepthBlockSettings(), SEGMENTATION).apply(frame, FilterState(CAMERA, on_person)).keep.all()


def test_depth_blocks_drop_what_a_person_touches() -> None:
    frame, on_person = person_before_a_wall()
    person, touched, apart = ((220, 100, 330, 380), (330, 300, 380, 380), (450, 100, 500, 200))
    x, y = np.rint(frame.keypoints.xy).T
    for second, dropped in ((touched, True), (apart, False)):
        one, other = box_instance(*person), box_instance(*second, name="chair")
        frame.instances = type(one)(
            np.concatenate([one.masks, other.masks]),
            np.concatenate([one.boxes, other.boxes]),
            ("person", "chair"),
            np.ones(2, np.float32),
        )
        verdict = DepthBlockFilter(DepthBlockSettings(), SEGMENTATION).apply(frame, FilterState(CAMERA, on_person))
        on_second = (x >= second[0]) & (x < second[2]) & (y >= second[1]) & (y < second[3])
        assert on_second.sum() > 3 and verdict.keep[on_second].all() != dropped
        assert verdict.stats["touched"] == dropped


def test_depth_beyond_the_limit_belongs_to_no_block() -> None:
    depth = np.full((40, 40), 7.0, np.float32)
    mask = np.ones((40, 40), bool)
    assert not covered_blocks(mask, depth, DepthBlockSettings())[0].any()
    assert covered_blocks(mask, depth, DepthBlockSettings(max_depth_m=8.0))[0].all()
    assert not covered_blocks(mask, np.full_like(depth, np.nan), DepthBlockSettings())[0].any()
