"""Moving an estimate onto the ground truth before absolute errors are taken."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.geometry import se3

from .conditioning import RELIABLE_DEG, rotation_uncertainty_deg
from .protocol import Alignment

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Similarity:
    """``p_gt = scale * R p_est + t``.

    Attributes:
        rotation: ``[3, 3]``.
        translation: Metres ``[3]``.
        scale: Factor applied to the estimate's positions first.
        degenerate: Whether the positions did not determine the rotation (no motion, or motion on a line); it then
            follows from the orientations, which leaves translational errors at their minimum all the same. Of a
            camera that does not move the scale is 1.
        fitted: Positions of the estimate and of the truth ``[N, 3]`` in metres that alone determined the rotation; None
            where they did not.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0
    degenerate: bool = False
    fitted: tuple[Array, Array] | None = None

    @cached_property
    def uncertainty_deg(self) -> float | None:
        """Standard error of the rotation, see `conditioning`; None where it does not come from enough positions."""
        return None if self.fitted is None else rotation_uncertainty_deg(*self.fitted, self.rotation)

    @property
    def rotation_reliable(self) -> bool:
        """Whether absolute rotational errors under this alignment are errors of the estimate."""
        return self.uncertainty_deg is None or self.uncertainty_deg <= RELIABLE_DEG

    def apply(self, poses: Array) -> Array:
        """Poses ``[N, 4, 4]`` moved; rotations stay rotations."""
        moved = poses.copy()
        moved[:, :3, :3] = self.rotation @ poses[:, :3, :3]
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] @ self.rotation.T + self.translation
        return moved


def align(estimate: Array, ground_truth: Array, mode: Alignment) -> Similarity:
    """The transformation that moves an estimate onto the ground truth.

    Args:
        estimate: Associated camera-to-world poses ``[N, 4, 4]``.
        ground_truth: Their counterparts ``[N, 4, 4]``.
        mode: See `Protocol.alignment`.

    Returns:
        For ``se3`` and ``sim3`` the least-squares solution over the positions (Umeyama 1991, Eq. 39-43).

    Raises:
        EvaluationError: There are no poses.
    """
    if not len(estimate):
        raise EvaluationError("there are no associated poses to align")
    if mode == "none":
        return Similarity(np.eye(3), np.zeros(3))
    if mode == "origin":
        moved = ground_truth[0] @ se3.inverse(estimate[0])
        return Similarity(moved[:3, :3].copy(), moved[:3, 3].copy())
    source, target = estimate[:, :3, 3], ground_truth[:, :3, 3]
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - centre_target).T @ (source - centre_source) / len(source)
    # how far the estimate's orientations are turned, summed: decides only what the positions leave open
    orientation = np.tensordot(ground_truth[:, :3, :3], estimate[:, :3, :3], axes=((0, 2), (0, 2))) / len(source)
    if mode == "yaw":
        rotation, degenerate = _yaw(covariance, orientation)
        return Similarity(rotation, centre_target - rotation @ centre_source, 1.0, degenerate)
    rotation, weighted, degenerate = _nearest_rotation(covariance, orientation)
    scale = 1.0
    if mode == "sim3":
        variance = float(((source - centre_source) ** 2).sum() / len(source))
        moves = variance > np.finfo(float).eps * max(1.0, float((source**2).max()))
        scale = weighted / variance if moves else 1.0  # without motion every scale gives the same positions
    fitted = None if degenerate else (source, target)
    return Similarity(rotation, centre_target - scale * rotation @ centre_source, scale, degenerate, fitted)


def _nearest_rotation(covariance: Array, orientation: Array) -> tuple[Array, float, bool]:
    """Rotation that maximises ``tr(R^T C)``, the maximum, and whether C alone does not determine it."""
    u, singular, vt = np.linalg.svd(covariance)
    degenerate = bool(singular[1] <= 1e-12 * max(singular[0], 1e-12))
    if degenerate:
        u, _, vt = np.linalg.svd(covariance + 1e-7 * max(singular[0], 1e-12) * orientation)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    return rotation, float(np.trace(rotation.T @ covariance)), degenerate


def _yaw(covariance: Array, orientation: Array) -> tuple[Array, bool]:
    """Rotation about z that maximises ``tr(R^T C)``."""
    degenerate = np.hypot(covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]) < 1e-15
    matrix = orientation if degenerate else covariance
    angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), bool(degenerate)
