"""Convolved orientation maps for the processor: what DAISY needs of one image, computed once a frame.

Eight rectified directional derivatives are blurred in a cascade of seven Gaussians. Maps of small
Gaussians are stored at half, of large ones at quarter resolution. Each histogram is normalised on
its own (partial normalisation) and stored as eight adjacent bytes, so that one descriptor histogram
is one 64-bit load. `tests/flow/test_flow_daisy.py` follows the definition.

A Gaussian is replaced by the binomial of equal variance, made of rounded means:
``[1 4 6 4 1] / 16`` has variance 1 and ``[1 2 1] / 4`` one half, times the square of the taps'
distance (which may exceed one where the rows are smooth enough already). Rows move through short
rings of lines that stay in the cache; neighbouring stripes compute the few lines that they share
twice.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import inlined, kernel
from dynslam_bench.core.simd import (
    Bytes,
    Halves,
    Longs,
    load_uint16,
    store_uint16,
)
from dynslam_bench.flow import layout
from dynslam_bench.flow.histogram_vectors import (
    average,
    average_of_pairs,
    derivatives,
    store_normalised,
)
from dynslam_bench.flow.layout import MapGeometry, map_geometry
from dynslam_bench.flow.refinement import BORDER
from dynslam_bench.flow.workers import Workers

NORM_FLOOR = 0.01 * 255.0
"""Added to a histogram's norm before dividing, so that flat regions stay near zero (0.01 for images in [0, 1])."""
FIXED_POINT = 256
"""Units a grey level in the blurred derivatives."""
Buffers = list[tuple[NDArray[np.uint8], ...]]
"""Arrays of maps that were deleted. The first access to a page of fresh memory costs more than computing its content
(`docs/lab/README.md`)."""
NO_GRADIENTS = np.empty((0, 0), dtype=np.uint8)
"""In place of the gradients where the terms of Eq. 1 do not need them."""
RING = 16
"""Lines stored of each level; a power of two above twice the farthest tap."""
SPILL = 64
"""Numbers that vector code may access beyond a line's end."""


class ImageArrays(NamedTuple):
    """Arrays of one prepared image for the kernels.

    Attributes:
        histograms: uint8, flat, `OrientationMaps.histograms`.
        gray: uint8 ``[H, W]``, the image.
        gradients: uint8 ``[H, W]``, `gradient_magnitudes`, for all terms of Eq. 1; else ``[0, 0]``.
    """

    histograms: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    gradients: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class OrientationMaps:
    """One prepared image. Its arrays are used again once it is deleted.

    Attributes:
        gray: uint8 ``[H, W]``, the image.
        framed: uint8 ``[H + 96, W + 96]``, the image with its edges repeated (`refinement.BORDER`).
        framed_half: uint8 ``[H / 2 + 96, W / 2 + 96]``, its mean over 2 x 2 pixels, edges repeated.
        histograms: uint8 ``[total, 8]``, all levels as `layout.map_geometry` arranges them; a
            unit-norm histogram has Euclidean length 255.
        arrays: For the kernels, without gradients.
        arrays_with_gradients: For the kernels, with gradients.
    """

    gray: NDArray[np.uint8]
    framed: NDArray[np.uint8]
    framed_half: NDArray[np.uint8]
    histograms: NDArray[np.uint8]
    arrays: ImageArrays

    @cached_property
    def arrays_with_gradients(self) -> ImageArrays:  # noqa: D102 - see the class
        return self.arrays._replace(gradients=gradient_magnitudes(self.gray))


def gradient_magnitudes(gray: Bytes) -> Bytes:
    """The gradients' rounded magnitudes, uint8 ``[H, W]``, by central differences, edges repeated."""
    levels = np.pad(gray, 1, mode="edge").astype(np.float32)
    gx = levels[1:-1, 2:] - levels[1:-1, :-2]
    gy = levels[2:, 1:-1] - levels[:-2, 1:-1]
    # half, because the differences are over two pixels; half a level more, to round
    magnitudes = np.sqrt(gx * gx + gy * gy) * np.float32(0.5)
    return np.asarray(magnitudes + np.float32(0.5), dtype=np.uint8)


def orientation_maps(
    gray: NDArray[np.uint8], workers: Workers | None = None, buffers: Buffers | None = None
) -> OrientationMaps:
    """Compute the maps of a uint8 ``[H, W]`` image; the result does not depend on the number of threads.

    Args:
        gray: The image.
        workers: Threads over which rows are divided; None for the calling thread alone.
        buffers: Takes the memory of maps once they are deleted, and gives it to the next ones of
            that size.
    """
    run = (workers or Workers()).run
    buffers = [] if buffers is None else buffers
    gray = np.ascontiguousarray(gray)
    height, width = gray.shape
    geometry = map_geometry(height, width)
    rows = max(1, height // 2)
    columns = max(1, width // 2)
    quarter_rows = max(1, height // 4)
    quarter_columns = max(1, width // 4)

    # take the arrays of deleted maps where they have the same size: their margins are zero already
    shapes = (
        (geometry.total, layout.BINS),
        (height + 2 * BORDER, width + 2 * BORDER),
        (rows + 2 * BORDER, columns + 2 * BORDER),
    )
    arrays = take_buffers(buffers, shapes)
    histograms, framed, framed_half = arrays
    cells = histograms.reshape(-1)

    # the cascade of blurs, at half and then at quarter resolution
    floor = np.float32(NORM_FLOOR * FIXED_POINT)
    blurs = np.asarray(layout.LEVEL_BLURS, dtype=np.int64)
    fine = layout.LEVEL_STEPS.count(2)
    # whole vectors of 32 numbers a row
    coarse = np.empty((quarter_rows, 32 * -(-8 * quarter_columns // 32)), dtype=np.uint16)
    half_row_pairs = -(-rows // 2)
    # fills `framed_half`, the finer levels of `cells`, and `coarse`, from which the next call goes on
    run(
        fine_levels,
        0,
        half_row_pairs,
        gray,
        framed_half,
        blurs[:fine],
        geometry,
        floor,
        cells,
        coarse,
    )
    run(
        coarse_levels,
        0,
        quarter_rows,
        coarse,
        quarter_columns,
        blurs[fine:],
        fine,
        geometry,
        floor,
        cells,
    )

    # the images with their borders
    framed[BORDER:-BORDER, BORDER:-BORDER] = gray
    repeat_edges(framed_half)
    repeat_edges(framed)
    arrays_of_image = ImageArrays(cells, gray, NO_GRADIENTS)
    maps = OrientationMaps(gray, framed, framed_half, histograms, arrays_of_image)
    weakref.finalize(maps, buffers.append, arrays)
    return maps


def take_buffers(
    buffers: Buffers, shapes: tuple[tuple[int, int], ...]
) -> tuple[NDArray[np.uint8], ...]:
    """Take arrays of these shapes from the buffers, or make them, filled with zeros; other sizes are dropped."""
    while buffers and tuple(array.shape for array in buffers[-1]) != shapes:
        buffers.pop()
    if buffers:
        return buffers.pop()
    return tuple(np.zeros(shape, dtype=np.uint8) for shape in shapes)


def repeat_edges(framed: NDArray[np.uint8]) -> None:
    """Fill the border of an image, `BORDER` wide, with its outermost pixels."""
    rows = framed[BORDER:-BORDER]
    rows[:, :BORDER] = rows[:, BORDER : BORDER + 1]
    rows[:, -BORDER:] = rows[:, -BORDER - 1 : -BORDER]
    # whole rows, their ends included, so that the corners are filled too
    framed[:BORDER] = rows[0]
    framed[-BORDER:] = rows[-1]


@inlined
def blur(
    source: Halves,
    middle: int,
    near: tuple[int, int],
    far: tuple[int, int],
    taps: int,
    out: Halves,
    out_at: int,
    length: int,
) -> None:
    """A binomial blur of 3 or 5 taps, made of rounded means.

    Args:
        source: uint16, flat.
        middle: Where the middle tap begins in it.
        near: Where the taps beside the middle one begin.
        far: Where the outermost of five taps begin.
        taps: 3, ``[1 2 1] / 4``, or 5, ``[1 4 6 4 1] / 16``.
        out: uint16, flat, receives the result ...
        out_at: ... from this index on.
        length: How many numbers, rounded up to 32.
    """
    for i in range(0, length, 32):
        centre = load_uint16(source, middle + i)
        beside = average(load_uint16(source, near[0] + i), load_uint16(source, near[1] + i))
        if taps == 3:
            store_uint16(out, out_at + i, average(centre, beside))
        else:
            beyond = average(load_uint16(source, far[0] + i), load_uint16(source, far[1] + i))
            store_uint16(out, out_at + i, average(beside, average(centre, average(centre, beyond))))


@inlined
def smooth_line(
    ring: Halves,
    pitch: int,
    row: int,
    rows: int,
    columns: int,
    taps: int,
    distance: int,
    line: Halves,
    out: Halves,
    out_at: int,
) -> None:
    """One row of a separable binomial blur, edges repeated.

    Args:
        ring: uint16, flat ``[RING, pitch]``, source rows; row y lies at ``y % RING``.
        pitch: Numbers a line.
        row: The row.
        rows: Rows of the source image.
        columns: Its columns.
        taps: 3 or 5.
        distance: Between taps, pixels.
        line: uint16, scratch.
        out: uint16, flat, receives the row ...
        out_at: ... from this index on.
    """
    length = 8 * columns
    last = rows - 1
    wrap = RING - 1

    # across the rows; the taps are rows of the ring
    above = (max(row - distance, 0) & wrap) * pitch
    below = (min(row + distance, last) & wrap) * pitch
    far_above = (max(row - 2 * distance, 0) & wrap) * pitch
    far_below = (min(row + 2 * distance, last) & wrap) * pitch
    # eight bins a pixel, and room for two taps on each side
    pad = 16 * distance
    middle = (row & wrap) * pitch
    blur(ring, middle, (above, below), (far_above, far_below), taps, line, pad, length)

    # along the row, after its first and last histogram are repeated beyond the edges
    for t in range(0, pad, 8):
        for k in range(8):
            line[t + k] = line[pad + k]
            line[pad + length + t + k] = line[pad + length - 8 + k]
    step = 8 * distance
    near = (pad - step, pad + step)
    far = (pad - 2 * step, pad + 2 * step)
    blur(line, pad, near, far, taps, out, out_at, length)


@inlined
def normalise_line(
    line: Halves, at: int, columns: int, floor: float, cells: Bytes, first: int
) -> None:
    """Partially normalised bytes of one row; bytes that the last vector writes into the margin are cleared.

    Args:
        line: uint16, flat, blurred histograms of eight bins.
        at: Index of the row's first bin.
        columns: Histograms of the row.
        floor: Added to the norm, so that weak gradients stay small.
        cells: uint8, flat, all maps; filled.
        first: Index of the row's first byte in it.
    """
    length = 8 * columns
    for i in range(0, length, 32):
        store_normalised(cells, first + i, load_uint16(line, at + i), floor)
    for i in range(length, 32 * ((length + 31) // 32)):
        cells[first + i] = 0


@inlined
def sum_line(gray: Bytes, row: int, sums: Halves, at: int, columns: int) -> None:
    """Sums over 2 x 2 pixels of one half-resolution row, with one repeated number on either side.

    Args:
        gray: uint8 ``[H, W]``.
        row: Row of the half-resolution image.
        sums: uint16, flat, filled.
        at: Index of the row's first sum in it.
        columns: Pixels of a half-resolution row.
    """
    height, width = gray.shape
    upper = gray[min(2 * row, height - 1)]
    lower = gray[min(2 * row + 1, height - 1)]
    for x in range(min(columns, width // 2)):
        above = np.uint16(upper[2 * x]) + np.uint16(upper[2 * x + 1])
        below = np.uint16(lower[2 * x]) + np.uint16(lower[2 * x + 1])
        sums[at + x] = np.uint16(above + below)
    if width == 1:
        sums[at] = np.uint16(2 * (np.uint16(upper[0]) + np.uint16(lower[0])))
    sums[at - 1] = sums[at]
    sums[at + columns] = sums[at + columns - 1]


@inlined
def quarter_line(rows: Halves, upper: int, lower: int, columns: int, target: Halves) -> None:
    """Means of 2 x 2 histograms of the rows that begin at `upper` and `lower`; a single column is its own neighbour.

    Args:
        rows: uint16, flat, rows of half-resolution histograms of eight bins.
        upper: Index at which the upper row begins.
        lower: Index at which the lower row begins.
        columns: Histograms of such a row.
        target: uint16, filled with a row of quarter resolution.
    """
    for k in range(8):
        for row in (lower, upper):
            rows[row + 8 * columns + k] = rows[row + 8 * columns - 8 + k]
    for i in range(0, len(target) - 31, 32):
        left = average(load_uint16(rows, upper + 2 * i), load_uint16(rows, lower + 2 * i))
        right = average(
            load_uint16(rows, upper + 2 * i + 32), load_uint16(rows, lower + 2 * i + 32)
        )
        store_uint16(target, i, average_of_pairs(left, right))


@kernel
def level_reach(blurs: Longs) -> Longs:
    """Rows beyond a stripe that each level must compute for the levels after it, int64 ``[L + 1]``."""
    reach = np.zeros(len(blurs) + 1, dtype=np.int64)
    for level in range(len(blurs) - 1, -1, -1):
        reach[level] = reach[level + 1] + (blurs[level, 0] // 2) * blurs[level, 1]
    return reach


@inlined
def farthest_tap(blurs: Longs) -> int:
    """The largest distance between taps of blurs, int64 ``[L, 2]`` of taps and distance."""
    farthest = np.int64(0)
    for level in range(len(blurs)):
        farthest = max(farthest, blurs[level, 1])
    return int(farthest)


@inlined
def blur_cascade(
    rings: Halves,
    pitch: int,
    row: int,
    rows: int,
    columns: int,
    top: int,
    bottom: int,
    blurs: Longs,
    reach: Longs,
    first_level: int,
    geometry: MapGeometry,
    margin: int,
    floor: float,
    cells: Bytes,
    line: Halves,
) -> int:
    """Compute the rows of all levels that the newest source row completes; returns the last level's row.

    Args:
        rings: uint16 ``[L + 1, RING * pitch]``, the lines of the source and of each level.
        pitch: Numbers a line.
        row: The newest source row.
        rows: Rows of the levels.
        columns: Columns of the levels.
        top: First row of the stripe.
        bottom: One past its last row.
        blurs: int64 ``[L, 2]``, taps and distance of each level.
        reach: int64 ``[L + 1]`` of `level_reach`: rows beyond the stripe that each level must
            compute.
        first_level: Number of the first of these levels.
        geometry: `layout.MapGeometry`.
        margin: Empty histograms around the maps.
        floor: Added to norms.
        cells: uint8, flat, all levels' histograms.
        line: uint16, scratch.
    """
    y = row
    for level in range(len(blurs)):
        taps = blurs[level, 0]
        distance = blurs[level, 1]
        # the last row of this level whose taps are all there
        y -= (taps // 2) * distance
        if not (max(top - reach[level + 1], 0) <= y < min(bottom + reach[level + 1], rows)):
            continue
        at = (y & (RING - 1)) * pitch
        smooth_line(
            rings[level], pitch, y, rows, columns, taps, distance, line, rings[level + 1], at
        )
        # the stripe's own rows become histograms
        if top <= y < bottom:
            number = first_level + level
            cell = geometry.base[number] + (margin + y) * geometry.stride[number] + margin
            normalise_line(rings[level + 1], at, columns, floor, cells, 8 * cell)
    return y


@kernel
def fine_levels(
    start: int,
    stop: int,
    gray: Bytes,
    half: Bytes,
    blurs: Longs,
    geometry: MapGeometry,
    floor: float,
    cells: Bytes,
    coarse: Halves,
) -> None:
    """The half-resolution levels, and the means of the last one at quarter resolution.

    Args:
        start: First pair of half-resolution rows.
        stop: One past the last pair.
        gray: uint8 ``[H, W]``.
        half: uint8 ``[h + 2 BORDER, w + 2 BORDER]``, receives the rounded mean over 2 x 2 pixels.
        blurs: int64 ``[L, 2]``, taps and distance of each level.
        geometry: `layout.MapGeometry`.
        floor: Added to norms.
        cells: uint8, flat, all levels' histograms.
        coarse: uint16 ``[quarter rows, >= 8 quarter columns]``, receives the means of 2 x 2
            histograms.
    """
    rows = half.shape[0] - 2 * BORDER
    columns = half.shape[1] - 2 * BORDER
    levels = len(blurs)
    length = 32 * ((8 * columns + 31) // 32)
    pitch = length + SPILL
    sum_pitch = columns + 2 + SPILL
    # rings of the last rows of each level, a line to blur, and four lines of sums of 2 x 2 pixels
    rings = np.zeros((levels + 1, RING * pitch), dtype=np.uint16)
    line = np.zeros(length + 32 * farthest_tap(blurs) + SPILL, dtype=np.uint16)
    sums = np.zeros(4 * sum_pitch, dtype=np.uint16)
    top = 2 * start
    bottom = min(2 * stop, rows)
    reach = level_reach(blurs)
    first = max(top - reach[0], 0)
    summed = max(top - reach[0] - 1, 0)
    # rows beyond the last one complete the levels, which lag behind
    for row in range(first, bottom + reach[0]):
        if row < min(bottom + reach[0], rows):
            # sums of 2 x 2 pixels up to the row below, in a ring of four lines
            while summed <= min(row + 1, rows - 1):
                at = (summed & 3) * sum_pitch + 1
                sum_line(gray, summed, sums, at, columns)
                if top <= summed < bottom:
                    target = half[BORDER + summed]
                    for x in range(columns):
                        target[BORDER + x] = np.uint8((sums[at + x] + np.uint16(2)) >> np.uint16(2))
                summed += 1
            # the row's rectified derivatives
            here = (row & 3) * sum_pitch + 1
            above = (max(row - 1, 0) & 3) * sum_pitch + 1
            below = (min(row + 1, rows - 1) & 3) * sum_pitch + 1
            at = (row & (RING - 1)) * pitch
            for x in range(0, columns, 4):
                bins = derivatives(sums, here + x, above + x, below + x)
                store_uint16(rings[0], at + 8 * x, bins)
        y = blur_cascade(
            rings,
            pitch,
            row,
            rows,
            columns,
            top,
            bottom,
            blurs,
            reach,
            0,
            geometry,
            layout.MARGIN // 2,
            floor,
            cells,
            line,
        )
        # every second row of the last level completes a row of quarter resolution
        if top <= y < bottom and (y & 1 or rows == 1) and y // 2 < len(coarse):
            upper = ((y & ~1) & (RING - 1)) * pitch
            lower = (y & (RING - 1)) * pitch
            quarter_line(rings[levels], upper, lower, columns, coarse[y // 2])


@kernel
def coarse_levels(
    start: int,
    stop: int,
    coarse: Halves,
    columns: int,
    blurs: Longs,
    first_level: int,
    geometry: MapGeometry,
    floor: float,
    cells: Bytes,
) -> None:
    """The quarter-resolution levels of rows start..stop.

    Args:
        start: First row.
        stop: One past the last.
        coarse: uint16 ``[rows, >= 8 columns]`` of `fine_levels`.
        columns: Pixels a row.
        blurs: int64 ``[L, 2]``, taps and distance of each level.
        first_level: Number of the first of these levels.
        geometry: `layout.MapGeometry`.
        floor: Added to norms.
        cells: uint8, flat, all levels' histograms.
    """
    rows = len(coarse)
    length = 32 * ((8 * columns + 31) // 32)
    pitch = length + SPILL
    rings = np.zeros((len(blurs) + 1, RING * pitch), dtype=np.uint16)
    line = np.zeros(length + 32 * farthest_tap(blurs) + SPILL, dtype=np.uint16)
    reach = level_reach(blurs)
    for row in range(max(start - reach[0], 0), stop + reach[0]):
        # the source's row into its ring
        if row < rows:
            source = coarse[row]
            at = (row & (RING - 1)) * pitch
            for i in range(0, length, 32):
                store_uint16(rings[0], at + i, load_uint16(source, i))
        # the rows of all levels that it completes
        blur_cascade(
            rings,
            pitch,
            row,
            rows,
            columns,
            start,
            stop,
            blurs,
            reach,
            first_level,
            geometry,
            layout.MARGIN // 4,
            floor,
            cells,
            line,
        )
