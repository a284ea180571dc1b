"""Moving things are regions: a lone point that fails a test is noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Flags = NDArray[np.bool_]

CELL = 16
REACH = 5
"""Cells on a side of the neighbourhood: 5 x 16 px."""
MIN_FAILING = 3


def coherent(failing: Flags, tested: Flags, xy: NDArray[np.floating], share: float, size: tuple[int, int]) -> Flags:
    """The failing points among whose tested neighbours enough fail too.

    Args:
        failing: bool ``[N]``, points that failed a test.
        tested: bool ``[N]``, points that were tested.
        xy: Raw pixels ``[N, 2]``.
        share: Share of the tested points in the neighbourhood (80 px wide) that must fail; 0 keeps all failures.
        size: Image height and width.

    Returns:
        Bool ``[N]``, a subset of `failing`.
    """
    if share <= 0 or not failing.any():
        return failing
    rows, columns = -(-size[0] // CELL), -(-size[1] // CELL)
    cell = np.floor(xy / CELL).astype(np.intp)
    index = cell[:, 1].clip(0, rows - 1) * columns + cell[:, 0].clip(0, columns - 1)

    def around(flags: Flags) -> NDArray[np.float64]:
        counts = np.bincount(index, weights=flags, minlength=rows * columns).reshape(rows, columns)
        return np.asarray(
            cv2.boxFilter(counts, -1, (REACH, REACH), normalize=False, borderType=cv2.BORDER_CONSTANT), np.float64
        ).ravel()

    bad, all_ = around(failing & tested), around(tested)
    return np.asarray(failing & (bad[index] >= MIN_FAILING) & (bad[index] >= share * all_[index]))
