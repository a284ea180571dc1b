"""After the camera was lost: what is recognised, what only looks like it, and what the relocalisation gate admits."""

import numpy as np
import pytest
from point_world import PointWorld, observed, states
from ring_world import RingWorld, drive, position_errors, rotated

from dynslam_bench.geometry import se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.place_recognition import PlaceHypothesis, is_aliased
from dynslam_bench.slam.relocalisation import RelocalisationGate, RotationEstimate
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.slam.tracking import TrackedFrame

STEP = 0.15
QUARTER = round((4.0 + np.pi / 2) / STEP)
"""Frames from a place to the one that looks the same, a corridor further on."""
FAST = {"relocalisation__max_speed": 100.0}
ROOM = PointWorld()


def run(world, path, **settings):
    backend, results, truth = drive(world, path, STEP, **settings)
    return backend, np.array(states(results)), position_errors(results, path, truth)


@pytest.mark.parametrize(
    ("alike", "path", "lost_from", "settings", "believing"),
    [
        (0.0, [*range(30), None, None, *range(6)], 30, {}, FAST),  # 4 m in less than a second
        (0.2, [*range(15), None, None, *range(QUARTER, QUARTER + 5)], 15, FAST,
         FAST | {"relocalisation__min_share": 0.0}),
    ],
)  # fmt: skip
def test_a_place_out_of_reach_or_only_similar_is_not_recognised(alike, path, lost_from, settings, believing):
    _, recognised, _ = run(RingWorld(alike=alike), path, **settings)
    assert (recognised[:lost_from] == "ok").all() and (recognised[lost_from:] == "lost").all()
    _, recognised, _ = run(RingWorld(alike=alike), path, **believing)
    assert (recognised[lost_from + 2 :] == "ok").any(), "without the rule it would be recognised"


def test_a_kidnapped_camera_is_relocalised_at_once_in_a_known_place():
    _, recognised, errors = run(RingWorld(), [*range(50), *range(10, 18)])
    assert (recognised[52:] == "ok").all() and errors[52:].max() < 0.1


@pytest.mark.parametrize(
    ("alike", "blind", "more", "recognised"),
    [
        *((alike, 30, more, alike < 0.5) for alike in (0.0, 0.2, 0.5, 0.9) for more in (0, 10)),
        *((alike, 0, 0, alike < 0.5) for alike in (0.0, 0.5, 1.0)),
    ],
)
def test_a_frame_of_two_places_tells_nothing(alike, blind, more, recognised):
    """Blind for three seconds, in which both can be reached, or kidnapped from one frame to the next."""
    path = [*range(2 * QUARTER + more), *[None] * blind, *range(10, 18)]
    _, tracking, errors = run(RingWorld(alike=alike), path)
    assert (tracking[-7:] == ("ok" if recognised else "lost")).all()
    assert not recognised or errors[-7:].max() < 0.1
    assert blind or tracking[2 * QUARTER] == "lost", "too far for a tenth of a second"


@pytest.mark.parametrize(("alike", "aliased"), [(0.0, False), (0.2, False), (0.6, True), (1.0, True)])
def test_perceptual_aliasing(alike, aliased):
    world, settings = RingWorld(alike=alike), TrackingSettings()
    backend, tracking, _ = run(world, [*range(2 * QUARTER)])
    lap = world.lap(2 * QUARTER, STEP)
    observations = observed(world.see(lap[10], 999), world.camera)
    here = PlaceHypothesis(se3.inverse(lap[10]) @ lap[0], 1.0, 3.0)
    everywhere = backend.world.keyframes
    assert (tracking == "ok").all()
    assert is_aliased(backend.world, observations, {0: here}, everywhere, settings, 0) is aliased
    assert not is_aliased(backend.world, observations, {0: here}, everywhere[:4], settings, 0)
    near = lambda submap, T_cam_world: not here.contradicts(PlaceHypothesis(T_cam_world, 1.0, 3.0))  # noqa: E731
    assert not is_aliased(backend.world, observations, {0: here}, everywhere, settings, 0, near)


def test_a_lost_camera_predicts_nothing_and_its_rotation_is_followed_in_every_frame(monkeypatch):
    calls, while_lost = [], RelocalisationGate.while_lost
    monkeypatch.setattr(
        RelocalisationGate, "while_lost", lambda self, *args: (calls.append(args), while_lost(self, *args))[1]
    )
    backend, recognised, _ = run(RingWorld(), [*range(15), *range(60, 70)])
    assert (recognised[15:] == "lost").all() and len(calls) == 9, "the first of the ten is compared by tracking"
    assert backend.predict(2.6) == (None, None)


# ---------------------------------------------------------------------- the gate


def seen_from(pose, index):
    return observed(ROOM.see(pose, index), ROOM.camera, levels=1)


def pose_at(degrees, at=(0.0, 0.0, 0.0)):
    """Camera-to-world pose, rotated about the vertical."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3], T_world_cam[:3, 3] = rotated(degrees / 90), at
    return T_world_cam


@pytest.mark.parametrize(("step", "sideways", "off"), [(3.0, 0.0, 1.0), (-3.0, 0.0, 1.0), (2.0, 0.03, 15.0)])
def test_the_rotation_is_followed_over_many_images(step, sideways, off):
    poses = [pose_at(step * k, (sideways * k, 0.0, 0.0)) for k in range(16)]
    estimate = RotationEstimate(seen_from(poses[0], 0), np.eye(3))
    for index, pose in enumerate(poses[1:], 1):
        estimate = estimate.advanced(seen_from(pose, index), ROOM.camera)
    last, now = se3.inverse(poses[0]), se3.inverse(poses[-1])
    assert np.degrees(se3.rotation_angle(now @ se3.inverse(estimate.applied(last)))) < off
    assert np.degrees(estimate.slack) == pytest.approx(20 + 0.75 * np.degrees(estimate.apparent))
    assert np.degrees(estimate.apparent) >= 15 * abs(step) - 1
    assert estimate.allows(last, now)
    for quarters in (1, 2, 3):  # the next corners, which look the same
        beside = now @ se3.inverse(pose_at(90 * quarters))
        assert not estimate.allows(last, beside) and estimate.allows(last, beside, more=np.pi)
    np.testing.assert_allclose(se3.inverse(estimate.applied(last))[:3, 3], poses[0][:3, 3], atol=1e-12)


@pytest.mark.parametrize("features", [0, 15, 400])
def test_images_that_show_nothing_common_are_not_connected(features):
    other = observed(ROOM.see(pose_at(180.0), 1, limit=features), ROOM.camera, levels=1)
    assert RotationEstimate(seen_from(pose_at(0.0), 0), np.eye(3)).advanced(other, ROOM.camera) is None


@pytest.mark.parametrize(("degrees", "kidnapped"), [(5.0, False), (180.0, True)])
def test_a_camera_that_still_sees_what_it_saw_is_not_kidnapped(degrees, kidnapped):
    """It showed a hundred map points and shows none now: kidnapped, or only rotated to an unmapped view."""
    first = seen_from(pose_at(0.0), 0)
    last = TrackedFrame(first, np.arange(len(first)), np.eye(4), 0.0)
    gate = RelocalisationGate(Atlas(Map(ROOM.camera, np.ones(1))), 2.0)
    gate.lose(last, seen_from(pose_at(degrees), 1), textured=True)
    assert np.isinf(gate.distance_m(last, 0.1)) == kidnapped and (gate.rotation is None) is kidnapped
    bound = gate.while_lost(last, seen_from(pose_at(2 * degrees), 2), 0.2)
    assert bound.admits(0, se3.inverse(pose_at(2 * degrees)))
    assert bound.admits(0, se3.inverse(pose_at(2 * degrees + 90.0))) is kidnapped
