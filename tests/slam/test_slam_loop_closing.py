"""Loop closing: drift is removed where a place is recognised, and nothing moves where places only look the same."""

from functools import partial

import numpy as np
import pytest
from helpers.point_world import make_backend, states, track_all, without_depth
from helpers.ring_world import RingWorld, drive, position_errors
from scipy.optimize import least_squares

from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import se3
from dynslam_bench.slam import loop_closing
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.loop_closing import (
    LOOP_WEIGHT,
    SIGMAS,
    Correction,
    Edge,
    optimise_poses,
    spread_scale,
    transferred_edges,
)
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.motion_model import FramePose, MotionState, rescale, trajectory
from dynslam_bench.slam.settings import MotionModelSettings
from dynslam_bench.slam.tracking import weakly_connected

NOISE = {"noise_px": 1.2, "depth_noise": 0.01, "limit": 500}
MONOCULAR_NOISE = {"noise_px": 0.8, "limit": 700}
STEP = 0.15
MONOCULAR_STEP = 0.07


def lap(world, frames, *, closing):
    """A back end that has driven along a ring, and the error of each online position in metres."""
    path = [*range(frames)]
    backend, results, truth = drive(
        world, path, STEP, rate=30.0, noise=NOISE, loop_closing__enabled=closing
    )
    assert states(results) == ["ok"] * frames
    assert results[-1].loops == len(backend.loops.closed)
    final = np.linalg.norm(backend.finalize().positions - truth[:, :3, 3], axis=1).max()
    return backend, position_errors(results, path, truth), final


@pytest.mark.slow
def test_a_lap_comes_back_to_where_it_began():
    world = RingWorld()
    frames = world.frames_of_a_lap(STEP)
    backend, errors, final = lap(world, frames + 15, closing=True)
    drift = errors[frames - 5 : frames + 5].max()
    assert drift > 0.1
    assert errors[-1] < 0.3 * drift
    loop = backend.loops.closed[0]
    assert np.linalg.norm(se3.inverse(loop.place.T_cam_world)[:3, 3]) < 20 * STEP
    assert loop.correction.moved_m == pytest.approx(drift, rel=0.5)
    assert final < 0.8 * drift, "the whole trajectory is corrected, not its end alone"
    index = backend.map.points
    assert (backend.map.n_obs[index] > 0).all()
    assert np.isfinite(backend.map.position[index]).all()


def rmse(poses, true):
    """RMSE of positions, metres, scaled and aligned."""
    return np.sqrt(
        np.square(align(poses, true, "sim3").apply(poses)[:, :3, 3] - true[:, :3, 3])
        .sum(axis=1)
        .mean()
    )


@pytest.fixture(scope="module")
def closed_monocular():
    """A ring, and a monocular back end that has closed it, with its results and the true poses."""
    world = RingWorld(side=9.0, seed=3)
    path = [*range(world.frames_of_a_lap(MONOCULAR_STEP) + 40)]
    return world, *drive(
        world, path, MONOCULAR_STEP, rate=30.0, monocular=True, noise=MONOCULAR_NOISE,
        # with the default scale hardly drifts
        loop_closing__enabled=True, mapping__min_parallax_sigmas=0.0,
    )  # fmt: skip


@pytest.mark.slow
def test_without_depth_a_lap_gets_its_scale_back(closed_monocular):
    _, backend, results, truth = closed_monocular
    loop = backend.loops.closed[0]
    final = backend.finalize()
    assert np.linalg.norm(se3.inverse(loop.place.T_cam_world)[:3, 3]) < 20 * MONOCULAR_STEP
    before = [at for at, result in enumerate(results) if result.state == "ok" and not result.loops]
    drifted = rmse(np.array([results[at].T_world_cam for at in before]), truth[before])
    closed = rmse(final.T_world_cam, truth[np.rint(final.timestamps * 30).astype(int)])
    assert abs(np.log(loop.correction.scale)) > 0.03
    assert closed < 0.6 * drifted


@pytest.mark.slow
def test_a_map_without_depth_goes_on_after_its_loop_was_closed_and_it_was_saved(
    closed_monocular, tmp_path
):
    world, made, _, _ = closed_monocular
    made.save_map(tmp_path / "lap.npz")
    again = make_backend(
        world,
        monocular=True,
        seed=1,
        loop_closing__enabled=True,
        map__file=str(tmp_path / "lap.npz"),
    )
    poses = world.lap(60, MONOCULAR_STEP)
    frames = [
        without_depth(world.see(pose, 1000 + i, **MONOCULAR_NOISE)) for i, pose in enumerate(poses)
    ]
    results = track_all(again, frames)
    assert states(results) == ["ok"] * 60
    assert not again.loops.closed
    online = np.array([result.T_world_cam for result in results])
    assert (
        np.linalg.norm((align(online, poses, "sim3").apply(online) - poses)[:, :3, 3], axis=1).max()
        < 0.05
    )
    # in the saved map's unit
    before = trajectory(made.history, made.map, made.settings.motion).T_world_cam[:60]
    lengths = [
        np.linalg.norm(np.diff(track[:, :3, 3], axis=0), axis=1).sum() for track in (online, before)
    ]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.1)


@pytest.mark.parametrize(
    ("scale", "second", "agree"), [(1.6, 1.6, True), (2.5, 2.4, True), (1.05, 2.5, False)]
)
def test_consecutive_keyframes_agree_on_a_similarity(scale, second, agree):
    """Two keyframes 0.2 apart; lengths where they are should be `scale` times as large, by the second one `second`."""
    corrections = []
    for at, factor in ((5.0, scale), (5.2, second)):
        before = np.eye(4)
        now = np.eye(4)
        before[0, 3] = -at
        now[0, 3] = -scale * (at - 5.0)
        corrections.append(Correction(before, now, factor))
    assert corrections[1].agrees(corrections[0], np.array([5.2, 0.0, 0.0])) is agree


def test_frames_of_a_rescaled_keyframe_move_with_it():
    pose = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.2, 0.0]))
    information = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
    history = [
        FramePose(stamp, slot, pose.copy(), information.astype(np.float32))
        for stamp, slot in ((0, 7), (1, 9))
    ]
    rescale(history, {7: 2.0})
    rescaled, other = history
    np.testing.assert_allclose(rescaled.T_cam_ref[:3, 3], 2.0 * pose[:3, 3])
    np.testing.assert_array_equal(rescaled.T_cam_ref[:3, :3], pose[:3, :3])
    np.testing.assert_allclose(np.diag(rescaled.information), 1.0)
    assert np.array_equal(other.T_cam_ref, pose)
    assert np.array_equal(other.information, information)


@pytest.mark.slow
def test_corridors_that_look_the_same_are_not_taken_for_one():
    backend, errors, _ = lap(RingWorld(alike=0.5), 70, closing=True)
    assert not backend.loops.closed
    assert errors.max() < 0.2


@pytest.mark.slow
def test_sections_of_a_long_path_drift_independently(monkeypatch):
    monkeypatch.setattr(loop_closing, "DRIFT_SECTION", 0.001)  # by the real one this lap is closed
    world = RingWorld()
    backend, _, _ = lap(world, world.frames_of_a_lap(STEP) + 6, closing=True)
    assert not backend.loops.closed


@pytest.mark.slow
def test_it_changes_nothing_where_no_place_is_seen_again():
    _, without, _ = lap(RingWorld(), 60, closing=False)
    backend, errors, _ = lap(RingWorld(), 60, closing=True)
    assert len(weakly_connected(backend.map, int(backend.map.keyframes[-1])))
    assert (errors == without).all()


# ---------------------------------------------------------------------- the pose graph


def test_a_loop_edge_moves_to_the_replacement_of_a_culled_keyframe():
    poses = [se3.exp(np.random.default_rng(number).normal(size=6)) for number in range(4)]
    edge = lambda a, b: Edge(a, b, poses[b] @ se3.inverse(poses[a]), 2.0)  # noqa: E731
    for culled, expected in ((0, edge(3, 1)), (1, edge(0, 3))):
        (moved,) = transferred_edges([edge(0, 1)], culled, 3, poses[culled] @ se3.inverse(poses[3]))
        assert (moved.one, moved.other, moved.weight) == (expected.one, expected.other, 2.0)
        np.testing.assert_allclose(moved.T_other_one, expected.T_other_one, atol=1e-12)
    assert transferred_edges([edge(0, 1)], 0, 1, poses[0] @ se3.inverse(poses[1])) == []
    assert len(transferred_edges([edge(0, 1), edge(1, 2)], 3, 2, np.eye(4))) == 2


def test_scale_is_spread_over_the_edges_along_which_it_drifted():
    ids = np.arange(5) * 10
    steps = [Edge(int(a), int(a + 10), np.eye(4)) for a in ids[:-1]]
    loop_edge = Edge(0, 40, np.eye(4))
    spread = spread_scale(ids, steps, loop_edge, 2.0)
    # five edges share a factor of two
    np.testing.assert_allclose(spread, 2.0 ** (np.arange(5) / 5), rtol=1e-6)
    np.testing.assert_allclose(spread_scale(ids, steps, loop_edge, 1.0), 1.0)
    # what is not connected keeps its scale, and so does the oldest of each connected component
    np.testing.assert_allclose(
        spread_scale(np.r_[ids, 50], steps, loop_edge, 2.0), [*spread, 1.0], rtol=1e-6
    )
    np.testing.assert_allclose(
        spread_scale(np.r_[-1, ids], steps, loop_edge, 2.0), [1.0, *spread], rtol=1e-6
    )
    assert spread_scale(ids, steps, Edge(0, 40, np.eye(4), LOOP_WEIGHT), 2.0)[4] == pytest.approx(
        2.0, rel=0.01
    )
    inner = spread_scale(ids, steps, Edge(10, 30, np.eye(4)), 2.0)
    assert inner[1] == pytest.approx(inner[0])
    assert inner[3] == pytest.approx(inner[4])


@pytest.mark.parametrize("weight", [1.0, LOOP_WEIGHT])
def test_a_pose_graph_agrees_with_general_least_squares(weight):
    rng = np.random.default_rng(0)
    count = 12
    noise = rng.normal(0, [0.01] * 3 + [0.005] * 3, (2, count, 6))
    steps = se3.exp(np.tile([0.2, 0.0, 0.05, 0.0, 2 * np.pi / count, 0.0], (count, 1)) + noise[0])
    true = [np.eye(4)]
    drifted = [np.eye(4)]
    for step, slip in zip(steps[1:], se3.exp(noise[1])[1:], strict=True):
        true.append(step @ true[-1])
        drifted.append(slip @ step @ drifted[-1])
    pairs = [(i, j) for i in range(count) for j in (i + 1, i + 2) if j < count]
    edges = [Edge(i, j, drifted[j] @ se3.inverse(drifted[i])) for i, j in pairs]
    edges.append(Edge(0, count - 1, true[-1], weight))

    def moved(twists):
        return np.concatenate(
            [[drifted[0]], se3.exp(twists.reshape(-1, 6)) @ np.array(drifted[1:])]
        )

    def residuals(twists):
        poses = moved(twists)
        between = [
            poses[e.other] @ se3.inverse(poses[e.one]) @ se3.inverse(e.T_other_one) for e in edges
        ]
        return (se3.log(np.array(between)) / SIGMAS * np.sqrt([[e.weight] for e in edges])).ravel()

    reference = moved(least_squares(residuals, np.zeros(6 * (count - 1)), xtol=1e-12, ftol=1e-12).x)
    optimised = optimise_poses(np.arange(count), np.array(drifted), edges)
    np.testing.assert_allclose(optimised, reference, atol=1e-4)
    assert np.linalg.norm(optimised[6, :3, 3] - drifted[6][:3, 3]) > 0.001


# Submaps: they begin after a loss, are merged when the camera comes round, or stay apart.


LAP = 4 * round((4.0 + np.pi / 2) / 0.15)
AROUND = [*range(25), *[None] * 20, *range(60, LAP + 20)]
"""A lap with a blind part."""
APART = [*range(25), *[None] * 20, *range(60, 90)]
CLOSING = {"loop_closing__enabled": True}


@pytest.mark.slow
def test_a_submap_is_merged_when_the_camera_comes_round():
    backend, results, truth = drive(RingWorld(), AROUND, STEP, **CLOSING)
    tracking = np.array(states(results))
    errors = position_errors(results, AROUND, truth)
    merged = int(np.flatnonzero(tracking[45:] == "ok")[0]) + 45
    assert merged > 100
    assert (tracking[25:merged] == "lost").all()
    assert (tracking[merged:] == "ok").all()
    assert errors[merged:].max() < 0.2
    final = backend.finalize()
    assert 20 <= len(AROUND) - len(final) <= 20 + 11, (
        "frames of the submap are in the final trajectory"
    )
    true = truth[[AROUND[round(stamp * 10)] for stamp in final.timestamps]]
    assert np.linalg.norm(final.positions - true[:, :3, 3], axis=1).max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("patience", [loop_closing.PATIENCE, 10**6])
def test_a_submap_that_is_not_merged_is_left_where_the_camera_is_in_the_root_map(
    monkeypatch, patience
):
    """Nothing suffices to merge them; the camera's own pose in the root map is known from the first frame on."""
    monkeypatch.setattr(loop_closing, "PATIENCE", patience)
    monkeypatch.setattr(loop_closing, "MERGE_SHARE", 1.0)
    backend, results, truth = drive(RingWorld(), AROUND, STEP, **CLOSING)
    tracking = np.array(states(results))
    errors = position_errors(results, AROUND, truth)
    back = 45 + int(np.flatnonzero(tracking[45:] == "ok")[0])
    assert AROUND[back] == pytest.approx(LAP, abs=15)
    assert (tracking[back:] == "ok").all()
    assert errors[back:].max() < 0.2
    assert not backend.loops.closed
    assert results[-1].maps == 2
    assert backend.outputs().keyframes[-1].map == int(patience > 100)
    # a pose in the other map is not that of the fit
    assert all(result.motion_covariance is None for result in results[45 : back + 1])
    final = backend.finalize()
    assert len(final) == np.count_nonzero(tracking == "ok"), "no frame of the submap"
    true = truth[[AROUND[round(stamp * 10)] for stamp in final.timestamps]]
    assert np.linalg.norm(final.positions - true[:, :3, 3], axis=1).max() < 0.3


def blind_monocular_lap():
    """Sixty frames, twenty blind ones, and from twenty frames further on the rest of a lap and sixty frames more."""
    world = RingWorld(side=6.0, seed=3)
    lap = world.frames_of_a_lap(0.07)
    path = [*range(60), *[None] * 20, *range(100, lap + 60)]
    noise = {"noise_px": 0.5, "limit": 700}
    backend, results, _ = drive(
        world, path, 0.07, rate=30.0, monocular=True, noise=noise, **CLOSING
    )
    tracking = np.array(states(results))
    back = 80 + int(np.flatnonzero(tracking[80:] == "ok")[0])
    assert path[back] == pytest.approx(lap, abs=20)
    assert (tracking[back:] == "ok").all()
    return path, backend, results, back, world.lap(lap + 60, 0.07)


@pytest.mark.slow
def test_without_depth_a_submap_is_merged_with_its_unit_of_length():
    path, backend, results, merged, poses = blind_monocular_lap()
    assert [r.maps for r in results[100:merged]] == [2] * (merged - 100)
    assert results[-1].maps == 1
    (loop,) = backend.loops.closed
    assert loop.merges
    assert loop.fits
    assert abs(np.log(loop.correction.scale)) > 0.05
    assert np.linalg.norm(se3.inverse(loop.place.T_cam_world)[:3, 3]) < 20 * 0.07
    final = backend.finalize()
    assert len(path) - len(final) <= 20 + 17, "frames of the submap are in the final trajectory"
    true = poses[[path[round(stamp * 30)] for stamp in final.timestamps]]
    aligned = align(final.T_world_cam, true, "sim3").apply(final.T_world_cam)
    assert np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.2
    estimated, real = (
        np.linalg.norm(np.diff(t[:, :3, 3], axis=0), axis=1) for t in (aligned, true)
    )
    before, after = (
        np.median((estimated / real)[final.timestamps[1:] * 30 > at][:50]) for at in (0, 80)
    )
    assert after == pytest.approx(before, rel=0.1), (
        "lengths in the submap are those of the root map"
    )


@pytest.mark.slow
def test_without_depth_a_submap_that_would_not_fit_is_left_for_the_root_map(monkeypatch):
    # as where its lengths have drifted apart
    monkeypatch.setattr(Atlas, "admits_start", lambda *_: False)
    _, backend, results, back, _ = blind_monocular_lap()
    assert not backend.loops.closed
    assert results[-1].maps == 2
    assert len(backend.finalize()) == states(results).count("ok"), "no frame of the submap"
    assert all(np.linalg.norm(r.T_world_cam[:3, 3]) < 10.0 for r in results[back:])


@pytest.mark.slow
def test_maps_that_never_meet_stay_apart_and_filters_see_the_active_one():
    backend, results, _ = drive(RingWorld(), APART, STEP, **CLOSING)
    assert set(states(results)[25:]) == {"lost"}
    assert len(backend.finalize()) == 25
    assert results[-1].maps == 2
    outputs = backend.outputs()
    slam_map = backend.map
    assert {record.map for record in outputs.keyframes} == {0, 1}
    assert 0 < len(outputs.positions) < len(slam_map.points), (
        "where those of the submap lie is unknown"
    )
    views, (ids, _) = backend.view()
    assert views, "keyframes of the root map are older"
    assert all(view.timestamp > 2.4 for view in views), "keyframes of the root map are older"
    assert set(ids.tolist()) == set(slam_map.id[slam_map.points_of(slam_map.submap(1))].tolist())
    assert 0 < len(ids) < len(slam_map.points)
    assert backend.predict_T_world_cam(8.0)[0] is not None
    without, results, _ = drive(RingWorld(), APART, STEP)
    assert set(states(results)[25:]) == {"lost"}
    assert {record.map for record in without.outputs().keyframes} == {0}


# ---------------------------------------------------------------------- where a submap may lie


@pytest.fixture
def atlas():
    return Atlas(Map(RingWorld().camera, np.ones(1)))


def test_a_submap_lies_where_the_camera_can_have_moved(atlas):
    starts = np.array([[1.0, 0.0, 0.0], [1.0, 3.0, 0.0]])
    atlas.begin_submap(starts[0], 2.0)
    atlas.begin_submap(starts[1], 1.0)
    moved = np.eye(4)
    for number, bound in ((1, 2.0), (2, 2.0 + 3.0 + 1.0)):
        for distance in (bound - 0.01, bound + 0.01):
            moved[:3, 3] = np.array([1.0, 0.0, distance]) - starts[number - 1]
            assert atlas.admits_start(number, partial(se3.transform, moved)) == (distance < bound)
    here = np.zeros(3)
    for left, there, last, now, bound, reachable in (
        (0, 0, here, [0.0, 0.0, 1.9], 2.0, True),
        (0, 0, here, [0.0, 0.0, 2.1], 2.0, False),
        (0, 1, here, here, 2.0, False),  # nothing is known of the way to another submap
        (1, 0, [1.0, 1.0, 0.0], [1.0, 0.0, 3.4], 0.5, True),
        (1, 0, [1.0, 1.0, 0.0], [1.0, 0.0, 3.6], 0.5, False),
    ):
        assert atlas.reachable(left, there, np.array(last), np.array(now), bound) is reachable


def test_rotations_between_maps_add_up(atlas):
    for left, slack in ((0, 0.3), (1, 0.4), (0, np.pi)):
        atlas.active = left
        atlas.begin_submap(np.zeros(3), 1.0, slack)
    expected = {
        (0, 0): 0.0,
        (2, 2): 0.0,
        (1, 0): 0.3,
        (0, 1): 0.3,
        (2, 0): 0.7,
        (2, 1): 1.0,
        (3, 0): np.pi,
    }
    assert {pair: atlas.slack(*pair) for pair in expected} == pytest.approx(expected)


def test_what_is_known_of_a_submap_moves_with_the_nearest_keyframe(atlas):
    """The camera was lost near the second of two keyframes, which a loop moves, rotates and rescales."""
    before = np.tile(np.eye(4), (2, 1, 1))
    before[1, :3, 3] = [-5.0, 0.0, 0.0]  # a centre at x = 5
    atlas.begin_submap(np.array([5.5, 0.0, 0.0]), 1.0, slack=0.1)
    atlas.begin_submap(np.array([5.5, 0.0, 0.2]), 1.0, slack=0.1)
    after = before.copy()
    after[1] = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])) @ before[1]
    after[1, :3, 3] += [0.0, 0.0, 3.0]
    atlas.move_nearby(0, before, after, np.array([1.0, 2.0]))
    first, second = atlas.submaps.values()
    np.testing.assert_allclose(
        first.anchor, se3.transform(se3.inverse(after[1]), np.array([1.0, 0.0, 0.0]))
    )
    assert first.bound_m == pytest.approx(2.0)
    assert atlas.slack(1, 0) == pytest.approx(0.4)
    assert np.array_equal(first.start, [5.5, 0.0, 0.0]), "its own world has not changed"
    atlas.move_nearby(2, before, after, np.array([1.0, 1.0]))
    assert np.array_equal(atlas.submaps[1].start, first.start)
    assert np.allclose(atlas.submaps[2].anchor, second.anchor)
    assert not np.allclose(atlas.submaps[2].start, second.start)


def test_the_motion_continues_in_the_camera_frame_where_a_loop_transforms_the_world():
    transform = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 2.0, 0.3]))
    state = MotionState.at(
        se3.inverse(se3.exp(np.array([1.0, 2.0, 3.0, 0.2, 0.1, 0.4]))), 1e-4 * np.eye(6)
    )
    state.speed[:] = [0.3, 0.1, 0.9, 0.02, 0.3, 0.1]
    state.covariance[6:9, 6:9] = np.diag([0.1, 0.2, 0.3])
    moved = state.transformed(transform[:3, :3], 2.0)
    assert np.allclose(moved.rotation @ moved.speed[:3], 2.0 * state.rotation @ state.speed[:3])
    assert np.allclose(moved.position, 2.0 * transform[:3, :3] @ state.position)
    assert np.array_equal(moved.speed[3:], state.speed[3:])
    assert np.allclose(
        np.linalg.eigvalsh(moved.covariance[6:9, 6:9]), 4.0 * np.array([0.1, 0.2, 0.3])
    )
    steps = [
        s.T_cam_world @ se3.inverse(s.predicted(0.1, MotionModelSettings()).T_cam_world)
        for s in (moved, state)
    ]
    assert np.allclose(steps[0][:3, :3], steps[1][:3, :3])
    assert np.allclose(steps[0][:3, 3], 2.0 * steps[1][:3, 3])
