"""SIMD vectors inside compiled kernels: 8 float64, 16 float32, 32 uint16 or 64 uint8 numbers as one value.

Written as generic vector code of fixed width (llvmlite): LLVM maps it to the processor's
instructions. A lane is the place of one number in a vector, as in SIMD hardware. The order of
every sum is part of the program, so that results do not depend on the processor. The uint16
operations are exact but for one square root and division, which IEEE 754 defines to the last bit;
`tests/flow/exact_reference.py` gives the same bytes.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial, reduce
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
UINT16_LANES = 32
_FLOAT, _INT64, _INT32, _UINT16, _BYTE = (
    ir.FloatType(),
    ir.IntType(64),
    ir.IntType(32),
    ir.IntType(16),
    ir.IntType(8),
)
_FLOATS, _INTS = ir.VectorType(_FLOAT, FLOAT_LANES), ir.VectorType(_INT32, FLOAT_LANES)
_BYTES16 = ir.VectorType(_BYTE, FLOAT_LANES)
_HALVES, _BYTES32 = ir.VectorType(_UINT16, UINT16_LANES), ir.VectorType(_BYTE, UINT16_LANES)
BYTE_LANES = 64
_DOUBLES = ir.VectorType(ir.DoubleType(), 8)
_BYTES64, _INTS32 = ir.VectorType(_BYTE, BYTE_LANES), ir.VectorType(_INT32, UINT16_LANES)
PATCH_ROWS = 31
"""Rows of the patches that `patch_sum` reads."""
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
SUMS = types.UniTuple(SimdType("Float64x8", _DOUBLES), 6)
"""Of normal equations: six rows of six numbers of the matrix, one of the vector and a zero."""


class _Arithmetic(AbstractTemplate):
    def generic(self, arguments: Code, keywords: Code) -> Code:
        return signature(FLOAT32X16, *arguments) if arguments == (FLOAT32X16, FLOAT32X16) else None


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


def _places(*places: int) -> Code:
    """The constant that tells `shuffle_vector` which numbers to take."""
    return ir.Constant(ir.VectorType(_INT32, len(places)), list(places))


_EACH_EIGHT_TIMES = _places(*(pixel for pixel in range(4) for _ in range(8)))


def splat(builder: Code, kind: ir.VectorType, value: Code) -> Code:
    """Code for a vector of equal numbers."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(
        first, ir.Constant(kind, ir.Undefined), _places(*([0] * kind.count))
    )


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
            return convert(
                builder, load_vector(context, builder, kind.args[0], array, index, vector, align)
            )

        return result(array, types.int64), generate

    return instruction(load)


def _storing(value: SimdType, align: int) -> Code:
    """The instruction ``store(array, index, vector)``; nothing is checked."""

    def store(typing_context: Code, array: Code, index: Code, vector: Code) -> Definition:
        def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
            array, index, vector = arguments
            builder.store(
                vector,
                pointer_to(context, builder, kind.args[0], array, index, value.vector),
                align=align,
            )
            return context.get_dummy_value()

        return types.void(array, types.int64, value), generate

    return instruction(store)


load = _loading(FLOAT32X16, _FLOATS, 4, lambda builder, loaded: loaded)
"""Sixteen adjacent numbers of a flat float32 array."""
load_bytes = _loading(
    FLOAT32X16,
    _BYTES16,
    1,
    lambda builder, loaded: builder.sitofp(builder.zext(loaded, _INTS), _FLOATS),
)
"""Sixteen adjacent numbers of a flat uint8 array, as floats."""
load_uint16 = _loading(UINT16X32, _HALVES, 2, lambda builder, loaded: loaded)
"""Thirty-two adjacent numbers of a flat uint16 array."""
store = _storing(FLOAT32X16, 4)
"""Write sixteen adjacent numbers of a flat float32 array."""
store_uint16 = _storing(UINT16X32, 2)
"""Write thirty-two adjacent numbers of a flat uint16 array."""


def _sum_of_lanes(builder: Code, vector: Code, add: Callable[[Code, Code], Code]) -> Code:
    """Code for the sum of a vector's numbers: halves onto halves, always in the same order."""
    width = vector.type.count
    while width > 1:
        width //= 2
        vector = add(
            *(
                builder.shuffle_vector(vector, vector, _places(*range(k, k + width)))
                for k in (0, width)
            )
        )
    return builder.extract_element(vector, ir.Constant(_INT32, 0))


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
        return _sum_of_lanes(builder, arguments[0], builder.fadd)

    return types.float32(vector), generate


def _grid_places(context: Code, builder: Code, kinds: Code, grid: Code) -> tuple[Code, Code]:
    """Code for columns and rows, in 65536ths of a pixel, of sixteen places of a rotated and scaled grid (`sample`)."""
    at = grid[2]
    origin_and_steps = grid[3:]
    right, down = (
        load_vector(context, builder, kinds[k], grid[k - 1], at, _INTS, 4) for k in (1, 2)
    )
    column, row, dx, dy = (splat(builder, _INTS, value) for value in origin_and_steps)
    x = builder.sub(builder.add(column, builder.mul(right, dx)), builder.mul(down, dy))
    y = builder.add(builder.add(row, builder.mul(right, dy)), builder.mul(down, dx))
    return x, y


@instruction
def store_offsets(
    typing_context: Code, offsets: Code, columns: Code, rows: Code, at: Code, column: Code, row: Code, step_x: Code,
    step_y: Code, stride: Code,
) -> Definition:  # fmt: skip
    """Write where in a flat image the pixels lie that are up and left of sixteen places, int32; see `sample`.

    `stride` is the number of pixels a row of the image, int32.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        offsets, *grid, stride = arguments
        x, y = (
            builder.ashr(c, constant(_INTS, 16))
            for c in _grid_places(context, builder, kind.args, grid)
        )
        offset = builder.add(builder.mul(y, splat(builder, _INTS, stride)), x)
        builder.store(
            offset, pointer_to(context, builder, kind.args[0], offsets, grid[2], _INTS), align=4
        )
        return context.get_dummy_value()

    return types.void(offsets, columns, rows, types.int64, *([types.int32] * 5)), generate


@instruction
def square(typing_context: Code, image: Code, at: Code, stride: Code) -> Definition:
    """Four pixels of a flat uint8 image as the bytes of an int32: at an index, right of it, and below these two.

    `stride` is the number of pixels a row of the image; `sample` interpolates between the four.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, at, stride = arguments
        above, below = (
            builder.zext(
                load_vector(context, builder, kind.args[0], image, index, _UINT16, 1), _INT32
            )
            for index in (at, builder.add(at, stride))
        )
        return builder.or_(above, builder.shl(below, ir.Constant(_INT32, 16)))

    return types.int32(image, types.int64, types.int64), generate


@instruction
def sample(
    typing_context: Code, squares: Code, columns: Code, rows: Code, at: Code, column: Code, row: Code, step_x: Code,
    step_y: Code,
) -> Definition:  # fmt: skip
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
        right, down = (
            builder.fmul(
                builder.sitofp(builder.and_(c, constant(_INTS, 65535)), _FLOATS),
                constant(_FLOATS, 1 / 65536),
            )
            for c in _grid_places(context, builder, kind.args, grid)
        )
        pixels = load_vector(context, builder, kind.args[0], squares, grid[2], _INTS, 4)
        corners = [
            builder.sitofp(
                builder.and_(builder.lshr(pixels, constant(_INTS, 8 * k)), constant(_INTS, 255)),
                _FLOATS,
            )
            for k in range(4)
        ]
        above, below = (
            builder.fadd(corners[k], builder.fmul(right, builder.fsub(corners[k + 1], corners[k])))
            for k in (0, 2)
        )
        return builder.fadd(above, builder.fmul(down, builder.fsub(below, above)))

    return FLOAT32X16(squares, columns, rows, types.int64, *([types.int32] * 4)), generate


def _average(builder: Code, first: Code, second: Code) -> Code:
    wide = ir.VectorType(_INT32, UINT16_LANES)
    total = builder.add(builder.zext(first, wide), builder.zext(second, wide))
    one = constant(wide, 1)
    return builder.trunc(builder.lshr(builder.add(total, one), one), _HALVES)


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
            builder.shuffle_vector(
                *arguments, _places(*(16 * pair + odd + b for pair in range(4) for b in range(8)))
            )
            for odd in (0, 8)
        ]
        return _average(builder, *parts)

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

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        four, wide = ir.VectorType(_UINT16, 4), ir.VectorType(_INT32, 4)

        def pixels(index: Code) -> Code:
            return builder.zext(
                load_vector(context, builder, kind.args[0], arguments[0], index, four, 2), wide
            )

        one = ir.Constant(ir.IntType(64), 1)
        gx = builder.sub(
            pixels(builder.add(arguments[1], one)), pixels(builder.sub(arguments[1], one))
        )
        gy = builder.sub(pixels(arguments[3]), pixels(arguments[2]))
        gx, gy = (builder.shuffle_vector(g, g, _EACH_EIGHT_TIMES) for g in (gx, gy))
        cosines, sines = (
            _places(*(COSINES[(b - turn) % 8] for b in range(UINT16_LANES))) for turn in (0, 2)
        )
        along = builder.add(builder.mul(gx, cosines), builder.mul(gy, sines))
        rounded = builder.add(along, constant(cosines.type, 1 << (DERIVATIVE_SHIFT - 1)))
        value = builder.ashr(rounded, constant(cosines.type, DERIVATIVE_SHIFT))
        zero = constant(cosines.type, 0)
        return builder.trunc(
            builder.select(builder.icmp_signed(">", value, zero), value, zero), _HALVES
        )

    return UINT16X32(sums, types.int64, types.int64, types.int64), generate


@instruction
def store_normalised(
    typing_context: Code, array: Code, index: Code, halves: Code, floor: Code
) -> Definition:
    """Write four histograms as 32 bytes: each divided by its Euclidean norm plus `floor`, times 255, rounded."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        array, index, halves, floor = arguments
        ints, many = ir.VectorType(_INT32, UINT16_LANES), ir.VectorType(_FLOAT, UINT16_LANES)
        wide = builder.zext(halves, ints)
        squares = builder.mul(wide, wide)
        for count in (32, 16, 8):
            parts = (
                builder.shuffle_vector(squares, squares, _places(*range(odd, count, 2)))
                for odd in (0, 1)
            )
            squares = builder.add(*parts)
        floats = ir.VectorType(_FLOAT, 4)
        root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(floats, [floats]), "llvm.sqrt.v4f32"
        )
        norm = builder.call(root, [builder.sitofp(squares, floats)])
        gain = builder.fdiv(
            constant(floats, 255.0), builder.fadd(norm, splat(builder, floats, floor))
        )
        scaled = builder.fmul(
            builder.sitofp(wide, many), builder.shuffle_vector(gain, gain, _EACH_EIGHT_TIMES)
        )
        rounded = builder.fptosi(builder.fadd(scaled, constant(many, 0.5)), ints)
        pointer = pointer_to(context, builder, kind.args[0], array, index, _BYTES32)
        builder.store(builder.trunc(rounded, _BYTES32), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.int64, UINT16X32, types.float32), generate


def _histogram_distances(builder: Code, first: Code, second: Code, count: int) -> Code:
    """L1 distances of `count` histograms of eight bytes, as ``count`` 64-bit lanes."""
    bytes_ = ir.VectorType(_BYTE, 8 * count)
    second = builder.bitcast(second, bytes_)
    first = builder.bitcast(first, bytes_)
    above = builder.icmp_unsigned(">", first, second)
    total = builder.sub(builder.select(above, first, second), builder.select(above, second, first))
    for bits in (8, 16, 32):  # add neighbours until a histogram is one number
        pairs = ir.VectorType(ir.IntType(2 * bits), 32 * count // bits)
        total = builder.bitcast(total, pairs)
        low = builder.and_(total, constant(pairs, (1 << bits) - 1))
        total = builder.add(low, builder.lshr(total, constant(pairs, bits)))
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
    signature = types.int64(
        image, samples, *([types.int64] * 4), descriptor, types.int64, types.int64
    )

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, samples, near_row, far_row, near, far, descriptor, at, truncation = arguments
        cells, offsets, mine = (
            context.make_array(kind.args[k])(context, builder, array).data
            for k, array in ((0, image), (1, samples), (6, descriptor))
        )
        mine = builder.gep(mine, [at])
        total = ir.Constant(_INT64, 0)
        for first, count, cell, row in (
            (0, 1, near, near_row),
            (1, 8, near, near_row),
            (9, 8, far, far_row),
        ):
            lanes = ir.VectorType(_INT64, count)
            base, theirs = builder.gep(cells, [cell]), ir.Constant(lanes, ir.Undefined)
            line = builder.gep(offsets, [builder.mul(row, ir.Constant(_INT64, 17))])
            for k in range(count):
                offset = builder.load(builder.gep(line, [ir.Constant(_INT64, first + k)]))
                place = builder.gep(base, [builder.sext(offset, _INT64)])
                histogram = builder.load(builder.bitcast(place, _INT64.as_pointer()))
                histogram.align = 1
                theirs = builder.insert_element(theirs, histogram, ir.Constant(_INT32, k))
            own = builder.load(
                builder.bitcast(
                    builder.gep(mine, [ir.Constant(_INT64, 8 * first)]), lanes.as_pointer()
                )
            )
            own.align = 1
            distances = _histogram_distances(builder, theirs, own, count)
            limit = splat(builder, lanes, truncation)
            kept = builder.select(builder.icmp_unsigned("<", distances, limit), distances, limit)
            total = builder.add(total, _sum_of_lanes(builder, kept, builder.add))
        return total

    return signature, generate


def _smaller(builder: Code, first: Code, second: Code) -> Code:
    return builder.select(builder.icmp_unsigned("<", first, second), first, second)


def _larger(builder: Code, first: Code, second: Code) -> Code:
    return builder.select(builder.icmp_unsigned(">", first, second), first, second)


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
        offsets = context.make_array(kind.args[3])(context, builder, circle).data
        load = partial(load_vector, context, builder, kind.args[1], image, vector=_BYTES64, align=1)
        ring = [
            load(
                index=builder.add(at, builder.load(builder.gep(offsets, [ir.Constant(_INT64, k)])))
            )
            for k in range(16)
        ]
        smaller, larger, centre = (
            partial(_smaller, builder),
            partial(_larger, builder),
            load(index=at),
        )

        def best_arc(worse: Callable[..., Code], better: Callable[..., Code]) -> Code:
            """The grey level that all pixels of the best arc of nine reach."""
            twos = [worse(ring[k], ring[(k + 1) % 16]) for k in range(1, 16, 2)]
            fours = [worse(twos[k], twos[(k + 1) % 8]) for k in range(8)]
            # with one more pixel at either end
            eights = [worse(fours[k], fours[(k + 2) % 8]) for k in range(8)]
            arcs = [worse(eights[k], better(ring[2 * k], ring[(2 * k + 9) % 16])) for k in range(8)]
            return reduce(better, arcs)

        brighter = builder.sub(larger(best_arc(smaller, larger), centre), centre)
        darker = builder.sub(centre, smaller(best_arc(larger, smaller), centre))
        one = constant(_BYTES64, 1)
        score = builder.sub(larger(larger(brighter, darker), one), one)
        builder.store(
            score, pointer_to(context, builder, kind.args[0], scores, at, _BYTES64), align=1
        )
        return context.get_dummy_value()

    return types.void(scores, image, types.int64, circle), generate


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
        load = partial(
            load_vector, context, builder, kind.args[1], scores, vector=_BYTES64, align=1
        )
        steps = [builder.sub(at, width), at, builder.add(at, width)]
        around = [
            load(index=builder.add(step, ir.Constant(_INT64, dx)))
            for step in steps
            for dx in (-1, 0, 1)
            if dx or step is not at
        ]
        limit = builder.sub(
            splat(builder, _BYTES64, builder.trunc(least, _BYTE)), constant(_BYTES64, 1)
        )
        score, bound = load(index=at), reduce(partial(_larger, builder), around, limit)
        kept = builder.select(
            builder.icmp_unsigned(">", score, bound), score, constant(_BYTES64, 0)
        )
        builder.store(
            kept, pointer_to(context, builder, kind.args[0], maxima, at, _BYTES64), align=1
        )
        return context.get_dummy_value()

    return types.void(maxima, scores, types.int64, types.int64, types.int64), generate


@instruction
def patch_sum(
    typing_context: Code, image: Code, at: Code, width: Code, weights: Code
) -> Definition:
    """Weighted sum of a patch of `PATCH_ROWS` rows and `UINT16_LANES` columns, exact in 32 bits.

    Args:
        typing_context: Numba's.
        image: Flat uint8 array.
        at: Index of the patch's first pixel.
        width: Pixels a row of the image.
        weights: Flat int16 array, one of each pixel of the patch, row by row.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, at, width, weights = arguments
        total = constant(_INTS32, 0)
        for row in range(PATCH_ROWS):
            pixels = load_vector(context, builder, kind.args[0], image, at, _BYTES32, 1)
            first = ir.Constant(_INT64, UINT16_LANES * row)
            factors = load_vector(context, builder, kind.args[3], weights, first, _HALVES, 2)
            total = builder.add(
                total, builder.mul(builder.zext(pixels, _INTS32), builder.sext(factors, _INTS32))
            )
            at = builder.add(at, width)
        return _sum_of_lanes(builder, total, builder.add)

    return types.int32(image, types.int64, types.int64, weights), generate


@instruction
def normal_equations(typing_context: Code) -> Definition:
    """Sums of no residuals, for `add_normal_equation`."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return context.make_tuple(builder, kind.return_type, [constant(_DOUBLES, 0.0)] * 6)

    return SUMS(), generate


@instruction
def add_normal_equation(
    typing_context: Code, sums: Code, weight: Code, j0: Code, j1: Code, j2: Code, j3: Code, j4: Code, j5: Code,
    residual: Code,
) -> Definition:  # fmt: skip
    """Sums with ``weight j^T j`` and ``weight j^T residual`` of one residual more, j its derivatives by six numbers."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        sums, weight, *numbers = arguments
        row = constant(_DOUBLES, 0.0)
        for place, number in enumerate(numbers):
            row = builder.insert_element(row, number, ir.Constant(_INT32, place))
        scaled = builder.fmul(splat(builder, _DOUBLES, weight), row)
        factors = [builder.shuffle_vector(scaled, scaled, _places(*([m] * 8))) for m in range(6)]
        rows = cgutils.unpack_tuple(builder, sums, 6)
        added = [
            builder.fadd(old, builder.fmul(factor, row))
            for old, factor in zip(rows, factors, strict=True)
        ]
        return context.make_tuple(builder, kind.return_type, added)

    return SUMS(SUMS, *([types.float64] * 8)), generate


@instruction
def store_normal_equations(
    typing_context: Code, sums: Code, matrix: Code, vector: Code
) -> Definition:
    """Write the matrix ``[6, 6]`` and the vector ``[6]`` of the sums into float64 arrays."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        sums, *arrays = arguments
        data = [
            context.make_array(k)(context, builder, array).data
            for k, array in zip(kind.args[1:], arrays, strict=True)
        ]
        for m, row in enumerate(cgutils.unpack_tuple(builder, sums, 6)):
            for n in range(7):
                place = builder.gep(data[n // 6], [ir.Constant(_INT64, m if n == 6 else 6 * m + n)])
                builder.store(builder.extract_element(row, ir.Constant(_INT32, n)), place)
        return context.get_dummy_value()

    return types.void(sums, matrix, vector), generate
