"""Moving an estimate onto the ground truth before absolute errors are taken."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dynslam_bench.core import EvaluationError
from dynslam_bench.core.number_text import mm
from dynslam_bench.evaluation.protocol import Alignment
from dynslam_bench.geometry import Array, se3


@dataclass(frozen=True, eq=False)
class Similarity:
    """``p_gt = scale * R p_est + t``.

    Attributes:
        rotation: ``[3, 3]``.
        translation: Metres ``[3]``.
        scale: Factor applied to the estimate's positions first.
        degenerate: Whether the positions did not determine the rotation (no motion, or motion on a
            line); it then follows from the orientations, which leaves translational errors at their
            minimum all the same. Of a camera that does not move the scale is 1.
        fitted: Positions of the estimate and of the truth ``[N, 3]`` in metres that alone
            determined the rotation; None where they did not.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0
    degenerate: bool = False
    fitted: tuple[Array, Array] | None = None

    @cached_property
    def uncertainty_deg(self) -> float | None:
        """Standard error of the rotation, see `rotation_uncertainty_deg`; None where too few positions determine it."""
        if self.fitted is None:
            return None
        return rotation_uncertainty_deg(*self.fitted, self.rotation)

    def doubts(self, truth: Array) -> list[str]:
        """Why absolute rotational errors under this alignment may not be errors of the estimate, a line each.

        Args:
            truth: True poses that the estimate was aligned with ``[N, 4, 4]``.
        """
        if self.degenerate:
            return [
                "the estimated positions do not determine a rotation; it was taken from the orientations"
            ]
        if self.uncertainty_deg is None or self.uncertainty_deg <= RELIABLE_DEG:
            return []
        positions = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
        along, *across = np.linalg.svd(positions, compute_uv=False) / np.sqrt(len(positions))
        return [
            f"the path (spread {mm(along)} mm along, {mm(across[0])} and {mm(across[1])} mm across) hardly determines "
            f"the alignment's rotation with such errors: +-{self.uncertainty_deg:.0f} degrees; the absolute rotational "
            "error (ape_rot) is unreliable, the translational and the relative ones are not affected"
        ]

    def apply(self, poses: Array) -> Array:
        """Poses ``[N, 4, 4]`` moved; rotations stay rotations."""
        moved = se3.with_rotation(poses, self.rotation @ poses[:, :3, :3])
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] @ self.rotation.T + self.translation
        return moved


def align(estimate: Array, ground_truth: Array, mode: Alignment) -> Similarity:
    """The transformation that moves an estimate onto the ground truth.

    Args:
        estimate: Associated camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``, one for each row of `estimate`.
        mode: See `Protocol.alignment`.

    Returns:
        For ``se3`` and ``sim3`` the least-squares solution over the positions (Umeyama 1991, Eq.
        39-43).

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
    source = estimate[:, :3, 3]
    target = ground_truth[:, :3, 3]

    # positions about their centres, in units of their own sizes: so neither coordinates of a map
    # nor the unit matter
    centre_source, unit_source, size_source = _centred(source)
    centre_target, unit_target, size_target = _centred(target)
    covariance = unit_target.T @ unit_source / len(source)

    # how far the estimate's orientations are turned, summed; they decide only what positions on a
    # line leave open
    orientation = np.tensordot(
        ground_truth[:, :3, :3], estimate[:, :3, :3], axes=((0, 2), (0, 2))
    ) / len(source)

    # rotation, then scale; the translation moves centre onto centre (Umeyama, Eq. 40-42)
    if mode == "yaw":
        rotation, degenerate = _yaw(covariance, orientation)
        return Similarity(rotation, centre_target - rotation @ centre_source, 1.0, degenerate)
    rotation, weighted, degenerate = _nearest_rotation(covariance, orientation)
    scale = 1.0
    # without motion every scale gives the same positions
    if mode == "sim3" and size_source > 0:
        variance = float((unit_source**2).sum() / len(source))
        scale = weighted / variance * (size_target / size_source)
    fitted = None if degenerate else (source, target)
    return Similarity(
        rotation, centre_target - scale * rotation @ centre_source, scale, degenerate, fitted
    )


def _centred(positions: Array) -> tuple[Array, Array, float]:
    """Positions about their centre, divided by their size.

    Args:
        positions: ``[N, 3]``.

    Returns:
        The centre ``[3]``, the positions about it in units of their size ``[N, 3]``, and the size,
        the largest of their coordinates: 0, with zeros, where they differ by no more than the
        rounding of their coordinates.
    """
    # first about one of them: means of large coordinates lose digits
    apart = positions - positions[0]
    mean = apart.mean(axis=0)
    centre = positions[0] + mean
    apart = apart - mean
    size = float(np.abs(apart).max())
    rounding = _ROUNDING * float(np.abs(positions).max())
    if size <= rounding:
        return centre, np.zeros_like(apart), 0.0
    return centre, apart / size, size


_ROUNDING = 8 * float(np.finfo(np.float64).eps)
"""Share of a coordinate that the rounding of differences may make up."""
_ON_A_LINE = 1e-12
"""Share of the first singular value below which the second one says that the positions lie on a line."""


def _nearest_rotation(covariance: Array, orientation: Array) -> tuple[Array, float, bool]:
    """Rotation R ``[3, 3]`` that maximises ``tr(R^T C)``, the maximum, and whether C alone does not determine it.

    Args:
        covariance: C ``[3, 3]``, of the true positions with the estimated ones, without units.
        orientation: Mean of true times inverse estimated orientations ``[3, 3]``.
    """
    # where the positions lie on a line or in a point, the orientations decide what is left open
    u, singular, vt = np.linalg.svd(covariance)
    degenerate = bool(singular[1] <= _ON_A_LINE * singular[0])
    if degenerate:
        weight = 1e-7 * singular[0] if singular[0] > 0 else 1.0
        u, _, vt = np.linalg.svd(covariance + weight * orientation)
    # a rotation, not a reflection
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    return rotation, float(np.trace(rotation.T @ covariance)), degenerate


def _yaw(covariance: Array, orientation: Array) -> tuple[Array, bool]:
    """Rotation about z that maximises ``tr(R^T C)``, and whether C alone does not determine it.

    Args:
        covariance: C ``[3, 3]``, of the true positions with the estimated ones, without units.
        orientation: Mean of true times inverse estimated orientations ``[3, 3]``, which decides
            where C does not.
    """
    # tr(R^T C) = cos(angle) (C_xx + C_yy) + sin(angle) (C_yx - C_xy) + C_zz
    degenerate = (
        np.hypot(covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]) < 1e-15
    )
    matrix = orientation if degenerate else covariance
    angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), bool(degenerate)


# How well the positions determine the rotation of an alignment: the same fit on halves of the path.


BLOCKS = 12
"""Blocks of the path, of which each half takes six."""
RELIABLE_DEG = 10.0
"""With a larger uncertainty of the alignment's rotation, absolute rotational errors say nothing of the tracker."""
_GENERATOR = np.array([1, 1, -1, 1, 1, 1, -1, -1, -1, 1, -1])
_DESIGN = np.array([np.append(np.roll(_GENERATOR, shift), -1) for shift in range(len(_GENERATOR))])
_HALVES = (np.vstack([_DESIGN, -_DESIGN]) > 0).astype(np.float64)


def rotation_uncertainty_deg(source: Array, target: Array, rotation: Array) -> float | None:
    """Standard error in degrees of the rotation that moves `source` onto `target`, in the least-squares sense.

    Args:
        source: Estimated positions in metres ``[N, 3]``, in the order of time.
        target: True positions in metres ``[N, 3]``, one for each row of `source`.
        rotation: The rotation found from all of them ``[3, 3]``.

    Returns:
        From half-paths where there are two positions a block, else by leaving out one position at a
        time (the jackknife); None for fewer than three positions.
    """
    if len(source) < 3:
        return None
    if len(source) < 2 * BLOCKS:
        pairs = [(source[rows], target[rows]) for rows in ~np.eye(len(source), dtype=bool)]
        covariances = np.array(
            [(to - to.mean(axis=0)).T @ (at - at.mean(axis=0)) for at, to in pairs]
        )
        squares = (_turned_deg(covariances, rotation) ** 2).sum()
        return float(np.sqrt((len(source) - 1) / len(source) * squares))

    # half-paths; the first blocks are longer by one where it does not come out even
    size, more = divmod(len(source), BLOCKS)
    starts = np.arange(BLOCKS) * size + np.minimum(np.arange(BLOCKS), more)
    source = source - source.mean(axis=0)
    target = target - target.mean(axis=0)

    # covariance of each half, from sums over its blocks
    count = _HALVES @ np.diff(starts, append=len(source))
    sums = _HALVES @ np.add.reduceat(source, starts)
    target_sums = _HALVES @ np.add.reduceat(target, starts)
    together = np.add.reduceat(target[:, :, None] * source[:, None, :], starts)
    products = (_HALVES @ together.reshape(BLOCKS, 9)).reshape(-1, 3, 3)
    covariances = products - target_sums[:, :, None] * sums[:, None, :] / count[:, None, None]
    return float(np.sqrt((_turned_deg(covariances, rotation) ** 2).mean()))


def _turned_deg(covariances: Array, rotation: Array) -> Array:
    """Angles in degrees ``[K]`` between the rotations that covariances ``[K, 3, 3]`` stand for and `rotation`."""
    u, _, vt = np.linalg.svd(covariances)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    turned = np.einsum("kii->k", (u @ vt) @ rotation.T)
    return np.asarray(np.rad2deg(np.arccos(np.clip((turned - 1) / 2, -1.0, 1.0))))
