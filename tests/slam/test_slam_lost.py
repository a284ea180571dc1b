"""After the camera was lost: what is recognised, what only looks like it, and maps of their own that meet again."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from ring_world import RingWorld

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.geometry import se3
from dynslam_bench.slam import loop_closing
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.backend import MonocularBackend, RgbdBackend
from dynslam_bench.slam.motion_model import MotionState
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.place_recognition import PlaceHypothesis, ambiguous
from dynslam_bench.slam.relocalisation import RelocalisationGate
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings, MotionModelSettings

STEP = 0.15
QUARTER = round((4.0 + np.pi / 2) / STEP)
"""Frames from a place to the one that looks the same, a corridor further on."""


def drive(world, way, **settings):
    """States, and errors in metres (infinite: no pose), along frames of a lap, ten a second; None is a blind frame."""
    backend = RgbdBackend(apply_overrides(BackendSettings(), settings))
    backend.reset(world.camera, 0)
    lap = world.lap(max(index for index in way if index is not None) + 1, STEP)
    states, errors = [], []
    for number, index in enumerate(way):
        stamp = number / 10.0
        frame = world.blind(number, stamp=stamp) if index is None else world.see(lap[index], number, stamp=stamp)
        found = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        states.append(found.state)
        true = None if index is None else (se3.inverse(lap[way[0]]) @ lap[index])[:3, 3]
        errors.append(np.inf if true is None else np.linalg.norm(found.T_world_cam[:3, 3] - true))
    return backend, np.array(states), np.array(errors)


def test_what_looks_like_a_place_is_not_it_if_nobody_gets_there_in_the_time():
    way = [*range(30), None, None, *range(6)]
    _, states, _ = drive(RingWorld(), way)
    assert (states[:30] == "ok").all() and (states[30:] == "lost").all(), "4 m in less than a second"
    _, states, _ = drive(RingWorld(), way, **{"relocalisation.max_speed": 100.0})
    assert (states[32:] == "ok").all(), "what else would be believed"


def test_a_place_that_has_something_in_common_is_not_taken_for_another():
    way = [*range(15), None, None, *range(QUARTER, QUARTER + 5)]
    world, fast = RingWorld(alike=0.2), {"relocalisation.max_speed": 100.0}
    _, states, _ = drive(world, way, **fast)
    assert (states[15:] == "lost").all()
    _, states, errors = drive(world, way, **fast, **{"relocalisation.min_share": 0.0})
    assert (errors[17:][states[17:] == "ok"] > 3.0).any(), "what else would be believed"


def test_a_known_place_is_recognised_at_once_wherever_it_is():
    way = [*range(50), *range(10, 18)]
    _, states, errors = drive(RingWorld(), way)
    assert (states[52:] == "ok").all() and errors[52:].max() < 0.1, "put there from one frame to the next"


def test_a_map_of_its_own_is_joined_when_the_camera_comes_round():
    world, lap = RingWorld(), 4 * QUARTER
    way = [*range(25), *[None] * 20, *range(60, lap + 20)]
    backend, states, errors = drive(world, way, **{"loop_closing.enabled": True})
    joined = int(np.flatnonzero(states[45:] == "ok")[0]) + 45
    assert joined > 100 and (states[25:joined] == "lost").all() and (states[joined:] == "ok").all()
    assert errors[joined:].max() < 0.2
    final = backend.finalize()
    missing = len(way) - len(final)
    assert 20 <= missing <= 20 + 11, "what was driven on the submap is in the final trajectory"
    lap_poses = world.lap(lap + 20, STEP)
    index = [way[round(stamp * 10)] for stamp in final.timestamps]
    true = se3.transform(se3.inverse(lap_poses[0]), lap_poses[index][:, :3, 3])
    assert np.linalg.norm(final.positions - true, axis=1).max() < 0.3


@pytest.mark.parametrize("patient", [False, True])
def test_an_island_that_is_not_joined_is_left_where_the_camera_is_in_the_first_map(monkeypatch, patient):
    """What is seen never suffices to join them here; the camera's own pose is known from the first frame on."""
    if patient:
        monkeypatch.setattr(loop_closing, "PATIENCE", 10**6)
    world, lap = RingWorld(), 4 * QUARTER
    way = [*range(25), *[None] * 20, *range(60, lap + 20)]
    closing = {"loop_closing.enabled": True, "loop_closing.merge_share": 1.0}
    backend, states, errors = drive(world, way, **closing)
    back = 45 + int(np.flatnonzero(states[45:] == "ok")[0])
    assert way[back] == pytest.approx(lap, abs=15) and (states[back:] == "ok").all() and errors[back:].max() < 0.2
    assert not backend.loops.closed and backend.world.map_count == 2
    assert backend.outputs().keyframes[-1].map == (1 if patient else 0)
    final = backend.finalize()
    assert len(final) == np.count_nonzero(states == "ok"), "nothing of the submap's, where it lies is unknown"
    poses = world.lap(lap + 20, STEP)[[way[round(stamp * 10)] for stamp in final.timestamps]]
    assert np.linalg.norm(final.positions - (poses[:, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, :3], axis=1).max() < 0.3


def drive_without_depth(world, way, step):
    """A monocular back end along frames of a lap, thirty a second, states, and how many loops there were by then."""
    backend = MonocularBackend(apply_overrides(MonocularBackendSettings(), {"loop_closing.enabled": True}))
    backend.reset(world.camera, 0)
    lap = world.lap(max(index for index in way if index is not None) + 1, step)
    found = []
    for number, index in enumerate(way):
        stamp = number / 30.0
        if index is None:
            frame = world.blind(number, stamp=stamp)
        else:
            frame = world.see(lap[index], number, stamp=stamp, noise_px=0.5, limit=700)
        frame = replace(frame, z=np.zeros_like(frame.z))
        found.append(backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32)))
    return backend, lap, found


def lap_with_a_gap(world, step):
    """Sixty frames, twenty blind ones, and from twenty frames further on the rest of a lap and sixty frames more."""
    lap = int(np.ceil((4 * (world.side - 2) + 2 * np.pi) / step))
    return [*range(60), *[None] * 20, *range(100, lap + 60)], lap


def test_without_depth_a_map_of_its_own_is_joined_with_its_unit_of_length():
    world, step = RingWorld(side=6.0, seed=3), 0.07
    way, lap = lap_with_a_gap(world, step)
    backend, poses, found = drive_without_depth(world, way, step)
    states = np.array([each.state for each in found])
    joined = 80 + int(np.flatnonzero(states[80:] == "ok")[0])
    assert way[joined] == pytest.approx(lap, abs=15) and (states[joined:] == "ok").all()
    assert [each.maps for each in found[100:joined]] == [2] * (joined - 100) and found[-1].maps == 1
    (loop,) = backend.loops.closed
    assert loop.joins and loop.fits and loop.frame < 20 and abs(np.log(loop.scale)) > 0.05
    final = backend.finalize()
    assert len(way) - len(final) <= 20 + 17, "what was driven on the submap is in the final trajectory"
    true = poses[[way[round(stamp * 30)] for stamp in final.timestamps]]
    aligned = align(final.T_world_cam, true, "sim3").apply(final.T_world_cam)
    assert np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.2
    went, was = (np.linalg.norm(np.diff(each[:, :3, 3], axis=0), axis=1) for each in (aligned, true))
    path = went / was
    before, after = (np.median(path[final.timestamps[1:] * 30 > at][:50]) for at in (0, 80))
    assert after == pytest.approx(before, rel=0.1), "lengths on the submap are those of the first map"


def test_without_depth_an_island_that_would_not_fit_is_left_for_the_first_map(monkeypatch):
    monkeypatch.setattr(Atlas, "admits_start", lambda *_: False)  # as where its lengths have drifted apart
    world, step = RingWorld(side=6.0, seed=3), 0.07
    way, lap = lap_with_a_gap(world, step)
    backend, _, found = drive_without_depth(world, way, step)
    states = np.array([each.state for each in found])
    back = 80 + int(np.flatnonzero(states[80:] == "ok")[0])
    assert way[back] == pytest.approx(lap, abs=20) and (states[back:] == "ok").all()
    assert not backend.loops.closed and found[-1].maps == 2
    assert len(backend.finalize()) == np.count_nonzero(states == "ok"), "nothing of the submap's"
    assert all(each.T_world_cam[:3, 3] @ each.T_world_cam[:3, 3] < 10.0**2 for each in found[back:])


def test_maps_that_never_meet_stay_apart():
    way = [*range(25), *[None] * 20, *range(60, 90)]
    backend, states, _ = drive(RingWorld(), way, **{"loop_closing.enabled": True})
    assert (states[25:] == "lost").all() and len(backend.finalize()) == 25
    outputs = backend.outputs()
    assert {record.map for record in outputs.keyframes} == {0, 1}
    assert 0 < len(outputs.positions) < backend.world.point_count, "where those of the submap lie is unknown"
    last = RingWorld().blind(99, stamp=99.0)
    assert backend.track(last, np.ones(0, bool), np.ones(0, np.float32)).maps == 2
    without, states, _ = drive(RingWorld(), way)
    assert (states[25:] == "lost").all() and {record.map for record in without.outputs().keyframes} == {0}


def test_filters_see_the_map_that_the_camera_is_in_alone():
    """A prediction on an submap, of keyframes of the first map, would be of places that have nothing to do with it."""
    way = [*range(25), *[None] * 20, *range(60, 90)]
    backend, _, _ = drive(RingWorld(), way, **{"loop_closing.enabled": True})
    ids, _ = backend.map_points()
    views = backend.keyframe_views(100)
    assert views and all(view.timestamp > 2.4 for view in views), "those of the first map were made before"
    world = backend.world
    held = world.kf_point[world.submap(1)]
    assert set(ids.tolist()) == set(world.id[np.unique(held[held >= 0])].tolist())
    assert 0 < len(ids) < world.point_count and backend.predict(8.0) is not None


def test_a_lost_camera_predicts_nothing():
    """Filters would judge what it sees by a pose that is known to be wrong, and hide the place from recognition."""
    backend, states, _ = drive(RingWorld(), [*range(25), None])
    assert states[-1] == "lost" and backend.predict(2.6) is None and backend.motion_covariance(2.6) is None
    assert drive(RingWorld(), [*range(25)])[0].predict(2.5) is not None


def test_an_island_lies_where_the_camera_can_have_got():
    submaps, moved = Atlas(), np.eye(4)
    first = submaps.begin(0, np.array([1.0, 0.0, 0.0]), 2.0)
    second = submaps.begin(first, np.array([1.0, 3.0, 0.0]), 1.0)
    for number, reach in ((first, 2.0), (second, 2.0 + 3.0 + 1.0)):
        start = np.array([1.0, 0.0 if number == first else 3.0, 0.0])
        for way in (reach - 0.01, reach + 0.01):
            moved[:3, 3] = np.array([1.0, 0.0, way]) - start
            assert submaps.admits_start(number, partial(se3.transform, moved)) == (way < reach)
    here = np.zeros(3)
    assert submaps.within(0, 0, here, np.array([0.0, 0.0, 1.9]), 2.0)
    assert not submaps.within(0, 0, here, np.array([0.0, 0.0, 2.1]), 2.0)
    assert not submaps.within(0, first, here, here, 2.0), "nothing is known of the way to another submap"
    assert submaps.within(first, 0, np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 3.4]), 0.5)
    assert not submaps.within(first, 0, np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 3.6]), 0.5)


def test_the_camera_moves_on_as_it_felt_it_where_a_loop_turns_the_world():
    """Forward stays forward, at a speed in the new unit of length; so does what is not known of it."""
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 2.0, 0.3]))
    state = MotionState.at(se3.inverse(se3.exp(np.array([1.0, 2.0, 3.0, 0.2, 0.1, 0.4]))), 1e-4 * np.eye(6))
    state.speed[:] = [0.3, 0.1, 0.9, 0.02, 0.3, 0.1]
    state.covariance[6:9, 6:9] = np.diag([0.1, 0.2, 0.3])
    carried = state.carried(turn[:3, :3], 2.0)
    assert np.allclose(carried.rotation @ carried.speed[:3], 2.0 * state.rotation @ state.speed[:3])
    assert np.allclose(carried.position, 2.0 * turn[:3, :3] @ state.position)
    assert np.array_equal(carried.speed[3:], state.speed[3:])
    assert np.allclose(np.linalg.eigvalsh(carried.covariance[6:9, 6:9]), 4.0 * np.array([0.1, 0.2, 0.3]))
    settings = MotionModelSettings()
    there, here = carried.predicted(0.1, settings).T_cam_world, state.predicted(0.1, settings).T_cam_world
    steps = [b @ se3.inverse(a) for a, b in ((carried.T_cam_world, there), (state.T_cam_world, here))]
    assert np.allclose(steps[0][:3, :3], steps[1][:3, :3]) and np.allclose(steps[0][:3, 3], 2.0 * steps[1][:3, 3])


@pytest.mark.parametrize(("alike", "found"), [(0.0, True), (0.2, True), (0.5, False), (0.9, False)])
@pytest.mark.parametrize("more", [0, 10])
def test_what_looks_like_two_places_tells_nothing_after_a_long_loss(alike, found, more):
    """Blind for three seconds, in which both can be reached; with 10 frames more the last one saw the look-alike."""
    way = [*range(2 * QUARTER + more), *[None] * 30, *range(10, 18)]
    _, states, errors = drive(RingWorld(alike=alike), way)
    assert (states[-8:] == ("ok" if found else "lost")).all()
    assert not found or errors[-8:].max() < 0.1


@pytest.mark.parametrize(("alike", "twice"), [(0.0, False), (0.2, False), (0.6, True), (1.0, True)])
def test_a_frame_is_ambiguous_where_its_features_are_found_in_two_places(alike, twice):
    world, settings = RingWorld(alike=alike), BackendSettings()
    backend, states, _ = drive(world, [*range(2 * QUARTER)])
    assert (states == "ok").all()
    lap = world.lap(2 * QUARTER, STEP)
    frame = world.see(lap[10], 999)
    seen = observe(frame, np.ones(len(frame), bool), np.ones(len(frame)), world.camera, np.ones(8), settings.tracking)
    here = PlaceHypothesis(se3.inverse(lap[10]) @ lap[0], 1.0, 3.0)
    everywhere = backend.world.keyframes
    assert ambiguous(backend.world, seen, {0: here}, everywhere, settings, 0) is twice
    assert not ambiguous(backend.world, seen, {0: here}, everywhere[:4], settings, 0), "nothing else is looked at"
    near = lambda submap, T_cam_world: not here.contradicts(PlaceHypothesis(T_cam_world, 1.0, 3.0))  # noqa: E731
    assert not ambiguous(backend.world, seen, {0: here}, everywhere, settings, 0, near), "it cannot have got there"


def test_every_frame_of_a_lost_camera_is_followed(monkeypatch):
    """Also where nothing at all is recognised: how far it has turned is known only from image to image."""
    asked, since = [], RelocalisationGate.since
    monkeypatch.setattr(RelocalisationGate, "since", lambda self, *known: (asked.append(known), since(self, *known))[1])
    _, states, _ = drive(RingWorld(), [*range(15), *range(60, 70)])
    assert (states[15:] == "lost").all() and len(asked) == 9, "of the tenth, the first, tracking knows itself"


@pytest.mark.parametrize(("alike", "found"), [(0.0, True), (0.5, False), (1.0, False)])
def test_from_one_frame_to_the_next_two_places_that_look_alike_tell_nothing_either(alike, found):
    """The camera is put back to where it was, and the corridor after that one looks the same."""
    way = [*range(2 * QUARTER), *range(10, 18)]
    _, states, errors = drive(RingWorld(alike=alike), way)
    assert states[2 * QUARTER] == "lost", "nobody gets there in a tenth of a second"
    assert (states[-7:] == ("ok" if found else "lost")).all()
    assert not found or errors[-7:].max() < 0.1


def test_what_is_known_of_an_island_is_carried_along_when_its_surroundings_are():
    """The camera was lost near the second of two keyframes, which a loop moves, turns and rescales."""
    submaps, before = Atlas(), np.tile(np.eye(4), (2, 1, 1))
    before[1, :3, 3] = [-5.0, 0.0, 0.0]  # a centre at x = 5
    first = submaps.begin(0, np.array([5.5, 0.0, 0.0]), 1.0, slack=0.1)
    second = submaps.begin(first, np.array([5.5, 0.0, 0.2]), 1.0, slack=0.1)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    after = before.copy()
    after[1] = turn @ before[1]
    after[1, :3, 3] += [0.0, 0.0, 3.0]
    submaps.carried(0, before, after, np.array([1.0, 2.0]))
    expected = se3.transform(se3.inverse(after[1]), np.array([1.0, 0.0, 0.0]))
    known = submaps.all()
    assert np.allclose(known[0].anchor, expected) and known[0].reach_m == pytest.approx(2.0)
    assert np.array_equal(known[0].start, [5.5, 0.0, 0.0]), "its own world is what it was"
    assert submaps.slack(first, 0) == pytest.approx(0.4)
    submaps.carried(second, before, after, np.array([1.0, 1.0]))
    assert np.array_equal(submaps.all()[0].start, known[0].start), "a loop of another submap moves nothing of it"
    assert np.allclose(submaps.all()[1].anchor, known[1].anchor) and not np.allclose(
        submaps.all()[1].start, known[1].start
    )
