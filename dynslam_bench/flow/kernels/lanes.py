"""Sixteen float32 numbers as one value inside the compiled kernels, with `+`, `-` and `*`.

Written as generic vector code of fixed width: LLVM makes of it what the processor has, and because the order of every
sum is part of the program, results do not depend on that.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from .instruction import Code, Definition, instruction

WIDTH = 16
_FLOAT, _WORD, _BYTE, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(8), ir.IntType(64)
_FLOATS, _WORDS = ir.VectorType(_FLOAT, WIDTH), ir.VectorType(_WORD, WIDTH)
_BYTES = ir.VectorType(_BYTE, WIDTH)
_PAIR = ir.IntType(16)
_PAIRS = ir.VectorType(_PAIR, WIDTH)


class LanesType(types.Type):
    """Numba's type of sixteen float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name="Float32x16")


LANES = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Code, kind: Code) -> None:
        super().__init__(manager, kind, _FLOATS)


class _Arithmetic(AbstractTemplate):
    def generic(self, arguments: Code, keywords: Code) -> Code:
        if len(arguments) == 2 and all(isinstance(a, LanesType) for a in arguments):
            return signature(LANES, LANES, LANES)
        return None


def _define(symbol: Code, operation: str) -> None:
    infer_global(symbol)(type(f"_Lanes_{operation}", (_Arithmetic,), {}))

    def lowered(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return getattr(builder, operation)(*arguments)

    lower_builtin(symbol, LanesType, LanesType)(lowered)


for _symbol, _operation in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _define(_symbol, _operation)


def pointer_to(context: Code, builder: Code, kind: Code, array: Code, index: Code, vector: ir.VectorType) -> Code:
    """Code for the address of an array's element, as the address of a vector."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _constant(kind: ir.VectorType, value: float) -> Code:
    return ir.Constant(kind, [value] * WIDTH)


def splat(builder: Code, kind: ir.VectorType, value: Code) -> Code:
    """Code for a vector of sixteen equal numbers."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_WORD, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), _constant(_WORDS, 0))


@instruction
def load(typing_context: Code, array: Code, index: Code) -> Definition:
    """Sixteen adjacent numbers of a flat float32 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _FLOATS))
        loaded.align = 4
        return loaded

    return LANES(array, types.int64), generate


@instruction
def load_bytes(typing_context: Code, array: Code, index: Code) -> Definition:
    """Sixteen adjacent numbers of a flat uint8 array, as floats; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _BYTES))
        loaded.align = 1
        return builder.sitofp(builder.zext(loaded, _WORDS), _FLOATS)

    return LANES(array, types.int64), generate


@instruction
def store(typing_context: Code, array: Code, index: Code, lanes: Code) -> Definition:
    """Write sixteen adjacent numbers of a flat float32 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        pointer = pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _FLOATS)
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, LANES), generate


@instruction
def spread(typing_context: Code, value: Code) -> Definition:
    """The same float32 in every lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return splat(builder, _FLOATS, arguments[0])

    return LANES(types.float32), generate


@instruction
def total(typing_context: Code, lanes: Code) -> Definition:
    """Sum of the lanes: halves onto halves, always in the same order."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        rest, width = arguments[0], WIDTH
        while width > 1:
            width //= 2
            parts = [
                builder.shuffle_vector(
                    rest, rest, ir.Constant(ir.VectorType(_WORD, width), list(range(first, first + width)))
                )
                for first in (0, width)
            ]
            rest = builder.fadd(*parts)
        return builder.extract_element(rest, ir.Constant(_WORD, 0))

    return types.float32(lanes), generate


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
            loaded = builder.load(pointer_to(context, builder, kind.args[k], array, at, _WORDS))
            loaded.align = 4
            grid.append(loaded)
        dx, dy = (splat(builder, _WORDS, step) for step in (step_x, step_y))
        x = builder.add(splat(builder, _WORDS, column), builder.mul(grid[0], dx))
        x = builder.sub(x, builder.mul(grid[1], dy))
        y = builder.add(splat(builder, _WORDS, row), builder.mul(grid[0], dy))
        y = builder.add(y, builder.mul(grid[1], dx))
        sixteen, low = _constant(_WORDS, 16), _constant(_WORDS, 65535)
        whole = [builder.ashr(value, sixteen) for value in (x, y)]
        share = [
            builder.fmul(builder.sitofp(builder.and_(value, low), _FLOATS), _constant(_FLOATS, 1 / 65536))
            for value in (x, y)
        ]
        offset = builder.add(builder.mul(whole[1], splat(builder, _WORDS, stride)), whole[0])
        data = context.make_array(kind.args[0])(context, builder, pixels).data
        pairs = [ir.Constant(_PAIRS, ir.Undefined)] * 2  # two adjacent pixels in each lane, of the upper and lower row
        for lane in range(WIDTH):
            index = ir.Constant(_WORD, lane)
            first = builder.gep(data, [builder.sext(builder.extract_element(offset, index), _LONG)])
            second = builder.gep(first, [builder.sext(stride, _LONG)])
            for line, place in enumerate((first, second)):
                pair = builder.load(builder.bitcast(place, _PAIR.as_pointer()))
                pair.align = 1
                pairs[line] = builder.insert_element(pairs[line], pair, index)
        lines = []
        for pair in pairs:
            words = builder.zext(pair, _WORDS)
            left = builder.sitofp(builder.and_(words, _constant(_WORDS, 255)), _FLOATS)
            right = builder.sitofp(builder.lshr(words, _constant(_WORDS, 8)), _FLOATS)
            lines.append(builder.fadd(left, builder.fmul(share[0], builder.fsub(right, left))))
        return builder.fadd(lines[0], builder.fmul(share[1], builder.fsub(lines[1], lines[0])))

    return LANES(image, types.int32, columns, rows, types.int64, *([types.int32] * 4)), generate
