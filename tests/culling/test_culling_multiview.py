"""DynaSLAM's multi-view test: what hides a keyframe's points, region growing, and the differences of paper and code."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import at_rest, bundle, keypoints

from dynslam_bench.contracts.filter import FilterState, FrameBundle, KeyframeView
from dynslam_bench.culling.multiview_depth import BIN_M, MultiViewFilter, grow, hidden
from dynslam_bench.culling.settings import MultiViewSettings
from dynslam_bench.trackers import TRACKERS

PERSON = (slice(100, 380), slice(220, 330))
GRID = np.stack(np.meshgrid(np.arange(30, 611, 10), np.arange(30, 451, 10)), axis=-1).reshape(-1, 2).astype(float)
PLAIN = MultiViewSettings(dilation_px=0, border_px=0)


def in_front(
    keyframes: int = 5, hole: tuple[slice, slice] | None = None, aside_m: float = 0.0, person: bool = True
) -> tuple[FrameBundle, FilterState]:
    """A person at 1.5 m before a wall that every keyframe observed from `aside_m` further left, features on a grid."""
    wall = np.full((480, 640), 3.0, np.float32)
    now, pose = wall.copy(), np.eye(4)
    if person:
        now[PERSON] = 1.5
    if hole is not None:
        now[hole] = 0.0
    pose[0, 3] = -aside_m
    frame = bundle(GRID, now[GRID[:, 1].astype(int), GRID[:, 0].astype(int)], now, 1.0)
    view = KeyframeView(pose, keypoints(GRID), GRID, np.full(len(GRID), 3.0, np.float32), wall, 0.0)
    return frame, at_rest(frame, keyframes=(view,) * keyframes)


def test_multiview_drops_what_hides_a_keyframe_s_points() -> None:
    frame, state = in_front()
    np.testing.assert_array_equal(MultiViewFilter(PLAIN).apply(frame, state).keep, frame.z > 2)
    assert MultiViewFilter(PLAIN).apply(*in_front(person=False)).keep.all()


def test_seeds_lie_well_inside_an_object_and_need_depth_at_their_pixel() -> None:
    depth = np.full((100, 100), 1.5, np.float32)
    depth[:, 60:] = 3.0
    depth[50, 20] = 0.0
    flags = hidden(depth, np.array([[30, 50], [45, 50], [20, 50]], np.int64), np.full(3, 3.01), 0.4, 20)
    np.testing.assert_array_equal(flags, [True, False, False])  # inside; the wall is in its window; no depth there


def test_missing_depth_counts_in_the_variance() -> None:
    assert MultiViewFilter(PLAIN).apply(*in_front()).stats["seeds"] > 0
    speckled = (slice(100, 380, 8), slice(220, 330, 8))
    assert MultiViewFilter(PLAIN).apply(*in_front(hole=speckled)).stats["seeds"] == 0


def test_features_at_the_border_of_the_mask_are_dropped() -> None:
    frame, state = in_front()
    x, y = frame.keypoints.xy.T
    wide = MultiViewFilter(PLAIN.model_copy(update={"border_px": 15})).apply(frame, state)
    tight = MultiViewFilter(PLAIN).apply(frame, state)
    beside = (y > 120) & (y < 360) & (((x >= 206) & (x < 220)) | ((x > 329) & (x <= 343)))
    assert beside.any() and not wide.keep[beside].any() and tight.keep[beside].all()
    assert TRACKERS.get("dynaslam-code").settings().multiview.border_px == 15  # the code's, not in the paper
    np.testing.assert_array_equal(wide.mask, tight.mask)  # the mask itself is not wider


@pytest.mark.parametrize(("name", "first"), [("dynaslam-g", 1), ("dynaslam", 1), ("dynaslam-code", 5), ("di-slam", 5)])
def test_the_test_of_the_paper_starts_with_the_first_keyframe_and_that_of_the_code_with_the_fifth(
    name: str, first: int
) -> None:
    rule = MultiViewFilter(TRACKERS.get(name).settings().multiview)
    culled = [bool((~rule.apply(*in_front(keyframes)).keep).any()) for keyframes in range(1, 7)]
    assert culled == [keyframes >= first for keyframes in range(1, 7)]


def test_a_region_follows_its_mean_and_stops_at_a_step() -> None:
    ramp = np.tile(np.linspace(1.0, 2.2, 240, dtype=np.float32), (20, 1))
    seed = np.array([[10, 10]], np.int64)
    grown = grow(ramp, seed, 0.2, BIN_M)
    assert grown[0].sum() > 1.3 * (np.abs(ramp[0] - ramp[0, 10]) < 0.2).sum(), "the mean moves along a slope"
    region = ramp[0][grown[0] > 0]
    assert region.max() - region.mean() < 0.2 + 0.01
    ramp[:, 30:] += 0.5
    ramp[5, 5] = 0.0
    cut = grow(ramp, seed, 0.2, BIN_M)
    assert cut[:, :30].sum() == 20 * 30 - 1 and not cut[:, 30:].any() and not cut[5, 5]


@pytest.mark.parametrize("depth_m", [1e30, np.inf, np.nan, -2.0])
def test_absurd_depth_is_missing_depth(depth_m: float) -> None:
    frame, state = in_front()
    frame.depth[0:10] = depth_m
    assert MultiViewFilter(MultiViewSettings()).apply(frame, state).stats["seeds"] > 0
