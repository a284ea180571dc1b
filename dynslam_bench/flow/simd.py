"""SIMD vectors inside the compiled kernels: sixteen float32 or thirty-two uint16 numbers as one value.

Written as generic vector code of fixed width (llvmlite): LLVM maps it to the processor's instructions. The order of
every sum is part of the program, so that results do not depend on the processor. The uint16 operations are exact but
for one square root and division, which IEEE 754 defines to the last bit; `tests/flow/torch_reference.py` gives the same
bytes.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numpy.typing import NDArray

Flags = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Halves = NDArray[np.uint16]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


Code: TypeAlias = Any
"""A type, value or builder of numba and llvmlite, neither of which is annotated."""

Arguments = ParamSpec("Arguments")
Definition: TypeAlias = tuple[Code, Callable[[Code, Code, Code, Code], Code]]
"""Numba's signature of an instruction, and the function that writes its code."""


def instruction(define: Callable[Concatenate[Code, Arguments], Definition]) -> Callable[Arguments, Code]:
    """Make an instruction for kernels from a function of numba's typing context and the types of the arguments."""
    return cast("Callable[Arguments, Code]", intrinsic(define))


FLOAT_LANES, UINT16_LANES = 16, 32
_FLOAT, _INT64, _INT32, _UINT16, _BYTE = ir.FloatType(), ir.IntType(64), ir.IntType(32), ir.IntType(16), ir.IntType(8)
_FLOATS, _INTS = ir.VectorType(_FLOAT, FLOAT_LANES), ir.VectorType(_INT32, FLOAT_LANES)
_BYTES16, _PAIRS = ir.VectorType(_BYTE, FLOAT_LANES), ir.VectorType(_UINT16, FLOAT_LANES)
_HALVES, _BYTES32 = ir.VectorType(_UINT16, UINT16_LANES), ir.VectorType(_BYTE, UINT16_LANES)
COSINES = (32768, 23170, 0, -23170, -32768, -23170, 0, 23170)
"""Cosines of multiples of 45 degrees, in 32768ths; two places on are the sines."""
DERIVATIVE_SHIFT = 11
"""From differences of sums over 2 x 2 pixels times `COSINES` to 256ths of a grey level a full-image pixel."""


class SimdType(types.Type):
    """Numba's type of a vector.

    Args:
        name: Of the type.
        vector: LLVM's type.
    """

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(SimdType)
class _SimdModel(models.PrimitiveModel):
    def __init__(self, manager: Code, kind: Code) -> None:
        super().__init__(manager, kind, kind.vector)


FLOAT32X16, UINT16X32 = SimdType("Float32x16", _FLOATS), SimdType("UInt16x32", _HALVES)


class _Arithmetic(AbstractTemplate):
    def generic(self, arguments: Code, keywords: Code) -> Code:
        return signature(FLOAT32X16, *arguments) if arguments == (FLOAT32X16, FLOAT32X16) else None


def _define(symbol: Code, operation: str) -> None:
    infer_global(symbol)(type(f"_Lanes_{operation}", (_Arithmetic,), {}))

    def lowered(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return getattr(builder, operation)(*arguments)

    lower_builtin(symbol, SimdType, SimdType)(lowered)


for _symbol, _operation in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _define(_symbol, _operation)


def pointer_to(context: Code, builder: Code, kind: Code, array: Code, index: Code, vector: ir.VectorType) -> Code:
    """Code for the address of an array's element, as the address of a vector."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _float_constant(kind: ir.VectorType, value: float) -> Code:
    return ir.Constant(kind, [value] * FLOAT_LANES)


def splat(builder: Code, kind: ir.VectorType, value: Code) -> Code:
    """Code for a vector of sixteen equal numbers."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), _float_constant(_INTS, 0))


@instruction
def load(typing_context: Code, array: Code, index: Code) -> Definition:
    """Sixteen adjacent numbers of a flat float32 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _FLOATS))
        loaded.align = 4
        return loaded

    return FLOAT32X16(array, types.int64), generate


@instruction
def load_bytes(typing_context: Code, array: Code, index: Code) -> Definition:
    """Sixteen adjacent numbers of a flat uint8 array, as floats; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _BYTES16))
        loaded.align = 1
        return builder.sitofp(builder.zext(loaded, _INTS), _FLOATS)

    return FLOAT32X16(array, types.int64), generate


@instruction
def store(typing_context: Code, array: Code, index: Code, vector: Code) -> Definition:
    """Write sixteen adjacent numbers of a flat float32 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        pointer = pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _FLOATS)
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, FLOAT32X16), generate


@instruction
def spread(typing_context: Code, value: Code) -> Definition:
    """The same float32 in every place."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return splat(builder, _FLOATS, arguments[0])

    return FLOAT32X16(types.float32), generate


@instruction
def total(typing_context: Code, vector: Code) -> Definition:
    """Sum of the numbers: halves onto halves, always in the same order."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        rest, width = arguments[0], FLOAT_LANES
        while width > 1:
            width //= 2
            parts = [
                builder.shuffle_vector(
                    rest, rest, ir.Constant(ir.VectorType(_INT32, width), list(range(first, first + width)))
                )
                for first in (0, width)
            ]
            rest = builder.fadd(*parts)
        return builder.extract_element(rest, ir.Constant(_INT32, 0))

    return types.float32(vector), generate


@instruction
def sample(
    typing_context: Code, image: Code, stride: Code, columns: Code, rows: Code, at: Code, column: Code, row: Code,
    step_x: Code, step_y: Code,
) -> Definition:  # fmt: skip
    """Bilinear samples of a flat uint8 image at sixteen places of a rotated and scaled grid.

    Args:
        typing_context: Numba's.
        image: Flat uint8 array.
        stride: Bytes a row of the image, int32.
        columns: Flat int32 array, the places' column on the grid ...
        rows: ... and row.
        at: Index of the first of the sixteen in `columns` and `rows`.
        column: Image column of the grid's origin, in 65536ths of a pixel, int32.
        row: Image row of the grid's origin, likewise.
        step_x: Image columns a grid column (and rows a grid row), likewise.
        step_y: Image rows a grid column (and minus the columns a grid row), likewise.

    Returns:
        Grey levels. The places must lie inside the image by at least one row and one column: nothing is checked.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        pixels, stride, columns, rows, at, column, row, step_x, step_y = arguments
        grid = []
        for k, array in ((2, columns), (3, rows)):
            loaded = builder.load(pointer_to(context, builder, kind.args[k], array, at, _INTS))
            loaded.align = 4
            grid.append(loaded)
        dx, dy = (splat(builder, _INTS, step) for step in (step_x, step_y))
        x = builder.add(splat(builder, _INTS, column), builder.mul(grid[0], dx))
        x = builder.sub(x, builder.mul(grid[1], dy))
        y = builder.add(splat(builder, _INTS, row), builder.mul(grid[0], dy))
        y = builder.add(y, builder.mul(grid[1], dx))
        sixteen, low = _float_constant(_INTS, 16), _float_constant(_INTS, 65535)
        whole = [builder.ashr(value, sixteen) for value in (x, y)]
        share = [
            builder.fmul(builder.sitofp(builder.and_(value, low), _FLOATS), _float_constant(_FLOATS, 1 / 65536))
            for value in (x, y)
        ]
        offset = builder.add(builder.mul(whole[1], splat(builder, _INTS, stride)), whole[0])
        data = context.make_array(kind.args[0])(context, builder, pixels).data
        pairs = [ir.Constant(_PAIRS, ir.Undefined)] * 2  # two adjacent pixels in each lane, of the upper and lower row
        for lane in range(FLOAT_LANES):
            index = ir.Constant(_INT32, lane)
            first = builder.gep(data, [builder.sext(builder.extract_element(offset, index), _INT64)])
            second = builder.gep(first, [builder.sext(stride, _INT64)])
            for line, place in enumerate((first, second)):
                pair = builder.load(builder.bitcast(place, _UINT16.as_pointer()))
                pair.align = 1
                pairs[line] = builder.insert_element(pairs[line], pair, index)
        lines = []
        for pair in pairs:
            both = builder.zext(pair, _INTS)
            left = builder.sitofp(builder.and_(both, _float_constant(_INTS, 255)), _FLOATS)
            right = builder.sitofp(builder.lshr(both, _float_constant(_INTS, 8)), _FLOATS)
            lines.append(builder.fadd(left, builder.fmul(share[0], builder.fsub(right, left))))
        return builder.fadd(lines[0], builder.fmul(share[1], builder.fsub(lines[1], lines[0])))

    return FLOAT32X16(image, types.int32, columns, rows, types.int64, *([types.int32] * 4)), generate


def _mask(places: list[int]) -> Code:
    return ir.Constant(ir.VectorType(_INT32, len(places)), places)


def _vector(element: Code, values: Code) -> Code:
    return ir.Constant(ir.VectorType(element, len(values)), list(values))


def _average(builder: Code, first: Code, second: Code) -> Code:
    wide = ir.VectorType(_INT32, UINT16_LANES)
    total = builder.add(builder.zext(first, wide), builder.zext(second, wide))
    one = _vector(_INT32, [1] * UINT16_LANES)
    return builder.trunc(builder.lshr(builder.add(total, one), one), _HALVES)


@instruction
def load_uint16(typing_context: Code, array: Code, index: Code) -> Definition:
    """Thirty-two adjacent numbers of a flat uint16 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _HALVES))
        loaded.align = 2
        return loaded

    return UINT16X32(array, types.int64), generate


@instruction
def store_uint16(typing_context: Code, array: Code, index: Code, halves: Code) -> Definition:
    """Write thirty-two adjacent numbers of a flat uint16 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        pointer = pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _HALVES)
        builder.store(arguments[2], pointer, align=2)
        return context.get_dummy_value()

    return types.void(array, types.int64, UINT16X32), generate


@instruction
def average(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded mean ``(a + b + 1) >> 1`` of every number."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return _average(builder, *arguments)

    return UINT16X32(first, second), generate


@instruction
def average_of_pairs(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded means of adjacent histograms: eight histograms to four."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        parts = [
            builder.shuffle_vector(*arguments, _mask([16 * pair + odd + b for pair in range(4) for b in range(8)]))
            for odd in (0, 8)
        ]
        return _average(builder, *parts)

    return UINT16X32(first, second), generate


@instruction
def derivatives(typing_context: Code, sums: Code, here: Code, above: Code, below: Code) -> Definition:
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

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        four, wide = ir.VectorType(_UINT16, 4), ir.VectorType(_INT32, 4)

        def pixels(index: Code) -> Code:
            loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], index, four))
            loaded.align = 2
            return builder.zext(loaded, wide)

        one = ir.Constant(ir.IntType(64), 1)
        gx = builder.sub(pixels(builder.add(arguments[1], one)), pixels(builder.sub(arguments[1], one)))
        gy = builder.sub(pixels(arguments[3]), pixels(arguments[2]))
        spread = _mask([pixel for pixel in range(4) for _ in range(8)])
        gx, gy = (builder.shuffle_vector(g, g, spread) for g in (gx, gy))
        sines = [COSINES[(b - 2) % 8] for b in range(8)]
        along = builder.add(builder.mul(gx, _vector(_INT32, COSINES * 4)), builder.mul(gy, _vector(_INT32, sines * 4)))
        rounded = builder.add(along, _vector(_INT32, [1 << (DERIVATIVE_SHIFT - 1)] * UINT16_LANES))
        value = builder.ashr(rounded, _vector(_INT32, [DERIVATIVE_SHIFT] * UINT16_LANES))
        zero = _vector(_INT32, [0] * UINT16_LANES)
        return builder.trunc(builder.select(builder.icmp_signed(">", value, zero), value, zero), _HALVES)

    return UINT16X32(sums, types.int64, types.int64, types.int64), generate


@instruction
def store_normalised(typing_context: Code, array: Code, index: Code, halves: Code, floor: Code) -> Definition:
    """Write four histograms as 32 bytes: each divided by its Euclidean norm plus `floor`, times 255, rounded."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        array, index, halves, floor = arguments
        wide = builder.zext(halves, ir.VectorType(_INT32, UINT16_LANES))
        squares, count = builder.mul(wide, wide), UINT16_LANES
        while count > 4:
            parts = [builder.shuffle_vector(squares, squares, _mask(list(range(odd, count, 2)))) for odd in (0, 1)]
            squares, count = builder.add(*parts), count // 2
        floats = ir.VectorType(_FLOAT, 4)
        root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(floats, [floats]), "llvm.sqrt.v4f32")
        norm = builder.call(root, [builder.sitofp(squares, floats)])
        spread = _mask([pixel for pixel in range(4) for _ in range(8)])
        first = builder.insert_element(ir.Constant(floats, ir.Undefined), floor, ir.Constant(_INT32, 0))
        floors = builder.shuffle_vector(first, first, _mask([0] * 4))
        gain = builder.fdiv(_vector(_FLOAT, [255.0] * 4), builder.fadd(norm, floors))
        gains = builder.shuffle_vector(gain, gain, spread)
        scaled = builder.fmul(builder.sitofp(wide, ir.VectorType(_FLOAT, UINT16_LANES)), gains)
        rounded = builder.fptosi(
            builder.fadd(scaled, _vector(_FLOAT, [0.5] * UINT16_LANES)), ir.VectorType(_INT32, UINT16_LANES)
        )
        builder.store(
            builder.trunc(rounded, _BYTES32),
            pointer_to(context, builder, kind.args[0], array, index, _BYTES32),
            align=1,
        )
        return context.get_dummy_value()

    return types.void(array, types.int64, UINT16X32, types.float32), generate


def _repeated(element: Code, value: int, count: int) -> Code:
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
        low = builder.and_(total, _repeated(element, (1 << bits) - 1, lanes))
        total = builder.add(low, builder.lshr(total, _repeated(element, bits, lanes)))
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
        total = ir.Constant(_INT64, 0)
        for first, count, cell, row in ((0, 1, near, near_row), (1, 8, near, near_row), (9, 8, far, far_row)):
            lanes = ir.VectorType(_INT64, count)
            base, theirs = builder.gep(cells, [cell]), ir.Constant(lanes, ir.Undefined)
            line = builder.gep(offsets, [builder.mul(row, ir.Constant(_INT64, 17))])
            for k in range(count):
                offset = builder.load(builder.gep(line, [ir.Constant(_INT64, first + k)]))
                place = builder.gep(base, [builder.sext(offset, _INT64)])
                histogram = builder.load(builder.bitcast(place, _INT64.as_pointer()))
                histogram.align = 1
                theirs = builder.insert_element(theirs, histogram, ir.Constant(_INT32, k))
            own = builder.load(builder.bitcast(builder.gep(mine, [ir.Constant(_INT64, 8 * first)]), lanes.as_pointer()))
            own.align = 1
            distances = _histogram_distances(builder, theirs, own, count)
            limit = ir.Constant(lanes, ir.Undefined)
            for k in range(count):
                limit = builder.insert_element(limit, truncation, ir.Constant(_INT32, k))
            below = builder.icmp_unsigned("<", distances, limit)
            kept = builder.select(below, distances, limit)
            for k in range(count):
                total = builder.add(total, builder.extract_element(kept, ir.Constant(_INT32, k)))
        return total

    return signature, generate
