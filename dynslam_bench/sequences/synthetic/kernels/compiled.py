"""How the renderer's kernels are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit


def kernel(function: Any) -> Any:
    """Compile without the GIL and without fastmath; cached on disk where numba finds a folder it may write."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # "no locator available": neither beside the module nor in the user's cache
        return njit(**options)(function)
