"""Trajectory files of the KITTI odometry benchmark: the 3x4 matrix ``[R|t]`` in row order, twelve numbers a line.

The files carry no stamps; they come from a ``times.txt`` (one stamp a line) or, without one, from the frame rate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.core.files import write_atomic

from . import se3
from .stamps import format_ns, to_seconds
from .trajectory import Trajectory
from .tum_file import read_stamped_table, read_table

_MEANING = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"


def read_kitti(
    path: str | Path,
    times: str | Path | NDArray[np.float64] | None = None,
    *,
    fps: float = 10.0,
    described: str = "",
) -> Trajectory:
    """Read a KITTI pose file.

    Args:
        path: The poses.
        times: Stamps in seconds ``[N]``, or a file of them, one a line; None for ``i / fps``.
        fps: Frame rate in Hz where there is no `times` (KITTI's is 10).
        described: Where stamps that are no file come from, for messages.

    Returns:
        Camera-to-world poses; rotations are made orthonormal exactly (files hold about seven digits).

    Raises:
        TrajectoryError: A file cannot be read, a line is malformed or no rigid pose, or the stamps do not fit.
    """
    path = Path(path)
    rows = read_table(path, 12, _MEANING)
    poses = np.zeros((len(rows), 4, 4))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    poses[:, 3, 3] = 1.0
    for index, pose in enumerate(poses):
        if not se3.is_pose(pose, tolerance=1e-3):
            raise TrajectoryError(f"{path}: pose {index} of {len(poses)} is no rigid transformation", _MEANING)
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    exact = None
    if times is None:
        if not (np.isfinite(fps) and fps > 0):
            raise TrajectoryError(f"the frame rate is {fps!r}, not a positive number of Hz")
        stamps = np.arange(len(poses)) / fps
    else:
        named = described or (str(times) if isinstance(times, (str, Path)) else "the list")
        if isinstance(times, (str, Path)):
            exact = read_stamped_table(Path(times), 1, "timestamp")[1]
            stamps = to_seconds(exact)
        else:
            stamps = times
        if len(stamps) != len(poses):
            raise TrajectoryError(f"{path} has {len(poses)} poses but {named} has {len(stamps)} stamps")
    return Trajectory(stamps, poses, exact)


def write_kitti(path: str | Path, trajectory: Trajectory, times: str | Path | None = None) -> None:
    """Write poses in KITTI's format and, if `times` is given, their stamps beside them (nine decimals).

    Raises:
        DynslamError: A file cannot be written.
    """
    rows = trajectory.T_world_cam[:, :3].reshape(-1, 12).tolist()
    write_atomic(Path(path), "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows))
    if times is not None:
        write_atomic(Path(times), "".join(f"{format_ns(ns)}\n" for ns in trajectory.timestamps_ns.tolist()))
