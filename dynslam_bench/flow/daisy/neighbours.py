"""Nearest neighbours among the points of one image."""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import kernel

from ..kernels.arrays import Floats, Longs


@kernel
def nearest_neighbours(start: int, stop: int, ordered: Floats, order: Longs, width: int, out: Longs) -> None:
    """The nearest other points of each point, in an approximate but deterministic search over rows of equal bands.

    Args:
        start: First place in the order.
        stop: One past the last.
        ordered: float32 ``[N, 2]``, the points sorted by x.
        order: int64 ``[N]``, their indices.
        width: Number of points looked at on each side in that order.
        out: int64 ``[N, K]``, nearest first; -1 where there are fewer. Rows are points, not places.
    """
    n, count = out.shape
    best, index = np.empty(count, dtype=np.float32), np.empty(count, dtype=np.int64)
    distances = np.empty(2 * width + 1, dtype=np.float32)
    for place in range(start, stop):
        x, y = ordered[place, 0], ordered[place, 1]
        first, last = max(0, place - width), min(n, place + width + 1)
        for k in range(last - first):
            dx, dy = ordered[first + k, 0] - x, ordered[first + k, 1] - y
            distances[k] = dx * dx + dy * dy
        distances[place - first] = np.inf
        best[:], index[:] = np.inf, -1
        worst = np.float32(np.inf)
        for k in range(last - first):
            distance = distances[k]
            if distance < worst:
                slot = count - 1
                while slot > 0 and best[slot - 1] > distance:
                    best[slot], index[slot] = best[slot - 1], index[slot - 1]
                    slot -= 1
                best[slot], index[slot] = distance, order[first + k]
                worst = best[count - 1]
        i = order[place]
        for slot in range(count):
            out[i, slot] = index[slot]
