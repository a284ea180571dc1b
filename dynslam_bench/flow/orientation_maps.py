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

from dynslam_bench.core.compiled import inlined, kernel
from dynslam_bench.flow import layout
from dynslam_bench.flow.layout import MapGeometry, level_shape, map_geometry
from dynslam_bench.flow.refinement import BORDER, pad_image
from dynslam_bench.flow.simd import (
    Bytes,
    Halves,
    Longs,
    average,
    average_of_pairs,
    derivatives,
    load_uint16,
    store_normalised,
    store_uint16,
)
from dynslam_bench.flow.workers import BufferPool, run_stripes

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


# The orientation maps' kernels: derivatives, the cascade of blurs, and normalised bytes, row by row.

RING = 16
"""Lines kept of each level; a power of two above twice the farthest tap."""
SPILL = 64
"""Numbers that vector code may touch beyond a line's end."""


@inlined
def smooth_line(
    ring: Halves, pitch: int, row: int, rows: int, columns: int, taps: int, distance: int, line: Halves, out: Halves,
    out_at: int,
) -> None:  # fmt: skip
    """One row of a separable binomial blur, edges repeated.

    Args:
        ring: uint16, flat ``[RING, pitch]``, source rows; row y lies at ``y % RING``.
        pitch: Numbers a line.
        row: Row wanted.
        rows: Rows of the source image.
        columns: Its columns.
        taps: 3 or 5.
        distance: Between taps, pixels.
        line: uint16, scratch.
        out: uint16, flat, receives the row ...
        out_at: ... from here on.
    """
    length, pad = 8 * columns, 16 * distance
    last = rows - 1
    here = (row & (RING - 1)) * pitch
    a, b = (max(row - distance, 0) & (RING - 1)) * pitch, (min(row + distance, last) & (RING - 1)) * pitch
    if taps == 3:
        for i in range(0, length, 32):
            middle = load_uint16(ring, here + i)
            store_uint16(line, pad + i, average(middle, average(load_uint16(ring, a + i), load_uint16(ring, b + i))))
    else:
        c = (max(row - 2 * distance, 0) & (RING - 1)) * pitch
        d = (min(row + 2 * distance, last) & (RING - 1)) * pitch
        for i in range(0, length, 32):
            middle, near = load_uint16(ring, here + i), average(load_uint16(ring, a + i), load_uint16(ring, b + i))
            far = average(load_uint16(ring, c + i), load_uint16(ring, d + i))
            store_uint16(line, pad + i, average(near, average(middle, average(middle, far))))
    for t in range(0, pad, 8):
        for k in range(8):
            line[t + k] = line[pad + k]
            line[pad + length + t + k] = line[pad + length - 8 + k]
    near, far = 8 * distance, 16 * distance
    if taps == 3:
        for i in range(pad, pad + length, 32):
            middle = load_uint16(line, i)
            beside = average(load_uint16(line, i - near), load_uint16(line, i + near))
            store_uint16(out, out_at + i - pad, average(middle, beside))
    else:
        for i in range(pad, pad + length, 32):
            middle = load_uint16(line, i)
            beside = average(load_uint16(line, i - near), load_uint16(line, i + near))
            beyond = average(load_uint16(line, i - far), load_uint16(line, i + far))
            store_uint16(out, out_at + i - pad, average(beside, average(middle, average(middle, beyond))))


@inlined
def normalise_line(line: Halves, at: int, columns: int, floor: float, cells: Bytes, first: int) -> None:
    """Partially normalised bytes of one row; what the last four histograms spill into the margin is cleared."""
    length = 8 * columns
    for i in range(0, length, 32):
        store_normalised(cells, first + i, load_uint16(line, at + i), floor)
    for i in range(length, 32 * ((length + 31) // 32)):
        cells[first + i] = 0


@inlined
def sum_line(gray: Bytes, row: int, sums: Halves, at: int, columns: int) -> None:
    """Sums over 2 x 2 pixels of one half-resolution row, with one repeated number on either side."""
    height, width = gray.shape
    upper, lower = gray[min(2 * row, height - 1)], gray[min(2 * row + 1, height - 1)]
    for x in range(min(columns, width // 2)):
        sums[at + x] = np.uint16(
            (np.uint16(upper[2 * x]) + np.uint16(upper[2 * x + 1]))
            + (np.uint16(lower[2 * x]) + np.uint16(lower[2 * x + 1]))
        )
    if width == 1:
        sums[at] = np.uint16(2 * (np.uint16(upper[0]) + np.uint16(lower[0])))
    sums[at - 1], sums[at + columns] = sums[at], sums[at + columns - 1]


@inlined
def quarter_line(rows: Halves, upper: int, lower: int, columns: int, target: Halves) -> None:
    """Means of 2 x 2 histograms of the rows that begin at `upper` and `lower`; a single column is its own neighbour."""
    for k in range(8):
        for each in (lower, upper):
            rows[each + 8 * columns + k] = rows[each + 8 * columns - 8 + k]
    for i in range(0, len(target) - 31, 32):
        left = average(load_uint16(rows, upper + 2 * i), load_uint16(rows, lower + 2 * i))
        right = average(load_uint16(rows, upper + 2 * i + 32), load_uint16(rows, lower + 2 * i + 32))
        store_uint16(target, i, average_of_pairs(left, right))


@kernel
def fine_levels(
    start: int, stop: int, gray: Bytes, half: Bytes, border: int, blurs: Longs, geometry: MapGeometry, margin: int,
    floor: float, cells: Bytes, coarse: Halves,
) -> None:  # fmt: skip
    """The half-resolution levels, and their last one once more at quarter resolution.

    Args:
        start: First pair of half-resolution rows.
        stop: One past the last pair.
        gray: uint8 ``[H, W]``.
        half: uint8 ``[h + 2 border, w + 2 border]``, receives the rounded mean over 2 x 2 pixels.
        border: Pixels around `half`'s image; left as they are.
        blurs: int64 ``[L, 2]``, taps and distance of each level.
        geometry: `levels.MapGeometry`.
        margin: Empty histograms around the maps.
        floor: Added to norms.
        cells: uint8, flat, all levels' histograms.
        coarse: uint16 ``[quarter rows, >= 8 quarter columns]``, receives the means of 2 x 2 histograms.
    """
    rows, columns = half.shape[0] - 2 * border, half.shape[1] - 2 * border
    levels, length = len(blurs), 32 * ((8 * columns + 31) // 32)
    pitch, sum_pitch = length + SPILL, columns + 2 + SPILL
    rings = np.zeros((levels + 1, RING * pitch), dtype=np.uint16)
    line = np.zeros(length + 32 * np.max(blurs[:, 1]) + SPILL, dtype=np.uint16)
    sums = np.zeros(4 * sum_pitch, dtype=np.uint16)
    top, bottom = 2 * start, min(2 * stop, rows)
    reach = np.zeros(levels + 1, dtype=np.int64)  # rows that later levels need beyond the stripe
    for level in range(levels - 1, -1, -1):
        reach[level] = reach[level + 1] + (blurs[level, 0] // 2) * blurs[level, 1]
    first, summed = max(top - reach[0], 0), max(top - reach[0] - 1, 0)
    for row in range(first, bottom + reach[0]):
        if row < min(bottom + reach[0], rows):
            while summed <= min(row + 1, rows - 1):
                at = (summed & 3) * sum_pitch + 1
                sum_line(gray, summed, sums, at, columns)
                if top <= summed < bottom:
                    target = half[border + summed]
                    for x in range(columns):
                        target[border + x] = np.uint8((sums[at + x] + np.uint16(2)) >> np.uint16(2))
                summed += 1
            here = (row & 3) * sum_pitch + 1
            above, below = (max(row - 1, 0) & 3) * sum_pitch + 1, (min(row + 1, rows - 1) & 3) * sum_pitch + 1
            at = (row & (RING - 1)) * pitch
            for x in range(0, columns, 4):
                store_uint16(rings[0], at + 8 * x, derivatives(sums, here + x, above + x, below + x))
        delay = 0
        for level in range(levels):
            taps, distance = blurs[level, 0], blurs[level, 1]
            delay += (taps // 2) * distance
            y = row - delay
            if not (max(top - reach[level + 1], 0) <= y < min(bottom + reach[level + 1], rows)):
                continue
            at = (y & (RING - 1)) * pitch
            smooth_line(rings[level], pitch, y, rows, columns, taps, distance, line, rings[level + 1], at)
            if top <= y < bottom:
                cell = geometry.base[level] + (margin + y) * geometry.stride[level] + margin
                normalise_line(rings[level + 1], at, columns, floor, cells, 8 * cell)
            if level == levels - 1 and (y & 1 or rows == 1) and y // 2 < len(coarse):
                before = ((y & ~1) & (RING - 1)) * pitch
                quarter_line(rings[levels], before, at, columns, coarse[y // 2])


@kernel
def coarse_levels(
    start: int, stop: int, coarse: Halves, columns: int, blurs: Longs, first_level: int, geometry: MapGeometry,
    margin: int, floor: float, cells: Bytes,
) -> None:  # fmt: skip
    """The quarter-resolution levels of rows start..stop.

    Args:
        start: First row.
        stop: One past the last.
        coarse: uint16 ``[rows, >= 8 columns]`` of `fine_levels`.
        columns: Pixels a row.
        blurs: int64 ``[L, 2]``, taps and distance of each level.
        first_level: Number of the first of these levels.
        geometry: `levels.MapGeometry`.
        margin: Empty histograms around the maps.
        floor: Added to norms.
        cells: uint8, flat, all levels' histograms.
    """
    rows, levels = len(coarse), len(blurs)
    length = 32 * ((8 * columns + 31) // 32)
    pitch = length + SPILL
    rings = np.zeros((levels + 1, RING * pitch), dtype=np.uint16)
    line = np.zeros(length + 32 * np.max(blurs[:, 1]) + SPILL, dtype=np.uint16)
    reach = np.zeros(levels + 1, dtype=np.int64)
    for level in range(levels - 1, -1, -1):
        reach[level] = reach[level + 1] + (blurs[level, 0] // 2) * blurs[level, 1]
    for row in range(max(start - reach[0], 0), stop + reach[0]):
        if row < rows:
            source, at = coarse[row], (row & (RING - 1)) * pitch
            for i in range(0, length, 32):
                store_uint16(rings[0], at + i, load_uint16(source, i))
        delay = 0
        for level in range(levels):
            taps, distance = blurs[level, 0], blurs[level, 1]
            delay += (taps // 2) * distance
            y = row - delay
            if not (max(start - reach[level + 1], 0) <= y < min(stop + reach[level + 1], rows)):
                continue
            at = (y & (RING - 1)) * pitch
            smooth_line(rings[level], pitch, y, rows, columns, taps, distance, line, rings[level + 1], at)
            if start <= y < stop:
                number = first_level + level
                cell = geometry.base[number] + (margin + y) * geometry.stride[number] + margin
                normalise_line(rings[level + 1], at, columns, floor, cells, 8 * cell)
