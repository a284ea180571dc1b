"""Histograms of orientations as vectors: four at a time, of eight bins each.

Each vector instruction has its plain form beside it, which a test compares it with. How an instruction
is written: `core.simd`. All are exact in whole numbers but `store_normalised`, whose square root and
division IEEE 754 defines to the last bit.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from dynslam_bench.core.compiled import Scalar, kernel
from dynslam_bench.core.simd import (
    BYTES32,
    FLOAT,
    FLOATS32,
    INT32,
    INT64,
    INTS32,
    UINT16,
    UINT16_LANES,
    UINT16S,
    UINT16X32,
    Bytes,
    Code,
    Definition,
    Halves,
    constant,
    instruction,
    lane_numbers,
    load_vector,
    pointer_to,
    splat,
)

COSINES = (32768, 23170, 0, -23170, -32768, -23170, 0, 23170)
"""Cosines of multiples of 45 degrees, in 32768ths; two places on are the sines."""
DERIVATIVE_SHIFT = 11
"""From differences of sums over 2 x 2 pixels times `COSINES` to 256ths of a grey level a full-image pixel."""

EACH_EIGHT_TIMES = lane_numbers(*(pixel for pixel in range(4) for _ in range(8)))
"""Four numbers to thirty-two: 0 0 0 0 0 0 0 0 1 1 ..., a number for each bin of four histograms."""


def _average(builder: Code, first: Code, second: Code) -> Code:
    """Code for ``(a + b + 1) >> 1`` of uint16 vectors, in 32 bits."""
    total = builder.add(builder.zext(first, INTS32), builder.zext(second, INTS32))
    one = constant(INTS32, 1)
    return builder.trunc(builder.lshr(builder.add(total, one), one), UINT16S)


@instruction
def average(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded mean ``(a + b + 1) >> 1`` of two uint16 vectors, lane by lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return _average(builder, *arguments)

    return UINT16X32(first, second), generate


@kernel
def plain_average(first: Halves, second: Halves, out: Halves) -> None:
    """`average` number by number, into `out` ``[32]``."""
    for lane in range(UINT16_LANES):
        out[lane] = (np.int64(first[lane]) + np.int64(second[lane]) + 1) >> 1


@instruction
def average_of_pairs(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded means of adjacent histograms of eight bins: the four of each vector, eight in all, to four."""
    # of each pair of histograms, sixteen numbers, the first eight and the last eight
    even = [16 * pair + b for pair in range(4) for b in range(8)]
    odd = [lane + 8 for lane in even]

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        left = builder.shuffle_vector(*arguments, lane_numbers(*even))
        right = builder.shuffle_vector(*arguments, lane_numbers(*odd))
        return _average(builder, left, right)

    return UINT16X32(first, second), generate


@kernel
def plain_average_of_pairs(first: Halves, second: Halves, out: Halves) -> None:
    """`average_of_pairs` number by number, into `out` ``[32]``."""
    for pair in range(4):
        # two pairs of histograms in the first vector, two in the second
        histograms = first if pair < 2 else second
        left = 16 * (pair % 2)
        for b in range(8):
            total = np.int64(histograms[left + b]) + np.int64(histograms[left + 8 + b])
            out[8 * pair + b] = (total + 1) >> 1


@instruction
def derivatives(
    typing_context: Code, sums: Code, here: Code, above: Code, below: Code
) -> Definition:
    """Rectified directional derivatives of four adjacent pixels.

    Args:
        typing_context: Numba's.
        sums: Flat uint16 array, sums over 2 x 2 pixels.
        here: Index of the first pixel.
        above: Index of the pixel above it.
        below: Index of the pixel below it.

    Returns:
        Eight bins a pixel, 256ths of a grey level a full-image pixel.
    """
    four = ir.VectorType(UINT16, 4)
    four_wide = ir.VectorType(INT32, 4)
    # bins of 45 degrees, of four pixels one after the other
    cosines = ir.Constant(INTS32, [COSINES[b % 8] for b in range(UINT16_LANES)])
    sines = ir.Constant(INTS32, [COSINES[(b - 2) % 8] for b in range(UINT16_LANES)])

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        sums, here, above, below = arguments

        def pixels(index: Code) -> Code:
            loaded = load_vector(context, builder, kind.args[0], sums, index, four, 2)
            return builder.zext(loaded, four_wide)

        # central differences of four pixels, each eight times
        one = ir.Constant(INT64, 1)
        gx = builder.sub(pixels(builder.add(here, one)), pixels(builder.sub(here, one)))
        gy = builder.sub(pixels(below), pixels(above))
        gx = builder.shuffle_vector(gx, gx, EACH_EIGHT_TIMES)
        gy = builder.shuffle_vector(gy, gy, EACH_EIGHT_TIMES)

        # the derivative along each bin's direction, rounded; negative ones become 0
        along = builder.add(builder.mul(gx, cosines), builder.mul(gy, sines))
        rounded = builder.add(along, constant(INTS32, 1 << (DERIVATIVE_SHIFT - 1)))
        value = builder.ashr(rounded, constant(INTS32, DERIVATIVE_SHIFT))
        zero = constant(INTS32, 0)
        rectified = builder.select(builder.icmp_signed(">", value, zero), value, zero)
        return builder.trunc(rectified, UINT16S)

    return UINT16X32(sums, types.int64, types.int64, types.int64), generate


@kernel
def plain_derivatives(sums: Halves, here: int, above: int, below: int, out: Halves) -> None:
    """`derivatives` bin by bin, into `out` ``[32]``."""
    for pixel in range(4):
        # central differences
        gx = np.int64(sums[here + pixel + 1]) - np.int64(sums[here + pixel - 1])
        gy = np.int64(sums[below + pixel]) - np.int64(sums[above + pixel])
        for b in range(8):
            # the derivative along the bin's direction, rounded; negative ones become 0
            along = gx * COSINES[b] + gy * COSINES[(b - 2) % 8]
            rounded = (along + (1 << (DERIVATIVE_SHIFT - 1))) >> DERIVATIVE_SHIFT
            out[8 * pixel + b] = rounded if rounded > 0 else np.int64(0)


@instruction
def store_normalised(
    typing_context: Code, array: Code, index: Code, halves: Code, floor: Code
) -> Definition:
    """Write four histograms as 32 bytes: each divided by its Euclidean norm plus `floor`, times 255, rounded."""
    four = ir.VectorType(FLOAT, 4)

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        array, index, halves, floor = arguments
        numbers = builder.zext(halves, INTS32)

        # sums of squares of each histogram: neighbours are added until four numbers are left
        squares = builder.mul(numbers, numbers)
        for count in (32, 16, 8):
            even = builder.shuffle_vector(squares, squares, lane_numbers(*range(0, count, 2)))
            odd = builder.shuffle_vector(squares, squares, lane_numbers(*range(1, count, 2)))
            squares = builder.add(even, odd)

        # 255 / (norm + floor), a factor for each histogram
        square_root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(four, [four]), "llvm.sqrt.v4f32"
        )
        norm = builder.call(square_root, [builder.sitofp(squares, four)])
        divisor = builder.fadd(norm, splat(builder, four, floor))
        gain = builder.fdiv(constant(four, 255.0), divisor)

        # the bins times their histogram's factor, rounded to bytes
        gains = builder.shuffle_vector(gain, gain, EACH_EIGHT_TIMES)
        scaled = builder.fmul(builder.sitofp(numbers, FLOATS32), gains)
        rounded = builder.fptosi(builder.fadd(scaled, constant(FLOATS32, 0.5)), INTS32)
        pointer = pointer_to(context, builder, kind.args[0], array, index, BYTES32)
        builder.store(builder.trunc(rounded, BYTES32), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.int64, UINT16X32, types.float32), generate


@kernel
def plain_store_normalised(array: Bytes, index: int, histograms: Halves, floor: Scalar) -> None:
    """`store_normalised` bin by bin, of histograms ``[32]``; `floor` is a float32."""
    for first in range(0, UINT16_LANES, 8):
        # 255 / (norm + floor) in float32
        squares = np.int64(0)
        for b in range(first, first + 8):
            squares += np.int64(histograms[b]) * np.int64(histograms[b])
        gain = np.float32(255) / (np.sqrt(np.float32(squares)) + floor)
        for b in range(first, first + 8):
            scaled = np.float32(histograms[b]) * gain
            array[index + b] = np.int64(scaled + np.float32(0.5))
