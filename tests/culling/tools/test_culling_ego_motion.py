"""The camera's motion from the flow, however much moves."""

from __future__ import annotations

import numpy as np
from scenes import (
    ACROSS,
    SIDEWAYS,
    scene,
)

from dynslam_bench.culling.ego_motion import refine_prediction
from dynslam_bench.geometry import se3


def test_ego_motion_resists_a_large_moving_object() -> None:
    made = scene(SIDEWAYS, n_static=200, n_moving=180, motion=ACROSS)
    made.state.T_world_pred = se3.exp(np.array([0.05, 0.02, 0.03, 0.01, -0.008, 0.005]))
    refined = refine_prediction(made.frame, made.state)
    assert refined is not None
    error = se3.inverse(SIDEWAYS) @ refined
    assert np.linalg.norm(error[:3, 3]) < 2e-3 and se3.rotation_angle(error) < 1e-3
