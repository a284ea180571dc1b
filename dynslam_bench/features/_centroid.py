"""Orientation of a patch by its intensity centroid (Rublee et al., 2011, Section 3.2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel


def patch_half_widths(radius: int) -> NDArray[np.int64]:
    """Half widths of the rows of a disc: row ``dy`` spans ``-w[|dy|] .. w[|dy|]``, int64 ``[radius + 1]``.

    The disc holds the pixels with ``dx^2 + dy^2 <= radius^2``, so that it is the same after a quarter turn.
    """
    rows = np.arange(radius + 1)
    return np.asarray(np.floor(np.sqrt(radius * radius - rows * rows)), dtype=np.int64)


@kernel
def _orientations(
    image: NDArray[np.uint8], xy: NDArray[np.float32], half_widths: NDArray[np.int64]
) -> NDArray[np.float32]:
    out = np.zeros(len(xy), np.float32)
    radius = len(half_widths) - 1
    for i in range(len(xy)):
        x0, y0 = int(xy[i, 0]), int(xy[i, 1])
        m10, m01 = np.int64(0), np.int64(0)
        for dy in range(-radius, radius + 1):
            w = half_widths[abs(dy)]
            row = np.int64(0)
            for dx in range(-w, w + 1):
                value = np.int64(image[y0 + dy, x0 + dx])
                m10 += dx * value
                row += value
            m01 += dy * row
        angle = math.degrees(math.atan2(float(m01), float(m10)))
        if angle < 0.0:
            angle += 360.0
        if angle >= 360.0:
            angle = 0.0
        out[i] = angle
        if out[i] >= 360.0:  # rounded up by float32
            out[i] = 0.0
    return out


def orientations(
    image: NDArray[np.uint8], xy: NDArray[np.float32], half_widths: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Orientations in degrees, [0, 360), float32 ``[N]``.

    Args:
        image: uint8 ``[H, W]``.
        xy: Integer-valued pixels ``[N, 2]``, at least the disc's radius away from the border.
        half_widths: Of `patch_half_widths`.
    """
    return np.asarray(_orientations(image, np.ascontiguousarray(xy, np.float32), half_widths))
