"""The control rows and `replay:FILE`: exact poses, and the names they are found by."""

import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import PluginError, SettingsError, TrajectoryError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.testing import CornerSequence, check_tracker
from dynslam_bench.trackers import TRACKERS, build_tracker
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
def test_controls_keep_the_contract(name):
    check_tracker(name)


def test_never_move_is_identity():
    tracker = reset(build_tracker("never-move"))
    for index in range(3):
        result = tracker.track(blank(index, float(index)))
        assert result.state == "ok" and np.array_equal(result.T_world_cam, np.eye(4))


def test_constant_velocity_stands_still_without_images():
    tracker = reset(build_tracker("constant-velocity"))
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
    path, _, _ = trajectory
    spec = TRACKERS.get(f"replay:{path}")
    assert spec.id == f"replay:{path}" and resolve_settings(spec).file == str(path)
    assert "estimate.txt" in spec.label
    version = spec.version
    path.write_text(path.read_text() + "1400000000.0 0 0 0 0 0 0 1\n")
    assert TRACKERS.get(f"replay:{path}").version != version, "another content is another run"
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


def test_replay_faults(tmp_path, trajectory):
    path, _, _ = trajectory
    with pytest.raises(SettingsError, match="replay:FILE"):
        build_tracker("replay")
    with pytest.raises(PluginError, match="lacks its file"):
        TRACKERS.get("replay:")
    with pytest.raises(TrajectoryError, match=r"missing\.txt"):
        build_tracker(f"replay:{tmp_path / 'missing.txt'}")
    empty = tmp_path / "empty.txt"
    empty.write_text("# nothing\n")
    with pytest.raises(TrajectoryError):
        build_tracker(f"replay:{empty}")
    with pytest.raises(SettingsError, match="tolerance_s"):
        build_tracker(f"replay:{path}", {"tolerance_s": 0})
