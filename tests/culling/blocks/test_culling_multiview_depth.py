"""DynaSLAM's multi-view test, difference by difference from what was wrong with it."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import (
    CAMERA,
    bundle,
    keyframe,
    keypoints,
)

from dynslam_bench.contracts.filter import FilterState, FrameBundle, KeyframeView
from dynslam_bench.culling.multiview_depth import BIN_M, MultiViewFilter, grow, hidden
from dynslam_bench.culling.settings import MultiViewSettings
from dynslam_bench.trackers import TRACKERS

WALL_M = 3.0


PERSON = (slice(100, 380), slice(220, 330))


def views(depth: np.ndarray, xy: np.ndarray, count: int) -> tuple[KeyframeView, ...]:
    z = depth[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    return (KeyframeView(np.eye(4), keypoints(xy), xy, z, depth, 0.0),) * count


def in_front(keyframes: int = 5, hole: tuple[slice, slice] | None = None) -> tuple[FrameBundle, FilterState]:
    """A person at 1.5 m before a wall that every keyframe saw, features on a grid."""
    grid = np.stack(np.meshgrid(np.arange(30, 611, 10), np.arange(30, 451, 10)), axis=-1).reshape(-1, 2).astype(float)
    wall = np.full((480, 640), WALL_M, np.float32)
    now = wall.copy()
    now[PERSON] = 1.5
    if hole is not None:
        now[hole] = 0.0
    z = now[grid[:, 1].astype(int), grid[:, 0].astype(int)]
    frame = bundle(grid, z, now, 1.0)
    state = FilterState(
        camera=CAMERA, keep=np.ones(len(grid), bool), T_world_pred=np.eye(4), keyframes=views(wall, grid, keyframes)
    )
    return frame, state


def test_multiview_drops_what_hides_a_keyframe_s_points() -> None:
    rng = np.random.default_rng(2)
    wall = np.full((480, 640), 3.0, np.float32)
    now = wall.copy()
    now[100:380, 220:330] = 1.5  # somebody has stepped in front
    seen = rng.uniform((40, 40), (600, 440), (800, 2))
    view = keyframe(np.eye(4), wall, 0.0)
    view = type(view)(np.eye(4), keypoints(seen), seen, np.full(800, 3.0, np.float32), wall, 0.0)
    xy = rng.uniform((30, 30), (610, 450), (400, 2))
    z = now[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    frame = bundle(xy, z, now, 1.0)
    state = FilterState(camera=CAMERA, keep=np.ones(400, bool), T_world_pred=np.eye(4), keyframes=(view,) * 5)
    block = MultiViewFilter(MultiViewSettings(dilation_px=0, border_px=0))
    verdict = block.apply(frame, state)
    np.testing.assert_array_equal(verdict.keep, z > 2)
    empty = bundle(xy, np.full(400, 3.0), wall, 1.0)
    assert block.apply(empty, state).keep.all()


def test_seeds_sit_where_a_point_is_expected_and_need_depth_there() -> None:
    depth = np.full((100, 100), 1.5, np.float32)
    depth[:, 60:] = 3.0
    depth[50, 20] = 0.0
    centre = np.array([[30, 50], [45, 50], [20, 50]], np.int64)
    flags = hidden(depth, centre, np.full(3, 3.01), 0.4, 20)
    np.testing.assert_array_equal(flags, [True, False, False])  # inside; the wall is in its window; no depth there


def test_missing_depth_counts_in_the_variance() -> None:
    block = MultiViewFilter(MultiViewSettings(dilation_px=0, border_px=0))
    assert block.apply(*in_front()).stats["seeds"] > 0
    speckled = (slice(100, 380, 8), slice(220, 330, 8))
    assert block.apply(*in_front(hole=speckled)).stats["seeds"] == 0


def test_features_at_the_border_of_the_mask_go() -> None:
    frame, state = in_front()
    x, y = frame.keypoints.xy.T
    kept = MultiViewFilter(MultiViewSettings(dilation_px=0, border_px=15)).apply(frame, state)
    tight = MultiViewFilter(MultiViewSettings(dilation_px=0, border_px=0)).apply(frame, state)
    beside = (y > 120) & (y < 360) & (((x >= 206) & (x < 220)) | ((x > 329) & (x <= 343)))
    assert beside.any() and not kept.keep[beside].any() and tight.keep[beside].all()
    assert TRACKERS.get("dynaslam-code").settings().multiview.border_px == 15  # the code's, not in the paper
    np.testing.assert_array_equal(kept.mask, tight.mask)  # the mask itself is not wider


def test_the_paper_s_test_acts_from_the_first_keyframe_on_and_the_code_s_from_the_fifth() -> None:
    for name, first in (("dynaslam-g", 1), ("dynaslam", 1), ("dynaslam-code", 5), ("di-slam", 5)):
        block = MultiViewFilter(TRACKERS.get(name).settings().multiview)
        culled = [bool((~block.apply(*in_front(keyframes)).keep).any()) for keyframes in range(1, 7)]
        assert culled == [keyframes >= first for keyframes in range(1, 7)], name


def test_a_region_follows_its_mean_and_stops_at_a_step() -> None:
    ramp = np.tile(np.linspace(1.0, 2.2, 240, dtype=np.float32), (20, 1))
    grown = grow(ramp, np.array([[10, 10]], np.int64), 0.2, BIN_M)
    fixed = np.abs(ramp[0] - ramp[0, 10]) < 0.2
    assert grown[0].sum() > 1.3 * fixed.sum(), "the mean moves along a slope"
    reached = ramp[0][grown[0] > 0]
    assert reached.max() - reached.mean() < 0.2 + 0.01
    stepped = ramp.copy()
    stepped[:, 30:] += 0.5
    stepped[5, 5] = 0.0
    cut = grow(stepped, np.array([[10, 10]], np.int64), 0.2, BIN_M)
    assert cut[:, :30].sum() == 20 * 30 - 1 and not cut[:, 30:].any() and not cut[5, 5]


@pytest.mark.parametrize("depth_m", [1e30, np.inf, np.nan, -2.0])
def test_absurd_depth_is_missing_depth(depth_m: float) -> None:
    frame, state = in_front()
    frame.depth[0:10] = depth_m
    assert MultiViewFilter(MultiViewSettings()).apply(frame, state).stats["seeds"] > 0
