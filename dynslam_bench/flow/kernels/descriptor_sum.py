"""The sum of truncated histogram distances that matching costs consist of, as one instruction."""

from __future__ import annotations

from llvmlite import ir
from numba import types

from .instruction import Code, Definition, instruction

_BYTE, _WORD, _LONG = ir.IntType(8), ir.IntType(32), ir.IntType(64)


def _constant(element: Code, value: int, count: int) -> Code:
    return ir.Constant(ir.VectorType(element, count), [value] * count)


def _histogram_distances(builder: Code, first: Code, second: Code, count: int) -> Code:
    """L1 distances of `count` histograms of eight bytes, as ``count`` 64-bit lanes."""
    bytes_ = ir.VectorType(_BYTE, 8 * count)
    first, second = builder.bitcast(first, bytes_), builder.bitcast(second, bytes_)
    above = builder.icmp_unsigned(">", first, second)
    total = builder.sub(builder.select(above, first, second), builder.select(above, second, first))
    for bits in (8, 16, 32):  # add neighbours until a histogram is one number
        element, lanes = ir.IntType(2 * bits), 8 * count * 8 // (2 * bits)
        total = builder.bitcast(total, ir.VectorType(element, lanes))
        low = builder.and_(total, _constant(element, (1 << bits) - 1, lanes))
        total = builder.add(low, builder.lshr(total, _constant(element, bits, lanes)))
    return total


@instruction
def descriptor_sum(
    typing_context: Code, image: Code, samples: Code, near_row: Code, far_row: Code, near: Code, far: Code,
    descriptor: Code, at: Code, truncation: Code,
) -> Definition:  # fmt: skip
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
    signature = types.int64(image, samples, *([types.int64] * 4), descriptor, types.int64, types.int64)

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, samples, near_row, far_row, near, far, descriptor, at, truncation = arguments
        cells, offsets, mine = (
            context.make_array(kind.args[k])(context, builder, array).data
            for k, array in ((0, image), (1, samples), (6, descriptor))
        )
        mine = builder.gep(mine, [at])
        total = ir.Constant(_LONG, 0)
        for first, count, cell, row in ((0, 1, near, near_row), (1, 8, near, near_row), (9, 8, far, far_row)):
            lanes = ir.VectorType(_LONG, count)
            base, theirs = builder.gep(cells, [cell]), ir.Constant(lanes, ir.Undefined)
            line = builder.gep(offsets, [builder.mul(row, ir.Constant(_LONG, 17))])
            for k in range(count):
                offset = builder.load(builder.gep(line, [ir.Constant(_LONG, first + k)]))
                place = builder.gep(base, [builder.sext(offset, _LONG)])
                histogram = builder.load(builder.bitcast(place, _LONG.as_pointer()))
                histogram.align = 1
                theirs = builder.insert_element(theirs, histogram, ir.Constant(_WORD, k))
            own = builder.load(builder.bitcast(builder.gep(mine, [ir.Constant(_LONG, 8 * first)]), lanes.as_pointer()))
            own.align = 1
            distances = _histogram_distances(builder, theirs, own, count)
            limit = ir.Constant(lanes, ir.Undefined)
            for k in range(count):
                limit = builder.insert_element(limit, truncation, ir.Constant(_WORD, k))
            below = builder.icmp_unsigned("<", distances, limit)
            kept = builder.select(below, distances, limit)
            for k in range(count):
                total = builder.add(total, builder.extract_element(kept, ir.Constant(_WORD, k)))
        return total

    return signature, generate
