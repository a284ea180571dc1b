"""Rules on masks and boxes: each drops what moves or what its classes name, and nothing else."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.culling_rules import RULES
from helpers.culling_scenes import (
    ACROSS,
    BOX,
    CAMERA,
    SEGMENTATION,
    SIDEWAYS,
    Scene,
    at_rest,
    box_instance,
    bundle,
    moved_patch,
    on_rectangle,
    scene,
)
from test_culling_geometry import in_front

from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Settings, build, parameters
from dynslam_bench.culling.correlation_graph import CorrelationFilter
from dynslam_bench.culling.depth_regions import (
    BoxDepthFilter,
    DepthBlockFilter,
    DepthRansacFilter,
    covered_blocks,
    person_set,
)
from dynslam_bench.culling.epipolar import BoxEpipolarFilter, ClassRuleFilter, MovingVoteFilter
from dynslam_bench.culling.moving_probability import ProbabilityFilter, expand
from dynslam_bench.culling.multiview_depth import MultiViewFilter
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.culling.residual_clusters import ResidualFilter
from dynslam_bench.culling.semantic import SemanticFilter
from dynslam_bench.culling.settings import (
    BoxDepthSettings,
    BoxEpipolarSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthBlockSettings,
    DepthRansacSettings,
    GuardSettings,
    MovingVoteSettings,
    MultiViewSettings,
    ProbabilitySettings,
    ReseedingSettings,
    ResidualSettings,
    TemplateSettings,
)
from dynslam_bench.culling.template_matching import TemplateFilter
from dynslam_bench.features.orb import OrbExtractor
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import inside
from dynslam_bench.slam.pipeline import combine_verdicts, least_masked

RESEEDING = ReseedingFilter(ReseedingSettings(budget=600), FeatureSettings(n_features=900))


def test_semantic_drops_the_features_on_people_only() -> None:
    for name in ("person", "chair"):
        made = scene(SIDEWAYS, instances=box_instance(*BOX, name=name))
        dropped = on_rectangle(made, *BOX) & (name == "person")
        np.testing.assert_array_equal(
            SemanticFilter(SEGMENTATION).apply(made.frame, made.state).keep, ~dropped
        )


def test_box_epipolar_has_a_limit_of_its_own_inside_boxes() -> None:
    # the motion is about 0.8 px at 1.5 m
    made = scene(
        SIDEWAYS, motion=np.array([0.0, 0.0022, 0.0]), noise_px=0.02, instances=box_instance(*BOX)
    )
    strict = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=0.3, outside_px=50.0), SEGMENTATION)
    keep = strict.apply(made.frame, made.state).keep
    assert not keep[made.moving].any()
    assert keep[~on_rectangle(made, *BOX)].all()
    lenient = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=3.0, outside_px=3.0), SEGMENTATION)
    assert lenient.apply(made.frame, made.state).keep.all()


def test_f_is_fitted_outside_the_previous_frame_s_boxes_where_sg_slam_does() -> None:
    # more moving points than static ones in the box
    made = scene(SIDEWAYS, n_static=200, n_moving=250, motion=ACROSS)
    made.state.previous.instances = box_instance(180, 80, 350, 400)
    made.frame.instances = box_instance(0, 0, 1, 1)
    x, y = made.state.previous.keypoints.xy.T
    outside = ~((x >= 180) & (x < 350) & (y >= 80) & (y < 400))
    for fit, count in (("outside previous", np.count_nonzero(outside)), ("kept", len(made.frame))):
        rule = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=1.0, fit=fit), SEGMENTATION)
        verdict = rule.apply(made.frame, made.state)
        assert verdict.stats["matches"] == count
        assert np.array_equal(verdict.keep, ~made.moving) == (fit == "outside previous")


def test_class_rule_drops_people_and_only_those_movable_objects_that_move() -> None:
    rule = ClassRuleFilter(ClassRuleSettings(), SEGMENTATION)
    chair = box_instance(*BOX, name="chair")
    moving = scene(SIDEWAYS, motion=ACROSS, instances=chair)
    still = scene(SIDEWAYS, instances=chair)
    keep = rule.apply(moving.frame, moving.state).keep
    assert not keep[moving.moving].any()
    assert keep[~on_rectangle(moving, *BOX)].all()
    assert rule.apply(still.frame, still.state).keep.all()
    still.frame.instances = box_instance(*BOX)
    np.testing.assert_array_equal(
        rule.apply(still.frame, still.state).keep, ~on_rectangle(still, *BOX)
    )


def test_class_rule_fits_f_to_static_labelled_points_only() -> None:
    made = scene(
        SIDEWAYS,
        n_static=160,
        n_moving=300,
        motion=ACROSS,
        instances=box_instance(*BOX, name="chair"),
    )
    keep = ClassRuleFilter(ClassRuleSettings(), SEGMENTATION).apply(made.frame, made.state).keep
    assert not keep[made.moving].any(), (
        "a chair with most of the points does not become the reference"
    )
    only_tv = ClassRuleFilter(ClassRuleSettings(movable="tv"), SEGMENTATION).apply(
        made.frame, made.state
    )
    assert only_tv.keep.all()
    assert only_tv.stats["on_movable"] == 0
    with pytest.raises(DynslamError, match="char"):
        build(ClassRuleSettings, {"movable": "char"})


def person_before_a_wall() -> tuple[FrameBundle, np.ndarray]:
    rng = np.random.default_rng(1)
    depth = np.full((480, 640), 3.0, np.float32)
    depth[100:380, 220:330] = 1.5
    depth[300:460, 400:520] = 2.2  # a cupboard
    xy = rng.uniform((30, 30), (610, 450), (500, 2))
    z = depth[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    return bundle(xy, z, depth, 1.0), z < 1.8


def blocks(frame: FrameBundle):  # type: ignore[no-untyped-def]
    return DepthBlockFilter(DepthBlockSettings(), SEGMENTATION).apply(frame, at_rest(frame))


@pytest.mark.parametrize(
    ("bottom", "whole"), [(240, True), (140, False)], ids=["half of the person", "a seventh"]
)
def test_depth_blocks_complete_a_mask_that_covers_enough_of_the_person(
    bottom: int, whole: bool
) -> None:
    frame, on_person = person_before_a_wall()
    frame.instances = box_instance(220, 100, 330, bottom)
    x, y = frame.keypoints.xy.T
    clear = (
        (np.abs(x - 220) > 3)
        & (np.abs(x - 330) > 3)
        & (np.abs(y - 100) > 3)
        & (np.abs(y - 380) > 3)
    )
    dropped = on_person if whole else on_rectangle(frame, 220, 100, 330, bottom)
    np.testing.assert_array_equal(blocks(frame).keep[clear], ~dropped[clear])
    frame.instances = box_instance(220, 100, 330, 380, name="chair")
    assert blocks(frame).keep.all()


@pytest.mark.parametrize(
    ("other", "touched"), [((330, 300, 380, 380), True), ((450, 100, 500, 200), False)]
)
def test_depth_blocks_drop_what_a_person_touches(
    other: tuple[int, int, int, int], touched: bool
) -> None:
    frame, _ = person_before_a_wall()
    person = box_instance(220, 100, 330, 380)
    chair = box_instance(*other, name="chair")
    masks = np.concatenate([person.masks, chair.masks])
    boxes_ = np.concatenate([person.boxes, chair.boxes])
    frame.instances = type(person)(masks, boxes_, ("person", "chair"), np.ones(2, np.float32))
    verdict = blocks(frame)
    on_other = on_rectangle(frame, *other)
    assert on_other.sum() > 3
    assert verdict.keep[on_other].all() != touched
    assert verdict.stats["touched"] == touched


def test_depth_beyond_the_limit_belongs_to_no_block() -> None:
    depth = np.full((40, 40), 7.0, np.float32)
    mask = np.ones((40, 40), bool)
    assert not covered_blocks(mask, depth, DepthBlockSettings())[0].any()
    assert covered_blocks(mask, depth, DepthBlockSettings(max_depth_m=8.0))[0].all()
    assert not covered_blocks(mask, np.full_like(depth, np.nan), DepthBlockSettings())[0].any()


def test_box_depth_segments_the_person_in_the_box() -> None:
    frame, on_person = person_before_a_wall()
    frame.instances = box_instance(200, 80, 350, 400)
    verdict = BoxDepthFilter(BoxDepthSettings(dilation_px=0), SEGMENTATION).apply(
        frame, at_rest(frame)
    )
    np.testing.assert_array_equal(verdict.keep, ~on_person)
    frame.depth[:] = 0
    assert (
        BoxDepthFilter(BoxDepthSettings(), SEGMENTATION)
        .apply(frame, at_rest(frame))
        .stats["ignored"]
        == 1
    )


def test_depth_ransac_drops_the_person_and_keeps_the_wall_behind() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform((210, 110), (320, 370), (100, 2))
    z = np.concatenate([rng.normal(1.5, 0.05, 70), rng.normal(4.0, 0.05, 30)])
    frame = bundle(xy, z, np.ones((480, 640), np.float32), 1.0)
    frame.instances = box_instance(*BOX)
    rule = DepthRansacFilter(DepthRansacSettings(variance_m2=0.05), SEGMENTATION)
    np.testing.assert_array_equal(rule.apply(frame, at_rest(frame)).keep, np.arange(100) >= 70)
    frame.instances = box_instance(400, 100, 500, 200)
    assert rule.apply(frame, at_rest(frame)).keep.all()


def test_probability_rises_on_masks_and_follows_the_flow() -> None:
    made = scene(SIDEWAYS)
    rule = ProbabilityFilter(ProbabilitySettings(), SEGMENTATION)
    made.state.previous.instances = box_instance(*BOX)
    first = FilterState(camera=CAMERA, keep=made.state.keep)
    was_on = on_rectangle(made.state.previous, *BOX)
    np.testing.assert_array_equal(rule.apply(made.state.previous, first).keep, ~was_on)
    made.frame.instances = None  # no segmentation on this frame
    assert (rule.apply(made.frame, made.state).keep == ~was_on).mean() > 0.99
    assert (
        ProbabilityFilter(ProbabilitySettings(), SEGMENTATION).apply(made.frame, first).keep.all()
    )


def test_expansion_gives_new_features_a_share_of_near_certain_ones() -> None:
    xy = np.array([[0.0, 0], [100, 0], [200, 0], [4, 0], [104, 0], [204, 0], [150, 0]])
    probability = np.array([0.9, 0.1, 0.6, 0.5, 0.5, 0.5, 0.5])
    shift = 0.4 * np.exp(-0.5 * (4 / 16) ** 2)
    expected = [0.9, 0.1, 0.6, 0.5 + shift, 0.5 - shift, 0.5, 0.5]
    np.testing.assert_allclose(expand(xy, probability, np.arange(7) < 3, 32.0), expected)


def panned(shift: int) -> Scene:
    """A camera that pans by 3 px before a wall; the texture in the box moves by `shift` pixels."""
    before, after = moved_patch(shift)
    made = scene(np.eye(4), instances=box_instance(*BOX))
    made.frame.gray = np.roll(after, 3, axis=1)
    made.state.previous.gray = before
    return made


@pytest.mark.parametrize("shift", [0, 12])
def test_moving_vote_drops_all_people_or_nobody(shift: int) -> None:
    made = panned(shift)
    verdict = MovingVoteFilter(MovingVoteSettings(threshold_px=1.0), SEGMENTATION).apply(
        made.frame, made.state
    )
    np.testing.assert_array_equal(verdict.keep, ~(on_rectangle(made, *BOX) & bool(shift)))


def test_moving_vote_tracks_the_corners_that_the_authors_code_chooses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    previous = cv2.resize(
        rng.integers(0, 255, (60, 80), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC
    )
    harris = cv2.goodFeaturesToTrack(
        previous,
        1000,
        0.01,
        8,
        mask=None,
        blockSize=3,
        gradientSize=3,
        useHarrisDetector=True,
        k=0.04,
    )
    given: list[np.ndarray] = []
    refine = cv2.cornerSubPix
    monkeypatch.setattr(
        cv2, "cornerSubPix", lambda i, c, *rest: (given.append(c.copy()), refine(i, c, *rest))[1]
    )
    MovingVoteFilter(MovingVoteSettings(), SEGMENTATION)._moving_corners(
        previous, np.roll(previous, 3, 1), CAMERA
    )
    np.testing.assert_array_equal(given[0], harris)


def test_residual_clusters_find_the_part_that_the_camera_does_not_explain() -> None:
    before, after = moved_patch(12)
    xy = np.random.default_rng(4).uniform((30, 30), (610, 450), (300, 2))
    depth = np.full((480, 640), 3.0, np.float32)
    depth[BOX[1] : BOX[3], BOX[0] : BOX[2]] = 1.5
    frame, previous = (bundle(xy, np.full(300, 2.0), depth, stamp) for stamp in (1.0, 0.9))
    frame.instances = box_instance(*BOX)
    frame.gray = after
    previous.gray = before
    rule = ResidualFilter(ResidualSettings(), SEGMENTATION)
    on = on_rectangle(frame, *BOX)
    keep = rule.apply(frame, at_rest(frame, previous)).keep
    assert keep[~on].mean() > 0.95
    assert keep[on].mean() < 0.05
    frame.gray = before
    frame.instances = None
    assert rule.apply(frame, at_rest(frame, previous)).keep.all()


@pytest.mark.parametrize("shift", [0, 12])
def test_template_keeps_what_matches_where_the_camera_predicts_it(shift: int) -> None:
    before, after = moved_patch(shift)
    xy = np.random.default_rng(3).uniform((30, 30), (610, 450), (300, 2))
    depth = np.full((480, 640), 2.0, np.float32)
    frame, previous = (bundle(xy, np.full(300, 2.0), depth, stamp) for stamp in (1.0, 0.9))
    frame.instances = box_instance(*BOX)
    frame.gray = after
    previous.gray = before
    keep = (
        TemplateFilter(TemplateSettings(), SEGMENTATION).apply(frame, at_rest(frame, previous)).keep
    )
    # no patch across the box's edge
    inner = on_rectangle(frame, BOX[0] + 8, BOX[1] + 8, BOX[2] - 8, BOX[3] - 8)
    assert keep[~on_rectangle(frame, *BOX)].all()
    assert not keep[inner].any() if shift else keep.all()


# Re-seeding: static features elsewhere replace what fell to a mask.


def textured(n_features: int) -> FrameBundle:
    """A frame full of corners, with the features that the extractor finds in it."""
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    gray = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    features = OrbExtractor(FeatureSettings(n_features=n_features)).extract(gray)
    xy = features.xy.astype(np.float64)
    depth = np.full(gray.shape, 2.0, np.float32)
    return FrameBundle(
        0,
        0.0,
        np.zeros((480, 640, 3), np.uint8),
        gray,
        depth,
        features,
        xy,
        np.full(len(xy), 2.0, "f4"),
    )


def ids(frame: FrameBundle, rows: np.ndarray) -> set[tuple[float, float, int]]:
    places = frame.keypoints.xy[rows].tolist()
    octaves = frame.keypoints.octave[rows].tolist()
    return {(x, y, octave) for (x, y), octave in zip(places, octaves, strict=True)}


def test_reseeding_replaces_what_fell_to_a_mask_with_static_features_elsewhere() -> None:
    frame = textured(900)
    on_person = (frame.keypoints.xy[:, 0] > 420) & (frame.keypoints.xy[:, 1] > 60)
    assert on_person.sum() > 200
    verdict = RESEEDING.apply(frame, FilterState(camera=CAMERA, keep=~on_person))
    used = verdict.keep & ~on_person
    assert used.sum() == min(600, (~on_person).sum())
    plain = (
        RESEEDING.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool))).keep
        & ~on_person
    )
    assert used.sum() > 1.2 * plain.sum(), (
        "the static background has more features than without re-seeding"
    )
    assert plain[used].sum() >= 0.95 * plain.sum(), "those that were there stay"
    assert verdict.stats["reseeded"] == np.count_nonzero(used & ~plain) > 100
    assert verdict.stats["static"] == np.count_nonzero(~on_person)
    assert verdict.keep[on_person].all(), "what earlier filters dropped is not judged again"


def test_reseeding_changes_nothing_where_nothing_is_dynamic() -> None:
    frame = textured(900)
    usual = textured(600)
    verdict = RESEEDING.apply(frame, FilterState(camera=CAMERA, keep=np.ones(len(frame), bool)))
    assert verdict.stats["reseeded"] == 0
    assert verdict.stats["missing"] == 0
    assert ids(frame, verdict.keep) == ids(usual, np.ones(len(usual), bool)), (
        "the features that other systems get"
    )


@pytest.mark.parametrize("left", [0, 1, 400])
def test_reseeding_leaves_all_that_there_is_where_it_is_less_than_the_budget(left: int) -> None:
    frame = textured(900)
    verdict = RESEEDING.apply(frame, FilterState(camera=CAMERA, keep=np.arange(len(frame)) < left))
    assert verdict.keep.all()
    assert verdict.stats["missing"] == 600 - left


@pytest.mark.parametrize("name", sorted(RULES))
def test_nothing_is_culled_where_nothing_is_known_of_the_past_nor_moves_nor_has_depth(
    name: str,
) -> None:
    """That no rule fails on less than that is a check of `testing.check_filter`."""
    made = scene(np.eye(4), noise_px=0.0)
    rule = RULES[name]()
    for state in (FilterState(camera=CAMERA, keep=made.state.keep), made.state):
        rule.reset(CAMERA)
        assert rule.apply(made.frame, state).keep.all()
    made.frame.depth[:] = np.nan
    made.frame.z[:] = 0
    assert rule.apply(made.frame, made.state).keep.all()


def test_guard_undoes_the_least_reliable_verdict_first() -> None:
    semantic = np.arange(100) >= 30
    nothing = np.zeros(100, bool)
    for verdicts, expected, undone in (
        ([semantic, nothing], semantic, 1),
        ([nothing, nothing], ~nothing, 2),
        ([semantic], semantic, 0),
    ):
        keep, count = combine_verdicts(verdicts, 100, 40)
        assert count == undone
        np.testing.assert_array_equal(keep, expected)
    assert combine_verdicts([semantic], 100, 80)[1] == 1


def test_guard_needs_the_larger_of_its_number_and_its_share_but_no_more_than_there_are() -> None:
    settings = GuardSettings(min_features=60, min_fraction=0.1)
    assert [settings.needed(total) for total in (0, 40, 100, 600, 601, 1000)] == [
        0, 40, 60, 60, 61, 100,
    ]  # fmt: skip


@pytest.mark.parametrize(("width", "height"), [(640, 480), (320, 240), (400, 300), (161, 120)])
def test_guard_gives_back_the_features_nearest_to_the_outside_of_the_mask(
    width: int, height: int
) -> None:
    mask = np.zeros((height, width), bool)
    mask[:, width // 4 :] = True
    # features on a row, from the left; those with x < width / 4 are left
    x = np.linspace(0, width - 1, 101)
    xy = np.column_stack([x, np.full(101, height / 2)])
    order = np.random.default_rng(width).permutation(101)
    keep = ~inside(mask, xy[order])
    left = np.count_nonzero(keep)
    returned = least_masked(keep, mask, xy[order], left + 7)
    assert not (returned & keep).any()
    np.testing.assert_array_equal(np.sort(x[order][returned]), x[left : left + 7])
    assert not least_masked(keep, mask, xy[order], left).any()
    assert not least_masked(keep, mask, xy[order], 3).any()


# Settings of culling rules that no short episode shows: each changes the verdict on a scene made
# for it.


def tracked_corners(value: int) -> float:
    made = panned(12)
    rule = MovingVoteFilter(MovingVoteSettings(corners=value), SEGMENTATION)
    return rule.apply(made.frame, made.state).stats["corners"]


def chair_of_which_half_moves(value: float) -> list[bool]:
    made = scene(
        SIDEWAYS,
        n_static=900,
        n_moving=40,
        motion=ACROSS,
        instances=box_instance(*BOX, name="chair"),
    )
    rule = ClassRuleFilter(ClassRuleSettings(vote_share=value, depth_m=2.0), SEGMENTATION)
    return rule.apply(made.frame, made.state).keep.tolist()


def near_person(value: float) -> list[bool]:
    """A person who fills half of the image."""
    made = scene(np.eye(4), instances=box_instance(0, 0, 320, 480))
    made.frame.depth[:, :320] = 1.0
    made.frame.depth[:, 320:] = 3.0
    return (
        BoxDepthFilter(BoxDepthSettings(max_cover=value), SEGMENTATION)
        .apply(made.frame, made.state)
        .keep.tolist()
    )


def many_points_on_a_small_body(value: str) -> list[bool]:
    made = scene(SIDEWAYS, n_static=120, n_moving=250, motion=np.array([0.15, 0.1, 0.0]))
    rule = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5, largest=value))
    rule.apply(made.state.previous, FilterState(CAMERA, made.state.keep, T_world_pred=np.eye(4)))
    return rule.apply(made.frame, made.state).keep.tolist()


def observed_from_aside(value: float) -> float:
    """Somebody before a wall that keyframes observed from 1.2 m further left."""
    return (
        MultiViewFilter(MultiViewSettings(max_parallax_deg=value))
        .apply(*in_front(aside_m=1.2))
        .stats["seeds"]
    )


def drawn_set(value: int) -> list[bool]:
    """A box of many depths, so that more draws find a larger set of similar ones."""
    z = np.random.default_rng(0).uniform(1.0, 6.0, 200)
    settings = DepthRansacSettings(max_draws=value, confidence=0.999, variance_m2=0.01)
    return person_set(z, settings, np.random.default_rng(1)).tolist()


def confident_set(value: float) -> list[bool]:
    """A box of many depths: with less confidence the draws end before the largest set is found."""
    z = np.random.default_rng(0).uniform(1.0, 3.0, 40)
    settings = DepthRansacSettings(max_draws=200, confidence=value, variance_m2=0.3)
    return person_set(z, settings, np.random.default_rng(1)).tolist()


CASES: dict[str, tuple[type[Settings], Callable[[Any], Any]]] = {
    "moving_vote.corners": (MovingVoteSettings, tracked_corners),
    "class_rule.vote_share": (ClassRuleSettings, chair_of_which_half_moves),
    "box_depth.max_cover": (BoxDepthSettings, near_person),
    "correlation.largest": (CorrelationSettings, many_points_on_a_small_body),
    "multiview.max_parallax_deg": (MultiViewSettings, observed_from_aside),
    "depth_ransac.max_draws": (DepthRansacSettings, drawn_set),
    "depth_ransac.confidence": (DepthRansacSettings, confident_set),
}
"""Setting as studies name it: its group, and the verdict at a value of it."""


@pytest.mark.parametrize("name", CASES)
def test_both_ends_of_the_range_give_other_verdicts(name: str) -> None:
    group, verdict = CASES[name]
    parameter = next(p for p in parameters(group) if p.name == name.partition(".")[2])
    first, *_, last = parameter.choices or (parameter.low, parameter.high)
    assert verdict(first) != verdict(last)
