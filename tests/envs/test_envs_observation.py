"""What an agent sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from envs_toys import CAMERA, TARGET, ToySequence, images

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.envs import STATS_LAYOUT, SlamEnv
from dynslam_bench.envs.spaces import MAX_DEPTH_M, stats_observation, stats_space
from dynslam_bench.geometry import se3

FRAME = Frame(3, 1.0, *images(3))


def observe(result: TrackResult, frame: Frame = FRAME, motion: np.ndarray | None = None) -> dict[str, float]:
    twist = None if motion is None else se3.log(motion)
    vector = stats_observation(frame, result, progress=0.5, lost_streak=0, motion=twist)
    assert vector in stats_space() and np.isfinite(vector).all()
    return dict(zip((name for name, _ in STATS_LAYOUT), vector.tolist(), strict=True))


def test_every_entry_means_what_is_documented() -> None:
    stats = {
        "keypoints": 1000.0, "culled": 250.0, "matches": 300.0, "inliers": 150.0, "residual_px": 1.0,
        "mask_fraction": 0.25, "map_points": 5000.0, "keyframes": 100.0, "keyframe": 1.0,
    }  # fmt: skip
    motion = se3.exp(np.array([0.1, 0, -0.1, 0, 0.1, 0]))
    entries = observe(TrackResult(np.eye(4), "ok", stats), motion=motion)
    brightness, contrast, motion_rx = (entries.pop(name) for name in ("brightness", "contrast", "motion_rx"))
    assert brightness == pytest.approx(FRAME.rgb.mean() / 255, abs=0.03) and contrast > 0
    expected = dict.fromkeys(entries, 0.0) | {
        "ok": 1, "progress": 0.5, "keypoints": 0.5, "culled": 0.25, "matches": 0.4, "inliers": 0.5, "residual": 0.5,
        "mask_fraction": 0.25, "map_points": 0.5, "keyframes": 0.5, "keyframe": 1, "motion_x": np.tanh(1),
        "motion_z": -np.tanh(1), "motion_ry": np.tanh(1), "depth_valid": 1, "depth_median": 1.3 / 4.3,
    }  # fmt: skip
    assert entries == pytest.approx(expected, abs=1e-6) and motion_rx == pytest.approx(0, abs=1e-9)


def test_nothing_reported_and_nonsense_reported_stay_in_bounds() -> None:
    assert observe(TrackResult(None, "lost"))["lost"] == 1
    wild = {"keypoints": np.inf, "culled": -5.0, "matches": 1e30, "inliers": np.nan, "mask_fraction": 7.0}
    observe(TrackResult(np.eye(4), "ok", wild), motion=se3.exp(np.array([1e6, 0, 0, 3, 0, 0])))
    black = replace(FRAME, rgb=np.zeros_like(FRAME.rgb), depth=np.zeros_like(FRAME.depth))
    entries = observe(TrackResult(None, "initialising"), black)
    assert entries["brightness"] == entries["contrast"] == entries["depth_valid"] == entries["depth_median"] == 0


def test_rgbd_holds_copies_of_the_images() -> None:
    env = SlamEnv(ToySequence(4), TARGET, observation="rgbd")
    seen, _ = env.reset(seed=0)
    assert seen["rgb"].shape == (CAMERA.height, CAMERA.width, 3) and seen["depth"].shape == seen["rgb"].shape[:2]
    assert (seen["rgb"] == images(0)[0]).all() and (seen["depth"] == images(0)[1]).all()
    assert not np.shares_memory(seen["rgb"], env.frame.rgb) and not np.shares_memory(seen["depth"], env.frame.depth)
    assert seen in env.observation_space
    assert env.observation_space["depth"].high.max() == MAX_DEPTH_M


def test_no_ground_truth_in_the_observation() -> None:
    with_truth, without = SlamEnv(ToySequence(8), TARGET), SlamEnv(ToySequence(8, has_truth=False), TARGET)
    for env in (with_truth, without):
        env.reset(seed=4)
    for _ in range(7):
        assert with_truth.step(0)[0].tobytes() == without.step(0)[0].tobytes()
