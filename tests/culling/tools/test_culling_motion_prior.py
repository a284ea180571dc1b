"""What the back end tells the culling of the camera's motion: surer once the speed is known, nothing while lost."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CAMERA, bundle, splat

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.ego_motion import CORRELATION, prior_information
from dynslam_bench.geometry import se3
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.motion_model import MotionState
from dynslam_bench.slam.settings import MotionModelSettings


def test_motion_covariance_is_the_speeds_plus_the_accelerations() -> None:
    state = MotionState.at(np.eye(4), 1e-6 * np.eye(6))
    settings = MotionModelSettings(acceleration=4.0, angular_acceleration=20.0)
    dt = 0.1
    got = state.motion_covariance(dt, settings)
    expected = np.diag(
        dt**2 * np.repeat([1.0, 4.0], 3) + np.repeat([(0.5 * 4.0 * dt**2) ** 2, (0.5 * 20.0 * dt**2) ** 2], 3)
    )
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)


def _frame(points: np.ndarray, words: np.ndarray, pose: np.ndarray, stamp: float):  # type: ignore[no-untyped-def]
    local = se3.transform(se3.inverse(pose), points)
    xy = CAMERA.project(local)
    made = bundle(xy, local[:, 2], splat(xy, local[:, 2], 5.0), stamp)
    n = len(xy)
    made.keypoints = Keypoints(
        xy.astype(np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32), np.ones(n, np.float32), words
    )
    return made


def test_back_end_is_surer_of_the_motion_once_it_knows_the_speed_and_says_nothing_when_lost() -> None:
    rng = np.random.default_rng(0)
    points = CAMERA.unproject(rng.uniform((60, 60), (580, 420), (400, 2)), rng.uniform(1.5, 3.5, 400))
    words = rng.integers(0, 256, (400, 32), dtype=np.uint8)
    backend = RgbdBackend()
    backend.reset(CAMERA, seed=0)
    assert backend.motion_covariance(0.0) is None
    ones, weight = np.ones(400, bool), np.ones(400, np.float32)
    widths = []
    for i in range(6):
        pose = se3.exp(np.array([0.003 * i, 0, 0, 0, 0, 0]))
        result = backend.track(_frame(points, words, pose, i / 30), ones, weight)
        assert result.state == "ok"
        covariance = backend.motion_covariance((i + 1) / 30)
        widths.append(np.nan if covariance is None else float(np.sqrt(covariance[:3, :3].trace())))
    assert widths[-1] < 0.5 * np.nanmax(widths) and widths[-1] < 0.01
    blind = _frame(points, rng.integers(0, 256, (400, 32), dtype=np.uint8), np.eye(4), 6 / 30)
    assert backend.track(blind, ones, weight).state == "lost"
    assert backend.motion_covariance(7 / 30) is None


def test_information_turns_with_the_camera() -> None:
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi / 2, 0]))
    covariance = np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0])
    state = FilterState(CAMERA, np.ones(0, bool), T_world_prev=turned, motion_covariance=covariance)
    information = prior_information(state, np.eye(4))
    assert information is not None
    np.testing.assert_allclose(
        np.diag(information)[:3], CORRELATION / np.array([9.0, 4.0, 1.0]), rtol=1e-6
    )  # x and z of the world have changed places
    assert prior_information(FilterState(CAMERA, np.ones(0, bool)), np.eye(4)) is None
    assert information == pytest.approx(information.T)
