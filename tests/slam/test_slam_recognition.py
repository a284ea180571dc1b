"""Place recognition: the RANSAC pose, whether the place is verified, and how well matches determine the pose."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from point_world import PointWorld, make_backend, observed, track_all
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.place_recognition import (
    PlaceMatch,
    match_keyframe,
    pose_uncertainty,
    ransac_pose,
    verify_place,
)
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.slam.tracking import solve

FIRST = np.eye(4)


def mapped():
    """A room, and the map of its first view."""
    room = PointWorld()
    backend = make_backend(room)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0)])
    return room, backend


def verified(backend, observations, patch, T_cam_world):
    """The verified place, from matches in a part of the image and from a pose."""
    every = match_keyframe(backend.world, 0, observations)
    few = every.select(patch(observations.xy[every.feature]))
    assert 8 <= len(few) < len(every) / 4
    return verify_place(backend.world, 0, observations, few, T_cam_world, TrackingSettings())


def test_a_pose_grows_from_a_patch():
    room, backend = mapped()
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    frame = room.see(pose, 1, noise_px=1.5)
    observations = observed(frame, room.camera)
    place = verified(backend, observations, lambda xy: np.abs(xy - 120).max(axis=1) < 70, se3.inverse(pose))
    assert place.share > 0.7 and len(place.matches) > 150
    assert np.linalg.norm(se3.inverse(place.T_cam_world)[:3, 3] - pose[:3, 3]) < 0.03


def test_what_people_hide_is_not_expected_to_be_seen():
    room, backend = mapped()
    frame = room.see(FIRST, 1)
    mask = np.zeros((480, 640), bool)
    mask[:, 220:] = True
    outside = frame.xy[:, 0] < 219
    patch = lambda xy: (xy[:, 0] < 120) & (xy[:, 1] < 160)  # noqa: E731
    without = verified(backend, observed(frame, room.camera, keep=outside), patch, FIRST)
    behind = verified(backend, observed(replace(frame, mask=mask), room.camera, keep=outside), patch, FIRST)
    assert without.share < 0.4 < 0.8 < behind.share and len(behind.matches) == len(without.matches)


@pytest.mark.parametrize(
    ("half", "beside", "precise"), [(60, 0, False), (60, 4, False), (60, 24, True), (90, 0, False), (250, 0, True)]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_one_patch_does_not_determine_the_pose_nor_do_a_few_matches_beside_it(half, beside, precise, seed):
    """Eighty matches each, from a square of twice `half` in an image of 640 x 480, and `beside` of them around it."""
    room = PointWorld(count=30_000)
    backend = make_backend(room)
    track_all(backend, [room.see(FIRST, 0, depthless=0.0, limit=4000)])
    pose = se3.exp(np.array([0.1, 0.05, 0.0, 0.0, 0.02, 0.01]))
    frame = room.see(pose, 1, noise_px=1.0, limit=4000)
    observations = observed(frame, room.camera)
    every, rng = match_keyframe(backend.world, 0, observations), np.random.default_rng(seed)
    off = np.abs(observations.xy[every.feature] - [260, 200]).max(axis=1)
    patch, beside_it = rng.permutation(np.flatnonzero(off < half)), rng.permutation(np.flatnonzero(off > 150))
    few = every.select(np.sort(np.concatenate([patch[: 80 - beside], beside_it[:beside]])))
    fitted = solve(room.camera, observations, few, se3.inverse(pose))
    place = PlaceMatch(fitted.T_cam_world, few.select(fitted.inliers), 0.5)
    assert len(place.matches) > 60
    assert (pose_uncertainty(backend.world, observations, place, np.random.default_rng(0)) <= 1) == precise


@pytest.mark.parametrize("count", [0, 4, 6, 11])
def test_a_few_matches_determine_no_pose(count):
    room, backend = mapped()
    frame = room.see(FIRST, 1)
    observations = observed(frame, room.camera)
    few = match_keyframe(backend.world, 0, observations).select(np.arange(count))
    assert (
        pose_uncertainty(backend.world, observations, PlaceMatch(FIRST, few, 1.0), np.random.default_rng(0)) == np.inf
    )


CAMERA = Camera(640, 480, 535.0, 539.0, 320.0, 247.0)


def true_and_false_matches(seed, count, right):
    """World points, noisy pixels of which the first `right` are right, and the world-to-camera pose."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, 1, 3)
    xy = rng.uniform([0, 0], [640, 480], (count, 2))
    world = (CAMERA.unproject(xy, rng.uniform(1, 5, count)) - pose[:3, 3]) @ pose[:3, :3]
    world[right:] = world[right:][rng.permutation(count - right)]
    return world, xy + rng.normal(0, 0.5, xy.shape), pose


@pytest.mark.parametrize("seed", range(10))
def test_half_of_the_matches_may_be_wrong(seed):
    world, xy, pose = true_and_false_matches(seed, 80, 40)
    estimate, inliers = ransac_pose(world, xy, np.ones(80), CAMERA, np.random.default_rng(seed))
    _, rotation, translation, theirs = cv2.solvePnPRansac(
        world, xy, CAMERA.matrix, None, iterationsCount=150, reprojectionError=np.sqrt(2 * 5.991), confidence=0.999
    )
    assert inliers[:40].sum() >= 30 and inliers[40:].sum() <= 3
    assert inliers.sum() >= len(theirs) - 8, "before any refinement, which theirs has"
    assert np.linalg.norm(estimate[:3, 3] - pose[:3, 3]) < 0.15
    assert np.linalg.norm(estimate[:3, 3] - translation.ravel()) < 0.15
    assert np.linalg.norm(Rotation.from_matrix(estimate[:3, :3] @ cv2.Rodrigues(rotation)[0].T).as_rotvec()) < 0.05


def test_coarse_features_may_be_farther_off():
    world, xy, _ = true_and_false_matches(4, 60, 60)
    xy = xy + np.random.default_rng(0).normal(0, 3.0, xy.shape)
    strict, coarse = (
        ransac_pose(world, xy, np.full(60, info), CAMERA, np.random.default_rng(0))[1] for info in (1.0, 0.1)
    )
    assert coarse.sum() > 50 > strict.sum()


def test_too_few_or_degenerate_points_give_no_pose():
    for count in (0, 3):
        world, xy, _ = true_and_false_matches(0, count, count)
        assert ransac_pose(world, xy, np.ones(count), CAMERA, np.random.default_rng(0)) is None
    same = np.tile([[0.3, -0.2, 2.0]], (30, 1))
    line = np.linspace([-1.0, 0.0, 3.0], [1.0, 0.0, 3.0], 30)
    for world in (same, line):
        xy = np.random.default_rng(0).uniform([0, 0], [640, 480], (30, 2))
        estimate = ransac_pose(world, xy, np.ones(30), CAMERA, np.random.default_rng(0))
        assert estimate is None or estimate[1].sum() < 15
