"""Order among numbers, for compiled loops: numpy's functions for it take numba a second or more each to compile."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel


@kernel
def counting_sort(
    keys: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort whole numbers from 0 to `count` - 1; equal ones keep their order.

    Returns:
        int64 ``[count + 1]``, where each number's places begin in the order, then N; int64 ``[N]``,
        the indices in order.
    """
    # how often each number occurs, one place on, and the sums of these
    start = np.zeros(count + 1, np.int64)
    for key in keys:
        start[key + 1] += 1
    for key in range(count):
        start[key + 1] += start[key]
    # put each index at its number's next free place
    place = start.copy()
    order = np.empty(len(keys), np.int64)
    for i in range(len(keys)):
        order[place[keys[i]]] = i
        place[keys[i]] += 1
    return start, order


@kernel
def median(values: NDArray[np.float64]) -> float:
    """Median of finite numbers ``[N]``, one or more, whose order changes."""
    # quickselect (Hoare 1961) of the upper middle: narrow down to the side that holds it
    middle = len(values) // 2
    first = 0
    last = len(values) - 1
    while first < last:
        pivot = values[(first + last) // 2]
        i = first
        j = last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                exchanged = values[i]
                values[i] = values[j]
                values[j] = exchanged
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            first = i
        else:
            break
    upper: float = values[middle]
    if len(values) % 2 == 1:
        return upper
    # none to the left of the upper middle is larger: the largest of them is the lower middle
    lower: float = values[0]
    for k in range(1, middle):
        lower = max(lower, values[k])
    return (lower + upper) / 2
