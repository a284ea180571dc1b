"""Re-seeding, depth blocks, light tracking and the finer rules of the published systems' blocks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import CAMERA, box_instance, bundle, keypoints, scene

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import build
from dynslam_bench.culling.blocks.box_epipolar import BoxEpipolarFilter
from dynslam_bench.culling.blocks.box_epipolar_settings import BoxEpipolarSettings
from dynslam_bench.culling.blocks.class_rule import ClassRuleFilter
from dynslam_bench.culling.blocks.class_rule_settings import ClassRuleSettings
from dynslam_bench.culling.blocks.correlation_graph import depth_variance, point_covariance
from dynslam_bench.culling.blocks.depth_blocks import DepthBlockFilter, covered_blocks
from dynslam_bench.culling.blocks.depth_blocks_settings import DepthBlockSettings
from dynslam_bench.culling.blocks.moving_probability import expand
from dynslam_bench.culling.blocks.reseeding import ReseedingFilter
from dynslam_bench.culling.blocks.reseeding_settings import ReseedingSettings
from dynslam_bench.culling.tools.ego_motion import depth_sigma
from dynslam_bench.culling.tools.light_track import light_track
from dynslam_bench.features.orb import OrbExtractor
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import se3
from dynslam_bench.segmentation.settings import SegmentationSettings

SEGMENTATION = SegmentationSettings(dilation_px=0)
SIDEWAYS = se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005]))
ACROSS = np.array([0.0, 0.05, 0.0])


def textured(n_features: int) -> FrameBundle:
    """A frame full of corners, with the features that the extractor finds in it."""
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    gray = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    found = OrbExtractor(FeatureSettings(n_features=n_features)).extract(gray)
    xy = found.xy.astype(np.float64)
    depth = np.full(gray.shape, 2.0, np.float32)
    return FrameBundle(0, 0.0, np.zeros((480, 640, 3), np.uint8), gray, depth, found, xy, np.full(len(xy), 2.0, "f4"))


def ids(frame: FrameBundle, rows: np.ndarray) -> set[tuple[float, float, int]]:
    return {(float(x), float(y), int(o)) for (x, y), o in zip(frame.keypoints.xy[rows], frame.keypoints.octave[rows],
                                                              strict=True)}  # fmt: skip


def test_reseeding_replaces_what_fell_to_a_mask_with_static_features_elsewhere() -> None:
    frame = textured(900)
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    on_person = (frame.keypoints.xy[:, 0] > 420) & (frame.keypoints.xy[:, 1] > 60)
    assert on_person.sum() > 200
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=~on_person))
    used = verdict.keep & ~on_person
    assert used.sum() == min(600, (~on_person).sum())
    plain = block.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool))).keep & ~on_person
    assert used.sum() > 1.2 * plain.sum(), "the static background has more features than without re-seeding"
    assert plain[used].sum() >= 0.95 * plain.sum(), "those that were there stay"
    assert verdict.stats["reseeded"] == np.count_nonzero(used & ~plain) > 100
    assert verdict.stats["static"] == np.count_nonzero(~on_person)
    assert verdict.keep[on_person].all(), "what earlier filters dropped is not judged again"


def test_reseeding_changes_nothing_where_nothing_is_dynamic() -> None:
    frame, usual = textured(900), textured(600)
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool)))
    assert verdict.stats["reseeded"] == 0 and verdict.stats["missing"] == 0
    assert ids(frame, verdict.keep) == ids(usual, np.ones(len(usual), bool)), "the features that other systems get"


@pytest.mark.parametrize("left", [0, 1, 400])
def test_reseeding_leaves_all_that_there_is_where_it_is_less_than_the_budget(left: int) -> None:
    frame = textured(900)
    keep = np.arange(len(frame)) < left
    block = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))
    verdict = block.apply(frame, FilterState(camera=CAMERA, keep=keep))
    assert verdict.keep.all() and verdict.stats["missing"] == 600 - left


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
            np.concatenate([one.masks, other.masks]), np.concatenate([one.boxes, other.boxes]), ("person", "chair"),
            np.ones(2, np.float32),
        )  # fmt: skip
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


def test_light_tracking_refines_a_poor_prediction_by_its_matches() -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    count = len(made.frame)
    words = np.random.default_rng(3).integers(0, 255, (count, 32), dtype=np.uint8)
    for each in (made.frame, made.state.previous):
        each.keypoints = type(each.keypoints)(
            each.keypoints.xy, each.keypoints.octave, each.keypoints.angle, each.keypoints.response, words
        )
    made.state.flow = None
    made.state.T_world_pred = SIDEWAYS @ se3.exp(np.array([0.01, -0.01, 0.01, 0.005, 0.005, 0.0]))
    made.state.keep = ~made.moving
    found = light_track(made.frame, made.state)
    wrong, right = (se3.inverse(SIDEWAYS) @ pose for pose in (made.state.T_world_pred, found))
    assert np.linalg.norm(right[:3, 3]) < 0.2 * np.linalg.norm(wrong[:3, 3])
    made.state.keep = np.zeros(count, bool)
    np.testing.assert_array_equal(light_track(made.frame, made.state), made.state.T_world_pred)
    made.state.previous = None
    np.testing.assert_array_equal(light_track(made.frame, made.state), made.state.T_world_pred)


def test_new_features_take_after_near_ones_that_are_sure() -> None:
    xy = np.array([[0.0, 0], [100, 0], [200, 0], [4, 0], [104, 0], [204, 0], [150, 0]])
    probability = np.array([0.9, 0.1, 0.6, 0.5, 0.5, 0.5, 0.5])
    linked = np.arange(7) < 3
    spread = expand(xy, probability, linked, 32.0)
    say = np.exp(-0.5 * (4 / 16) ** 2)
    np.testing.assert_allclose(spread[:3], probability[:3])
    np.testing.assert_allclose(spread[3:], [0.5 + 0.4 * say, 0.5 - 0.4 * say, 0.5, 0.5])


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


def test_class_rule_fits_f_to_static_labelled_points_only() -> None:
    made = scene(SIDEWAYS, n_static=160, n_moving=300, motion=ACROSS)
    made.frame.instances = box_instance(200, 100, 331, 381, name="chair")
    verdict = ClassRuleFilter(ClassRuleSettings(), SEGMENTATION).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any(), "a chair with most of the points does not become the reference"
    only_tv = ClassRuleFilter(ClassRuleSettings(movable="tv"), SEGMENTATION).apply(made.frame, made.state)
    assert only_tv.keep.all() and only_tv.stats["on_movable"] == 0
    with pytest.raises(DynslamError, match="char"):
        build(ClassRuleSettings, {"movable": "char"})


def test_depth_edges_are_uncertain_and_covariance_is_that_of_the_unprojection() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 3.0
    flat, edge, hole = depth_variance(depth, np.array([[100.0, 100], [319, 100], [500, 200]]))
    np.testing.assert_allclose(flat, float(depth_sigma(np.array([2.0]))[0]) ** 2)
    assert edge > 0.18  # a quarter of the weight lies one metre further
    np.testing.assert_allclose(hole, float(depth_sigma(np.array([3.0]))[0]) ** 2)
    rng = np.random.default_rng(0)
    xy, z = np.array([[500.0, 100.0]]), np.array([2.5])
    covariance = point_covariance(xy, z, np.array([0.02**2]), CAMERA, 0.8)[0]
    noisy = CAMERA.unproject(xy + rng.normal(0, 0.8, (200_000, 2)), z + rng.normal(0, 0.02, 200_000))
    np.testing.assert_allclose(covariance, np.cov(noisy.T), atol=4e-6)


def test_blocks_survive_frames_without_anything() -> None:
    empty = bundle(np.zeros((0, 2)), np.zeros(0), np.zeros((480, 640), np.float32), 1.0)
    empty.instances = box_instance(0, 0, 10, 10)
    state = FilterState(camera=CAMERA, keep=np.zeros(0, bool))
    assert empty.keypoints.xy.shape == keypoints(np.zeros((0, 2))).xy.shape
    for block in (
        ReseedingFilter(ReseedingSettings(), FeatureSettings()),
        DepthBlockFilter(DepthBlockSettings(), SEGMENTATION),
    ):
        verdict = block.apply(empty, state)
        assert len(verdict.keep) == 0 and all(np.isfinite(list(verdict.stats.values())))
