"""Run a kernel over stripes of rows or points on a few threads."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray


def run_stripes(
    function: Callable[..., Any], count: int, threads: int, pool: ThreadPoolExecutor | None, *arguments: Any
) -> None:
    """Call ``function(start, stop, *arguments)`` on equal parts of ``range(count)`` and wait for all.

    The last part runs in the calling thread. The kernels release the GIL and write disjoint rows, so the result is the
    same for every number of threads.
    """
    parts = min(threads, count) if pool is not None else 1
    if parts <= 1:
        function(0, count, *arguments)
        return
    assert pool is not None
    bounds = [count * part // parts for part in range(parts + 1)]
    futures = [pool.submit(function, bounds[i], bounds[i + 1], *arguments) for i in range(parts - 1)]
    function(bounds[parts - 1], bounds[parts], *arguments)
    for future in futures:
        future.result()


# Memory that is used again: a page touched for the first time costs the kernel more than filling it costs us.

Shape = tuple[int, ...]
Arrays = tuple[NDArray[np.uint8], ...]


def _references(arrays: Arrays) -> int:
    """The largest number of references to one of a set's arrays, this function's own included."""
    return max(sys.getrefcount(array) for array in arrays)


_UNHELD = _references((np.zeros(1, dtype=np.uint8),))
"""Of a set that only its tuple holds."""


class BufferPool:
    """Sets of zeroed uint8 arrays, handed out again once nobody else refers to any of them or to a view.

    Whoever takes a set may leave anything in it: what must be zero has to be kept so by its users.

    Args:
        most: Sets kept at most; the rest is left to the garbage collector.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._sets: list[Arrays] = []

    def take(self, *shapes: Shape) -> Arrays:
        """Arrays of these shapes: a set used before where one is free, else new ones, zeroed."""
        for number, arrays in enumerate(self._sets):
            if tuple(array.shape for array in arrays) == shapes and _references(arrays) <= _UNHELD:
                self._sets.append(self._sets.pop(number))  # the longest unused first
                return tuple([*arrays])  # a tuple of its own, so that its holder counts
        fresh = tuple(np.zeros(shape, dtype=np.uint8) for shape in shapes)
        self._sets = [*self._sets, fresh][-self._most :]
        return tuple([*fresh])
