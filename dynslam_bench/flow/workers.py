"""Threads and memory of the flow's kernels."""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = tuple[NDArray[np.uint8], ...]


def _call(kernel: Callable[..., Any], *arguments: Any) -> None:
    kernel(*arguments)


class Workers:
    """Threads over which a kernel's rows or points are divided.

    Args:
        threads: Their number, the calling thread included.

    Attributes:
        run: ``run(kernel, start, stop, *arguments)`` calls ``kernel(start, stop, *arguments)`` on equal parts of the
            range and waits for all; with one thread it calls the kernel itself.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = max(1, threads)
        self.run: Callable[..., Any] = getattr(operator, "call", _call)  # without an `operator.call` in Python 3.10
        if self.threads > 1:
            self.run = self._divide
            self._pool = ThreadPoolExecutor(self.threads - 1, "flow")

    def _divide(self, kernel: Callable[..., Any], start: int, stop: int, *arguments: Any) -> None:
        """Run the last part in the calling thread, the others in the pool.

        The kernels release the GIL and write disjoint rows, so that the result is the same for every number of threads.
        """
        parts = max(1, min(self.threads, stop - start))
        bounds = [start + (stop - start) * part // parts for part in range(parts + 1)]
        futures = [self._pool.submit(kernel, bounds[i], bounds[i + 1], *arguments) for i in range(parts - 1)]
        kernel(bounds[-2], bounds[-1], *arguments)
        for future in futures:
            future.result()


def _references(arrays: Arrays) -> int:
    """The largest number of references to one of a set's arrays, this function's own included."""
    return max(sys.getrefcount(array) for array in arrays)


_UNREFERENCED = _references((np.zeros(1, dtype=np.uint8),))
"""Of a set that only its tuple refers to."""


class BufferPool:
    """Sets of zeroed uint8 arrays, reused once nothing else refers to any of them or to a view.

    The first access to a page of fresh memory costs more than computing its content (`docs/flow.md`, Speed). A reused
    set keeps its old content: callers must not write where they rely on zeros.

    Args:
        most: Sets kept at most; older ones are left to the garbage collector.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._sets: list[Arrays] = []

    def take(self, *shapes: tuple[int, ...]) -> Arrays:
        """Arrays of these shapes: a used set where one is free, else new ones, zeroed."""
        for number, arrays in enumerate(self._sets):
            if tuple(array.shape for array in arrays) == shapes and _references(arrays) <= _UNREFERENCED:
                self._sets.append(self._sets.pop(number))  # the longest unused first
                return tuple([*arrays])  # a tuple of its own, so that its holder counts as a reference
        fresh = tuple(np.zeros(shape, dtype=np.uint8) for shape in shapes)
        self._sets = [*self._sets, fresh][-self._most :]
        return tuple([*fresh])
