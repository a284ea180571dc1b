"""Which of the paper's moth-flame equations are in force, and the schedule they follow."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SPIRAL_LOW, SPIRAL_STEPS = -2.0, 1024
CAUCHY_STEPS = 4096


class MothFlameRules(NamedTuple):
    """A member of the moth-flame family.

    Attributes:
        opposition: Elite opposition-based learning of the first population (Eq. 19-22).
        cauchy: Cauchy steps in the first half of the iterations (Eq. 13-16).
        best_flame: Pull of the flames towards the best one in the second half (Eq. 17-18).
        half: Divide Eq. 17 by two, as printed, which pulls every label towards zero.
        as_printed: Eq. 9-11 with the signs as printed: t in [1, 2], flames counted down from the last count.
    """

    opposition: bool
    cauchy: bool
    best_flame: bool
    half: bool
    as_printed: bool


EMFOA = MothFlameRules(opposition=True, cauchy=True, best_flame=True, half=False, as_printed=False)
MFO = MothFlameRules(opposition=False, cauchy=False, best_flame=False, half=False, as_printed=False)
EMFOA_LITERAL = MothFlameRules(opposition=True, cauchy=True, best_flame=True, half=True, as_printed=True)


def flame_counts(population: int, iterations: int, rules: MothFlameRules) -> NDArray[np.int64]:
    """Number of flames in iterations 1..T (Eq. 11): ``round(N - l (N - 1) / T)``.

    As printed, the count is taken from the last one instead of N, and collapses.
    """
    counts, last = [], population
    for iteration in range(1, iterations + 1):
        base = last if rules.as_printed else population
        last = max(1, round(base - iteration * (base - 1) / iterations))
        counts.append(last)
    return np.asarray(counts or [1], dtype=np.int64)


@lru_cache(maxsize=1)
def spiral_table() -> NDArray[np.float32]:
    """``e^t cos(2 pi t)`` (Eq. 8 with b = 1) for t in [-2, 2), 1,024 steps a unit."""
    t = SPIRAL_LOW + (np.arange(4 * SPIRAL_STEPS) + 0.5) / SPIRAL_STEPS
    return np.asarray(np.exp(t) * np.cos(2 * np.pi * t), dtype=np.float32)


@lru_cache(maxsize=1)
def cauchy_table() -> NDArray[np.float32]:
    """``tan(pi (U - 1/2))`` (Eq. 16) for 4,096 values of U."""
    u = (np.arange(CAUCHY_STEPS) + 0.5) / CAUCHY_STEPS
    return np.asarray(np.tan(np.pi * (u - 0.5)), dtype=np.float32)
