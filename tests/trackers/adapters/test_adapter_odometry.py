"""Dense frame-to-frame odometries of OpenCV and Open3D, and the chain that they share."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.testing import check_tracker
from dynslam_bench.trackers import TRACKERS, build_tracker
from dynslam_bench.trackers.adapters import odometry as opencv_odometry
from dynslam_bench.trackers.adapters.odometry import FrameToFrame, undistortion_maps

XYZ = Path(__file__).resolve().parents[4] / "shared" / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"
needs_data = pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")
needs_opencv = pytest.mark.skipif(bool(opencv_odometry.unavailable()), reason=opencv_odometry.unavailable())
needs_open3d = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="open3d is not installed")
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


@needs_opencv
def test_opencv_keeps_the_contract():
    check_tracker("opencv-odometry", frames=3)


@needs_data
@pytest.mark.parametrize(
    ("name", "settings", "bound"),
    [
        pytest.param("opencv-odometry", {"method": "rgbd"}, 0.01, marks=needs_opencv),
        pytest.param("opencv-odometry", {"method": "rgb"}, 0.01, marks=needs_opencv),
        pytest.param("open3d-odometry", {}, 0.015, marks=needs_open3d),
    ],
)
def test_odometries_follow_a_static_scene(name, settings, bound):
    sequence = open_sequence(XYZ, frames=(0, 12))
    tracker = build_tracker(name, settings)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    results = [tracker.track(sequence[index]) for index in range(12)]
    assert {result.state for result in results} == {"ok"}
    estimate = Trajectory(sequence.timestamps, np.stack([result.T_world_cam for result in results]))
    metrics = evaluate(estimate, sequence.ground_truth, "tum-rgbd/v1").metrics
    assert metrics["ate_rmse_m"] < bound < metrics["static_camera_ate_rmse_m"] / 2


def test_without_the_api_it_is_listed_and_says_what_to_install(monkeypatch):
    for name in ("Odometry", "rgbd"):
        monkeypatch.delattr(cv2, name, raising=False)
    assert "opencv-odometry" in [found.spec.id for found in TRACKERS.all()]
    hints = TRACKERS.get("opencv-odometry").missing()
    assert len(hints) == 1 and "opencv-contrib-python-headless" in hints[0] and cv2.__version__ in hints[0]
    with pytest.raises(TrackerError, match="opencv-contrib"):
        build_tracker("opencv-odometry")


class Scripted(FrameToFrame):
    """Frames carry their number in a pixel; a motion of 1 along x each, or none where the script says so."""

    def __init__(self, failing):
        self.failing = failing

    def start(self, camera):
        """Nothing to set up."""

    def prepare(self, rgb, depth):
        return int(rgb[0, 0, 0])

    def align(self, reference, current):
        return None if current in self.failing else se3.exp(np.array([current - reference, 0.0, 0, 0, 0, 0]))


def run_scripted(failing, count, blind):
    tracker = Scripted(failing)
    tracker.reset(CAMERA, rng=np.random.default_rng(0))
    results = []
    for index in range(count):
        depth = np.full((48, 64), 0.0 if index in blind else 1.0, np.float32)
        results.append(tracker.track(Frame(index, float(index), np.full((48, 64, 3), index, np.uint8), depth)))
    return results


@pytest.mark.parametrize(
    ("failing", "blind", "states", "place"),
    [
        ((2, 3), (), "ok ok lost lost ok", 4),
        ((1, 2, 3, 4, 5), (), "ok lost lost lost lost lost ok ok", 2),  # as if it had not moved while it was lost
        ((), (0, 1, 3), "initialising initialising ok lost ok", 2),
    ],
)
def test_lost_frames_are_bridged_from_the_last_good_one(failing, blind, states, place):
    results = run_scripted(failing, len(states.split()), blind)
    assert " ".join(result.state for result in results) == states
    assert results[-1].T_world_cam[0, 3] == place
    assert all((result.T_world_cam is None) == (result.state != "ok") for result in results)


def test_undistortion_maps_invert_the_distortion():
    camera = Camera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.26, -0.95, -0.005, 0.003, 1.16))
    columns, rows = undistortion_maps(camera)
    grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1).reshape(-1, 2)
    expected = camera.distort_points(grid).reshape(48, 64, 2)
    assert np.abs(columns - expected[..., 0]).max() < 1e-3 and np.abs(rows - expected[..., 1]).max() < 1e-3
    assert undistortion_maps(CAMERA) is None
