"""The moth-flame equations (Eq. 8-22), and the members of the moth-flame family.

The sampler of `packaging/optunahub` calls them. The flow's search is compiled:
`move_moths` of `label_search` is `moth_positions` for one point, with `flight_table`,
`spiral_table` and `cauchy_table` from here. Moths and flames are arrays of any leading shape with
the dimensions of the problem last; `uniform(shape)` draws from [0, 1).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Uniform = Callable[[tuple[int, ...]], Any]
"""Draws numbers of a shape from [0, 1)."""


class MothFlameRules(NamedTuple):
    """A member of the moth-flame family.

    Attributes:
        opposition: Elite opposition-based learning of the first population (Eq. 19-22).
        cauchy: Cauchy steps in the first half of the iterations (Eq. 13-16).
        best_flame: Pull of the flames towards the best one in the second half (Eq. 17-18).
        half: Divide Eq. 17 by two, as printed, which pulls every label towards zero.
        as_printed: Eq. 9-11 with the signs as printed: t in [1, 2], flames counted down from the
            last count.
    """

    opposition: bool
    cauchy: bool
    best_flame: bool
    half: bool
    as_printed: bool


EMFOA = MothFlameRules(opposition=True, cauchy=True, best_flame=True, half=False, as_printed=False)
"""The paper's enhanced search (Eq. 8-22), with Eq. 9-11 and 17 corrected."""
MFO = MothFlameRules(opposition=False, cauchy=False, best_flame=False, half=False, as_printed=False)
"""Moth-flame optimisation without the enhancements (Eq. 8-12)."""
EMFOA_LITERAL = MothFlameRules(
    opposition=True, cauchy=True, best_flame=True, half=True, as_printed=True
)
"""The enhanced search as printed."""


def flames_left(flames: int, iteration: int, iterations: int) -> int:
    """Number of flames in iteration l of T (Eq. 11): ``round(N - l (N - 1) / T)``."""
    return max(1, round(flames - iteration * (flames - 1) / iterations))


def flame_counts(population: int, iterations: int, rules: MothFlameRules) -> NDArray[np.int64]:
    """Number of flames in iterations 1..T (Eq. 11).

    As printed, the count is taken from the last one instead of N, and collapses.
    """
    # Eq. 11 for each iteration
    counts = []
    last = population
    for iteration in range(1, iterations + 1):
        last = flames_left(last if rules.as_printed else population, iteration, iterations)
        counts.append(last)
    return np.asarray(counts or [1], dtype=np.int64)


class Flight(NamedTuple):
    """Coefficients of an iteration, the same for every moth.

    Attributes:
        span: ``r - 1`` (Eq. 9), so that ``t = span U + 1`` (Eq. 10) lies between r and 1.
        own: Weight of a moth's own flame in its goal (a of Eq. 17-18).
        best: Weight of the best flame; 0 leaves the own flame as it is.
        stepping: Whether a Cauchy step is added (Eq. 13).
    """

    span: Any
    own: Any
    best: Any
    stepping: bool


def flight(progress: Any, rules: MothFlameRules) -> Flight:
    """The coefficients at ``progress = l / T``, in the precision of `progress`."""
    # r falls from -1 to -2 (Eq. 9)
    r = 1 + progress if rules.as_printed else -1 - progress

    # first half: the own flame alone, with Cauchy steps
    first_half = bool(progress <= 0.5)
    stepping = rules.cauchy and first_half
    if first_half or not rules.best_flame:
        return Flight(r - 1, 1 + 0 * progress, 0 * progress, stepping)

    # second half: own and best flame, weighted by a and 1 - a (Eq. 18)
    a = 0.6 - 0.4 * progress
    share = 0.5 if rules.half else 1.0
    return Flight(r - 1, share * a, share * (1 - a), stepping)


def spiral(distance: Any, t: Any) -> Any:
    """``D e^(b t) cos(2 pi t)`` of Eq. 8 and 12, with b = 1."""
    return distance * np.exp(t) * np.cos(2 * np.pi * t)


def cauchy(uniform: Any) -> Any:
    """A Cauchy number ``tan(pi (U - 1/2))`` (Eq. 14-16, g = 1)."""
    return np.tan(np.pi * (uniform - 0.5))


def moth_positions(
    moths: Any, own: Any, flames: Any, best: Any, iteration: Flight, scale: Any, uniform: Uniform
) -> Any:
    """New positions: a spiral around the flame, attraction to the best flame, a Cauchy step (Eq. 8, 10, 12, 13, 17).

    Args:
        moths: Positions of the moths ``[..., D]``: labels of D dimensions.
        own: Flames with the moths' own numbers ``[..., D]``; the spiral's width is the distance to
            them.
        flames: Flames that the moths fly around ``[..., D]``: their own, or the last flame that is
            left (Eq. 8).
        best: The best flame, ``[1, D]`` or ``[D]``.
        iteration: Coefficients of the iteration.
        scale: Scale of the Cauchy steps, ``[D]``, in the units of the label.
        uniform: Draws uniform numbers in [0, 1) of a shape.
    """
    # where on the spiral each moth is drawn, from 1 at the flame to r (Eq. 10)
    t = iteration.span * uniform(moths.shape) + 1

    # the goal: the flame, in the second half pulled towards the best one (Eq. 17)
    goal = flames
    if iteration.best:
        goal = iteration.own * flames + iteration.best * best

    # a spiral around the goal (Eq. 8, 12), and a Cauchy step in the first half (Eq. 13)
    position = spiral(np.abs(own - moths), t) + goal
    if iteration.stepping:
        position = position + cauchy(uniform(moths.shape)) * scale
    return position


def opposites(
    members: Any, least: Any, greatest: Any, low: Any, high: Any, uniform: Uniform
) -> Any:
    """Elite opposition-based learning (Eq. 19-22).

    Args:
        members: Positions ``[..., D]`` of one or several members of the population.
        least: Lower dynamic bounds of the population (dy of Eq. 20), ``[..., D]``.
        greatest: Upper dynamic bounds of the population (dz of Eq. 20), ``[..., D]``.
        low: Lower bounds of the search ``[D]``; an opposite outside the bounds is replaced by a
            draw within them.
        high: Upper bounds of the search ``[D]``.
        uniform: Draws uniform numbers in [0, 1) of a shape.
    """
    # the opposite of each member in the population's bounds, by one draw a member (Eq. 19)
    opposite = uniform((*members.shape[:-1], 1)) * (least + greatest) - members

    # outside of the bounds a draw within them (Eq. 21-22)
    drawn = low + (high - low) * uniform(members.shape)
    return np.where((opposite < low) | (opposite > high), drawn, opposite)


class FlightTable(NamedTuple):
    """Iterations 1..T of the compiled search.

    Attributes:
        counts: int64 ``[T]``, number of flames (Eq. 11).
        coefficients: float32 ``[T, 4]``, the fields of `Flight`.
        opposition: Whether the first population is drawn by opposition.
    """

    counts: NDArray[np.int64]
    coefficients: NDArray[np.float32]
    opposition: bool


@lru_cache(maxsize=64)
def flight_table(population: int, iterations: int, rules: MothFlameRules) -> FlightTable:
    """The flights of T iterations, computed in float32."""
    rows = [flight(np.float32(k) / np.float32(iterations), rules) for k in range(1, iterations + 1)]
    return FlightTable(
        flame_counts(population, iterations, rules), np.array(rows, np.float32), rules.opposition
    )


@lru_cache(maxsize=1)
def spiral_table() -> NDArray[np.float32]:
    """`spiral` of distance 1 for t in [-2, 2), 1,024 steps a unit."""
    return np.asarray(spiral(1.0, -2 + (np.arange(4 * 1024) + 0.5) / 1024), dtype=np.float32)


@lru_cache(maxsize=1)
def cauchy_table() -> NDArray[np.float32]:
    """`cauchy` for 4,096 values of U."""
    return np.asarray(cauchy((np.arange(4096) + 0.5) / 4096), dtype=np.float32)
