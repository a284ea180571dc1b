"""Covariances of the camera's motion from frame to frame, and the file that holds them.

Over several frames the errors are taken for independent. An error before a motion ``T`` becomes
``Ad(T^-1) xi`` behind it, so that ``C_ik = Ad(T_jk^-1) C_ij Ad(T_jk^-1)^T + C_jk``, with
``Ad(T) = [[R, [t] R], [0, R]]`` (Barfoot, State Estimation for Robotics, 2017, Section 7.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import TrajectoryError, write_atomic
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.se3 import Array
from dynslam_bench.geometry.stamp_units import UNITS
from dynslam_bench.geometry.stamps import (
    LEAST_GAP_NS,
    NS_PER_S,
    format_ns,
    from_seconds,
    nearest_gap,
)
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_table

SYMMETRY = 1e-5
"""Largest difference of a matrix of correlations from its transpose; files have six digits."""
POSITIVE = 1e-9
"""Least eigenvalue of a matrix of correlations; a smaller one is zero or negative by rounding."""
LEAST_SHARE = 0.5
"""A file of which a smaller share of the stamps belongs to poses is that of another trajectory."""

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


def at_poses(
    covariances: MotionCovariances, trajectory: Trajectory, file: str
) -> MotionCovariances:
    """The covariances of a file at the stamps of a trajectory's poses; those of no pose are left out.

    The file's stamps may be in another unit than seconds: that in which most of them belong to poses.

    Args:
        covariances: The covariances as they were read.
        trajectory: The poses.
        file: Name of the file, for the message.

    Raises:
        TrajectoryError: Fewer than half of the stamps belong to a pose.
    """
    # stamps in seconds by the unit in which most of them are those of poses
    poses = trajectory.timestamps
    by_unit = [covariances.timestamps / unit.per_s for unit in UNITS]
    tolerance_s = LEAST_GAP_NS / NS_PER_S
    shared = [int((nearest_gap(stamps, poses) < tolerance_s).sum()) for stamps in by_unit]
    stamps = by_unit[int(np.argmax(shared))]
    if max(shared) < LEAST_SHARE * len(covariances):
        raise TrajectoryError(
            f"{max(shared)} of {len(covariances)} stamps of {file} belong to a pose of the trajectory",
            "give the covariances of this trajectory, with the stamps of its poses",
        )

    # the nearest pose's own stamp: between two poses rows grow in proportion to time
    rows = np.interp(stamps, poses, np.arange(len(poses)))
    nearest = np.rint(rows).astype(np.intp)
    belongs = np.abs(poses[nearest] - stamps) < tolerance_s
    return MotionCovariances(poses[nearest[belongs]], covariances.matrices[belongs])


def between_poses(trajectory: Trajectory, covariances: MotionCovariances) -> Array:
    """The covariance of the motion to each pose but the first, ``[N - 1, 6, 6]``; NaN where none was given."""
    matrices = np.full((max(len(trajectory) - 1, 0), 6, 6), np.nan)
    stamps = from_seconds(trajectory.timestamps.tolist()).tolist()
    rows = {stamp: row for row, stamp in enumerate(stamps)}
    given = from_seconds(covariances.timestamps.tolist()).tolist()
    for stamp, matrix in zip(given, covariances.matrices, strict=True):
        row = rows.get(stamp, 0)
        if row > 0:
            matrices[row - 1] = matrix
    return matrices


class CovarianceChecks(NamedTuple):
    """Flags ``[M]`` of covariances.

    Attributes:
        finite: Whether all numbers are.
        positive: Whether they are finite, and the matrix of correlations is positive definite.
        symmetric: Whether the matrix of correlations is symmetric; true where there is none.
    """

    finite: NDArray[np.bool_]
    positive: NDArray[np.bool_]
    symmetric: NDArray[np.bool_]


def check_covariances(matrices: Array) -> CovarianceChecks:
    """Check covariances ``[M, 6, 6]`` by their correlations, whatever the units."""
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], matrices, np.eye(6))
    diagonal = np.diagonal(safe, axis1=1, axis2=2)
    with_variances = finite & (diagonal > 0).all(axis=1)
    safe = np.where(with_variances[:, None, None], safe, np.eye(6))

    # symmetry
    deviations = np.sqrt(np.diagonal(safe, axis1=1, axis2=2))
    correlations = safe / (deviations[:, :, None] * deviations[:, None, :])
    asymmetry = np.abs(correlations - np.swapaxes(correlations, 1, 2)).max(axis=(1, 2), initial=0)
    symmetric: NDArray[np.bool_] = np.asarray(asymmetry <= SYMMETRY)

    # eigenvalues; NaN and infinite correlations come of variances that no float holds
    halves = 0.5 * (correlations + np.swapaxes(correlations, 1, 2))
    finite_halves = np.isfinite(halves).all(axis=(1, 2))
    halves = np.where(finite_halves[:, None, None], halves, -np.eye(6))
    positive = with_variances & (np.linalg.eigvalsh(halves)[:, 0] > POSITIVE)
    return CovarianceChecks(finite, positive, symmetric)


def adjoint(pose: Array) -> Array:
    """Adjoints ``[..., 6, 6]`` of poses ``[..., 4, 4]``: ``T Exp(xi) T^-1 = Exp(Ad(T) xi)``, translation first."""
    rotation = pose[..., :3, :3]
    result = np.zeros((*pose.shape[:-2], 6, 6))
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = se3.hat(pose[..., :3, 3]) @ rotation
    return result


def compose_covariances(poses: Array, matrices: Array, pairs: NDArray[np.intp]) -> Array:
    """Covariances ``[P, 6, 6]`` of the motions of pairs of poses, those from pose to pose being independent.

    Args:
        poses: Camera to world ``[N, 4, 4]``.
        matrices: Covariances of the motions to each pose but the first ``[N - 1, 6, 6]``.
        pairs: Indices of an earlier and a later pose ``[P, 2]``.
    """
    total = np.zeros((len(pairs), 6, 6))
    if not len(pairs):
        return total
    for step in range(int((pairs[:, 1] - pairs[:, 0]).max())):
        at = pairs[:, 0] + step
        active = at < pairs[:, 1]
        at = at[active]
        # transport what there is behind the next motion, and add its covariance
        back = adjoint(se3.inverse(se3.between(poses, np.stack([at, at + 1], axis=1))))
        total[active] = back @ total[active] @ np.swapaxes(back, -1, -2) + matrices[at]
    return total
