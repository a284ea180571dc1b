"""The distance of two DAISY descriptors, eight histograms at a time: the first term of Eq. 1.

The vector instruction has its plain form beside it, which a test compares it with. How an instruction
is written: `core.simd`.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types

from dynslam_bench.core.compiled import Scalar, kernel
from dynslam_bench.core.simd import (
    BYTE,
    INT32,
    INT64,
    Bytes,
    Code,
    Definition,
    Ints,
    constant,
    instruction,
    smaller,
    splat,
    sum_of_lanes,
)


def _histogram_distances(builder: Code, first: Code, second: Code, count: int) -> Code:
    """Code for L1 distances of `count` histograms of eight bytes, as ``count`` 64-bit lanes."""
    # absolute differences of bytes: the larger less the smaller
    bytes_ = ir.VectorType(BYTE, 8 * count)
    second = builder.bitcast(second, bytes_)
    first = builder.bitcast(first, bytes_)
    above = builder.icmp_unsigned(">", first, second)
    total = builder.sub(builder.select(above, first, second), builder.select(above, second, first))
    # add neighbours until a histogram is one number: lanes of 16, 32, then 64 bits
    for bits in (8, 16, 32):
        pairs = ir.VectorType(ir.IntType(2 * bits), 32 * count // bits)
        total = builder.bitcast(total, pairs)
        low = builder.and_(total, constant(pairs, (1 << bits) - 1))
        total = builder.add(low, builder.lshr(total, constant(pairs, bits)))
    return total


@instruction
def descriptor_sum(
    typing_context: Code,
    image: Code,
    samples: Code,
    near_row: Code,
    far_row: Code,
    near: Code,
    far: Code,
    descriptor: Code,
    at: Code,
    truncation: Code,
) -> Definition:
    """Sum of the truncated L1 distances of 17 histograms of eight bytes (first term of Eq. 1), without a branch.

    Written as generic vector code. Nothing is checked.

    Args:
        typing_context: Numba's.
        image: Flat uint8 array, the histograms of the image that is sampled.
        samples: int32 array of 17 byte offsets a row.
        near_row: Row of `samples` in force for the first nine histograms ...
        far_row: ... and for the last eight.
        near: Byte offset of the cell to which the first nine offsets are added ...
        far: ... and the last eight.
        descriptor: Flat uint8 array, the histograms compared with.
        at: Index of the first of its 136 bytes.
        truncation: Largest distance counted for one histogram.
    """
    signature = types.int64(
        image, samples, *([types.int64] * 4), descriptor, types.int64, types.int64
    )

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, samples, near_row, far_row, near, far, descriptor, at, truncation = arguments
        cells = context.make_array(kind.args[0])(context, builder, image).data
        offsets = context.make_array(kind.args[1])(context, builder, samples).data
        own = context.make_array(kind.args[6])(context, builder, descriptor).data
        own = builder.gep(own, [at])

        def add_distances(total: Code, first: int, count: int, cell: Code, row: Code) -> Code:
            """Code that adds the distances of `count` histograms from the `first` on."""
            lanes = ir.VectorType(INT64, count)

            # the image's histograms, a 64-bit lane each, from where the samples lie
            sampled = ir.Constant(lanes, ir.Undefined)
            base = builder.gep(cells, [cell])
            line = builder.gep(offsets, [builder.mul(row, ir.Constant(INT64, 17))])
            for k in range(count):
                offset = builder.load(builder.gep(line, [ir.Constant(INT64, first + k)]))
                place = builder.gep(base, [builder.sext(offset, INT64)])
                histogram = builder.load(builder.bitcast(place, INT64.as_pointer()))
                histogram.align = 1
                sampled = builder.insert_element(sampled, histogram, ir.Constant(INT32, k))

            # the descriptor's own, which lie side by side
            place = builder.gep(own, [ir.Constant(INT64, 8 * first)])
            compared = builder.load(builder.bitcast(place, lanes.as_pointer()))
            compared.align = 1

            distances = _histogram_distances(builder, sampled, compared, count)
            limit = splat(builder, lanes, truncation)
            truncated = smaller(builder, distances, limit)
            return builder.add(total, sum_of_lanes(builder, truncated, builder.add))

        # the centre, the first ring, the second ring
        total = ir.Constant(INT64, 0)
        total = add_distances(total, 0, 1, near, near_row)
        total = add_distances(total, 1, 8, near, near_row)
        return add_distances(total, 9, 8, far, far_row)

    return signature, generate


@kernel
def plain_descriptor_sum(
    image: Bytes,
    samples: Ints,
    near_row: int,
    far_row: int,
    near: int,
    far: int,
    descriptor: Bytes,
    at: int,
    truncation: int,
) -> Scalar:
    """`descriptor_sum` byte by byte."""
    offsets = samples.reshape(-1)
    total = np.int64(0)
    for k in range(17):
        # where the image's histogram lies
        cell = near if k < 9 else far
        row = near_row if k < 9 else far_row
        place = cell + offsets[17 * row + k]

        # L1 distance to the descriptor's own, truncated
        distance = np.int64(0)
        for b in range(8):
            distance += abs(np.int64(image[place + b]) - np.int64(descriptor[at + 8 * k + b]))
        total += distance if distance < truncation else np.int64(truncation)
    return total
