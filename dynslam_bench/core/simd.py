"""SIMD vectors inside compiled kernels: 16 float32, 32 uint16 or 64 uint8 numbers as one value.

Written as generic vector code of fixed width (llvmlite): LLVM maps it to the processor's
instructions. A lane is the place of one number in a vector, as in SIMD hardware. The order of
every sum is part of the program, so that results do not depend on the processor. The uint16
operations are exact but for one square root and division, which IEEE 754 defines to the last bit;
`tests/helpers/exact_reference.py` gives the same bytes.

How an instruction is written: the function under `instruction` gets numba's types of the arguments
and returns the signature and a function `generate`, which writes LLVM's code with a builder. The
arguments of `generate` are LLVM's values; ``kind.args`` has numba's types of them, which tell how an
array lies in memory.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, TypeAlias

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
Words = NDArray[np.uint64]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


Code: TypeAlias = Any
"""A type, value or builder of numba and llvmlite, neither of which is annotated."""

Definition: TypeAlias = tuple[Code, Callable[[Code, Code, Code, Code], Code]]
"""Numba's signature of an instruction, and the function that writes its code."""


def instruction(define: Callable[..., Definition]) -> Code:
    """Make an instruction for kernels from a function of numba's typing context and the types of the arguments."""
    return intrinsic(define)


FLOAT_LANES = 16
"""Numbers of a float32 vector, 64 bytes."""
UINT16_LANES = 32
"""Numbers of a uint16 vector, 64 bytes: four histograms of eight bins."""
BYTE_LANES = 64
"""Numbers of a uint8 vector, 64 bytes: `features.fast`."""

# LLVM's types of numbers; its integers have no sign
_FLOAT = ir.FloatType()
_INT64 = ir.IntType(64)
_INT32 = ir.IntType(32)
_UINT16 = ir.IntType(16)
_BYTE = ir.IntType(8)

# LLVM's types of vectors: sixteen numbers for float32, thirty-two for uint16
_FLOATS = ir.VectorType(_FLOAT, FLOAT_LANES)
_INTS = ir.VectorType(_INT32, FLOAT_LANES)
_BYTES16 = ir.VectorType(_BYTE, FLOAT_LANES)
_HALVES = ir.VectorType(_UINT16, UINT16_LANES)
_BYTES32 = ir.VectorType(_BYTE, UINT16_LANES)
_INTS32 = ir.VectorType(_INT32, UINT16_LANES)
_FLOATS32 = ir.VectorType(_FLOAT, UINT16_LANES)

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


FLOAT32X16 = SimdType("Float32x16", _FLOATS)
UINT16X32 = SimdType("UInt16x32", _HALVES)


class _Arithmetic(AbstractTemplate):
    """Numba's typing of ``+``, ``-`` and ``*`` on two float32 vectors."""

    def generic(self, arguments: Code, keywords: Code) -> Code:
        """The signature of the operation; None for other types."""
        if arguments != (FLOAT32X16, FLOAT32X16):
            return None
        return signature(FLOAT32X16, *arguments)


# a + b, a - b and a * b of float32 vectors, lane by lane
for _symbol, _operation in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    infer_global(_symbol)(type(f"_Lanes_{_operation}", (_Arithmetic,), {}))

    def _lower(
        context: Code, builder: Code, kind: Code, arguments: Code, operation: str = _operation
    ) -> Code:
        return getattr(builder, operation)(*arguments)

    lower_builtin(_symbol, SimdType, SimdType)(_lower)


def pointer_to(
    context: Code, builder: Code, kind: Code, array: Code, index: Code, vector: ir.VectorType
) -> Code:
    """Code for the address of an array's element, as the address of a vector."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def constant(kind: ir.VectorType, value: float) -> Code:
    """A vector constant of equal numbers."""
    return ir.Constant(kind, [value] * kind.count)


def _lanes(*lanes: int) -> Code:
    """The constant that tells `shuffle_vector` which lanes to take; those of a second vector follow the first's."""
    return ir.Constant(ir.VectorType(_INT32, len(lanes)), list(lanes))


_EACH_EIGHT_TIMES = _lanes(*(pixel for pixel in range(4) for _ in range(8)))
"""Four numbers to thirty-two: 0 0 0 0 0 0 0 0 1 1 ..., a number for each bin of four histograms."""


def splat(builder: Code, kind: ir.VectorType, value: Code) -> Code:
    """Code for a vector of equal numbers."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, undefined, _lanes(*([0] * kind.count)))


def load_vector(
    context: Code,
    builder: Code,
    kind: Code,
    array: Code,
    index: Code,
    vector: ir.VectorType,
    align: int,
) -> Code:
    """Code that reads adjacent elements of an array from an index on."""
    loaded = builder.load(pointer_to(context, builder, kind, array, index, vector))
    loaded.align = align
    return loaded


def _loading(
    result: SimdType, vector: ir.VectorType, align: int, convert: Callable[[Code, Code], Code]
) -> Code:
    """The instruction ``load(array, index)``; nothing is checked."""

    def load(typing_context: Code, array: Code, index: Code) -> Definition:
        def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
            array, index = arguments
            loaded = load_vector(context, builder, kind.args[0], array, index, vector, align)
            return convert(builder, loaded)

        return result(array, types.int64), generate

    return instruction(load)


def _storing(value: SimdType, align: int) -> Code:
    """The instruction ``store(array, index, vector)``; nothing is checked."""

    def store(typing_context: Code, array: Code, index: Code, vector: Code) -> Definition:
        def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
            array, index, vector = arguments
            pointer = pointer_to(context, builder, kind.args[0], array, index, value.vector)
            builder.store(vector, pointer, align=align)
            return context.get_dummy_value()

        return types.void(array, types.int64, value), generate

    return instruction(store)


def _unchanged(builder: Code, loaded: Code) -> Code:
    return loaded


def _bytes_to_floats(builder: Code, loaded: Code) -> Code:
    return builder.sitofp(builder.zext(loaded, _INTS), _FLOATS)


load = _loading(FLOAT32X16, _FLOATS, 4, _unchanged)
"""``load(array, index)``: sixteen adjacent numbers of a flat float32 array."""
load_bytes = _loading(FLOAT32X16, _BYTES16, 1, _bytes_to_floats)
"""``load_bytes(array, index)``: sixteen adjacent numbers of a flat uint8 array, as floats."""
load_uint16 = _loading(UINT16X32, _HALVES, 2, _unchanged)
"""``load_uint16(array, index)``: thirty-two adjacent numbers of a flat uint16 array."""
store = _storing(FLOAT32X16, 4)
"""``store(array, index, vector)``: write sixteen adjacent numbers of a flat float32 array."""
store_uint16 = _storing(UINT16X32, 2)
"""``store_uint16(array, index, vector)``: write thirty-two adjacent numbers of a flat uint16 array."""


def _sum_of_lanes(builder: Code, vector: Code, add: Callable[[Code, Code], Code]) -> Code:
    """Code for the sum of a vector's numbers: halves onto halves, always in the same order."""
    width = vector.type.count
    while width > 1:
        width //= 2
        lower = builder.shuffle_vector(vector, vector, _lanes(*range(width)))
        upper = builder.shuffle_vector(vector, vector, _lanes(*range(width, 2 * width)))
        vector = add(lower, upper)
    return builder.extract_element(vector, ir.Constant(_INT32, 0))


@instruction
def spread(typing_context: Code, value: Code) -> Definition:
    """A float32 vector with the same number in every lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return splat(builder, _FLOATS, arguments[0])

    return FLOAT32X16(types.float32), generate


@instruction
def total(typing_context: Code, vector: Code) -> Definition:
    """Sum of the numbers of a float32 vector: halves onto halves, always in the same order."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return _sum_of_lanes(builder, arguments[0], builder.fadd)

    return types.float32(vector), generate


def _grid_places(context: Code, builder: Code, kinds: Code, grid: Code) -> tuple[Code, Code]:
    """Code for columns and rows, in 65536ths of a pixel, of sixteen places of a rotated and scaled grid.

    Args:
        context: Numba's.
        builder: LLVM's.
        kinds: Types of the instruction's arguments, of which the second and third are `columns` and
            `rows`.
        grid: Values of ``columns, rows, at, column, row, step_x, step_y`` as in `sample`.
    """
    columns, rows, at, *origin_and_steps = grid
    right = load_vector(context, builder, kinds[1], columns, at, _INTS, 4)
    down = load_vector(context, builder, kinds[2], rows, at, _INTS, 4)
    column, row, dx, dy = (splat(builder, _INTS, value) for value in origin_and_steps)
    # x = column + right dx - down dy, y = row + right dy + down dx
    x = builder.sub(builder.add(column, builder.mul(right, dx)), builder.mul(down, dy))
    y = builder.add(builder.add(row, builder.mul(right, dy)), builder.mul(down, dx))
    return x, y


@instruction
def store_offsets(
    typing_context: Code,
    offsets: Code,
    columns: Code,
    rows: Code,
    at: Code,
    column: Code,
    row: Code,
    step_x: Code,
    step_y: Code,
    stride: Code,
) -> Definition:
    """Write where in a flat image the pixels lie that are up and left of sixteen places, int32; see `sample`.

    `stride` is the number of pixels a row of the image, int32.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        offsets, *grid, stride = arguments
        x, y = _grid_places(context, builder, kind.args, grid)
        # whole pixels of 65536ths
        column = builder.ashr(x, constant(_INTS, 16))
        row = builder.ashr(y, constant(_INTS, 16))
        offset = builder.add(builder.mul(row, splat(builder, _INTS, stride)), column)
        pointer = pointer_to(context, builder, kind.args[0], offsets, grid[2], _INTS)
        builder.store(offset, pointer, align=4)
        return context.get_dummy_value()

    return types.void(offsets, columns, rows, types.int64, *([types.int32] * 5)), generate


@instruction
def square(typing_context: Code, image: Code, at: Code, stride: Code) -> Definition:
    """Four pixels of a flat uint8 image as the bytes of an int32: at an index, right of it, and below these two.

    `stride` is the number of pixels a row of the image; `sample` interpolates between the four.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, at, stride = arguments

        def two_pixels(index: Code) -> Code:
            pair = load_vector(context, builder, kind.args[0], image, index, _UINT16, 1)
            return builder.zext(pair, _INT32)

        above = two_pixels(at)
        below = two_pixels(builder.add(at, stride))
        return builder.or_(above, builder.shl(below, ir.Constant(_INT32, 16)))

    return types.int32(image, types.int64, types.int64), generate


@instruction
def sample(
    typing_context: Code,
    squares: Code,
    columns: Code,
    rows: Code,
    at: Code,
    column: Code,
    row: Code,
    step_x: Code,
    step_y: Code,
) -> Definition:
    """Bilinear samples of an image at sixteen places of a rotated and scaled grid.

    Args:
        typing_context: Numba's.
        squares: Flat int32 array, `square` of the image for each place of the grid.
        columns: Flat int32 array, the places' column on the grid ...
        rows: ... and row.
        at: Index of the first of the sixteen in these.
        column: Image column of the grid's origin, in 65536ths of a pixel, int32.
        row: Image row of the grid's origin, likewise.
        step_x: Image columns a grid column (and rows a grid row), likewise.
        step_y: Image rows a grid column (and minus the columns a grid row), likewise.

    Returns:
        Grey levels. The places must lie inside the image by at least one row and one column:
        nothing is checked.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        squares, *grid = arguments

        def part_of_pixel(position: Code) -> Code:
            part = builder.and_(position, constant(_INTS, 65535))
            return builder.fmul(builder.sitofp(part, _FLOATS), constant(_FLOATS, 1 / 65536))

        def between(first: Code, second: Code, part: Code) -> Code:
            return builder.fadd(first, builder.fmul(part, builder.fsub(second, first)))

        x, y = _grid_places(context, builder, kind.args, grid)
        right = part_of_pixel(x)
        down = part_of_pixel(y)

        # the four bytes of every square: above left, above right, below left, below right
        pixels = load_vector(context, builder, kind.args[0], squares, grid[2], _INTS, 4)
        corners = []
        for k in range(4):
            byte = builder.lshr(pixels, constant(_INTS, 8 * k))
            corners.append(builder.sitofp(builder.and_(byte, constant(_INTS, 255)), _FLOATS))

        # along the rows, then between them
        above = between(corners[0], corners[1], right)
        below = between(corners[2], corners[3], right)
        return between(above, below, down)

    return FLOAT32X16(squares, columns, rows, types.int64, *([types.int32] * 4)), generate


def _average(builder: Code, first: Code, second: Code) -> Code:
    """Code for ``(a + b + 1) >> 1`` of uint16 vectors, in 32 bits."""
    total = builder.add(builder.zext(first, _INTS32), builder.zext(second, _INTS32))
    one = constant(_INTS32, 1)
    return builder.trunc(builder.lshr(builder.add(total, one), one), _HALVES)


@instruction
def average(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded mean ``(a + b + 1) >> 1`` of two uint16 vectors, lane by lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return _average(builder, *arguments)

    return UINT16X32(first, second), generate


@instruction
def average_of_pairs(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded means of adjacent histograms of eight bins: the four of each vector, eight in all, to four."""
    # of each pair of histograms, sixteen numbers, the first eight and the last eight
    even = [16 * pair + b for pair in range(4) for b in range(8)]
    odd = [lane + 8 for lane in even]

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        left = builder.shuffle_vector(*arguments, _lanes(*even))
        right = builder.shuffle_vector(*arguments, _lanes(*odd))
        return _average(builder, left, right)

    return UINT16X32(first, second), generate


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
    four = ir.VectorType(_UINT16, 4)
    four_wide = ir.VectorType(_INT32, 4)
    # bins of 45 degrees, of four pixels one after the other
    cosines = ir.Constant(_INTS32, [COSINES[b % 8] for b in range(UINT16_LANES)])
    sines = ir.Constant(_INTS32, [COSINES[(b - 2) % 8] for b in range(UINT16_LANES)])

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        sums, here, above, below = arguments

        def pixels(index: Code) -> Code:
            loaded = load_vector(context, builder, kind.args[0], sums, index, four, 2)
            return builder.zext(loaded, four_wide)

        # central differences of four pixels, each eight times
        one = ir.Constant(_INT64, 1)
        gx = builder.sub(pixels(builder.add(here, one)), pixels(builder.sub(here, one)))
        gy = builder.sub(pixels(below), pixels(above))
        gx = builder.shuffle_vector(gx, gx, _EACH_EIGHT_TIMES)
        gy = builder.shuffle_vector(gy, gy, _EACH_EIGHT_TIMES)

        # the derivative along each bin's direction, rounded; negative ones become 0
        along = builder.add(builder.mul(gx, cosines), builder.mul(gy, sines))
        rounded = builder.add(along, constant(_INTS32, 1 << (DERIVATIVE_SHIFT - 1)))
        value = builder.ashr(rounded, constant(_INTS32, DERIVATIVE_SHIFT))
        zero = constant(_INTS32, 0)
        rectified = builder.select(builder.icmp_signed(">", value, zero), value, zero)
        return builder.trunc(rectified, _HALVES)

    return UINT16X32(sums, types.int64, types.int64, types.int64), generate


@instruction
def store_normalised(
    typing_context: Code, array: Code, index: Code, halves: Code, floor: Code
) -> Definition:
    """Write four histograms as 32 bytes: each divided by its Euclidean norm plus `floor`, times 255, rounded."""
    four = ir.VectorType(_FLOAT, 4)

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        array, index, halves, floor = arguments
        numbers = builder.zext(halves, _INTS32)

        # sums of squares of each histogram: neighbours are added until four numbers are left
        squares = builder.mul(numbers, numbers)
        for count in (32, 16, 8):
            even = builder.shuffle_vector(squares, squares, _lanes(*range(0, count, 2)))
            odd = builder.shuffle_vector(squares, squares, _lanes(*range(1, count, 2)))
            squares = builder.add(even, odd)

        # 255 / (norm + floor), a factor for each histogram
        square_root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(four, [four]), "llvm.sqrt.v4f32"
        )
        norm = builder.call(square_root, [builder.sitofp(squares, four)])
        divisor = builder.fadd(norm, splat(builder, four, floor))
        gain = builder.fdiv(constant(four, 255.0), divisor)

        # the bins times their histogram's factor, rounded to bytes
        gains = builder.shuffle_vector(gain, gain, _EACH_EIGHT_TIMES)
        scaled = builder.fmul(builder.sitofp(numbers, _FLOATS32), gains)
        rounded = builder.fptosi(builder.fadd(scaled, constant(_FLOATS32, 0.5)), _INTS32)
        pointer = pointer_to(context, builder, kind.args[0], array, index, _BYTES32)
        builder.store(builder.trunc(rounded, _BYTES32), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.int64, UINT16X32, types.float32), generate


def _histogram_distances(builder: Code, first: Code, second: Code, count: int) -> Code:
    """Code for L1 distances of `count` histograms of eight bytes, as ``count`` 64-bit lanes."""
    # absolute differences of bytes: the larger less the smaller
    bytes_ = ir.VectorType(_BYTE, 8 * count)
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
            lanes = ir.VectorType(_INT64, count)

            # the image's histograms, a 64-bit lane each, from where the samples lie
            sampled = ir.Constant(lanes, ir.Undefined)
            base = builder.gep(cells, [cell])
            line = builder.gep(offsets, [builder.mul(row, ir.Constant(_INT64, 17))])
            for k in range(count):
                offset = builder.load(builder.gep(line, [ir.Constant(_INT64, first + k)]))
                place = builder.gep(base, [builder.sext(offset, _INT64)])
                histogram = builder.load(builder.bitcast(place, _INT64.as_pointer()))
                histogram.align = 1
                sampled = builder.insert_element(sampled, histogram, ir.Constant(_INT32, k))

            # the descriptor's own, which lie side by side
            place = builder.gep(own, [ir.Constant(_INT64, 8 * first)])
            compared = builder.load(builder.bitcast(place, lanes.as_pointer()))
            compared.align = 1

            distances = _histogram_distances(builder, sampled, compared, count)
            limit = splat(builder, lanes, truncation)
            truncated = smaller(builder, distances, limit)
            return builder.add(total, _sum_of_lanes(builder, truncated, builder.add))

        # the centre, the first ring, the second ring
        total = ir.Constant(_INT64, 0)
        total = add_distances(total, 0, 1, near, near_row)
        total = add_distances(total, 1, 8, near, near_row)
        return add_distances(total, 9, 8, far, far_row)

    return signature, generate


def smaller(builder: Code, first: Code, second: Code) -> Code:
    """Code for the smaller of two numbers without sign, lane by lane."""
    return builder.select(builder.icmp_unsigned("<", first, second), first, second)


def larger(builder: Code, first: Code, second: Code) -> Code:
    """Code for the larger of two numbers without sign, lane by lane."""
    return builder.select(builder.icmp_unsigned(">", first, second), first, second)
