"""The published systems' blocks: what each must cull, what it must leave, and what it must survive."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import CAMERA, Scene, box_instance, bundle, keyframe, keypoints, scene

from dynslam_bench.contracts.filter import DynamicFilter, FilterState
from dynslam_bench.culling.blocks.box_epipolar import BoxEpipolarFilter
from dynslam_bench.culling.blocks.box_epipolar_settings import BoxEpipolarSettings
from dynslam_bench.culling.blocks.boxes import BoxFilter
from dynslam_bench.culling.blocks.boxes_settings import BoxSettings
from dynslam_bench.culling.blocks.class_rule import ClassRuleFilter
from dynslam_bench.culling.blocks.class_rule_settings import ClassRuleSettings
from dynslam_bench.culling.blocks.correlation_graph import CorrelationFilter
from dynslam_bench.culling.blocks.correlation_graph_settings import CorrelationSettings
from dynslam_bench.culling.blocks.depth_ransac import DepthRansacFilter
from dynslam_bench.culling.blocks.depth_ransac_settings import DepthRansacSettings
from dynslam_bench.culling.blocks.moving_probability import ProbabilityFilter
from dynslam_bench.culling.blocks.moving_probability_settings import ProbabilitySettings
from dynslam_bench.culling.blocks.moving_vote import MovingVoteFilter
from dynslam_bench.culling.blocks.moving_vote_settings import MovingVoteSettings
from dynslam_bench.culling.blocks.multiview_depth import MultiViewFilter
from dynslam_bench.culling.blocks.multiview_depth_settings import MultiViewSettings
from dynslam_bench.culling.blocks.residual_clusters import ResidualFilter
from dynslam_bench.culling.blocks.residual_clusters_settings import ResidualSettings
from dynslam_bench.culling.blocks.template_matching import TemplateFilter
from dynslam_bench.culling.blocks.template_matching_settings import TemplateSettings
from dynslam_bench.geometry import se3
from dynslam_bench.segmentation.settings import SegmentationSettings

SEGMENTATION = SegmentationSettings(dilation_px=0)
SIDEWAYS = se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005]))
ACROSS = np.array([0.0, 0.05, 0.0])
BOX = (200, 100, 331, 381)


def on_box(made: Scene) -> np.ndarray:
    x, y = made.frame.keypoints.xy.T
    return (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])


def test_boxes_drop_what_is_inside_and_nothing_else() -> None:
    made = scene(SIDEWAYS)
    made.frame.instances = box_instance(*BOX)
    verdict = BoxFilter(BoxSettings(), SEGMENTATION).apply(made.frame, made.state)
    np.testing.assert_array_equal(verdict.keep, ~on_box(made))
    made.frame.instances = box_instance(*BOX, name="chair")
    assert BoxFilter(BoxSettings(), SEGMENTATION).apply(made.frame, made.state).keep.all()


def test_box_epipolar_has_a_limit_of_its_own_inside_boxes() -> None:
    slow = np.array([0.0, 0.0022, 0.0])  # about 0.8 px at 1.5 m
    made = scene(SIDEWAYS, motion=slow, noise_px=0.02)
    made.frame.instances = box_instance(*BOX)
    strict = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=0.3, outside_px=50.0), SEGMENTATION)
    verdict = strict.apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~on_box(made)].all()
    lenient = BoxEpipolarFilter(BoxEpipolarSettings(inside_px=3.0, outside_px=3.0), SEGMENTATION)
    assert lenient.apply(made.frame, made.state).keep.all()


def test_depth_ransac_takes_the_person_and_leaves_the_wall_behind() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform((210, 110), (320, 370), (100, 2))
    z = np.concatenate([rng.normal(1.5, 0.05, 70), rng.normal(4.0, 0.05, 30)])
    frame = bundle(xy, z, np.ones((480, 640), np.float32), 1.0)
    frame.instances = box_instance(*BOX)
    state = FilterState(camera=CAMERA, keep=np.ones(100, bool))
    verdict = DepthRansacFilter(DepthRansacSettings(variance_m2=0.05), SEGMENTATION).apply(frame, state)
    np.testing.assert_array_equal(verdict.keep, np.arange(100) >= 70)
    frame.instances = box_instance(400, 100, 500, 200)
    assert DepthRansacFilter(DepthRansacSettings(), SEGMENTATION).apply(frame, state).keep.all()


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


def test_correlation_separates_the_moving_body() -> None:
    block = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5))
    for motion, expected in ((np.array([0.15, 0.1, 0.0]), True), (None, False)):
        made = scene(SIDEWAYS, motion=motion)
        block.reset(CAMERA)
        start = FilterState(camera=CAMERA, keep=made.state.keep, T_world_pred=np.eye(4))
        block.apply(made.state.previous, start)
        verdict = block.apply(made.frame, made.state)
        dropped = ~verdict.keep
        if expected:
            assert dropped[made.moving].mean() > 0.9 and dropped[~made.moving].mean() < 0.05
        else:
            assert dropped.mean() < 0.02


def texture(seed: int) -> np.ndarray:
    import cv2

    noise = np.random.default_rng(seed).integers(0, 255, (480, 640), dtype=np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(blurred, None, 0, 255, cv2.NORM_MINMAX)


def moved_patch(shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Two images of a textured wall; the box's texture has moved by `shift` pixels downwards in the second."""
    wall, person = texture(0), texture(1)
    x0, y0, x1, y1 = BOX
    before, after = wall.copy(), wall.copy()
    before[y0:y1, x0:x1] = person[y0:y1, x0:x1]
    after[y0:y1, x0:x1] = person[y0 - shift : y1 - shift, x0:x1]
    return before, after


@pytest.mark.parametrize("shift", [0, 12])
def test_template_keeps_what_is_found_where_the_camera_predicts_it(shift: int) -> None:
    before, after = moved_patch(shift)
    rng = np.random.default_rng(3)
    xy = rng.uniform((30, 30), (610, 450), (300, 2))
    frame = bundle(xy, np.full(300, 2.0), np.full((480, 640), 2.0, np.float32), 1.0)
    previous = bundle(xy, np.full(300, 2.0), frame.depth, 0.9)
    frame.gray, previous.gray = after, before
    frame.instances = box_instance(*BOX)
    state = FilterState(
        camera=CAMERA, keep=np.ones(300, bool), previous=previous, T_world_prev=np.eye(4), T_world_pred=np.eye(4)
    )
    verdict = TemplateFilter(TemplateSettings(), SEGMENTATION).apply(frame, state)
    x, y = xy.T
    margin = 8 if shift else 0  # patches across the box's edge see both
    inside = (x >= BOX[0] + margin) & (x < BOX[2] - margin) & (y >= BOX[1] + margin) & (y < BOX[3] - margin)
    outside = ~((x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3]))
    assert verdict.keep[outside].all()
    assert verdict.keep[inside].all() if shift == 0 else not verdict.keep[inside].any()


@pytest.mark.parametrize("shift", [0, 12])
def test_moving_vote_drops_all_people_or_nobody(shift: int) -> None:
    before, after = moved_patch(shift)
    made = scene(np.eye(4))
    made.frame.gray, made.state.previous.gray = np.roll(after, 3, axis=1), before  # the camera pans by 3 px
    made.frame.instances = box_instance(*BOX)
    verdict = MovingVoteFilter(MovingVoteSettings(threshold_px=1.0), SEGMENTATION).apply(made.frame, made.state)
    x, y = np.rint(made.frame.keypoints.xy).T
    on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    np.testing.assert_array_equal(verdict.keep, ~on if shift else np.ones(len(on), bool))


def test_moving_vote_tracks_the_corners_that_the_authors_code_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    previous = cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    harris = cv2.goodFeaturesToTrack(
        previous, 1000, 0.01, 8, mask=None, blockSize=3, gradientSize=3, useHarrisDetector=True, k=0.04
    )
    given: list[np.ndarray] = []
    refine = cv2.cornerSubPix
    monkeypatch.setattr(cv2, "cornerSubPix", lambda image, corners, *rest: given.append(corners.copy()) or refine(
        image, corners, *rest
    ))  # fmt: skip
    MovingVoteFilter(MovingVoteSettings(), SEGMENTATION)._moving_corners(previous, np.roll(previous, 3, 1), CAMERA)
    np.testing.assert_array_equal(given[0], harris)


def test_residual_clusters_find_the_part_that_the_camera_does_not_explain() -> None:
    before, after = moved_patch(12)
    rng = np.random.default_rng(4)
    xy = rng.uniform((30, 30), (610, 450), (300, 2))
    depth = np.full((480, 640), 3.0, np.float32)
    depth[BOX[1] : BOX[3], BOX[0] : BOX[2]] = 1.5
    frame = bundle(xy, np.full(300, 2.0), depth, 1.0)
    previous = bundle(xy, np.full(300, 2.0), depth, 0.9)
    frame.gray, previous.gray = after, before
    frame.instances = box_instance(*BOX)
    state = FilterState(
        camera=CAMERA, keep=np.ones(300, bool), previous=previous, T_world_prev=np.eye(4), T_world_pred=np.eye(4)
    )
    block = ResidualFilter(ResidualSettings(), SEGMENTATION)
    x, y = xy.T
    on = (x >= BOX[0]) & (x < BOX[2]) & (y >= BOX[1]) & (y < BOX[3])
    keep = block.apply(frame, state).keep
    assert keep[~on].mean() > 0.95 and keep[on].mean() < 0.05
    frame.gray, frame.instances = before, None
    assert block.apply(frame, state).keep.all()


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


BLOCKS = [
    BoxFilter(BoxSettings(), SEGMENTATION),
    BoxEpipolarFilter(BoxEpipolarSettings(), SEGMENTATION),
    MovingVoteFilter(MovingVoteSettings(), SEGMENTATION),
    MultiViewFilter(MultiViewSettings()),
    DepthRansacFilter(DepthRansacSettings(), SEGMENTATION),
    CorrelationFilter(CorrelationSettings()),
    ProbabilityFilter(ProbabilitySettings(), SEGMENTATION),
    TemplateFilter(TemplateSettings(), SEGMENTATION),
    ResidualFilter(ResidualSettings(), SEGMENTATION),
    ClassRuleFilter(ClassRuleSettings(), SEGMENTATION),
]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.name)
@pytest.mark.parametrize("case", ["first frame", "no points", "no depth", "no objects", "black", "invalid flow"])
def test_degenerate_input_is_survived(block: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    block.reset(CAMERA)
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "no depth":
        frame.depth[:] = 0
        frame.z[:] = 0
    elif case == "no objects":
        frame.instances = box_instance(0, 0, 10, 10).of_classes(())
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    verdict = block.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert all(np.isfinite(value) for value in verdict.stats.values())
