"""How kernels are compiled: functions in numba's subset of Python that become machine code at their first call."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

Scalar: TypeAlias = Any
"""A number inside kernels. Numba compiles a kernel for the widths that it is called with (float32, int64, uint64); no
annotation can say which. Arrays, records and counts are annotated as they are."""


def kernel(function: Function) -> Function:
    """Compile a function, cached on disk and without the GIL.

    The compiled code lies beside the source, or in the user's cache folder; where neither can be written it is compiled
    again in every process. Sums of floats keep their written order (no fast-math), so that a result does not depend on
    the processor's vector width.
    """
    return _compiled(function)


def dividing_kernel(function: Function) -> Function:
    """`kernel` in which a division by zero gives an infinity, as numpy's does, and no error."""
    return _compiled(function, error_model="numpy")


def spliced(function: Function) -> Function:
    """Compile a function whose statements numba copies into its callers: arrays that are passed to it cost nothing."""
    return _compiled(function, inline="always")


def inlined(function: Function) -> Function:
    """Compile a small function of scalars and arrays, which makes no arrays, into its callers' machine code.

    References to arrays are not counted in it: numba's atomic counts took a third of the flow's search.
    """
    return cast("Function", numba.njit(nogil=True, forceinline=True, _nrt=False)(function))


def load_kernels() -> None:
    """Load what lies compiled on disk of all kernels, and with it the rest of numba.

    Processes that are forked from this one have it then; else each takes 0.4 s to load it.
    """
    for compiled in _CACHED:
        cache, target = compiled._cache, compiled.targetctx.codegen()
        for key in cache._cache_file._load_index():
            if key == cache._index_key(key[0], target):  # not of another processor
                compiled.compile(key[0])


_CACHED: list[Any] = []


def _compiled(function: Function, **options: Any) -> Function:
    try:
        compiled = numba.njit(cache=True, nogil=True, **options)(function)
    except RuntimeError:  # numba finds no folder in which it may cache
        return cast("Function", numba.njit(nogil=True, **options)(function))
    _CACHED.append(compiled)
    return cast("Function", compiled)
