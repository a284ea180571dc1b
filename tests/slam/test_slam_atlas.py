"""Submaps: they begin after a loss, are merged when the camera comes round, or stay apart."""

from functools import partial

import numpy as np
import pytest
from point_world import states
from ring_world import RingWorld, drive, position_errors

from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import se3
from dynslam_bench.slam import loop_closing
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.motion_model import MotionState
from dynslam_bench.slam.settings import MotionModelSettings

STEP, LAP = 0.15, 4 * round((4.0 + np.pi / 2) / 0.15)
AROUND = [*range(25), *[None] * 20, *range(60, LAP + 20)]
"""A lap with a blind part."""
APART = [*range(25), *[None] * 20, *range(60, 90)]
CLOSING = {"loop_closing__enabled": True}


def test_a_submap_is_merged_when_the_camera_comes_round():
    backend, results, truth = drive(RingWorld(), AROUND, STEP, **CLOSING)
    tracking, errors = np.array(states(results)), position_errors(results, AROUND, truth)
    merged = int(np.flatnonzero(tracking[45:] == "ok")[0]) + 45
    assert merged > 100 and (tracking[25:merged] == "lost").all() and (tracking[merged:] == "ok").all()
    assert errors[merged:].max() < 0.2
    final = backend.finalize()
    assert 20 <= len(AROUND) - len(final) <= 20 + 11, "frames of the submap are in the final trajectory"
    true = truth[[AROUND[round(stamp * 10)] for stamp in final.timestamps]]
    assert np.linalg.norm(final.positions - true[:, :3, 3], axis=1).max() < 0.3


@pytest.mark.parametrize("patience", [loop_closing.PATIENCE, 10**6])
def test_a_submap_that_is_not_merged_is_left_where_the_camera_is_in_the_root_map(monkeypatch, patience):
    """Nothing suffices to merge them; the camera's own pose in the root map is known from the first frame on."""
    monkeypatch.setattr(loop_closing, "PATIENCE", patience)
    monkeypatch.setattr(loop_closing, "MERGE_SHARE", 1.0)
    backend, results, truth = drive(RingWorld(), AROUND, STEP, **CLOSING)
    tracking, errors = np.array(states(results)), position_errors(results, AROUND, truth)
    back = 45 + int(np.flatnonzero(tracking[45:] == "ok")[0])
    assert AROUND[back] == pytest.approx(LAP, abs=15) and (tracking[back:] == "ok").all() and errors[back:].max() < 0.2
    assert not backend.loops.closed and backend.world.map_count == 2
    assert backend.outputs().keyframes[-1].map == (1 if patience > 100 else 0)
    final = backend.finalize()
    assert len(final) == np.count_nonzero(tracking == "ok"), "no frame of the submap"
    true = truth[[AROUND[round(stamp * 10)] for stamp in final.timestamps]]
    assert np.linalg.norm(final.positions - true[:, :3, 3], axis=1).max() < 0.3


def monocular_lap():
    """Sixty frames, twenty blind ones, and from twenty frames further on the rest of a lap and sixty frames more."""
    world = RingWorld(side=6.0, seed=3)
    lap = world.frames_of_a_lap(0.07)
    path = [*range(60), *[None] * 20, *range(100, lap + 60)]
    noise = {"noise_px": 0.5, "limit": 700}
    backend, results, _ = drive(world, path, 0.07, rate=30.0, monocular=True, noise=noise, **CLOSING)
    tracking = np.array(states(results))
    back = 80 + int(np.flatnonzero(tracking[80:] == "ok")[0])
    assert path[back] == pytest.approx(lap, abs=20) and (tracking[back:] == "ok").all()
    return path, backend, results, back, world.lap(lap + 60, 0.07)


def test_without_depth_a_submap_is_merged_with_its_unit_of_length():
    path, backend, results, merged, poses = monocular_lap()
    assert [r.maps for r in results[100:merged]] == [2] * (merged - 100) and results[-1].maps == 1
    (loop,) = backend.loops.closed
    assert loop.merges and loop.fits and loop.frame < 20 and abs(np.log(loop.scale)) > 0.05
    final = backend.finalize()
    assert len(path) - len(final) <= 20 + 17, "frames of the submap are in the final trajectory"
    true = poses[[path[round(stamp * 30)] for stamp in final.timestamps]]
    aligned = align(final.T_world_cam, true, "sim3").apply(final.T_world_cam)
    assert np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.2
    estimated, real = (np.linalg.norm(np.diff(t[:, :3, 3], axis=0), axis=1) for t in (aligned, true))
    before, after = (np.median((estimated / real)[final.timestamps[1:] * 30 > at][:50]) for at in (0, 80))
    assert after == pytest.approx(before, rel=0.1), "lengths in the submap are those of the root map"


def test_without_depth_a_submap_that_would_not_fit_is_left_for_the_root_map(monkeypatch):
    monkeypatch.setattr(Atlas, "admits_start", lambda *_: False)  # as where its lengths have drifted apart
    _, backend, results, back, _ = monocular_lap()
    assert not backend.loops.closed and results[-1].maps == 2
    assert len(backend.finalize()) == states(results).count("ok"), "no frame of the submap"
    assert all(np.linalg.norm(r.T_world_cam[:3, 3]) < 10.0 for r in results[back:])


def test_maps_that_never_meet_stay_apart_and_filters_see_the_active_one():
    backend, results, _ = drive(RingWorld(), APART, STEP, **CLOSING)
    assert set(states(results)[25:]) == {"lost"} and len(backend.finalize()) == 25 and results[-1].maps == 2
    outputs, world = backend.outputs(), backend.world
    assert {record.map for record in outputs.keyframes} == {0, 1}
    assert 0 < len(outputs.positions) < world.point_count, "where those of the submap lie is unknown"
    views, ids, _ = backend.view()
    assert views and all(view.timestamp > 2.4 for view in views), "keyframes of the root map are older"
    assert set(ids.tolist()) == set(world.id[world.points_of(world.submap(1))].tolist())
    assert 0 < len(ids) < world.point_count and backend.predict(8.0)[0] is not None
    without, results, _ = drive(RingWorld(), APART, STEP)
    assert set(states(results)[25:]) == {"lost"} and {record.map for record in without.outputs().keyframes} == {0}


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
    expected = {(0, 0): 0.0, (2, 2): 0.0, (1, 0): 0.3, (0, 1): 0.3, (2, 0): 0.7, (2, 1): 1.0, (3, 0): np.pi}
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
    np.testing.assert_allclose(first.anchor, se3.transform(se3.inverse(after[1]), np.array([1.0, 0.0, 0.0])))
    assert first.bound_m == pytest.approx(2.0) and atlas.slack(1, 0) == pytest.approx(0.4)
    assert np.array_equal(first.start, [5.5, 0.0, 0.0]), "its own world has not changed"
    atlas.move_nearby(2, before, after, np.array([1.0, 1.0]))
    assert np.array_equal(atlas.submaps[1].start, first.start)
    assert np.allclose(atlas.submaps[2].anchor, second.anchor)
    assert not np.allclose(atlas.submaps[2].start, second.start)


def test_the_motion_continues_in_the_camera_frame_where_a_loop_transforms_the_world():
    transform = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 2.0, 0.3]))
    state = MotionState.at(se3.inverse(se3.exp(np.array([1.0, 2.0, 3.0, 0.2, 0.1, 0.4]))), 1e-4 * np.eye(6))
    state.speed[:] = [0.3, 0.1, 0.9, 0.02, 0.3, 0.1]
    state.covariance[6:9, 6:9] = np.diag([0.1, 0.2, 0.3])
    moved = state.transformed(transform[:3, :3], 2.0)
    assert np.allclose(moved.rotation @ moved.speed[:3], 2.0 * state.rotation @ state.speed[:3])
    assert np.allclose(moved.position, 2.0 * transform[:3, :3] @ state.position)
    assert np.array_equal(moved.speed[3:], state.speed[3:])
    assert np.allclose(np.linalg.eigvalsh(moved.covariance[6:9, 6:9]), 4.0 * np.array([0.1, 0.2, 0.3]))
    steps = [s.T_cam_world @ se3.inverse(s.predicted(0.1, MotionModelSettings()).T_cam_world) for s in (moved, state)]
    assert np.allclose(steps[0][:3, :3], steps[1][:3, :3]) and np.allclose(steps[0][:3, 3], 2.0 * steps[1][:3, 3])
