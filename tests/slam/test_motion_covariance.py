"""The covariance of a pose by its information and residuals, against simulated draws of the measurements."""

import numpy as np
import pytest
from helpers.point_world import make_backend, track_all

from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.loop_closing import LoopClosingResult
from dynslam_bench.slam.pose_optimisation import (
    CAUCHY,
    COVARIANCE_FACTOR,
    Measurements,
    PoseEstimate,
    motion_covariance,
    optimise_pose,
)

CAMERA = Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240)
DRAWS = 250


def cauchy_ratio():
    """Variance of an estimate with Cauchy's weights, times the information with these weights, by Huber's formula.

    The weights are ``w(c) = 1 / (1 + c / 5)`` of chi-squares c with three degrees of freedom.
    """
    c = np.random.default_rng(0).chisquare(3, 400_000)
    w = 1 / (1 + c / CAUCHY)
    derivative = np.mean(w - 2 / 3 * c * w**2 / CAUCHY)
    return np.mean(w) * np.mean(w**2 * c) / 3 / derivative**2


def test_a_pose_that_is_not_determined_has_no_covariance():
    inliers = np.zeros(3, bool)
    assert motion_covariance(PoseEstimate(np.eye(4), inliers, 0, np.nan, np.zeros((6, 6)))) is None


@pytest.mark.parametrize("noise_px", [0.2, 0.5])
def test_the_covariance_is_that_of_simulated_poses(noise_px):
    rng = np.random.default_rng(7)
    T_cam_world = se3.exp(np.array([0.1, -0.2, 0.3, 0.2, -0.1, 0.3]))
    T_world_cam = se3.inverse(T_cam_world)
    # most points lie far off: the directions are determined differently well
    z = rng.uniform(1.0, 6.0, 150)
    uv = rng.uniform([5, 5], [315, 235], (150, 2))
    points = se3.transform(T_world_cam, CAMERA.unproject(uv, z))
    right = uv[:, 0] - CAMERA.fx * CAMERA.baseline_m / z
    ones = np.ones(150)

    # errors xi of T_world_cam Exp(xi), the true pose being the estimated one times Exp(xi)
    errors = []
    covariances = []
    for _ in range(DRAWS):
        measured = uv + rng.normal(0, noise_px, uv.shape)
        # the right coordinate has a noise of its own
        measured_right = right + rng.normal(0, noise_px, 150)
        measurements = Measurements(measured, measured_right, ones, ones)
        estimate = optimise_pose(T_cam_world, points, measurements, CAMERA)
        errors.append(se3.log(estimate.T_cam_world @ T_world_cam))
        covariances.append(motion_covariance(estimate) / COVARIANCE_FACTOR)
    errors = np.array(errors)
    predicted = np.mean(covariances, axis=0)

    # along every direction the simulated variance is the predicted one, up to what robust weights do to Gaussian noise
    root = np.linalg.inv(np.linalg.cholesky(predicted))
    whitened = errors @ root.T
    expected = cauchy_ratio()
    assert np.diag(np.cov(whitened.T)) == pytest.approx(np.full(6, expected), rel=0.25)
    # and the errors in different directions are independent
    assert np.abs(np.corrcoef(whitened.T) - np.eye(6)).max() < 0.2


@pytest.mark.parametrize("moved_m", [0.0, 0.02, 0.5])
def test_a_frame_that_a_loop_moved_has_no_covariance(room, monkeypatch, moved_m):
    """The covariance is that of the fit to the image, which knows nothing of the loop."""
    backend = make_backend(room, loop_closing__enabled=True, keyframes__schedule="every")
    frames = [room.see(pose, index) for index, pose in enumerate(room.path(4))]
    before = track_all(backend, frames[:3])
    assert before[0].motion_covariance is None, "the first frame has no motion"
    assert all(np.linalg.eigvalsh(result.motion_covariance)[0] > 0 for result in before[1:])

    def close(slot, *_):
        backend.map.kf_pose[slot, 0, 3] += moved_m
        return LoopClosingResult()

    monkeypatch.setattr(backend.loops, "close", close)
    (result,) = track_all(backend, frames[3:])
    assert result.keyframe
    assert (result.motion_covariance is None) == (moved_m > 0)
