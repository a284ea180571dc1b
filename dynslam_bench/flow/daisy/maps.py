"""Convolved orientation maps for the processor: what DAISY needs of one image, computed once a frame.

Eight rectified directional derivatives are blurred in a cascade of seven Gaussians (`smoothing`). Maps of small
Gaussians are kept at half, of large ones at quarter resolution; each histogram is normalised on its own (partial
normalisation) and stored as eight adjacent bytes, so that one descriptor histogram is one 64-bit load. `tests/flow/
daisy_reference.py` follows the definition.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.buffers import BufferPool
from ..kernels.workers import run_stripes
from . import layout
from .levels import MapGeometry, level_shape, map_geometry
from .refinement import BORDER, pad_image
from .smoothing import coarse_levels, fine_levels

NORM_FLOOR = 0.01 * 255.0
"""Added to a histogram's norm before dividing, so that flat regions stay near zero (0.01 for images in [0, 1])."""
FIXED_POINT = 256
"""Units a grey level in the blurred derivatives."""


@dataclass(frozen=True, eq=False)
class OrientationMaps:
    """One prepared image.

    Attributes:
        gray: uint8 ``[H, W]``, the image.
        framed: uint8 ``[H + 96, W + 96]``, the image with its edges repeated (`refinement.BORDER`).
        framed_half: uint8 ``[H / 2 + 96, W / 2 + 96]``, its mean over 2 x 2 pixels, likewise.
        histograms: uint8 ``[total, 8]``, all levels; a unit-norm histogram has Euclidean length 255.
        geometry: How to index them.
    """

    gray: NDArray[np.uint8]
    framed: NDArray[np.uint8]
    framed_half: NDArray[np.uint8]
    histograms: NDArray[np.uint8]
    geometry: MapGeometry


def orientation_maps(
    gray: NDArray[np.uint8],
    *,
    threads: int = 1,
    pool: ThreadPoolExecutor | None = None,
    buffers: BufferPool | None = None,
) -> OrientationMaps:
    """Compute the maps of a uint8 ``[H, W]`` image; the result does not depend on the number of threads.

    Args:
        gray: The image.
        threads: Over which rows are divided.
        pool: Of the other threads.
        buffers: Memory of maps that nobody holds any more is used again; None allocates anew.
    """
    gray = np.ascontiguousarray(gray)
    height, width = gray.shape
    geometry = map_geometry(height, width)
    (rows, columns), (quarter_rows, quarter_columns) = level_shape(height, width, 2), level_shape(height, width, 4)
    buffers = buffers or BufferPool()
    histograms, whole, half = buffers.take(
        (geometry.total, layout.BINS),
        (height + 2 * BORDER, width + 2 * BORDER),
        (rows + 2 * BORDER, columns + 2 * BORDER),
    )
    coarse = np.empty((quarter_rows, 32 * -(-8 * quarter_columns // 32)), dtype=np.uint16)
    floor = np.float32(NORM_FLOOR * FIXED_POINT)
    blurs = np.asarray(layout.LEVEL_BLURS, dtype=np.int64)
    fine = layout.LEVEL_STEPS.count(2)
    cells = histograms.reshape(-1)
    halves = (gray, half, BORDER, blurs[:fine], geometry, layout.MARGIN // 2)
    run_stripes(fine_levels, -(-rows // 2), threads, pool, *halves, floor, cells, coarse)
    quarters = (coarse, quarter_columns, blurs[fine:], fine, geometry, layout.MARGIN // 4)
    run_stripes(coarse_levels, quarter_rows, threads, pool, *quarters, floor, cells)
    pad_image(half[BORDER : BORDER + rows, BORDER : BORDER + columns], BORDER, half)
    pad_image(gray, BORDER, whole)
    return OrientationMaps(gray, whole, half, histograms, geometry)


def half_image(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Rounded mean over 2 x 2 pixels of a uint8 ``[H, W]`` image."""
    height, width = gray.shape
    y, x = (
        np.minimum(np.arange(2 * max(1, height // 2)), height - 1),
        np.minimum(np.arange(2 * max(1, width // 2)), width - 1),
    )
    even = gray[np.ix_(y, x)].astype(np.uint16)
    total = even[::2, ::2] + even[::2, 1::2] + even[1::2, ::2] + even[1::2, 1::2]
    return np.asarray((total + 2) >> 2, dtype=np.uint8)


def framed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with `refinement.BORDER` pixels of repeated edge around it."""
    out = np.empty((image.shape[0] + 2 * BORDER, image.shape[1] + 2 * BORDER), dtype=np.uint8)
    pad_image(image, BORDER, out)
    return out
