"""Dai et al.'s graph: bodies come apart, and what is uncertain stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scenes import (
    CAMERA,
    SIDEWAYS,
    scene,
)

from dynslam_bench.contracts.filter import FilterState
from dynslam_bench.culling.correlation_graph import CorrelationFilter, depth_variance, point_covariance
from dynslam_bench.culling.ego_motion import depth_sigma
from dynslam_bench.culling.settings import CorrelationSettings
from dynslam_bench.geometry import se3
from dynslam_bench.trackers import TRACKERS


def test_correlation_separates_the_moving_body() -> None:
    block = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5))
    for motion, expected in ((np.array([0.15, 0.1, 0.0]), True), (None, False)):
        made = scene(SIDEWAYS, motion=motion)
        block.reset(CAMERA)
        start = FilterState(camera=CAMERA, keep=made.state.keep, T_world_pred=np.eye(4))
        block.apply(made.state.previous, start)
        verdict = block.apply(made.frame, made.state)
        dropped = ~verdict.keep
        if expected:
            assert dropped[made.moving].mean() > 0.9 and dropped[~made.moving].mean() < 0.05
        else:
            assert dropped.mean() < 0.02


def test_correlation_judges_points_that_were_no_keypoint_before() -> None:
    made = scene(se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005])), motion=np.array([0.15, 0.1, 0.0]))
    before = made.state.previous
    missed = np.arange(len(before)) % 2 == 0  # the detector found every other point only now
    found = np.flatnonzero(~missed)
    made.state.previous = replace(
        before, keypoints=before.keypoints.select(found), xy=before.xy[found], z=before.z[found]
    )
    made.state.previous_keep = np.ones(len(found), bool)
    block = CorrelationFilter(CorrelationSettings(window=1, pixel_sigma=0.5))
    block.apply(made.state.previous, FilterState(CAMERA, np.ones(len(found), bool), T_world_pred=np.eye(4)))
    verdict = block.apply(made.frame, made.state)
    assert verdict.stats["tracked"] > 0.9 * len(made.frame)
    dropped = ~verdict.keep
    assert dropped[made.moving & missed].mean() > 0.9 and dropped[~made.moving & missed].mean() < 0.05
    assert TRACKERS.get("dai-slam").provenance == "inspired" and not TRACKERS.get("dai-slam").ranked


def test_depth_edges_are_uncertain_and_covariance_is_that_of_the_unprojection() -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 3.0
    flat, edge, hole = depth_variance(depth, np.array([[100.0, 100], [319, 100], [500, 200]]))
    np.testing.assert_allclose(flat, float(depth_sigma(np.array([2.0]))[0]) ** 2)
    assert edge > 0.18  # a quarter of the weight lies one metre further
    np.testing.assert_allclose(hole, float(depth_sigma(np.array([3.0]))[0]) ** 2)
    rng = np.random.default_rng(0)
    xy, z = np.array([[500.0, 100.0]]), np.array([2.5])
    covariance = point_covariance(xy, z, np.array([0.02**2]), CAMERA, 0.8)[0]
    noisy = CAMERA.unproject(xy + rng.normal(0, 0.8, (200_000, 2)), z + rng.normal(0, 0.02, 200_000))
    np.testing.assert_allclose(covariance, np.cov(noisy.T), atol=4e-6)
