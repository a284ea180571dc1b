"""How far a lost camera has turned, by images alone, and what that rules out."""

import numpy as np
import pytest
from point_world import PointWorld
from ring_world import turned

from dynslam_bench.geometry import se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.relocalisation import RelocalisationGate, RotationEstimate
from dynslam_bench.slam.settings import RelocalisationSettings, TrackingSettings
from dynslam_bench.slam.tracking import TrackedFrame

ROOM = PointWorld()


def seen(pose, index):
    frame = ROOM.see(pose, index)
    keep, weight = np.ones(len(frame), bool), np.ones(len(frame), np.float32)
    return observe(frame, keep, weight, ROOM.camera, np.ones(1), TrackingSettings())


def pose(degrees, at=(0.0, 0.0, 0.0)):
    """Camera-to-world pose, turned about the vertical."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3], T_world_cam[:3, 3] = turned(degrees / 90), at
    return T_world_cam


@pytest.mark.parametrize(("step", "sideways", "off"), [(3.0, 0.0, 1.0), (-3.0, 0.0, 1.0), (2.0, 0.03, 15.0)])
def test_the_turn_is_followed_over_many_images(step, sideways, off):
    way = [pose(step * k, (sideways * k, 0.0, 0.0)) for k in range(16)]
    turn = RotationEstimate(seen(way[0], 0), np.eye(3))
    for index, each in enumerate(way[1:], 1):
        turn = turn.on(seen(each, index), ROOM.camera, 64)
    true = se3.inverse(way[-1]) @ way[0]
    error = np.degrees(
        se3.rotation_angle(np.block([[turn.R_now_last @ true[:3, :3].T, np.zeros((3, 1))], [0, 0, 0, 1]]))
    )
    assert error < off and np.degrees(turn.slack) == pytest.approx(20 + 0.75 * np.degrees(turn.apparent))
    assert np.degrees(turn.apparent) >= 15 * abs(step) - 1
    last, now = se3.inverse(way[0]), se3.inverse(way[-1])
    assert turn.allows(last, now)
    for quarters in (1, 2, 3):
        beside = now @ se3.inverse(pose(90 * quarters))
        assert not turn.allows(last, beside), "the next corner, which looks the same"
        assert turn.allows(last, beside, more=np.pi)
    np.testing.assert_allclose(se3.inverse(turn.after(last))[:3, 3], way[0][:3, 3], atol=1e-12)


@pytest.mark.parametrize("features", [0, 15, 400])
def test_images_that_show_nothing_common_are_not_connected(features):
    turn = RotationEstimate(seen(pose(0.0), 0), np.eye(3))
    other = ROOM.see(pose(180.0), 1, limit=features)
    keep, weight = np.ones(len(other), bool), np.ones(len(other), np.float32)
    assert turn.on(observe(other, keep, weight, ROOM.camera, np.ones(1), TrackingSettings()), ROOM.camera, 64) is None


@pytest.mark.parametrize(("degrees", "elsewhere"), [(5.0, False), (180.0, True)])
def test_a_camera_that_still_sees_what_it_saw_was_not_put_elsewhere(degrees, elsewhere):
    """It showed a hundred map points and shows none now: carried off, or only turned to what nobody has mapped."""
    settings = RelocalisationSettings()
    first = seen(pose(0.0), 0)
    last = TrackedFrame(first, np.arange(len(first)), np.eye(4), 0.0)
    reach = RelocalisationGate(ROOM.camera)
    reach.lost(last, seen(pose(degrees), 1), settings, shows=True)
    assert np.isinf(reach.metres(last, 0.1, settings)) is np.bool_(elsewhere)
    assert (reach.turn is None) is elsewhere
    lost = reach.since(last, seen(pose(2 * degrees), 2), 0.2, 0, settings)
    there, beside = se3.inverse(pose(2 * degrees)), se3.inverse(pose(2 * degrees + 90.0))
    assert lost.admits(Atlas(), last.T_cam_world, 0, there)
    assert lost.admits(Atlas(), last.T_cam_world, 0, beside) is elsewhere


def test_worlds_of_islands_are_turned_as_far_as_the_images_left_open():
    submaps, here = Atlas(), np.zeros(3)
    first = submaps.begin(0, here, 1.0, 0.3)
    second = submaps.begin(first, here, 1.0, 0.4)
    unseen = submaps.begin(0, here, 1.0)
    assert submaps.slack(0, 0) == submaps.slack(second, second) == 0.0
    assert submaps.slack(first, 0) == submaps.slack(0, first) == pytest.approx(0.3)
    assert submaps.slack(second, 0) == pytest.approx(0.7), "it was begun from the first one"
    assert submaps.slack(second, first) == pytest.approx(1.0)
    assert submaps.slack(unseen, 0) == pytest.approx(np.pi)
