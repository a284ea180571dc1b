"""Covariances of the camera's motion from frame to frame, and the file that holds them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynslam_bench.core import TrajectoryError, write_atomic
from dynslam_bench.geometry.se3 import Array
from dynslam_bench.geometry.stamps import format_ns, from_seconds
from dynslam_bench.geometry.trajectory_files import read_table

HEADING = (
    "# timestamp, then the covariance of T_prev_cur (6x6, row by row): right perturbation,\n"
    "# translation (m) before rotation (rad); prev is the last frame before it that has a pose\n"
)


@dataclass(frozen=True, eq=False)
class MotionCovariances:
    """Covariances of the motions ``T_prev_cur`` to frames from the last frame before each that has a pose.

    A covariance is that of the twist ``xi`` = (translation in metres, rotation in radians) in
    ``T_true = T_estimated Exp(xi)``. Nothing is promised of the numbers: they are what a tracker gave.

    Attributes:
        timestamps: Stamps of the frames in seconds, float64 ``[N]``.
        matrices: float64 ``[N, 6, 6]``.
    """

    timestamps: Array
    matrices: Array

    def __len__(self) -> int:
        return len(self.timestamps)


def write_motion_covariances(path: Path, covariances: MotionCovariances) -> None:
    """Write covariances, one frame a line: the stamp and 36 numbers."""
    lines = [HEADING]
    stamps = from_seconds(covariances.timestamps.tolist()).tolist()
    for stamp, matrix in zip(stamps, covariances.matrices, strict=True):
        numbers = " ".join(f"{value:.6g}" for value in matrix.ravel().tolist())
        lines.append(f"{format_ns(stamp)} {numbers}\n")
    write_atomic(path, "".join(lines))


def read_motion_covariances(path: str | Path) -> MotionCovariances:
    """Read what `write_motion_covariances` writes; the numbers may be NaN or infinite.

    Raises:
        TrajectoryError: The file is missing, or a line has not 37 numbers.
    """
    table = read_table(Path(path).expanduser(), 37, "the stamp and 36 numbers of a covariance")
    if not np.isfinite(table[:, 0]).all():
        raise TrajectoryError(f"{path}: a stamp is not finite")
    return MotionCovariances(table[:, 0].copy(), table[:, 1:].reshape(-1, 6, 6))
