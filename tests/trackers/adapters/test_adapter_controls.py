"""The control rows and `replay:FILE`: exact poses, and the names they are found by."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import PluginError, SettingsError, TrackerError, TrajectoryError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.testing import CornerSequence, check_tracker
from dynslam_bench.trackers import TRACKERS, build_tracker
from dynslam_bench.trackers.adapters import odometry as opencv_odometry
from dynslam_bench.trackers.adapters.odometry import FrameToFrame, undistortion_maps
from dynslam_bench.trackers.registry import resolve_settings

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def blank(index, stamp):
    return Frame(index, stamp, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32))


def reset(tracker, camera=CAMERA):
    tracker.reset(camera, rng=np.random.default_rng(0))
    return tracker


@pytest.fixture
def trajectory(tmp_path):
    stamps = 1305031102.175304 + np.arange(20) / 30
    poses = se3.exp(np.random.default_rng(1).normal(size=(20, 6)))
    path = tmp_path / "estimate.txt"
    write_tum(path, Trajectory(stamps, poses))
    return path, stamps, poses


@pytest.mark.parametrize("name", ["never-move", "constant-velocity"])
def test_controls_stand_still_without_images(name):
    tracker = reset(build_tracker(name))
    for index in range(12):
        result = tracker.track(blank(index, index / 30))
        assert result.state == "ok" and np.allclose(result.T_world_cam, np.eye(4), atol=1e-12)


def test_constant_velocity_repeats_the_measured_motion():
    """After the measured frames each pose is the one before times exp(velocity * dt), whatever the images show."""
    sequence = CornerSequence(12)
    tracker = reset(build_tracker("constant-velocity", {"frames": 4}), sequence.camera)
    stamps = sequence.timestamps
    results = [tracker.track(sequence[i]) for i in range(4)]
    poses = sequence.ground_truth.T_world_cam
    truth = se3.inverse(poses[0]) @ poses
    measured = np.stack([result.T_world_cam for result in results])
    assert np.linalg.norm(measured[:, :3, 3] - truth[:4, :3, 3], axis=1).max() < 0.01
    assert min(result.stats["inliers"] for result in results[1:]) >= 12
    velocity = se3.log(measured[3]) / (stamps[3] - stamps[0])
    pose, stamp = measured[3], stamps[3]
    for index, gap in ((4, 0.04), (5, 0.5), (6, 0.01)):
        stamp += gap
        frame = Frame(index, stamp, np.zeros_like(sequence[0].rgb), np.zeros_like(sequence[0].depth))
        pose = pose @ se3.exp(velocity * gap)
        assert np.allclose(tracker.track(frame).T_world_cam, pose, atol=1e-6)


def test_replay_gives_the_files_poses(trajectory):
    path, stamps, poses = trajectory
    tracker = reset(build_tracker(f"replay:{path}"))
    for index, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        result = tracker.track(blank(index, stamp + 0.009))
        assert result.state == "ok"
        assert np.allclose(result.T_world_cam, pose, atol=1e-8)
        assert result.stats["stamp_gap_s"] == pytest.approx(0.009, abs=2e-6)


def test_replay_skips_a_hole(trajectory, tmp_path):
    path, stamps, _ = trajectory
    lines = path.read_text().splitlines(keepends=True)
    holed = tmp_path / "holed.txt"
    holed.write_text("".join(lines[:6] + lines[9:]))  # a header line, then poses 0-4 and 8-19
    tracker = reset(build_tracker(f"replay:{holed}"))
    states = [tracker.track(blank(i, stamp)).state for i, stamp in enumerate(stamps)]
    assert states == ["ok"] * 5 + ["lost"] * 3 + ["ok"] * 12


def test_replay_id_carries_the_file(trajectory):
    path = trajectory[0]
    spec = TRACKERS.get(f"replay:{path}")
    assert spec.id == f"replay:{path}" and resolve_settings(spec).file == str(path)
    assert "estimate.txt" in spec.label
    path.write_text(path.read_text() + "1400000000.0 0 0 0 0 0 0 1\n")
    assert TRACKERS.get(f"replay:{path}").version != spec.version, "another content is another run"
    assert resolve_settings(spec, {"tolerance_s": "0.02"}).tolerance_s == 0.02
    assert TRACKERS.get("replay").id == "replay"


def test_bound_values_stay_text(trajectory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trajectory[0].rename(tmp_path / "5")
    assert resolve_settings(TRACKERS.get("replay:5")).file == "5"
    assert resolve_settings(TRACKERS.get("subprocess:true")).command == "true"


def test_names_with_a_colon_still_load_specs(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from dynslam_bench.trackers import TrackerSpec\n"
        "SPEC = TrackerSpec('mine', 'dynslam_bench.trackers.adapters.controls:NeverMove', 'mine')\n"
    )
    assert TRACKERS.get(f"{file}:SPEC").id == "mine"
    assert TRACKERS.get("dynslam_bench.trackers.adapters.specs:NEVER_MOVE").id == "never-move"
    with pytest.raises(PluginError):
        TRACKERS.get("never-move:x")


@pytest.mark.parametrize(
    ("name", "settings", "error", "words"),
    [
        ("replay", {}, SettingsError, "replay:FILE"),
        ("replay:", {}, PluginError, "lacks its file"),
        ("replay:missing.txt", {}, TrajectoryError, r"missing\.txt"),
        ("replay:empty.txt", {}, TrajectoryError, r"empty\.txt"),
        ("replay:estimate.txt", {"tolerance_s": 0}, SettingsError, "tolerance_s"),
    ],
)
def test_replay_faults(tmp_path, monkeypatch, trajectory, name, settings, error, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(error, match=words):
        build_tracker(name, settings)


# Dense frame-to-frame odometries of OpenCV and Open3D, and the chain that they share.


XYZ = Path(__file__).resolve().parents[4] / "shared" / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"
needs_data = pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")
needs_opencv = pytest.mark.skipif(bool(opencv_odometry.unavailable()), reason=opencv_odometry.unavailable())
needs_open3d = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="open3d is not installed")


@needs_opencv
def test_opencv_keeps_the_contract():
    check_tracker("opencv-odometry", frames=2)


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
