"""Compilation of kernels: functions in numba's subset of Python that become machine code at their first call."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

import numba
from numba.extending import is_jitted

from dynslam_bench.core.kernel_cache import KernelCompiler, remember_kernel

Function = TypeVar("Function", bound=Callable[..., Any])

Scalar: TypeAlias = Any
"""A number inside kernels. Numba compiles a kernel for the widths that it is called with (float32, int64, uint64); no
annotation can say which. Arrays, records and counts are annotated as they are."""


def kernel(function: Function) -> Function:
    """Compile a function, cached on disk and without the GIL.

    The compiled code lies in the user's cache folder (`core.kernel_cache`); where that cannot be
    written it is compiled again in every process. Sums of floats keep their written order (no
    fast-math), so that a result does not depend on the processor's vector width.
    """
    return _compiled(function, error_model="python")


def dividing_kernel(function: Function) -> Function:
    """`kernel` in which a division by zero gives an infinity, as numpy's does, and no error."""
    return _compiled(function, error_model="numpy")


def inlined_statements(function: Function) -> Function:
    """Compile a function whose statements numba copies into its callers: arrays that are passed to it cost nothing."""
    return _compiled(function, error_model="python", inline="always")


def inlined(function: Function) -> Function:
    """Compile a small function of scalars and arrays, which makes no arrays, into its callers' machine code.

    References to arrays are not counted in it: numba's atomic counts took a third of the flow's
    search.
    """
    return cast("Function", numba.njit(nogil=True, forceinline=True, _nrt=False)(function))


def _compiled(function: Function, *, error_model: str, **options: Any) -> Function:
    """Numba's kernel of a function, compiled at its first call or loaded from disk.

    Args:
        function: The function.
        error_model: ``python``: a division by zero raises; ``numpy``: it gives an infinity.
        **options: Further options of `numba.njit`.
    """
    # numba would give a kernel without an error model that of the kernel which calls it first
    compiled = numba.njit(
        nogil=True, pipeline_class=KernelCompiler, error_model=error_model, **options
    )(function)
    if is_jitted(compiled):  # not under NUMBA_DISABLE_JIT
        remember_kernel(compiled)
    return cast("Function", compiled)
