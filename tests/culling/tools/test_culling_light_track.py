"""The low-cost pose before the geometric test."""

from __future__ import annotations

import numpy as np
from scenes import (
    ACROSS,
    SIDEWAYS,
    scene,
)

from dynslam_bench.culling.multiview_depth import refine_by_matches
from dynslam_bench.geometry import se3


def test_light_tracking_refines_a_poor_prediction_by_its_matches() -> None:
    made = scene(SIDEWAYS, motion=ACROSS)
    count = len(made.frame)
    words = np.random.default_rng(3).integers(0, 255, (count, 32), dtype=np.uint8)
    for each in (made.frame, made.state.previous):
        each.keypoints = type(each.keypoints)(
            each.keypoints.xy, each.keypoints.octave, each.keypoints.angle, each.keypoints.response, words
        )
    made.state.flow = None
    made.state.T_world_pred = SIDEWAYS @ se3.exp(np.array([0.01, -0.01, 0.01, 0.005, 0.005, 0.0]))
    made.state.keep = ~made.moving
    found = refine_by_matches(made.frame, made.state)
    wrong, right = (se3.inverse(SIDEWAYS) @ pose for pose in (made.state.T_world_pred, found))
    assert np.linalg.norm(right[:3, 3]) < 0.2 * np.linalg.norm(wrong[:3, 3])
    made.state.keep = np.zeros(count, bool)
    np.testing.assert_array_equal(refine_by_matches(made.frame, made.state), made.state.T_world_pred)
    made.state.previous = None
    np.testing.assert_array_equal(refine_by_matches(made.frame, made.state), made.state.T_world_pred)
