"""Whether a place is there: what a small patch of it tells, and what people hide of it."""

from dataclasses import replace

import numpy as np
import pytest
from point_world import PointWorld, track_all

from dynslam_bench.geometry import se3
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.observation import observe
from dynslam_bench.slam.place_recognition import PlaceMatch, match_keyframe, pose_uncertainty, verify_place
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.slam.tracking import solve

FIRST = np.eye(4)


def mapped():
    """A room, and the map of its first view."""
    room, backend = PointWorld(), RgbdBackend()
    backend.reset(room.camera, 0)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0)])
    return room, backend


def seen_in(backend, frame, keep):
    """The features of a frame that are kept, as the back end uses them."""
    return observe(
        frame, keep, np.ones(len(frame), np.float32), backend.camera, 1.2 ** np.arange(8.0), TrackingSettings()
    )


def recognised(backend, seen, patch, T_cam_world):
    """The place, begun from matches with features in a part of the image and from a pose."""
    every = match_keyframe(backend.world, 0, seen, 60)
    few = every.select(patch(seen.xy[every.feature]))
    assert 8 <= len(few) < len(every) / 4
    return verify_place(backend.world, 0, seen, few, T_cam_world, TrackingSettings())


def test_a_pose_grows_from_the_patch_that_tells_it():
    room, backend = mapped()
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    frame = room.see(pose, 1, noise_px=1.5)
    seen = seen_in(backend, frame, np.ones(len(frame), bool))
    place = recognised(backend, seen, lambda xy: np.abs(xy - 120).max(axis=1) < 70, se3.inverse(pose))
    assert place.share > 0.7 and len(place.matches) > 150
    assert np.linalg.norm(se3.inverse(place.T_cam_world)[:3, 3] - pose[:3, 3]) < 0.03


def test_what_people_hide_is_not_expected_to_be_seen():
    room, backend = mapped()
    frame = room.see(FIRST, 1)
    mask = np.zeros((480, 640), bool)
    mask[:, 220:] = True
    outside = frame.xy[:, 0] < 219
    patch = lambda xy: (xy[:, 0] < 120) & (xy[:, 1] < 160)  # noqa: E731
    without = recognised(backend, seen_in(backend, frame, outside), patch, FIRST)
    behind = recognised(backend, seen_in(backend, replace(frame, mask=mask), outside), patch, FIRST)
    assert without.share < 0.4 < 0.8 < behind.share and len(behind.matches) == len(without.matches)


@pytest.mark.parametrize(
    ("half", "beside", "tells"), [(60, 0, False), (60, 4, False), (60, 24, True), (90, 0, False), (250, 0, True)]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_patch_does_not_tell_from_where_it_is_seen_nor_do_a_few_matches_beside_it(half, beside, tells, seed):
    """Eighty matches each, from a square of twice `half` in an image of 640 x 480, and `beside` of them around it."""
    room, backend = PointWorld(count=30_000), RgbdBackend()
    backend.reset(room.camera, 0)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0, limit=4000)])
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    frame = room.see(pose, 1, noise_px=1.0, limit=4000)
    seen = seen_in(backend, frame, np.ones(len(frame), bool))
    every, rng = match_keyframe(backend.world, 0, seen, 60), np.random.default_rng(seed)
    off = np.abs(seen.xy[every.feature] - [260, 200]).max(axis=1)
    patch, around = rng.permutation(np.flatnonzero(off < half)), rng.permutation(np.flatnonzero(off > 150))
    few = every.select(np.sort(np.concatenate([patch[: 80 - beside], around[:beside]])))
    found = solve(backend.world, seen, few, se3.inverse(pose))
    place = PlaceMatch(found.T_cam_world, few.select(found.inliers), 0.5)
    assert len(place.matches) > 60
    assert (pose_uncertainty(backend.world, seen, place, np.random.default_rng(0)) <= 1) == tells


@pytest.mark.parametrize("count", [0, 4, 6, 11])
def test_a_few_matches_tell_nothing(count):
    room, backend = mapped()
    frame = room.see(FIRST, 1)
    seen = seen_in(backend, frame, np.ones(len(frame), bool))
    few = match_keyframe(backend.world, 0, seen, 60).select(np.arange(count))
    assert pose_uncertainty(backend.world, seen, PlaceMatch(FIRST, few, 1.0), np.random.default_rng(0)) == np.inf
