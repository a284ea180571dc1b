"""Winner takes all (Eq. 3): each pixel keeps the label of the lowest aggregated cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def winner_takes_all(costs: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.floating]]:
    """The best label of every pixel.

    Args:
        costs: ``[L, ...]``, aggregated cost of each label at each pixel; NaN never wins.

    Returns:
        Index of the winner (the first of equals), and its cost.
    """
    filled = np.where(np.isnan(costs), np.inf, costs)
    best = filled.argmin(axis=0)
    return best, np.take_along_axis(filled, best[None], axis=0)[0]
