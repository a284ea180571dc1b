"""How well the positions determine the rotation of an alignment: the same fit on halves of the path.

On an almost straight path the least-squares rotation about the path's direction follows the errors of the positions,
not the path: orientations are then off by any angle, though every position fits. The path is cut into twelve blocks,
which keep errors together that belong together; the alignment is repeated on the 22 halves (six blocks each) of a
two-level design (Plackett and Burman, Biometrika, 1946), in which every block and every pair of blocks takes part
equally often. The rotations' root-mean-square distance from that of the whole path estimates the standard error of that
rotation: a delete-half jackknife.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCKS = 12
RELIABLE_DEG = 10.0
"""With a larger uncertainty of the alignment's rotation, absolute rotational errors say nothing of the tracker."""
_GENERATOR = np.array([1, 1, -1, 1, 1, 1, -1, -1, -1, 1, -1])
_DESIGN = np.array([np.append(np.roll(_GENERATOR, shift), -1) for shift in range(len(_GENERATOR))])
_HALVES = np.vstack([_DESIGN, -_DESIGN]) > 0


def rotation_uncertainty_deg(source: Array, target: Array, rotation: Array) -> float | None:
    """Standard error in degrees of the rotation that moves `source` onto `target`, in the least-squares sense.

    Args:
        source: Estimated positions in metres ``[N, 3]``, in the order of time.
        target: Their true counterparts ``[N, 3]``.
        rotation: The rotation found from all of them ``[3, 3]``.

    Returns:
        From half-paths where there are two positions a block, else by leaving out one position at a time (the
        jackknife); None for fewer than three positions.
    """
    if len(source) < 3:
        return None
    if len(source) < 2 * BLOCKS:
        return _left_out(source, target, rotation)
    size, more = divmod(len(source), BLOCKS)  # the first blocks are longer by one where it does not come out even
    starts = np.arange(BLOCKS) * size + np.minimum(np.arange(BLOCKS), more)
    source, target = source - source.mean(axis=0), target - target.mean(axis=0)
    weights = _HALVES.astype(np.float64)
    count = weights @ np.diff(starts, append=len(source))
    sums = weights @ np.add.reduceat(source, starts)
    target_sums = weights @ np.add.reduceat(target, starts)
    together = np.add.reduceat(target[:, :, None] * source[:, None, :], starts)
    products = (weights @ together.reshape(BLOCKS, 9)).reshape(-1, 3, 3)
    covariances = products - target_sums[:, :, None] * sums[:, None, :] / count[:, None, None]
    return float(np.sqrt((_turned_deg(covariances, rotation) ** 2).mean()))


def _left_out(source: Array, target: Array, rotation: Array) -> float:
    """The jackknife's standard error in degrees: every position is left out once."""
    kept = ~np.eye(len(source), dtype=bool)
    pairs = [(source[rows], target[rows]) for rows in kept]
    covariances = np.array([(to - to.mean(axis=0)).T @ (at - at.mean(axis=0)) for at, to in pairs])
    squares = _turned_deg(covariances, rotation) ** 2
    return float(np.sqrt((len(source) - 1) / len(source) * squares.sum()))


def _turned_deg(covariances: Array, rotation: Array) -> Array:
    """Angles in degrees ``[K]`` between the rotations that covariances ``[K, 3, 3]`` stand for and `rotation`."""
    u, _, vt = np.linalg.svd(covariances)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    turned = np.einsum("kii->k", (u @ vt) @ rotation.T)
    return np.asarray(np.rad2deg(np.arccos(np.clip((turned - 1) / 2, -1.0, 1.0))))
