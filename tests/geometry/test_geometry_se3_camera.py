"""SE(3) and camera: properties over random values, and agreement with scipy and OpenCV."""

import itertools

import cv2
import numpy as np
import pytest
import scipy.linalg

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.geometry.gauss_newton import apply_twist, twist_of

FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
BONN = Camera(640, 480, 542.822841, 542.57687, 315.59352, 237.756098, (0.039903, -0.099343, -0.00073, -0.000144, 0.0))
PINHOLE = Camera(640, 480, 535.4, 539.2, 320.1, 247.6)


def twists(angle, n=50, seed=0):
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(n, 3))
    phi *= angle / np.linalg.norm(phi, axis=1, keepdims=True)
    return np.concatenate([rng.normal(0, 2, (n, 3)), phi], axis=1)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9e-6, 1.1e-5, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-6])
def test_exp_and_log_are_inverse(angle):
    xi = twists(angle)
    poses = se3.exp(xi)
    assert all(se3.is_pose(pose, 1e-12) for pose in poses)
    assert np.allclose(se3.log(poses), xi, atol=1e-9 if angle < 3.1 else 1e-6)
    assert np.allclose(se3.rotation_angle(poses), angle, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 3.0])
def test_exp_is_the_matrix_exponential(angle):
    xi = twists(angle, 5)
    generators = se3.from_matrix(xi[:, :3], se3.hat(xi[:, 3:])) - np.diag([0, 0, 0, 1])
    assert np.allclose(se3.exp(xi), scipy.linalg.expm(generators), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-6, 1.1e-5, 0.3, 2.0])
def test_compiled_twists_are_those_of_numpy(angle):
    start = se3.exp(twists(1.0, 1, seed=1))[0]
    for twist in twists(angle, 5):
        assert np.allclose(twist_of(se3.exp(twist)), twist, atol=1e-9)
        assert np.allclose(apply_twist(start, twist), se3.exp(twist) @ start, atol=1e-9)


def test_inverse_transform_and_hat():
    poses = se3.exp(twists(1.0))
    assert np.allclose(se3.inverse(poses) @ poses, np.eye(4), atol=1e-12)
    points = np.random.default_rng(1).normal(size=(7, 3))
    assert np.allclose(se3.transform(poses[0], points), [(poses[0] @ np.append(p, 1))[:3] for p in points])
    a, b = points[:3], points[3:6]
    assert np.allclose((se3.hat(a) @ b[..., None])[..., 0], np.cross(a, b))


def test_batches_of_any_shape():
    xi = twists(0.7, 12).reshape(3, 4, 6)
    poses = se3.exp(xi)
    assert poses.shape == (3, 4, 4, 4)
    assert np.allclose(se3.log(poses), xi)
    assert np.allclose(se3.from_quaternion(*se3.to_quaternion(poses)), poses)
    assert np.allclose(se3.rotation_angle(poses), 0.7)


def test_quaternions_are_normalised_and_canonical():
    lengths = np.array([[1.0], [-7], [1e-300], [1e200], [1e308]])  # a file may hold any number
    poses = se3.from_quaternion(np.zeros((5, 3)), lengths * [0.1, -0.2, 0.3, -0.4])
    assert np.allclose(poses, poses[0])
    _, again = se3.to_quaternion(poses)
    assert np.allclose(np.linalg.norm(again, axis=1), 1) and (again[:, 3] > 0).all()


@pytest.mark.parametrize(
    "pose",
    [
        None,
        "pose",
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.eye(4, dtype=int),
    ],
    ids=["none", "text", "3x3", "nan", "mirror", "scaled", "homogeneous", "integers"],
)
def test_what_is_no_pose(pose):
    assert not se3.is_pose(pose)
    assert se3.is_pose(np.eye(4))


# -- camera


def pixel_grid(camera, border=0.0):
    u, v = np.meshgrid(np.linspace(border, camera.width - border, 25), np.linspace(border, camera.height - border, 19))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("camera", [FR1, BONN, PINHOLE], ids=["fr1", "bonn", "pinhole"])
def test_undistort_and_distort_are_inverse(camera):
    distorted = pixel_grid(camera)
    undistorted = camera.undistort_points(distorted)
    assert np.abs(camera.distort_points(undistorted) - distorted).max() < 1e-4
    assert (np.abs(undistorted - distorted).max() > 1) == camera.is_distorted


@pytest.mark.parametrize("camera", [FR1, BONN], ids=["fr1", "bonn"])
def test_distortion_is_opencvs(camera):
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (100, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    assert np.allclose(camera.distort_points(camera.project(points)), expected[:, 0], atol=1e-9)


def test_project_and_unproject_are_inverse():
    pixels = pixel_grid(PINHOLE)
    depth = np.random.default_rng(0).uniform(0.3, 8, len(pixels))
    points = PINHOLE.unproject(pixels, depth)
    assert np.allclose(points[:, 2], depth)
    assert np.allclose(PINHOLE.project(points), pixels)


@pytest.mark.parametrize(("width", "height"), list(itertools.product((320, 640, 1280), (240, 480, 300))))
def test_resizing_scales_the_intrinsics_with_the_pixels(width, height):
    small = PINHOLE.resized(width, height)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    scale = np.array([width / 640, height / 480])
    assert np.allclose(small.project(points), (PINHOLE.project(points) + 0.5) * scale - 0.5)
    assert (small.width, small.height) == (width, height)
    back = small.resized(640, 480)
    assert np.allclose([back.fx, back.fy, back.cx, back.cy], [PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy])


def test_distortion_does_not_depend_on_the_resolution():
    small = FR1.resized(320, 240)
    pixels = pixel_grid(FR1, border=20)
    half = (pixels + 0.5) / 2 - 0.5
    assert np.allclose(small.distort_points(half), (FR1.distort_points(pixels) + 0.5) / 2 - 0.5, atol=1e-9)
    assert not FR1.undistorted().is_distorted
    assert np.array_equal(FR1.undistorted().matrix, FR1.matrix)


# -- trajectory


@pytest.mark.parametrize(
    ("stamps", "exact", "broken", "named"),
    [
        ([0.0, 1.0], None, 0.0, "2 stamps but 3 poses"),
        ([0.0, 1.0, 1.0], None, 0.0, r"not strictly increasing: 1\.0+ then 1\.0+"),
        ([0.0, 1.0, 1.0 + 4e-10], None, 0.0, r"increasing in nanoseconds: 1\.000000000 then 1\.000000000"),
        ([0.0, 1.0, np.nan], None, 0.0, "not finite"),
        ([0.0, 1.0, 2.0], None, np.inf, "not finite"),
        ([0.0, 1.0, 2.0], [10**9], 0.0, "3 stamps but 1 in ns"),
    ],
)
def test_trajectory_refuses_what_is_none(stamps, exact, broken, named):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = broken
    with pytest.raises(TrajectoryError, match=named):
        Trajectory(np.array(stamps), poses, exact)


def test_trajectory_views():
    trajectory = Trajectory(np.arange(5.0), se3.exp(twists(0.4, 5)))
    assert trajectory.select(trajectory.timestamps > 2).timestamps.tolist() == [3.0, 4.0]
    way = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(trajectory.positions))
    assert trajectory.path_length_m == pytest.approx(way)
    assert len(trajectory.select(slice(1, 4))) == 3 and trajectory.select(slice(0, 0)).path_length_m == 0
