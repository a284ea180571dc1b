"""Rigid motion in 3-D sees what the epipolar test cannot."""

from __future__ import annotations

import numpy as np
from scenes import (
    ACROSS,
    CAMERA,
    ROTATION,
    Scene,
    scene,
)

from dynslam_bench.culling.ego_motion import refine_prediction
from dynslam_bench.culling.rigid_motion import RigidMotionFilter
from dynslam_bench.culling.settings import RigidMotionSettings
from dynslam_bench.geometry import se3


def test_motion_sees_what_moves_along_epipolar_lines_and_under_rotation() -> None:
    forward = se3.exp(np.array([0, 0, 0.05, 0, 0, 0]))
    for camera_motion, motion in ((forward, np.array([0, 0, -0.1])), (ROTATION, ACROSS), (np.eye(4), ACROSS)):
        made = scene(camera_motion, motion=motion)
        verdict = RigidMotionFilter(RigidMotionSettings(min_share=0.0)).apply(made.frame, made.state)
        np.testing.assert_array_equal(verdict.keep, ~made.moving)
        still = scene(camera_motion)
        assert RigidMotionFilter(RigidMotionSettings()).apply(still.frame, still.state).keep.all()


def far_wall_and_walker(walk: np.ndarray, n_static: int, n_moving: int) -> Scene:
    """A camera at rest, a wall 3 m away, of one depth within the sensor's noise, and a person at 1 m who walks."""
    T_prev_cur = np.eye(4)
    made = scene(T_prev_cur, n_static=n_static, n_moving=n_moving, seed=3)
    rng = np.random.default_rng(3)
    z = np.where(made.moving, rng.uniform(0.9, 1.1, len(made.frame)), rng.uniform(2.9, 3.1, len(made.frame)))
    made.frame.z[:] = z
    assert made.state.previous is not None and made.state.flow is not None
    made.state.previous.depth[:] = 0.0  # the flow alone has to tell
    before = se3.transform(T_prev_cur, CAMERA.unproject(made.frame.xy, z))
    before[made.moving] -= walk
    made.state.flow.xy[:] = CAMERA.project(before) + rng.normal(0, 0.3, (len(z), 2))
    return made


WALK = np.array([0.03, 0.0, 0.0])
"""1 m/s at 30 Hz."""


SURE = np.diag([2.5e-3**2] * 3 + [0.012**2] * 3)
"""What the back end's motion model leaves open once it knows the camera's speed."""


def test_a_walker_before_a_far_wall_does_not_drag_the_camera_along() -> None:
    made = far_wall_and_walker(WALK, 250, 120)
    made.state.T_world_pred = refined = refine_prediction(made.frame, made.state)  # the speed is not known
    assert refined is not None and np.linalg.norm(refined[:3, 3]) < 4e-3
    verdict = RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~made.moving].mean() > 0.97


def test_a_moving_majority_drags_the_camera_along_unless_its_speed_is_known() -> None:
    made = far_wall_and_walker(WALK, 100, 600)
    assert made.moving.mean() > 0.6
    free = refine_prediction(made.frame, made.state)
    made.state.motion_covariance = SURE
    held = refine_prediction(made.frame, made.state)
    assert free is not None and np.linalg.norm(free[:3, 3]) > 0.02
    assert held is not None and np.linalg.norm(held[:3, 3]) < 4e-3
    made.state.T_world_pred = held
    verdict = RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state)
    assert not verdict.keep[made.moving].any() and verdict.keep[~made.moving].mean() > 0.97


def test_the_motion_model_does_not_hold_back_a_camera_that_really_accelerates() -> None:
    jerk = se3.exp(np.array([0.004, -0.003, 0.002, 0.01, -0.02, 0.005]))
    made = scene(jerk)
    made.state.T_world_pred = np.eye(4)
    made.state.motion_covariance = SURE
    held = refine_prediction(made.frame, made.state)
    assert held is not None
    assert se3.rotation_angle(se3.inverse(jerk) @ held) < 3e-3 < se3.rotation_angle(jerk) / 5
    made.state.T_world_pred = held
    assert RigidMotionFilter(RigidMotionSettings()).apply(made.frame, made.state).keep.all()
