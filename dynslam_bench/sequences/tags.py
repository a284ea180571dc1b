"""Tags of a sequence's difficulty: how much of its scene moves, and how its camera moves."""

from typing import Any, Literal

import numpy as np

from dynslam_bench.geometry import Trajectory, se3

Tag = Literal["static", "low-dynamic", "high-dynamic", "unknown-objects"]
"""Motion in a scene: nothing, people who stay where they are, people who walk, things that are no people."""
# mean speeds from which a camera counts as fast; TUM's fr1/desk has 0.4 m/s and 23 deg/s, fr1/rpy 0.06
# and 50
FAST_M_S = 1.0
"""Metres a second."""
FAST_DEG_S = 40.0
"""Degrees a second."""
STEP_S = 0.1
"""Time over which speeds are taken, so that the noise of a motion capture system does not count as motion."""
LOOP_PATH_M = 10.0
"""Length of a loop's path, at least."""
LOOP_EXTENT_M = 2.0
"""Largest distance between two places of a path with a loop, at least."""
LOOP_GAP_M = 1.0
"""Distance between the ends of a loop, at most."""
MOST_POSES = 500
"""Poses among which loops are looked for, at most: every pair of them is compared."""
FIXED_CAMERA = "fixed-camera"
"""Tag of a sequence whose camera stands still: not moving is right there, and a static camera's error is zero."""


def sequence_tags(sequence: Any) -> list[str]:
    """Tags of a sequence or a part of one: those it brings, and those of the camera's motion from its ground truth."""
    truth: Trajectory | None = sequence.ground_truth
    if truth is not None:
        times = sequence.timestamps
        truth = truth.select((truth.timestamps >= times[0]) & (truth.timestamps <= times[-1]))
    motion = set() if truth is None or len(truth) < 2 else motion_tags(truth)
    return sorted({*getattr(sequence, "tags", ()), *motion})


def motion_tags(truth: Trajectory) -> set[str]:
    """``fast``, ``loop`` or ``fixed-camera``, as far as they hold for the truth of a camera of two poses or more."""
    if se3.is_static(truth.T_world_cam):
        return {FIXED_CAMERA}
    times = truth.timestamps
    # the first pose of each step of time: work by poses, however long the holes between them are
    # (as the floats of Unix time resolve the step)
    step_s = (times[0] + STEP_S) - times[0]
    step_number = np.floor((times - times[0]) / step_s)
    is_first = np.append(True, np.diff(step_number) > 0)
    index = np.unique(np.append(np.flatnonzero(is_first), len(times) - 1))
    poses = truth.T_world_cam[index]

    # mean speeds, by distances and rotations between these poses
    duration_s = times[-1] - times[0]
    motions = se3.inverse(poses[:-1]) @ poses[1:]
    steps_m = np.linalg.norm(motions[:, :3, 3], axis=1)
    turned_deg = np.degrees(se3.rotation_angle(motions))
    fast = steps_m.sum() >= FAST_M_S * duration_s or turned_deg.sum() >= FAST_DEG_S * duration_s

    # a loop: two places close to each other that are far apart along the path
    some = np.linspace(0, len(index) - 1, min(len(index), MOST_POSES)).astype(int)
    path_m = np.concatenate([[0.0], steps_m.cumsum()])[some]
    positions = poses[some, :3, 3]
    apart_m = np.linalg.norm(positions[:, None] - positions, axis=2)
    closes = (apart_m <= LOOP_GAP_M) & (path_m - path_m[:, None] >= LOOP_PATH_M)
    loop = apart_m.max() >= LOOP_EXTENT_M and closes.any()
    tags = set()
    if fast:
        tags.add("fast")
    if loop:
        tags.add("loop")
    return tags
