"""The guided filter (He, Sun, Tang 2010) that aggregates matching costs: Eq. 2."""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel

from ..kernels.arrays import Floats


@kernel
def filter_patch(
    guide: Floats, values: Floats, height: int, width: int, radius: int, epsilon: Scalar, work: Floats, out: Floats
) -> None:
    """Edge-preserving average of `values` that follows the edges of `guide`.

    Within each ``(2 radius + 1)**2`` window (clipped at the image's edge) the output is a linear function of the guide;
    overlapping windows are averaged.

    Args:
        guide: float32, flat ``[height * width]``, grey levels in [0, 1].
        values: float32, flat, what is filtered (matching costs).
        height: Of the image.
        width: Of the image.
        radius: Of the window, pixels.
        epsilon: Regularisation, squared grey levels.
        work: float32 ``[6, height * width]``, scratch.
        out: float32, flat, filled.
    """
    n = height * width
    mean_guide, mean_value = work[0, :n], work[1, :n]
    product, square, line = work[2, :n], work[3, :n], work[4, :n]
    box_mean(guide, height, width, radius, line, mean_guide)
    box_mean(values, height, width, radius, line, mean_value)
    for k in range(n):
        out[k] = guide[k] * values[k]
    box_mean(out, height, width, radius, line, product)
    for k in range(n):
        out[k] = guide[k] * guide[k]
    box_mean(out, height, width, radius, line, square)
    slope, offset = product, square
    for k in range(n):
        spread = max(square[k] - mean_guide[k] * mean_guide[k], np.float32(0)) + epsilon
        a = (product[k] - mean_guide[k] * mean_value[k]) / spread if spread > 0 else np.float32(0)
        slope[k] = a
        offset[k] = mean_value[k] - a * mean_guide[k]
    box_mean(slope, height, width, radius, line, mean_guide)
    box_mean(offset, height, width, radius, line, mean_value)
    for k in range(n):
        out[k] = mean_guide[k] * guide[k] + mean_value[k]


@inlined
def box_mean(values: Floats, height: int, width: int, radius: int, line: Floats, out: Floats) -> None:
    """Mean over the window clipped at the edges; columns first (vectorised), then running sums along rows."""
    for y in range(height):
        low, high = max(y - radius, 0), min(y + radius, height - 1)
        row = line[y * width : (y + 1) * width]
        first = values[low * width : (low + 1) * width]
        for x in range(width):
            row[x] = first[x]
        for other in range(low + 1, high + 1):
            more = values[other * width : (other + 1) * width]
            for x in range(width):
                row[x] += more[x]
        count = np.float32(high - low + 1)
        total = np.float32(0)
        for x in range(min(radius, width)):
            total += row[x]
        for x in range(width):
            if x + radius < width:
                total += row[x + radius]
            if x - radius - 1 >= 0:
                total -= row[x - radius - 1]
            columns = np.float32(min(x + radius, width - 1) - max(x - radius, 0) + 1)
            out[y * width + x] = total / (count * columns)
