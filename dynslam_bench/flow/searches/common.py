"""What all label searches share: their state, their random numbers, and how a label enters the population."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined

from ..kernels.arrays import Floats, Longs

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)


class SearchState(NamedTuple):
    """The best labels so far, of all points.

    Attributes:
        moths: float32 ``[N, P, 4]``, where each point's population is.
        flames: float32 ``[N, P, 4]``, the best labels ever evaluated, best first.
        costs: int64 ``[N, P]``, their costs (Eq. 5, 7).
        used: int64 ``[N]``, cost evaluations spent.
        lower: float32 ``[N, 4]``, the box that is searched.
        upper: float32 ``[N, 4]``.
    """

    moths: NDArray[np.float32]
    flames: NDArray[np.float32]
    costs: NDArray[np.int64]
    used: NDArray[np.int64]
    lower: NDArray[np.float32]
    upper: NDArray[np.float32]


def new_state(
    count: int, population: int, lower: NDArray[np.float32], upper: NDArray[np.float32], ceiling: int
) -> SearchState:
    """A state in which nothing has been evaluated: every flame costs `ceiling`."""
    return SearchState(
        np.zeros((count, population, 4), dtype=np.float32),
        np.zeros((count, population, 4), dtype=np.float32),
        np.full((count, population), ceiling, dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        lower,
        upper,
    )


@inlined
def scrambled(state: Scalar) -> Scalar:
    """64 random bits of a state (splitmix64)."""
    z = (state ^ (state >> np.uint64(30))) * _MIX1
    z = (z ^ (z >> np.uint64(27))) * _MIX2
    return z ^ (z >> np.uint64(31))


@inlined
def first_state(seed: Scalar, point: int, phase: int) -> Scalar:
    """First state of a point's random numbers in one phase: a hash of its arguments."""
    return scrambled(np.uint64(seed) + _GOLDEN * (np.uint64(point) * np.uint64(64) + np.uint64(phase) + np.uint64(1)))


@inlined
def advance(state: Scalar) -> Scalar:
    """The next state of a point's random numbers."""
    return state + _GOLDEN


@inlined
def uniform(bits: Scalar, quarter: int) -> Scalar:
    """One of the four float32 in [0, 1) that `scrambled` bits make, in steps of 2**-16."""
    part = np.int32((bits >> np.uint64(16 * quarter)) & np.uint64(65535))
    return np.float32(part) * np.float32(1.0 / 65536)


@inlined
def insert(flames: Floats, costs: Longs, label: Floats, cost: Scalar) -> None:
    """Merge an evaluated label into a point's sorted flames if it is better than the worst (``F = best N``).

    Args:
        flames: float32 ``[P, 4]``, changed in place.
        costs: int64 ``[P]``, likewise.
        label: float32 ``[4]``.
        cost: Its cost.
    """
    k = len(costs) - 1
    if cost >= costs[k]:
        return
    while k > 0 and costs[k - 1] > cost:
        costs[k] = costs[k - 1]
        for j in range(4):
            flames[k, j] = flames[k - 1, j]
        k -= 1
    costs[k] = cost
    for j in range(4):
        flames[k, j] = label[j]


@inlined
def widen(lower: Floats, upper: Floats, flames: Floats) -> None:
    """Let a point's box contain the surroundings of its best displacement, which a neighbour may have brought."""
    room = np.float32(8)
    for j in range(2):
        lower[j], upper[j] = min(lower[j], flames[0, j] - room), max(upper[j], flames[0, j] + room)
