"""TartanAir-Shibuya: ``image_0``, ``depth_0`` (arrays of metres), ``times.txt`` and ``gt_pose.txt`` in NED axes.

Poses are those of a camera that looks along x, with y to the right and z down; the optical axes (z forward) follow from
a permutation. The sky is rendered at thousands of metres and is no measurement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import SequenceError, TrajectoryError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_stamps, read_table
from dynslam_bench.sequences.readers.lists import Contents, find_names, stamped

FOCAL = 772.5483399593904
CAMERA = Camera(640, 360, FOCAL, FOCAL, 320.0, 180.0, depth_factor=1.0, baseline_m=0.25)
SKY_M = 1000.0
T_NED_CAM = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From optical axes (x right, y down, z forward) to NED axes (x forward, y right, z down)."""


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of TartanAir-Shibuya.

    Args:
        folder: The sequence's folder, ``RoadCrossing07`` for example.
        fps: Nominal frame rate in Hz; from the stamps where not given.

    Raises:
        SequenceError: Images, depth, stamps and poses are not equal in number, or missing.
        TrajectoryError: The stamps or poses are malformed.
    """
    colour, depth = find_names(folder, "image_0/*.[pj][np]g"), find_names(folder, "depth_0/*.npy")
    stamps = read_stamps(folder / "times.txt")
    try:
        rows = read_table(folder / "gt_pose.txt", 8, "timestamp tx ty tz qx qy qz qw")[:, 1:]
    except TrajectoryError:
        rows = read_table(folder / "gt_pose.txt", 7, "tx ty tz qx qy qz qw")
    if not len(colour) == len(depth) == len(stamps) == len(rows):
        raise SequenceError(
            f"{folder} holds {len(colour)} colour images, {len(depth)} depth arrays, {len(stamps)} stamps and "
            f"{len(rows)} poses, expected as many of each"
        )
    if not np.isfinite(rows).all() or (np.linalg.norm(rows[:, 3:], axis=1) < 1e-8).any():
        raise SequenceError(f"{folder / 'gt_pose.txt'} holds a pose that is none")
    images, arrays = stamped(colour, stamps, str(folder)), stamped(depth, stamps, str(folder))
    order = np.argsort(stamps, kind="stable")
    poses = se3.from_quaternion(rows[order, :3], rows[order, 3:]) @ T_NED_CAM
    truth = Trajectory(images.stamps, poses, images.stamps_ns)
    return Contents(images, arrays, True, truth, camera=CAMERA, fps=fps, furthest_m=SKY_M)
