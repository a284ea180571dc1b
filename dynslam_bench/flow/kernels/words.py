"""Thirty-two uint16 numbers as one value inside the compiled kernels: four histograms of eight bins.

Whole numbers throughout (but for one square root and division, which IEEE 754 defines to the last bit), so that every
processor, and `daisy.torch_maps` on every torch device, gets the same bytes.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import models, register_model

from .instruction import Code, Definition, instruction
from .lanes import pointer_to

WIDTH = 32
_HALF, _WORD, _BYTE, _FLOAT = ir.IntType(16), ir.IntType(32), ir.IntType(8), ir.FloatType()
_HALVES, _BYTES = ir.VectorType(_HALF, WIDTH), ir.VectorType(_BYTE, WIDTH)
COSINES = (32768, 23170, 0, -23170, -32768, -23170, 0, 23170)
"""Cosines of multiples of 45 degrees, in 32768ths; two places on are the sines."""
DERIVATIVE_SHIFT = 11
"""From differences of sums over 2 x 2 pixels times `COSINES` to 256ths of a grey level a full-image pixel."""


class WordsType(types.Type):
    """Numba's type of thirty-two uint16 lanes."""

    def __init__(self) -> None:
        super().__init__(name="UInt16x32")


WORDS = WordsType()


@register_model(WordsType)
class _WordsModel(models.PrimitiveModel):
    def __init__(self, manager: Code, kind: Code) -> None:
        super().__init__(manager, kind, _HALVES)


def _mask(places: list[int]) -> Code:
    return ir.Constant(ir.VectorType(_WORD, len(places)), places)


def _constant(element: Code, values: Code) -> Code:
    return ir.Constant(ir.VectorType(element, len(values)), list(values))


def _average(builder: Code, first: Code, second: Code) -> Code:
    wide = ir.VectorType(_WORD, WIDTH)
    total = builder.add(builder.zext(first, wide), builder.zext(second, wide))
    one = _constant(_WORD, [1] * WIDTH)
    return builder.trunc(builder.lshr(builder.add(total, one), one), _HALVES)


@instruction
def load_words(typing_context: Code, array: Code, index: Code) -> Definition:
    """Thirty-two adjacent numbers of a flat uint16 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        loaded = builder.load(pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _HALVES))
        loaded.align = 2
        return loaded

    return WORDS(array, types.int64), generate


@instruction
def store_words(typing_context: Code, array: Code, index: Code, words: Code) -> Definition:
    """Write thirty-two adjacent numbers of a flat uint16 array; nothing is checked."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        pointer = pointer_to(context, builder, kind.args[0], arguments[0], arguments[1], _HALVES)
        builder.store(arguments[2], pointer, align=2)
        return context.get_dummy_value()

    return types.void(array, types.int64, WORDS), generate


@instruction
def average(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded mean ``(a + b + 1) >> 1`` of every lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return _average(builder, *arguments)

    return WORDS(first, second), generate


@instruction
def average_of_pairs(typing_context: Code, first: Code, second: Code) -> Definition:
    """Rounded means of adjacent histograms: eight histograms to four."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        parts = [
            builder.shuffle_vector(*arguments, _mask([16 * pair + odd + b for pair in range(4) for b in range(8)]))
            for odd in (0, 8)
        ]
        return _average(builder, *parts)

    return WORDS(first, second), generate


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
        four, wide = ir.VectorType(_HALF, 4), ir.VectorType(_WORD, 4)

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
        along = builder.add(
            builder.mul(gx, _constant(_WORD, COSINES * 4)), builder.mul(gy, _constant(_WORD, sines * 4))
        )
        rounded = builder.add(along, _constant(_WORD, [1 << (DERIVATIVE_SHIFT - 1)] * WIDTH))
        value = builder.ashr(rounded, _constant(_WORD, [DERIVATIVE_SHIFT] * WIDTH))
        zero = _constant(_WORD, [0] * WIDTH)
        return builder.trunc(builder.select(builder.icmp_signed(">", value, zero), value, zero), _HALVES)

    return WORDS(sums, types.int64, types.int64, types.int64), generate


@instruction
def store_normalised(typing_context: Code, array: Code, index: Code, words: Code, floor: Code) -> Definition:
    """Write four histograms as 32 bytes: each divided by its Euclidean norm plus `floor`, times 255, rounded."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        array, index, words, floor = arguments
        wide = builder.zext(words, ir.VectorType(_WORD, WIDTH))
        squares, count = builder.mul(wide, wide), WIDTH
        while count > 4:
            parts = [builder.shuffle_vector(squares, squares, _mask(list(range(odd, count, 2)))) for odd in (0, 1)]
            squares, count = builder.add(*parts), count // 2
        floats = ir.VectorType(_FLOAT, 4)
        root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(floats, [floats]), "llvm.sqrt.v4f32")
        norm = builder.call(root, [builder.sitofp(squares, floats)])
        spread = _mask([pixel for pixel in range(4) for _ in range(8)])
        first = builder.insert_element(ir.Constant(floats, ir.Undefined), floor, ir.Constant(_WORD, 0))
        floors = builder.shuffle_vector(first, first, _mask([0] * 4))
        gain = builder.fdiv(_constant(_FLOAT, [255.0] * 4), builder.fadd(norm, floors))
        gains = builder.shuffle_vector(gain, gain, spread)
        scaled = builder.fmul(builder.sitofp(wide, ir.VectorType(_FLOAT, WIDTH)), gains)
        rounded = builder.fptosi(builder.fadd(scaled, _constant(_FLOAT, [0.5] * WIDTH)), ir.VectorType(_WORD, WIDTH))
        builder.store(
            builder.trunc(rounded, _BYTES), pointer_to(context, builder, kind.args[0], array, index, _BYTES), align=1
        )
        return context.get_dummy_value()

    return types.void(array, types.int64, WORDS, types.float32), generate
