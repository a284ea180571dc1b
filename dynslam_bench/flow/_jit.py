"""One way to compile the kernels of this room: cached on disk, without the GIL, without fast-math."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

Function = Callable[..., Any]


def kernel(function: Function) -> Function:
    """Compile a function at its first call.

    The compiled code is cached beside the source (or in the user's cache folder); where neither can be written it is
    compiled anew in every process. Sums of floats keep their written order (no fast-math), so that a result does not
    depend on the processor's vector width.
    """
    try:
        return cast("Function", numba.njit(cache=True, nogil=True)(function))
    except RuntimeError:  # numba finds no folder in which it may cache
        return cast("Function", numba.njit(nogil=True)(function))


def inlined(function: Function) -> Function:
    """Compile a small function into its callers."""
    return cast("Function", numba.njit(nogil=True, forceinline=True)(function))


@intrinsic
def sum_abs_diff8(typing_context, first, i, second, j):  # type: ignore[no-untyped-def]
    """L1 distance of eight adjacent bytes: ``sum |first[i + b] - second[j + b]|`` for flat uint8 arrays.

    Written as generic vector code, from which LLVM makes one instruction where the processor has it. The indices must
    be valid: nothing is checked.
    """
    signature = types.int32(first, types.uint64, second, types.uint64)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        word = ir.IntType(32)
        bytes8, words8 = ir.VectorType(ir.IntType(8), 8), ir.VectorType(word, 8)
        loaded = []
        for k in (0, 2):
            array = context.make_array(signature.args[k])(context, builder, arguments[k])
            pointer = builder.gep(array.data, [arguments[k + 1]])
            load = builder.load(builder.bitcast(pointer, bytes8.as_pointer()))
            load.align = 1
            loaded.append(builder.zext(load, words8))
        difference = builder.sub(*loaded)
        zero = ir.Constant(words8, [0] * 8)
        absolute = builder.select(builder.icmp_signed(">", difference, zero), difference, builder.sub(zero, difference))
        total = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(word, [words8]), "llvm.vector.reduce.add.v8i32"
        )
        return builder.call(total, [absolute])

    return signature, generate
