"""Nearest neighbours among the points of one image."""

from __future__ import annotations

import numpy as np

from ._jit import kernel


@kernel
def nearest_neighbours(points, order, width, out):  # type: ignore[no-untyped-def]
    """The nearest other points of each point, in an approximate but deterministic search over rows of equal bands.

    Args:
        points: float32 ``[N, 2]``.
        order: int64 ``[N]``, indices sorted by x.
        width: Number of points looked at on each side in that order.
        out: int64 ``[N, K]``, nearest first; -1 where there are fewer.
    """
    n, count = out.shape
    out[:] = -1
    best = np.empty(max(count, 1), dtype=np.float32)
    for position in range(n):
        i = order[position]
        x, y = points[i, 0], points[i, 1]
        found = 0
        for other in range(max(0, position - width), min(n, position + width + 1)):
            if other == position or count == 0:
                continue
            j = order[other]
            dx, dy = points[j, 0] - x, points[j, 1] - y
            distance = dx * dx + dy * dy
            if found == count and distance >= best[count - 1]:
                continue
            k = found if found < count else count - 1
            while k > 0 and best[k - 1] > distance:
                best[k] = best[k - 1]
                out[i, k] = out[i, k - 1]
                k -= 1
            best[k] = distance
            out[i, k] = j
            found = min(found + 1, count)
