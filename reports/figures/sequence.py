"""Series along a trajectory, made fit to be drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MOST_POINTS = 500


def broken(
    stamps: NDArray[np.float64], values: NDArray[np.float64], most: int = _MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thin a series and put NaN where the time between two poses exceeds twice the median interval.

    Args:
        stamps: Seconds ``[N]``.
        values: ``[N, K]``.
        most: About how many points to keep.

    Returns:
        Stamps ``[M]`` and values ``[M, K]`` with NaN rows in the gaps.
    """
    if len(stamps) < 3:
        return stamps, values
    intervals = np.diff(stamps)
    piece = np.concatenate([[0], np.cumsum(intervals > 2 * np.median(intervals))])
    step = max(1, -(-len(stamps) // most))
    keep = np.arange(len(stamps)) % step == 0
    edge = np.diff(piece) > 0
    keep |= np.append(edge, True) | np.append(True, edge)  # the ends of every piece stay
    kept = np.flatnonzero(keep)
    breaks = np.flatnonzero(np.diff(piece[kept]) > 0) + 1
    middle = (stamps[kept][breaks - 1] + stamps[kept][breaks]) / 2
    return (
        np.insert(stamps[kept], breaks, middle),
        np.insert(values[kept], breaks, np.nan, axis=0),
    )
