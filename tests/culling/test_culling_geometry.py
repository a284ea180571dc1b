"""Rules on motion and depth, and the geometry behind them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.culling_scenes import (
    ACROSS,
    CAMERA,
    ROTATION,
    SIDEWAYS,
    Scene,
    at_rest,
    box_instance,
    bundle,
    keyframe,
    keypoints,
    on_rectangle,
    scene,
)

from dynslam_bench.contracts.filter import FilterState, FrameBundle, KeyframeView
from dynslam_bench.culling.correlation_graph import (
    CorrelationFilter,
    depth_variance,
    point_covariance,
)
from dynslam_bench.culling.ego_motion import (
    CORRELATION,
    depth_sigma,
    prior_information,
    refine_prediction,
)
from dynslam_bench.culling.epipolar import EpipolarFilter, epipolar_distance, fundamental_matrix
from dynslam_bench.culling.free_space import MAX_AGE_S, FreeSpaceFilter
from dynslam_bench.culling.moving_regions import in_moving_region
from dynslam_bench.culling.multiview_depth import (
    BIN_M,
    MultiViewFilter,
    grow,
    hidden,
    refine_by_matches,
)
from dynslam_bench.culling.rigid_motion import RigidMotionFilter
from dynslam_bench.culling.settings import (
    CorrelationSettings,
    EpipolarSettings,
    FreeSpaceSettings,
    MultiViewSettings,
    RigidMotionSettings,
)
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.gauss_newton import twist_of
from dynslam_bench.trackers import TRACKERS

FORWARD = se3.exp(np.array([0, 0, 0.05, 0, 0, 0]))


@pytest.mark.parametrize(
    "distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), (-0.28, 0.09, 0.001, 0.0005, 0.0)]
)
def test_epipolar_culls_exactly_the_moving_points(
    distortion: tuple[float, float, float, float, float],
) -> None:
    camera = replace(CAMERA, distortion=distortion)
    made = scene(SIDEWAYS, motion=ACROSS, camera=camera)
    still = scene(SIDEWAYS, camera=camera)
    verdict = EpipolarFilter(EpipolarSettings(min_share=0.0)).apply(made.frame, made.state)
    np.testing.assert_array_equal(verdict.keep, ~made.moving)
    assert verdict.stats["degenerate"] == 0
    assert EpipolarFilter(EpipolarSettings()).apply(still.frame, still.state).keep.all()


@pytest.mark.parametrize(
    ("motion", "depths"),
    [
        (ROTATION, (1.0, 4.0)),
        (np.eye(4), (1.0, 4.0)),
        (se3.exp(np.array([0.02, 0, 0, 0, 0.15, 0])), (1.0, 4.0)),
        (SIDEWAYS, (2.0, 2.0)),
    ],
    ids=["pure rotation", "static camera", "fast rotation with little parallax", "plane"],
)
def test_epipolar_is_skipped_where_it_is_degenerate(
    motion: np.ndarray, depths: tuple[float, float]
) -> None:
    made = scene(motion, n_moving=30, motion=ACROSS, depths=depths)
    verdict = EpipolarFilter(EpipolarSettings()).apply(made.frame, made.state)
    assert verdict.keep.all()
    assert verdict.stats["degenerate"] == 1


def test_epipolar_is_skipped_where_depth_contradicts_f() -> None:
    """People who fill most of the image own the largest set of matches that agree on an F; the walls then fail it."""
    motion = se3.exp(np.array([0.05, 0, 0.01, 0, 0.01, 0]))
    made = scene(motion, n_static=120, n_moving=600, motion=np.array([0, 0.05, 0]))
    settings = EpipolarSettings(min_share=0.0, homography_share=1.0)
    fooled = EpipolarFilter(settings.model_copy(update={"max_contradiction": 1.0})).apply(
        made.frame, made.state
    )
    assert (~fooled.keep[~made.moving]).mean() > 0.5, "the scene does fool the plain test"
    verdict = EpipolarFilter(settings).apply(made.frame, made.state)
    assert verdict.keep.all()
    assert verdict.stats["degenerate"] == 1.0
    assert verdict.stats["contradiction"] > 0.5
    made = scene(motion, motion=np.array([0, 0.1, 0]))
    verdict = EpipolarFilter(settings).apply(made.frame, made.state)
    assert (verdict.keep == ~made.moving).all()
    assert verdict.stats["contradiction"] < 0.05


def test_what_was_culled_before_neither_determines_f_nor_contradicts_it() -> None:
    """Most points lie on people, who also took the predicted pose along."""
    made = scene(SIDEWAYS, n_static=120, n_moving=600, motion=ACROSS)
    made.state.T_world_pred = se3.exp(np.r_[-ACROSS, 0, 0, 0]) @ SIDEWAYS
    made.state.keep = ~made.moving
    keep = EpipolarFilter(EpipolarSettings(min_share=0.0)).apply(made.frame, made.state).keep
    np.testing.assert_array_equal(keep, ~made.moving)


@pytest.mark.parametrize("left", [200, 400])
def test_epipolar_object_mode_drops_whole_objects_and_nothing_else(left: int) -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    rectangle = (left, 100, left + 131, 381)
    made.frame.instances = box_instance(*rectangle)
    keep = EpipolarFilter(EpipolarSettings(mode="object")).apply(made.frame, made.state).keep
    np.testing.assert_array_equal(keep, ~(on_rectangle(made, *rectangle) & (left == 200)))


@pytest.mark.parametrize(
    ("measured", "settings", "violated"),
    [
        ([(4.5, 0.5)], {}, True),
        ([(4.5, MAX_AGE_S + 1)], {}, False),
        ([(0, 0.5)], {}, False),
        ([(4.5, 0.5), (4.5, 0.6)], {}, True),
        ([(4.5, 0.5), (0, 0.6)], {}, False),
        ([(4.5, 0.5), (0, 0.6)], {"min_votes": 1}, True),
        ([(4.5, 0.5)], {"threshold_m": 4.0}, False),
        ([(6.0, 0.5)], {"threshold_sigma": 100.0}, False),
    ],
)
def test_free_space_culls_what_stands_where_enough_recent_keyframes_measured_clearly_further(
    measured: list[tuple[float, float]], settings: dict[str, float], violated: bool
) -> None:
    """Keyframes from the previous pose, of so many metres (0: what the scene shows there) and seconds of age."""
    made = scene(SIDEWAYS)
    previous = se3.exp(np.array([1.0, 2.0, 3.0, 0.5, 0.4, 0.3]))
    views = tuple(
        keyframe(
            previous,
            np.where(depth_m, np.float32(depth_m), made.state.previous.depth),
            made.frame.timestamp - age_s,
        )
        for depth_m, age_s in measured
    )
    state = FilterState(CAMERA, made.state.keep, T_world_pred=previous @ SIDEWAYS, keyframes=views)
    keep = (
        FreeSpaceFilter(FreeSpaceSettings(min_share=0.0, **settings)).apply(made.frame, state).keep
    )
    # the near points of the scene
    assert keep[made.frame.z < 3.9].any() != violated
    assert keep.all() != violated


def test_free_space_knows_an_image_by_itself_and_not_by_its_address() -> None:
    made = scene(SIDEWAYS)
    far, near = (
        np.full((CAMERA.height, CAMERA.width), depth_m, np.float32) for depth_m in (4.5, 0.5)
    )
    view = keyframe(np.eye(4), near, made.frame.timestamp - 0.5)
    state = FilterState(CAMERA, made.state.keep, T_world_pred=SIDEWAYS, keyframes=(view,))
    rule = FreeSpaceFilter(FreeSpaceSettings(min_votes=1, min_share=0.0))
    rule.reset()
    rule._smallest[id(near)] = (far, far)  # as after a copy, whose original is gone
    assert rule.apply(made.frame, state).keep.all()


@pytest.mark.parametrize(
    ("camera_motion", "motion"),
    [(FORWARD, np.array([0, 0, -0.1])), (ROTATION, ACROSS), (np.eye(4), ACROSS)],
    ids=["along epipolar lines", "rotation", "camera at rest"],
)
def test_rigid_motion_detects_what_the_epipolar_test_cannot(
    camera_motion: np.ndarray, motion: np.ndarray
) -> None:
    made = scene(camera_motion, motion=motion)
    still = scene(camera_motion)
    rule = RigidMotionFilter(RigidMotionSettings(min_share=0.0))
    np.testing.assert_array_equal(rule.apply(made.frame, made.state).keep, ~made.moving)
    rule.reset(CAMERA)
    assert rule.apply(still.frame, still.state).keep.all()


@pytest.mark.parametrize(("moving_frames", "held_s"), [(1, 0.0), (20, 2.0)])
def test_what_moved_for_some_frames_stays_culled_after_it_stopped(
    moving_frames: int, held_s: float
) -> None:
    made = far_wall_and_walker(250, 300)
    still = far_wall_and_walker(250, 300)
    still.state.flow.xy[:] = still.frame.xy
    rule = RigidMotionFilter(RigidMotionSettings())
    for _ in range(moving_frames):
        assert not rule.apply(made.frame, made.state).keep[made.moving].any()
    middle = made.moving & on_rectangle(still, 230, 130, 300, 350)
    far = ~on_rectangle(still, 140, 40, 390, 440)
    culled = [~rule.apply(still.frame, still.state).keep for _ in range(150)]
    held = int(held_s * 30)
    assert all(keypoints[middle].all() and not keypoints[far].any() for keypoints in culled[:held])
    assert not culled[-1].any()
    assert held or not culled[0].any()


def test_slow_steady_motion_fails_after_some_frames_and_noise_does_not() -> None:
    # 2 px a frame
    slow = far_wall_and_walker(250, 300, step_m=0.004)
    rule = RigidMotionFilter(RigidMotionSettings())
    first, *_, last = (rule.apply(slow.frame, slow.state).keep for _ in range(20))
    assert first.all()
    assert not last[slow.moving].any()
    assert last[~slow.moving].mean() > 0.97


def far_wall_and_walker(n_static: int, n_moving: int, step_m: float = 0.03) -> Scene:
    """A camera at rest, a wall 3 m away, of one depth within the sensor's noise, and a person at 1 m."""
    made = scene(np.eye(4), n_static=n_static, n_moving=n_moving, seed=3)
    rng = np.random.default_rng(3)
    z = np.where(
        made.moving, rng.uniform(0.9, 1.1, len(made.frame)), rng.uniform(2.9, 3.1, len(made.frame))
    )
    made.frame.z[:] = made.state.previous.z[:] = z
    made.state.previous.depth[:] = 0.0  # the flow alone decides
    before = CAMERA.unproject(made.frame.xy, z)
    before[made.moving] -= (step_m, 0.0, 0.0)
    made.state.flow.xy[:] = CAMERA.project(before) + rng.normal(0, 0.3, (len(z), 2))
    return made


CERTAIN = np.diag([2.5e-3**2] * 3 + [0.012**2] * 3)
"""Covariance of the back end's motion model once it knows the camera's speed."""


@pytest.mark.parametrize(
    ("n_static", "n_moving", "covariance"), [(250, 120, None), (100, 600, CERTAIN)]
)
def test_a_walker_before_a_far_wall_does_not_bias_the_camera(
    n_static: int, n_moving: int, covariance
) -> None:  # type: ignore[no-untyped-def]
    made = far_wall_and_walker(n_static, n_moving)
    if covariance is not None:  # a moving majority biases the estimate unless the speed is known
        assert np.linalg.norm(refine_prediction(made.frame, made.state)[:3, 3]) > 0.02
    made.state.motion_covariance = covariance
    made.state.T_world_pred = refine_prediction(made.frame, made.state)
    assert np.linalg.norm(made.state.T_world_pred[:3, 3]) < 4e-3
    keep = RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state).keep
    assert not keep[made.moving].any()
    assert keep[~made.moving].mean() > 0.97


def test_a_box_that_is_lifted_before_the_camera_does_not_take_it_along() -> None:
    made = far_wall_and_walker(600, 200, step_m=0.01)  # 5 px a frame
    static = ~made.moving
    z = made.frame.z
    z[static] = np.random.default_rng(5).uniform(1.8, 3.5, static.sum())
    still = CAMERA.project(CAMERA.unproject(made.frame.xy[static], z[static]))
    made.state.flow.xy[static] = still + np.random.default_rng(6).normal(0, 0.1, still.shape)
    # as if the box were at rest
    made.state.T_world_pred = se3.exp(np.array([0.008, 0.0, 0.0, 0.0, -0.003, 0.0]))
    made.state.motion_covariance = CERTAIN
    assert np.linalg.norm(refine_prediction(made.frame, made.state)[:3, 3]) < 1e-3


def test_the_motion_model_does_not_hold_back_a_camera_that_accelerates() -> None:
    jerk = se3.exp(np.array([0.004, -0.003, 0.002, 0.01, -0.02, 0.005]))
    made = scene(jerk)
    made.state.T_world_pred = np.eye(4)
    made.state.motion_covariance = CERTAIN
    made.state.T_world_pred = refine_prediction(made.frame, made.state)
    assert (
        se3.rotation_angle(se3.inverse(jerk) @ made.state.T_world_pred)
        < 3e-3
        < se3.rotation_angle(jerk) / 5
    )
    assert RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state).keep.all()


def test_ego_motion_resists_a_large_moving_object() -> None:
    made = scene(SIDEWAYS, n_static=200, n_moving=180, motion=ACROSS)
    made.state.T_world_pred = se3.exp(np.array([0.05, 0.02, 0.03, 0.01, -0.008, 0.005]))
    error = se3.inverse(SIDEWAYS) @ refine_prediction(made.frame, made.state)
    assert np.linalg.norm(error[:3, 3]) < 2e-3
    assert se3.rotation_angle(error) < 1e-3


def test_descriptor_matches_refine_a_poor_prediction() -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    descriptors = np.random.default_rng(3).integers(0, 255, (len(made.frame), 32), dtype=np.uint8)
    for frame in (made.frame, made.state.previous):
        frame.keypoints = replace(frame.keypoints, descriptors=descriptors)
    poor = SIDEWAYS @ se3.exp(np.array([0.01, -0.01, 0.01, 0.005, 0.005, 0.0]))
    made.state.flow = None
    made.state.T_world_pred = poor
    made.state.keep = ~made.moving
    errors = [
        se3.inverse(SIDEWAYS) @ pose for pose in (poor, refine_by_matches(made.frame, made.state))
    ]
    assert np.linalg.norm(errors[1][:3, 3]) < 0.2 * np.linalg.norm(errors[0][:3, 3])
    made.state.keep = np.zeros(len(made.frame), bool)
    np.testing.assert_array_equal(refine_by_matches(made.frame, made.state), poor)
    made.state.previous = None
    np.testing.assert_array_equal(refine_by_matches(made.frame, made.state), poor)


@pytest.mark.slow
def test_covariance_of_the_motion_is_that_of_sampled_motions() -> None:
    rng = np.random.default_rng(0)
    before = se3.exp(rng.normal(size=6))
    motion = se3.exp(rng.normal(size=6))
    # of (position in the world, rotation in the camera frame)
    root = 1e-3 * rng.normal(size=(6, 6))
    state = FilterState(
        CAMERA, np.ones(0, bool), T_world_prev=before, motion_covariance=root @ root.T
    )
    twists = []
    for shift, turn in (rng.normal(size=(4_000, 6)) @ root.T).reshape(-1, 2, 3):
        pose = before @ motion
        pose[:3, :3] = pose[:3, :3] @ se3.exp(np.append(np.zeros(3), turn))[:3, :3].T
        pose[:3, 3] += shift
        twists.append(twist_of(se3.inverse(before) @ pose @ se3.inverse(motion)))
    covariance = CORRELATION * np.linalg.inv(prior_information(state, motion))
    np.testing.assert_allclose(
        np.cov(np.array(twists).T), covariance, atol=0.1 * np.abs(covariance).max()
    )
    assert not prior_information(FilterState(CAMERA, np.ones(0, bool)), np.eye(4)).any()


def test_epipolar_distance_agrees_with_the_definition() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(3, 3))
    (first, second) = rng.uniform(0, 600, (2, 20, 2))
    expected = []
    for (u1, v1), (u2, v2) in zip(first, second, strict=True):
        x, y, w = matrix @ (u1, v1, 1)
        expected.append(abs(x * u2 + y * v2 + w) / np.hypot(x, y))
    np.testing.assert_allclose(epipolar_distance(matrix, first, second), expected, rtol=1e-12)


def test_fundamental_matrix_is_that_of_the_true_motion() -> None:
    made = scene(SIDEWAYS, n_moving=0, noise_px=0.05)
    clean = scene(SIDEWAYS, n_moving=0, noise_px=0.0, seed=5)
    matrix = fundamental_matrix(made.state.flow.xy.astype(float), made.frame.xy)
    T_cur_prev = se3.inverse(SIDEWAYS)
    inverse = np.linalg.inv(CAMERA.matrix)
    true = inverse.T @ se3.hat(T_cur_prev[:3, 3]) @ T_cur_prev[:3, :3] @ inverse
    matches = clean.state.flow.xy.astype(float), clean.frame.xy
    assert epipolar_distance(true, *matches).max() < 1e-3
    assert np.median(epipolar_distance(matrix, *matches)) < 0.1
    assert fundamental_matrix(matches[0][:15], matches[1][:15]) is None


@pytest.mark.parametrize("width", [320, 160, 400, 1280])
def test_a_region_is_the_same_share_of_an_image_of_any_size(width: int) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform((0, 0), (640, 480), (1000, 2))
    failing = (np.abs(xy - (320, 240)).max(axis=1) < 60) | (rng.random(1000) < 0.05)
    tested = np.ones(1000, bool)
    scale = width / 640
    moving = in_moving_region(failing, tested, xy, 0.4, (480, 640))
    size = round(480 * scale), width
    np.testing.assert_array_equal(in_moving_region(failing, tested, scale * xy, 0.4, size), moving)
    assert 0 < np.count_nonzero(moving) < np.count_nonzero(failing)


def test_a_region_that_fails_moves_and_a_lone_point_is_noise() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform((0, 0), (640, 480), (1000, 2))
    noise = rng.random(1000) < 0.05
    away = np.abs(xy - (320, 240)).max(axis=1)
    moving = in_moving_region((away < 60) | noise, np.ones(1000, bool), xy, 0.4, (480, 640))
    assert moving[away < 40].all()
    assert moving[(away > 120) & noise].mean() < 0.05
    np.testing.assert_array_equal(
        in_moving_region(noise, np.ones(1000, bool), xy, 0.0, (480, 640)), noise
    )


def test_correlation_separates_the_moving_body_of_known_and_of_new_keypoints() -> None:
    rule = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5))
    for motion, missed in (
        (np.array([0.15, 0.1, 0.0]), False),
        (None, False),
        (np.array([0.15, 0.1, 0.0]), True),
    ):
        made = scene(SIDEWAYS, motion=motion)
        before = made.state.previous
        # other points are detected only now
        rows = np.flatnonzero(np.arange(len(before)) % (1 + missed) == 0)
        previous = replace(
            before, keypoints=before.keypoints.select(rows), xy=before.xy[rows], z=before.z[rows]
        )
        made.state.previous_keep = np.ones(len(rows), bool)
        made.state.previous = previous
        rule.reset(CAMERA)
        rule.apply(previous, FilterState(CAMERA, np.ones(len(rows), bool), T_world_pred=np.eye(4)))
        verdict = rule.apply(made.frame, made.state)
        new = ~np.isin(np.arange(len(before)), rows) if missed else np.ones(len(before), bool)
        share = (~verdict.keep)[made.moving & new].mean()
        assert (~verdict.keep)[~made.moving & new].mean() < 0.05
        assert share > 0.9 if motion is not None else share < 0.02
        assert verdict.stats["tracked"] > 0.9 * len(made.frame)


def test_depth_edges_are_uncertain_and_covariance_is_that_of_the_unprojection() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 3.0
    flat, edge, far = depth_variance(depth, np.array([[100.0, 100], [319, 100], [500, 200]]))
    sigma = depth_sigma(np.array([2.0, 3.0]))
    # Nguyen et al. 2012
    np.testing.assert_allclose(sigma, 0.0012 + 0.0019 * np.array([1.6, 2.6]) ** 2)
    np.testing.assert_allclose([flat, far], sigma**2)
    assert edge > 0.18  # a quarter of the weight lies one metre further
    rng = np.random.default_rng(0)
    xy = np.array([[500.0, 100.0]])
    z = np.array([2.5])
    covariance = point_covariance(xy, z, np.array([0.02**2]), CAMERA, 0.8)[0]
    noisy = CAMERA.unproject(
        xy + rng.normal(0, 0.8, (200_000, 2)), z + rng.normal(0, 0.02, 200_000)
    )
    np.testing.assert_allclose(covariance, np.cov(noisy.T), atol=4e-6)


# DynaSLAM's multi-view test: what hides a keyframe's points, region growing, and the differences of
# paper and code.


PERSON = (slice(100, 380), slice(220, 330))
GRID = (
    np.stack(np.meshgrid(np.arange(30, 611, 10), np.arange(30, 451, 10)), axis=-1)
    .reshape(-1, 2)
    .astype(float)
)
PLAIN = MultiViewSettings(dilation_px=0, border_px=0)


def in_front(
    keyframes: int = 5,
    hole: tuple[slice, slice] | None = None,
    aside_m: float = 0.0,
    person: bool = True,
) -> tuple[FrameBundle, FilterState]:
    """A person at 1.5 m before a wall that every keyframe observed from `aside_m` further left, features on a grid."""
    wall = np.full((480, 640), 3.0, np.float32)
    now = wall.copy()
    pose = np.eye(4)
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
    flags = hidden(
        depth, np.array([[30, 50], [45, 50], [20, 50]], np.int64), np.full(3, 3.01), 0.4, 20
    )
    # inside; the wall is in its window; no depth there
    np.testing.assert_array_equal(flags, [True, False, False])


def test_missing_depth_counts_in_the_variance() -> None:
    assert MultiViewFilter(PLAIN).apply(*in_front()).stats["seeds"] > 0
    assert (
        MultiViewFilter(PLAIN)
        .apply(*in_front(hole=(slice(100, 380, 8), slice(220, 330, 8))))
        .stats["seeds"]
        == 0
    )


def test_features_at_the_border_of_the_mask_are_dropped() -> None:
    frame, state = in_front()
    x, y = frame.keypoints.xy.T
    wide = MultiViewFilter(PLAIN.model_copy(update={"border_px": 15})).apply(frame, state)
    tight = MultiViewFilter(PLAIN).apply(frame, state)
    beside = (y > 120) & (y < 360) & (((x >= 206) & (x < 220)) | ((x > 329) & (x <= 343)))
    assert beside.any()
    assert not wide.keep[beside].any()
    assert tight.keep[beside].all()
    # the code's, not in the paper
    assert TRACKERS.get("dynaslam-code").settings().multiview.border_px == 15
    np.testing.assert_array_equal(wide.mask, tight.mask)  # the mask itself is not wider


@pytest.mark.parametrize(
    ("name", "first"), [("dynaslam-g", 1), ("dynaslam", 1), ("dynaslam-code", 5), ("di-slam", 5)]
)
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
    assert grown[0].sum() > 1.3 * (np.abs(ramp[0] - ramp[0, 10]) < 0.2).sum(), (
        "the mean moves along a slope"
    )
    region = ramp[0][grown[0] > 0]
    assert region.max() - region.mean() < 0.2 + 0.01
    ramp[:, 30:] += 0.5
    ramp[5, 5] = 0.0
    cut = grow(ramp, seed, 0.2, BIN_M)
    assert cut[:, :30].sum() == 20 * 30 - 1
    assert not cut[:, 30:].any()
    assert not cut[5, 5]


@pytest.mark.parametrize("depth_m", [1e30, np.inf, np.nan, -2.0])
def test_absurd_depth_is_missing_depth(depth_m: float) -> None:
    frame, state = in_front()
    frame.depth[0:10] = depth_m
    assert MultiViewFilter(MultiViewSettings()).apply(frame, state).stats["seeds"] > 0
