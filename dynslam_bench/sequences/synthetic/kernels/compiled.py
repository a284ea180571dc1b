"""How the renderer's kernels are compiled."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.integer]
Reals = NDArray[np.floating]
Intrinsics = tuple[float, float, float, float]

Function = TypeVar("Function")


def kernel(function: Function) -> Function:
    """Compile without the GIL and without fastmath; cached on disk where numba finds a folder it may write."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(Function, njit(cache=True, **options)(function))
    except RuntimeError:  # "no locator available": neither beside the module nor in the user's cache
        return cast(Function, njit(**options)(function))
