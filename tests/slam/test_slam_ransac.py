"""Poses by RANSAC over three-point poses, beside the true one and OpenCV's."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.place_recognition import ransac_pose

CAMERA = Camera(640, 480, 535.0, 539.0, 320.0, 247.0)


def matches(seed, count, right):
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
    world, xy, pose = matches(seed, 80, 40)
    found, inliers = ransac_pose(world, xy, np.ones(80), CAMERA, 150, np.random.default_rng(seed))
    _, rotation, translation, theirs = cv2.solvePnPRansac(
        world, xy, CAMERA.matrix, None, iterationsCount=150, reprojectionError=np.sqrt(2 * 5.991), confidence=0.999
    )
    assert inliers[:40].sum() >= 30 and inliers[40:].sum() <= 3
    assert inliers.sum() >= len(theirs) - 8, "before any refinement, which theirs has"
    assert np.linalg.norm(found[:3, 3] - pose[:3, 3]) < 0.15
    assert np.linalg.norm(found[:3, 3] - translation.ravel()) < 0.15
    assert np.linalg.norm(Rotation.from_matrix(found[:3, :3] @ cv2.Rodrigues(rotation)[0].T).as_rotvec()) < 0.05


def test_the_same_draws_give_the_same_pose():
    world, xy, _ = matches(3, 60, 20)
    one, two = (ransac_pose(world, xy, np.ones(60), CAMERA, 150, np.random.default_rng(0)) for _ in range(2))
    assert (one[0] == two[0]).all() and (one[1] == two[1]).all()


def test_coarse_features_may_be_farther_off():
    world, xy, _ = matches(4, 60, 60)
    xy = xy + np.random.default_rng(0).normal(0, 3.0, xy.shape)
    strict, coarse = (
        ransac_pose(world, xy, np.full(60, info), CAMERA, 150, np.random.default_rng(0))[1] for info in (1.0, 0.1)
    )
    assert coarse.sum() > 50 > strict.sum()


@pytest.mark.parametrize("count", [0, 3])
def test_three_matches_prove_nothing(count):
    world, xy, _ = matches(0, count, count)
    assert ransac_pose(world, xy, np.ones(count), CAMERA, 150, np.random.default_rng(0)) is None


def test_points_that_fix_no_pose_give_none():
    same = np.tile([[0.3, -0.2, 2.0]], (30, 1))
    line = np.linspace([-1.0, 0.0, 3.0], [1.0, 0.0, 3.0], 30)
    for world in (same, line):
        xy = np.random.default_rng(0).uniform([0, 0], [640, 480], (30, 2))
        found = ransac_pose(world, xy, np.ones(30), CAMERA, 150, np.random.default_rng(0))
        assert found is None or found[1].sum() < 15
