"""Memory that is used again: a page touched for the first time costs the kernel more than filling it costs us."""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

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
