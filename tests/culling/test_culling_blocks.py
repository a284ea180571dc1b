"""Each block in a scene where it must cull exactly the moving points, and in one where it must cull none."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CAMERA, Scene, box_instance, bundle, keyframe, scene

from dynslam_bench.contracts.filter import DynamicFilter, FilterState
from dynslam_bench.culling.blocks.epipolar import EpipolarFilter
from dynslam_bench.culling.blocks.epipolar_settings import EpipolarSettings
from dynslam_bench.culling.blocks.free_space import FreeSpaceFilter
from dynslam_bench.culling.blocks.free_space_settings import FreeSpaceSettings
from dynslam_bench.culling.blocks.rigid_motion import RigidMotionFilter
from dynslam_bench.culling.blocks.rigid_motion_settings import RigidMotionSettings
from dynslam_bench.culling.blocks.semantic import SemanticFilter
from dynslam_bench.culling.guard import GuardSettings, restore_starved
from dynslam_bench.culling.tools.coherence import coherent
from dynslam_bench.culling.tools.ego_motion import refine_prediction
from dynslam_bench.culling.tools.fundamental_matrix import Estimator, epipolar_distance, fundamental_matrix
from dynslam_bench.geometry import se3
from dynslam_bench.segmentation.settings import SegmentationSettings

SIDEWAYS = se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005]))
ROTATION = se3.exp(np.array([0, 0, 0, 0.02, 0.03, 0.01]))
ACROSS = np.array([0.0, 0.05, 0.0])


def test_epipolar_distance_agrees_with_the_definition() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(3, 3))
    first, second = rng.uniform(0, 600, (2, 20, 2))
    expected = []
    for (u1, v1), (u2, v2) in zip(first, second, strict=True):
        x, y, w = matrix @ (u1, v1, 1)
        expected.append(abs(x * u2 + y * v2 + w) / np.hypot(x, y))
    np.testing.assert_allclose(epipolar_distance(matrix, first, second), expected, rtol=1e-12)


@pytest.mark.parametrize("estimator", ["ransac", "lmeds", "magsac"])
def test_fundamental_matrix_is_that_of_the_true_motion(estimator: str) -> None:
    made = scene(SIDEWAYS, n_moving=0, noise_px=0.05)
    matrix = fundamental_matrix(made.state.flow.xy.astype(float), made.frame.xy, Estimator(estimator))
    assert matrix is not None
    T_cur_prev = se3.inverse(SIDEWAYS)
    essential = se3.hat(T_cur_prev[:3, 3]) @ T_cur_prev[:3, :3]
    inverse = np.linalg.inv(CAMERA.matrix)
    true = inverse.T @ essential @ inverse
    clean = scene(SIDEWAYS, n_moving=0, noise_px=0.0, seed=5)
    assert epipolar_distance(true, clean.state.flow.xy.astype(float), clean.frame.xy).max() < 1e-3
    assert np.median(epipolar_distance(matrix, clean.state.flow.xy.astype(float), clean.frame.xy)) < 0.1


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


def test_motion_sees_what_moves_along_epipolar_lines_and_under_rotation() -> None:
    forward = se3.exp(np.array([0, 0, 0.05, 0, 0, 0]))
    for camera_motion, motion in ((forward, np.array([0, 0, -0.1])), (ROTATION, ACROSS), (np.eye(4), ACROSS)):
        made = scene(camera_motion, motion=motion)
        verdict = RigidMotionFilter(RigidMotionSettings(min_share=0.0)).apply(made.frame, made.state)
        np.testing.assert_array_equal(verdict.keep, ~made.moving)
        still = scene(camera_motion)
        assert RigidMotionFilter(RigidMotionSettings()).apply(still.frame, still.state).keep.all()


def test_ego_motion_resists_a_large_moving_object() -> None:
    made = scene(SIDEWAYS, n_static=200, n_moving=180, motion=ACROSS)
    made.state.T_world_pred = se3.exp(np.array([0.05, 0.02, 0.03, 0.01, -0.008, 0.005]))
    refined = refine_prediction(made.frame, made.state)
    assert refined is not None
    error = se3.inverse(SIDEWAYS) @ refined
    assert np.linalg.norm(error[:3, 3]) < 2e-3 and se3.rotation_angle(error) < 1e-3


def far_wall_and_walker(walk: np.ndarray, n_static: int, n_moving: int) -> Scene:
    """A camera at rest, a wall 3 m away, of one depth within the sensor's noise, and a person at 1 m who walks."""
    T_prev_cur = np.eye(4)
    made = scene(T_prev_cur, n_static=n_static, n_moving=n_moving, seed=3)
    rng = np.random.default_rng(3)
    z = np.where(made.moving, rng.uniform(0.9, 1.1, len(made.frame)), rng.uniform(2.9, 3.1, len(made.frame)))
    made.frame.z[:] = z
    assert made.state.previous is not None and made.state.flow is not None
    made.state.previous.depth[:] = 0.0  # the flow alone has to tell
    before = se3.transform(T_prev_cur, CAMERA.unproject(made.frame.xy, z))
    before[made.moving] -= walk
    made.state.flow.xy[:] = CAMERA.project(before) + rng.normal(0, 0.3, (len(z), 2))
    return made


WALK = np.array([0.03, 0.0, 0.0])
"""1 m/s at 30 Hz."""
SURE = np.diag([2.5e-3**2] * 3 + [0.012**2] * 3)
"""What the back end's motion model leaves open once it knows the camera's speed."""


def test_a_walker_before_a_far_wall_does_not_drag_the_camera_along() -> None:
    made = far_wall_and_walker(WALK, 250, 120)
    made.state.T_world_pred = refined = refine_prediction(made.frame, made.state)  # the speed is not known
    assert refined is not None and np.linalg.norm(refined[:3, 3]) < 4e-3
    verdict = RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~made.moving].mean() > 0.97


def test_a_moving_majority_drags_the_camera_along_unless_its_speed_is_known() -> None:
    made = far_wall_and_walker(WALK, 100, 600)
    assert made.moving.mean() > 0.6
    free = refine_prediction(made.frame, made.state)
    made.state.motion_covariance = SURE
    held = refine_prediction(made.frame, made.state)
    assert free is not None and np.linalg.norm(free[:3, 3]) > 0.02
    assert held is not None and np.linalg.norm(held[:3, 3]) < 4e-3
    made.state.T_world_pred = held
    verdict = RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~made.moving].mean() > 0.97


def test_the_motion_model_does_not_hold_back_a_camera_that_really_accelerates() -> None:
    jerk = se3.exp(np.array([0.004, -0.003, 0.002, 0.01, -0.02, 0.005]))
    made = scene(jerk)
    made.state.T_world_pred = np.eye(4)
    made.state.motion_covariance = SURE
    held = refine_prediction(made.frame, made.state)
    assert held is not None
    assert se3.rotation_angle(se3.inverse(jerk) @ held) < 3e-3 < se3.rotation_angle(jerk) / 5
    made.state.T_world_pred = held
    assert RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state).keep.all()


def test_free_space_culls_what_stands_where_a_keyframe_saw_through() -> None:
    made = scene(SIDEWAYS)
    empty_room = np.full((CAMERA.height, CAMERA.width), 4.5, np.float32)
    static_room = made.state.previous.depth  # what is here now was there before
    settings = FreeSpaceSettings(min_votes=1, min_share=0.0)
    seen_through = FilterState(
        camera=CAMERA, keep=made.state.keep, T_world_pred=SIDEWAYS, keyframes=(keyframe(np.eye(4), empty_room, 0.5),)
    )
    verdict = FreeSpaceFilter(settings).apply(made.frame, seen_through)
    near = made.frame.z < 3.9
    assert not verdict.keep[near].any()
    unchanged = FilterState(
        camera=CAMERA, keep=made.state.keep, T_world_pred=SIDEWAYS, keyframes=(keyframe(np.eye(4), static_room, 0.5),)
    )
    assert FreeSpaceFilter(settings).apply(made.frame, unchanged).keep.all()


def test_semantic_drops_the_features_on_people_only() -> None:
    made = scene(SIDEWAYS)
    made.frame.instances = box_instance(200, 100, 331, 381)
    verdict = SemanticFilter(SegmentationSettings(dilation_px=0)).apply(made.frame, made.state)
    x, y = np.rint(made.frame.keypoints.xy).T
    np.testing.assert_array_equal(verdict.keep, ~((x >= 200) & (x < 331) & (y >= 100) & (y < 381)))
    made.frame.instances = box_instance(200, 100, 331, 381, name="chair")
    assert SemanticFilter(SegmentationSettings()).apply(made.frame, made.state).keep.all()


FILTERS = [
    EpipolarFilter(EpipolarSettings()),
    EpipolarFilter(EpipolarSettings(estimator="magsac")),
    RigidMotionFilter(RigidMotionSettings()),
    FreeSpaceFilter(FreeSpaceSettings()),
    SemanticFilter(SegmentationSettings()),
]


@pytest.mark.parametrize("block", FILTERS, ids=lambda block: block.name)
@pytest.mark.parametrize(
    "case", ["first frame", "no points", "seven matches", "nan depth", "identical", "invalid flow"]
)
def test_degenerate_input_culls_nothing_and_never_raises(block: DynamicFilter, case: str) -> None:
    made = scene(np.eye(4), noise_px=0.0)
    frame, state = made.frame, made.state
    if case == "first frame":
        state = FilterState(camera=CAMERA, keep=state.keep)
    elif case == "no points":
        frame = bundle(np.zeros((0, 2)), np.zeros(0), frame.depth, 1.0)
        state = FilterState(camera=CAMERA, keep=np.zeros(0, bool), previous=made.state.previous)
    elif case == "seven matches":
        state.flow.valid[7:] = False
    elif case == "nan depth":
        frame.depth[:] = np.nan
        frame.z[:] = 0
    elif case == "invalid flow":
        state.flow.valid[:] = False
        state.flow.xy[:] = np.nan
    block.reset(CAMERA)
    verdict = block.apply(frame, state)
    assert verdict.keep.shape == (len(frame),) and verdict.keep.all()
    assert all(np.isfinite(value) for value in verdict.stats.values())


def test_a_region_that_fails_moves_and_a_lone_point_is_noise() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform((0, 0), (640, 480), (1000, 2))
    region = (np.abs(xy - (320, 240)) < 60).all(axis=1)
    noise = rng.random(1000) < 0.05
    tested = np.ones(1000, bool)
    kept = coherent(region | noise, tested, xy, 0.4, (480, 640))
    inner = (np.abs(xy - (320, 240)) < 40).all(axis=1)
    assert kept[inner].all(), "the whole region moves"
    far = (np.abs(xy - (320, 240)) > 120).any(axis=1)
    assert kept[far & noise].mean() < 0.05, "lone failures do not"
    np.testing.assert_array_equal(coherent(noise, tested, xy, 0.0, (480, 640)), noise)


def test_guard_undoes_the_most_speculative_verdict_first() -> None:
    semantic, geometric = np.ones(100, bool), np.zeros(100, bool)
    semantic[:30] = False
    keep, undone = restore_starved([semantic, geometric], GuardSettings(min_features=40))
    assert undone == 1
    np.testing.assert_array_equal(keep, semantic)
    keep, undone = restore_starved([~np.ones(100, bool), geometric], GuardSettings(min_features=40))
    assert keep.all() and undone == 2
    keep, undone = restore_starved([semantic], GuardSettings(min_features=40))
    assert undone == 0
    np.testing.assert_array_equal(keep, semantic)
