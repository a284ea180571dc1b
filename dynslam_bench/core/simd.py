"""SIMD vectors inside compiled kernels: 16 float32, 32 uint16 or 64 uint8 numbers as one value.

Written as generic vector code of fixed width (llvmlite): LLVM maps it to the processor's
instructions. A lane is the place of one number in a vector, as in SIMD hardware. The order of
every sum is part of the program, so that results do not depend on the processor.

Here are the types, arithmetic and access to memory. Instructions of one use lie beside it, each with
its plain form, which a test compares it with: `features.fast`, `flow.sampling`,
`flow.histogram_vectors`, `flow.descriptor_vectors`.

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
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numpy.typing import NDArray

# arrays of kernels, by what they hold
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
FLOAT = ir.FloatType()
INT64 = ir.IntType(64)
INT32 = ir.IntType(32)
UINT16 = ir.IntType(16)
BYTE = ir.IntType(8)

# LLVM's types of vectors: sixteen numbers for float32, thirty-two for uint16
FLOATS = ir.VectorType(FLOAT, FLOAT_LANES)
INTS = ir.VectorType(INT32, FLOAT_LANES)
BYTES16 = ir.VectorType(BYTE, FLOAT_LANES)
UINT16S = ir.VectorType(UINT16, UINT16_LANES)
BYTES32 = ir.VectorType(BYTE, UINT16_LANES)
INTS32 = ir.VectorType(INT32, UINT16_LANES)
FLOATS32 = ir.VectorType(FLOAT, UINT16_LANES)


class SimdType(types.Type):
    """Numba's type of a vector.

    Args:
        name: Name of the type in numba's messages and signatures.
        vector: LLVM's type.
    """

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(SimdType)
class _SimdModel(models.PrimitiveModel):
    """Numba's model of a vector: LLVM's value of its type."""

    def __init__(self, manager: Code, kind: Code) -> None:
        super().__init__(manager, kind, kind.vector)


FLOAT32X16 = SimdType("Float32x16", FLOATS)
UINT16X32 = SimdType("UInt16x32", UINT16S)


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


def lane_numbers(*lanes: int) -> Code:
    """The constant that tells `shuffle_vector` which lanes to take; those of a second vector follow the first's."""
    return ir.Constant(ir.VectorType(INT32, len(lanes)), list(lanes))


def splat(builder: Code, kind: ir.VectorType, value: Code) -> Code:
    """Code for a vector of equal numbers."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(INT32, 0))
    return builder.shuffle_vector(first, undefined, lane_numbers(*([0] * kind.count)))


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
    return builder.sitofp(builder.zext(loaded, INTS), FLOATS)


load = _loading(FLOAT32X16, FLOATS, 4, _unchanged)
"""``load(array, index)``: sixteen adjacent numbers of a flat float32 array."""
load_bytes = _loading(FLOAT32X16, BYTES16, 1, _bytes_to_floats)
"""``load_bytes(array, index)``: sixteen adjacent numbers of a flat uint8 array, as floats."""
load_uint16 = _loading(UINT16X32, UINT16S, 2, _unchanged)
"""``load_uint16(array, index)``: thirty-two adjacent numbers of a flat uint16 array."""
store = _storing(FLOAT32X16, 4)
"""``store(array, index, vector)``: write sixteen adjacent numbers of a flat float32 array."""
store_uint16 = _storing(UINT16X32, 2)
"""``store_uint16(array, index, vector)``: write thirty-two adjacent numbers of a flat uint16 array."""


def sum_of_lanes(builder: Code, vector: Code, add: Callable[[Code, Code], Code]) -> Code:
    """Code for the sum of a vector's numbers: halves onto halves, always in the same order."""
    width = vector.type.count
    while width > 1:
        width //= 2
        lower = builder.shuffle_vector(vector, vector, lane_numbers(*range(width)))
        upper = builder.shuffle_vector(vector, vector, lane_numbers(*range(width, 2 * width)))
        vector = add(lower, upper)
    return builder.extract_element(vector, ir.Constant(INT32, 0))


@instruction
def spread(typing_context: Code, value: Code) -> Definition:
    """A float32 vector with the same number in every lane."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return splat(builder, FLOATS, arguments[0])

    return FLOAT32X16(types.float32), generate


@instruction
def total(typing_context: Code, vector: Code) -> Definition:
    """Sum of the numbers of a float32 vector: halves onto halves, always in the same order."""

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        return sum_of_lanes(builder, arguments[0], builder.fadd)

    return types.float32(vector), generate


def plain_total(values: Floats) -> np.float32:
    """`total` of sixteen numbers, in numpy."""
    while len(values) > 1:
        half = len(values) // 2
        values = values[:half] + values[half:]
    return np.float32(values[0])


def smaller(builder: Code, first: Code, second: Code) -> Code:
    """Code for the smaller of two numbers without sign, lane by lane."""
    return builder.select(builder.icmp_unsigned("<", first, second), first, second)


def larger(builder: Code, first: Code, second: Code) -> Code:
    """Code for the larger of two numbers without sign, lane by lane."""
    return builder.select(builder.icmp_unsigned(">", first, second), first, second)
