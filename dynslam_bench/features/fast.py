"""FAST corners (Rosten and Drummond 2006), sixty-four pixels at a time; the same as OpenCV's.

Each vector instruction has its plain form beside it, which a test compares it with.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce

import numpy as np
from llvmlite import ir
from numba import types
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, kernel
from dynslam_bench.core.simd import (
    BYTE_LANES,
    Code,
    Definition,
    constant,
    instruction,
    larger,
    load_vector,
    pointer_to,
    smaller,
    splat,
)

EDGE = 19
"""Corners nearer to a level's border than this are not used: the rotated descriptor pattern would leave the image."""

CIRCLE = np.array(
    [
        (0, 3),
        (1, 3),
        (2, 2),
        (3, 1),
        (3, 0),
        (3, -1),
        (2, -2),
        (1, -3),
        (0, -3),
        (-1, -3),
        (-2, -2),
        (-3, -1),
        (-3, 0),
        (-3, 1),
        (-2, 2),
        (-1, 3),
    ]
)
"""The sixteen pixels of FAST around a corner, (column, row) each."""

# LLVM's types
_BYTE = ir.IntType(8)
_INT64 = ir.IntType(64)
_BYTES64 = ir.VectorType(_BYTE, BYTE_LANES)


def fast_corners(
    image: NDArray[np.uint8], threshold: int
) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
    """FAST corners that are stronger than their eight neighbours, row by row; the same as OpenCV's.

    Args:
        image: uint8 ``[H, W]``, more than twice `EDGE` wide and high; corners nearer to its border
            are left out.
        threshold: Least score, at least 1.

    Returns:
        Indices ``[N]`` into the flat image, and their scores ``[N]``.
    """
    height, width = image.shape
    circle = CIRCLE[:, 0] + CIRCLE[:, 1] * width
    maxima = np.zeros(image.size, np.uint8)
    # of 2 x 2 pixels one at most is stronger than its neighbours
    corners = np.empty(image.size // 4, np.int64)
    count = list_corners(image.reshape(-1), height, width, threshold, circle, maxima, corners)
    corners = corners[:count]
    return corners, maxima[corners].astype(np.int16)


@kernel
def list_corners(
    pixels: NDArray[np.uint8],
    height: int,
    width: int,
    threshold: int,
    circle: NDArray[np.int64],
    maxima: NDArray[np.uint8],
    corners: NDArray[np.int64],
) -> int:
    """Fill the scores of the corners of a flat image, 0 elsewhere, and the corners' indices; returns how many.

    Args:
        pixels: uint8, flat, the image and what the last vector reads beyond it.
        height: Rows of the image.
        width: Columns of the image.
        threshold: Least score of a corner.
        circle: Offsets of the circle's pixels in the flat image.
        maxima: uint8, flat, filled.
        corners: int64, filled with indices of the flat image.
    """
    scores = np.zeros(len(pixels), np.uint8)
    # scores of all rows but those near the upper and lower border
    first = EDGE * width
    last = (height - EDGE) * width
    for at in range(first, last, BYTE_LANES):
        store_corner_scores(scores, pixels, at, circle)
    # none near the left and right border, nor where the last vector passed the last row
    for y in range(EDGE, height - EDGE):
        for x in range(EDGE):
            scores[y * width + x] = scores[(y + 1) * width - 1 - x] = 0
    for at in range(last, last + BYTE_LANES):
        scores[at] = 0
    # non-maximum suppression
    for at in range(first, last, BYTE_LANES):
        store_maxima(maxima, scores, at, width, threshold)
    # list the maxima, without a branch; of four adjacent pixels one at most is a maximum
    count = 0
    for at in range(first, last):
        corners[count] = at
        count += maxima[at] > 0
    return count


@instruction
def store_corner_scores(
    typing_context: Code, scores: Code, image: Code, at: Code, circle: Code
) -> Definition:
    """Write the FAST scores of sixty-four adjacent pixels (Rosten and Drummond 2006).

    The score is the largest threshold at which the pixel is a corner: nine adjacent pixels of the
    circle around it are all brighter, or all darker, by more than the threshold. It is 0 where
    there is none.

    Args:
        typing_context: Numba's.
        scores: Flat uint8 array that is written.
        image: Flat uint8 array, grey levels.
        at: Index of the first pixel.
        circle: int64 array, offsets of the sixteen pixels of the circle, in order.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        scores, image, at, circle = arguments
        lower = partial(smaller, builder)
        higher = partial(larger, builder)

        def pixels(index: Code) -> Code:
            return load_vector(context, builder, kind.args[1], image, index, _BYTES64, 1)

        # the sixteen pixels of the circle, for sixty-four centres at once
        offsets = context.make_array(kind.args[3])(context, builder, circle).data
        ring = []
        for k in range(16):
            offset = builder.load(builder.gep(offsets, [ir.Constant(_INT64, k)]))
            ring.append(pixels(builder.add(at, offset)))
        centre = pixels(at)

        def best_arc(worse: Callable[..., Code], better: Callable[..., Code]) -> Code:
            """The grey level that all pixels of the best arc of nine reach."""
            # the worst of two, four and eight pixels that follow each other, from every odd one on
            twos = [worse(ring[k], ring[(k + 1) % 16]) for k in range(1, 16, 2)]
            fours = [worse(twos[k], twos[(k + 1) % 8]) for k in range(8)]
            eights = [worse(fours[k], fours[(k + 2) % 8]) for k in range(8)]
            # with one more pixel at either end these are all sixteen arcs of nine
            arcs = [worse(eights[k], better(ring[2 * k], ring[(2 * k + 9) % 16])) for k in range(8)]
            return reduce(better, arcs)

        # differences that are negative become 0, because the centre takes part
        brighter = builder.sub(higher(best_arc(lower, higher), centre), centre)
        darker = builder.sub(centre, lower(best_arc(higher, lower), centre))
        # the largest threshold that the difference exceeds
        one = constant(_BYTES64, 1)
        score = builder.sub(higher(higher(brighter, darker), one), one)
        pointer = pointer_to(context, builder, kind.args[0], scores, at, _BYTES64)
        builder.store(score, pointer, align=1)
        return context.get_dummy_value()

    return types.void(scores, image, types.int64, circle), generate


@kernel
def plain_corner_scores(
    scores: NDArray[np.uint8], image: NDArray[np.uint8], at: int, circle: NDArray[np.int64]
) -> None:
    """`store_corner_scores` pixel by pixel."""
    for pixel in range(at, at + BYTE_LANES):
        centre = np.int64(image[pixel])
        score = 0
        for first in range(16):
            # the least difference of an arc of nine, for a corner that is darker than the arc or brighter
            brighter: Scalar = 255
            darker: Scalar = 255
            for k in range(first, first + 9):
                difference = np.int64(image[pixel + circle[k % 16]]) - centre
                brighter = min(brighter, difference)
                darker = min(darker, -difference)
            # the largest threshold that the difference exceeds
            score = max(score, brighter - 1, darker - 1)
        scores[pixel] = score


@instruction
def store_maxima(
    typing_context: Code, maxima: Code, scores: Code, at: Code, width: Code, least: Code
) -> Definition:
    """Write sixty-four adjacent scores, those that are below `least` or not above all eight around them as 0.

    Args:
        typing_context: Numba's.
        maxima: Flat uint8 array that is written.
        scores: Flat uint8 array.
        at: Index of the first score.
        width: Scores a row.
        least: In 1 to 255.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        maxima, scores, at, width, least = arguments

        def scores_at(row: Code, dx: int) -> Code:
            index = builder.add(row, ir.Constant(_INT64, dx))
            return load_vector(context, builder, kind.args[1], scores, index, _BYTES64, 1)

        above = builder.sub(at, width)
        below = builder.add(at, width)
        around = [
            *(scores_at(above, dx) for dx in (-1, 0, 1)),
            *(scores_at(at, dx) for dx in (-1, 1)),
            *(scores_at(below, dx) for dx in (-1, 0, 1)),
        ]

        # a maximum exceeds the eight around it, and the largest score that is too small
        least_byte = splat(builder, _BYTES64, builder.trunc(least, _BYTE))
        too_small = builder.sub(least_byte, constant(_BYTES64, 1))
        bound = reduce(partial(larger, builder), around, too_small)
        score = load_vector(context, builder, kind.args[1], scores, at, _BYTES64, 1)
        is_maximum = builder.icmp_unsigned(">", score, bound)
        kept = builder.select(is_maximum, score, constant(_BYTES64, 0))
        pointer = pointer_to(context, builder, kind.args[0], maxima, at, _BYTES64)
        builder.store(kept, pointer, align=1)
        return context.get_dummy_value()

    return types.void(maxima, scores, types.int64, types.int64, types.int64), generate


@kernel
def plain_maxima(
    maxima: NDArray[np.uint8], scores: NDArray[np.uint8], at: int, width: int, least: int
) -> None:
    """`store_maxima` score by score."""
    for pixel in range(at, at + BYTE_LANES):
        score = scores[pixel]
        is_maximum = score >= least
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if dx != 0 or dy != 0:
                    is_maximum = is_maximum and score > scores[pixel + dy * width + dx]
        maxima[pixel] = score if is_maximum else 0
