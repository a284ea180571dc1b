"""Hints name the faults of a trajectory file, and say nothing of healthy or merely bad trackers."""

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.evaluation import hints
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import load_tum, write_tum

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"
FR3 = "rgbd-vo/rgbd_dataset_freiburg3_"


def hand_held(frames=240, rate=30.0, seed=0, noise_m=0.0):
    """A camera that moves along and turns about all axes, as a hand does."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / rate
    size = np.repeat([0.15, 0.12], 3)
    twists = sum(
        size / (k + 1) * np.sin(np.outer(t, rng.uniform(1, 2, 6) * (k + 1)) + rng.uniform(0, 6, 6)) for k in range(3)
    )
    poses = se3.exp(rng.normal(size=6)) @ se3.exp(twists)
    poses[:, :3, 3] += rng.normal(0, 1, (frames, 3)) * noise_m
    return Trajectory(np.round(1e9 + t, 6), poses)


def tracked(truth, seed=1, drift=0.01, jitter=5e-4, every=1):
    rng = np.random.default_rng(seed)
    steps = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    size = np.linalg.norm(se3.log(steps), axis=1, keepdims=True)
    poses = [np.eye(4)]
    for step in steps @ se3.exp(rng.normal(size=(len(steps), 6)) * drift * size):
        poses.append(poses[-1] @ step)
    estimate = Trajectory(truth.timestamps, np.array(poses) @ se3.exp(rng.normal(0, jitter, (len(truth), 6))))
    return estimate.select(slice(None, None, every))


def ids(estimate, truth, *arguments, **options):
    return [hint.id for hint in hints(estimate, truth, *arguments, **options)]


def posed(trajectory, poses):
    return Trajectory(trajectory.timestamps, poses)


def scaled(trajectory, factor):
    poses = trajectory.T_world_cam.copy()
    poses[:, :3, 3] *= factor
    return posed(trajectory, poses)


def w_first(trajectory):
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    return posed(trajectory, se3.from_quaternion(position, np.roll(quaternion, 1, axis=1)))


TRUTH = hand_held()
ESTIMATE = tracked(TRUTH)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("drift", "jitter"), [(0.0, 3e-4), (0.01, 5e-4), (0.05, 2e-3)])
def test_healthy_estimates_get_none(seed, drift, jitter):
    truth = hand_held(seed=seed)
    assert ids(tracked(truth, seed, drift, jitter), truth) == []


def test_estimates_of_every_length_are_taken():
    for frames in (1, 2, 7, 8, 9, 12, 20):
        truth = hand_held(max(frames, 2)).select(slice(0, frames))
        assert ids(tracked(truth), truth) == []


@pytest.mark.parametrize("seconds", [-1, -0.2, -0.05, 0.05, 0.2, 1])
@pytest.mark.parametrize("every", [1, 3])
def test_time_shifts_are_measured(seconds, every):
    estimate = tracked(TRUTH, every=every)
    (hint,) = hints(Trajectory(estimate.timestamps + seconds, estimate.T_world_cam), TRUTH)
    assert hint.id == "time-shift"
    assert hint.numbers["shift_s"] == pytest.approx(-seconds, abs=0.01)
    assert hint.numbers["error_undone_m"] < 0.5 * hint.numbers["error_m"]


@pytest.mark.parametrize("factor", [1000, 100, 5, 1.5, 0.8, 0.2, 0.001])
def test_scales_are_measured(factor):
    (hint,) = hints(scaled(ESTIMATE, factor), TRUTH)
    assert hint.id == "scale" and hint.numbers["scale"] == pytest.approx(1 / factor, rel=0.05)
    assert ("millimetres" in hint.text) == (factor == 1000)


def test_a_scale_that_the_protocol_finds_is_no_fault():
    assert ids(scaled(ESTIMATE, 5), TRUTH, "tum-rgbd/v1-sim3") == []


@pytest.mark.parametrize("seed", range(4))
def test_conventions_are_named(seed):
    truth = hand_held(seed=seed)
    estimate = tracked(truth, seed)
    assert ids(posed(estimate, se3.inverse(estimate.T_world_cam)), truth) == ["inverted-poses"]
    assert ids(w_first(estimate), truth) == ["quaternion-order"]
    (hint,) = hints(posed(estimate, estimate.T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0])), truth)
    assert hint.id == "camera-axes" and "OpenGL" in hint.text
    turned = estimate.T_world_cam.copy()
    turned[:, :3, :3] = turned[:, :3, :3].transpose(0, 2, 1)
    assert ids(posed(estimate, turned), truth) == ["inverted-rotations"]


def test_two_faults_are_both_named():
    inverted = se3.inverse(scaled(ESTIMATE, 1000).T_world_cam)
    assert ids(posed(ESTIMATE, inverted), TRUTH) == ["inverted-poses", "scale"]
    late = Trajectory(ESTIMATE.timestamps + 0.2, scaled(ESTIMATE, 1000).T_world_cam)
    assert ids(late, TRUTH) == ["time-shift", "scale"]


def test_a_truth_with_axes_of_its_own_is_no_fault_of_the_estimate():
    truth = posed(TRUTH, TRUTH.T_world_cam @ se3.exp(np.array([0.02, 0.01, 0.0, 2.0, -0.7, 0.4])))
    assert ids(ESTIMATE, truth) == []
    assert ids(posed(ESTIMATE, se3.inverse(ESTIMATE.T_world_cam)), truth) == ["inverted-poses"]


def test_several_recordings_in_a_file(tmp_path):
    other = Trajectory(TRUTH.timestamps + 3600, ESTIMATE.T_world_cam)
    both = Trajectory(
        np.concatenate([ESTIMATE.timestamps, other.timestamps]),
        np.concatenate([ESTIMATE.T_world_cam, other.T_world_cam]),
    )
    (hint,) = hints(both, TRUTH)
    assert hint.id == "several-recordings" and hint.numbers["poses_outside"] == len(other)
    long = hand_held(600)
    write_tum(tmp_path / "run.txt", tracked(long))
    text = (tmp_path / "run.txt").read_text()
    (tmp_path / "twice.txt").write_text(text + text)
    file = load_tum(tmp_path / "twice.txt")
    assert file.notes.back_s == pytest.approx(599 / 30)
    (hint,) = hints(file.trajectory, long, notes=file.notes)
    assert hint.id == "several-recordings" and hint.numbers["repeated_stamps"] == 600


def test_frames_lost_for_long_are_not_several_recordings():
    truth = hand_held(1200)
    estimate = tracked(truth)
    kept = (truth.timestamps < truth.timestamps[0] + 5) | (truth.timestamps > truth.timestamps[0] + 30)
    assert ids(estimate.select(kept), truth) == []


def test_poses_read_from_the_truth_are_named():
    assert ids(TRUTH, TRUTH) == ["below-truth-noise"]
    measured = hand_held(1200, rate=100.0, noise_m=1e-4)
    stamps = measured.timestamps[:-4:3] + 0.004
    at = np.searchsorted(measured.timestamps, stamps)
    between = measured.T_world_cam[at].copy()
    for axis in range(3):
        between[:, axis, 3] = np.interp(stamps, measured.timestamps, measured.positions[:, axis])
    assert ids(Trajectory(stamps, between), measured) == ["below-truth-noise"]
    drift = np.cumsum(np.random.default_rng(0).normal(0, 1e-5, (len(at), 3)), axis=0)
    between[:, :3, 3] += drift + [[0.003, 0, 0]] * np.sin(stamps - stamps[0])[:, None]
    assert ids(Trajectory(stamps, between), measured) == ["below-truth-noise"]
    few = tracked(measured, drift=0.0, jitter=3e-4, every=3)
    assert ids(few, measured) == [] and ids(few.select(np.arange(len(few)) < 20), measured) == []


def test_a_camera_that_stands_still_may_be_followed_exactly():
    still = Trajectory(100 + np.arange(60) / 30, np.tile(np.eye(4), (60, 1, 1)))
    assert ids(still, still) == []
    noisy = hand_held(600, rate=100.0)
    noisy = posed(noisy, np.tile(np.eye(4), (600, 1, 1)))
    noisy.T_world_cam[:, :3, 3] += np.random.default_rng(0).normal(0, 3e-4, (600, 3))
    assert ids(Trajectory(noisy.timestamps, np.tile(np.eye(4), (600, 1, 1))), noisy) == []


def bad(kind, truth, rng):
    stamps, number, good = truth.timestamps, np.arange(len(truth)), tracked(truth).T_world_cam
    speed = se3.log(se3.inverse(good[:1]) @ good[5:6]) / 5
    walk = np.cumsum(rng.normal(0, 0.01, (len(truth), 6)), axis=0)
    poses = {
        "still": np.tile(np.eye(4), (len(truth), 1, 1)),
        "steady": se3.exp(speed * number[:, None]),
        "walk": se3.exp(walk),
        "stops": good[np.minimum(number, len(truth) // 2)],
        "jumps": se3.exp(rng.normal(0, 0.5, (4, 6)))[number * 4 // len(truth)] @ good,
        "drifts": tracked(truth, 3, 0.3, 2e-3).T_world_cam,
        "diverges": se3.exp(np.exp(0.1 * number)[:, None] * rng.normal(0, 1e-4, 6)),
    }[kind]
    return Trajectory(stamps, poses)


@pytest.mark.parametrize("kind", ["still", "steady", "walk", "stops", "jumps", "drifts", "diverges"])
@pytest.mark.parametrize("seed", range(5))
def test_bad_trackers_get_none(kind, seed):
    truth = hand_held(seed=seed)
    assert ids(bad(kind, truth, np.random.default_rng(seed)), truth) == []


def test_no_number_changes():
    estimate = posed(ESTIMATE, se3.inverse(ESTIMATE.T_world_cam))
    kept = estimate.timestamps.copy(), estimate.T_world_cam.copy()
    hints(estimate, TRUTH)
    assert np.array_equal(kept[0], estimate.timestamps) and np.array_equal(kept[1], estimate.T_world_cam)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the trajectories in ../shared/data")
@pytest.mark.parametrize(
    ("estimate", "truth", "expected"),
    [
        ("authors/dyslam/walking_xyz.txt", f"{FR3}walking_xyz/groundtruth.txt", []),
        ("authors/cds_slam/walking_rpy.txt", f"{FR3}walking_rpy/groundtruth.txt", []),
        ("authors/amos_slam/CameraTrajectory.txt", "authors/amos_slam/groundtruth.txt", []),
        (f"{FR3}walking_xyz/ours.txt", f"{FR3}walking_xyz/groundtruth.txt", ["several-recordings"]),
        (f"{FR3}walking_static/ours.txt", f"{FR3}walking_static/groundtruth.txt", ["several-recordings"]),
    ],
)
def test_published_trajectories(estimate, truth, expected):
    file = load_tum(SHARED / estimate)
    assert ids(file.trajectory, load_tum(SHARED / truth).trajectory, notes=file.notes) == expected
