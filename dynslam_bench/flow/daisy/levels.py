"""Where the levels of the orientation maps lie in one flat array."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import layout


class MapGeometry(NamedTuple):
    """Where each level lies in the flat histogram array.

    Attributes:
        base: int64 ``[LEVELS]``, index of each level's first histogram (the corner of its margin).
        stride: int64 ``[LEVELS]``, histograms a row, margins included.
        shift: int64 ``[LEVELS]``, quarter pixels to map pixels: ``index = (position + bias) >> shift``.
        bias: int64 ``[LEVELS]``, rounding and margin.
        total: Number of histograms.
    """

    base: NDArray[np.int64]
    stride: NDArray[np.int64]
    shift: NDArray[np.int64]
    bias: NDArray[np.int64]
    total: int


def level_shape(height: int, width: int, step: int) -> tuple[int, int]:
    """Rows and columns of a level with `step` full-image pixels a map pixel; an odd last row or column is dropped."""
    for _ in range(int(np.log2(step))):
        height, width = max(1, height // 2), max(1, width // 2)
    return height, width


@lru_cache(maxsize=16)
def map_geometry(height: int, width: int) -> MapGeometry:
    """The arrangement of the seven levels for an image size in pixels."""
    base, stride, shift, bias, total = [], [], [], [], 0
    for step in layout.LEVEL_STEPS:
        rows, columns = level_shape(height, width, step)
        margin = layout.MARGIN // step
        base.append(total)
        stride.append(columns + 2 * margin)
        # full-image x (pixel centres at integers) falls into map pixel floor((x + 0.5) / step)
        shift.append(int(np.log2(step * layout.SUBPIXEL)))
        bias.append(layout.SUBPIXEL // 2 + margin * step * layout.SUBPIXEL)
        total += (rows + 2 * margin) * (columns + 2 * margin)
    return MapGeometry(
        np.asarray(base, dtype=np.int64),
        np.asarray(stride, dtype=np.int64),
        np.asarray(shift, dtype=np.int64),
        np.asarray(bias, dtype=np.int64),
        total,
    )
