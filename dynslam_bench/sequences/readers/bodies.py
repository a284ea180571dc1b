"""Ground truth of a body that carries the camera, turned into the camera's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.stamps import refuse_close, to_seconds
from dynslam_bench.geometry.trajectory import Trajectory

from .yaml_numbers import numbers

Array = NDArray[np.float64]


def camera_on_body(value: object, where: str) -> Array:
    """The camera's pose on the body, ``T_BS`` of EuRoC's files, ``[4, 4]``; the identity where it is not stated.

    Raises:
        SequenceError: It is no rigid transformation.
    """
    if value is None:
        return np.eye(4)
    pose = np.array(numbers(value, 16, f"{where}: T_BS")).reshape(4, 4)
    if not se3.is_pose(pose, tolerance=1e-3):
        raise SequenceError(f"{where}: T_BS is no rigid transformation")
    return pose


def camera_truth(stamps: NDArray[np.int64], rows: Array, T_body_cam: Array, where: str) -> Trajectory | None:
    """Camera-to-world poses of the body's, rows ``tx ty tz qx qy qz qw`` ``[N, 7]`` at stamps in nanoseconds ``[N]``.

    Rows without a rotation are left out, of several with one stamp the last holds; None where nothing is left.

    Raises:
        SequenceError: Two stamps of `where` differ by less than 1 us.
    """
    order = np.argsort(stamps, kind="stable")
    stamps, rows = stamps[order], rows[order]
    refuse_close(stamps, where, SequenceError)
    keep = np.append(np.diff(stamps) > 0, True) & (np.linalg.norm(rows[:, 3:], axis=1) > 1e-8)
    if not keep.any():
        return None
    poses = se3.from_quaternion(rows[keep, :3], rows[keep, 3:]) @ T_body_cam
    return Trajectory(to_seconds(stamps[keep]), poses, stamps[keep])
