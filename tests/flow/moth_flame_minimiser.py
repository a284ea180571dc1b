"""The moth-flame equations (`flow.searches.moth_flame`) over any box, for functions with known optima.

The algorithm of the label search (Eq. 4-22, corrected Algorithm 1); whole populations of B problems at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow.moth_flame import EMFOA, MothFlameRules, opposites, population_positions

Floats = NDArray[np.float64]
CAUCHY_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Minimum:
    """What was found for B problems in D dimensions.

    Attributes:
        x: float64 ``[B, D]``, the best position of each problem.
        value: float64 ``[B]``, its value.
        evaluations: Function evaluations a problem.
        history: float64 ``[evaluated populations, B]``, best value so far; never rises.
    """

    x: Floats
    value: Floats
    evaluations: int
    history: Floats


def _box(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> tuple[Floats, Floats]:
    low: Floats = np.atleast_2d(np.asarray(lower, dtype=np.float64))
    high: Floats = np.atleast_2d(np.asarray(upper, dtype=np.float64))
    low, high = low + np.zeros_like(high), high + np.zeros_like(low)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError("bounds must be finite, and lower <= upper")
    return low, high


def _join(moths: Floats, start: Floats, low: Floats, high: Floats) -> None:
    """Put given positions in the place of the first moths; what is not finite stays drawn."""
    problems, population, _ = moths.shape
    given = np.broadcast_to(start, (problems, *start.shape[-2:]))[:, :population]
    joined = moths[:, : given.shape[1]]
    joined[:] = np.where(np.isfinite(given), np.clip(given, low, high), joined)


def emfoa_minimise(
    fun: Callable[[Floats], Floats],
    lower: NDArray[np.floating],
    upper: NDArray[np.floating],
    *,
    budget: int,
    population: int = 20,
    seed: int = 0,
    start: NDArray[np.floating] | None = None,
    steps: NDArray[np.floating] | None = None,
    rules: MothFlameRules = EMFOA,
) -> Minimum:
    """Minimise functions over boxes by the enhanced moth-flame algorithm.

    Args:
        fun: Maps positions ``[B, N, D]`` (N candidates of each of B problems) to values ``[B, N]``; NaN counts as +inf.
        lower: ``[D]`` or ``[B, D]``, lower bounds; ``[D]`` alone means one problem.
        upper: ``[D]`` or ``[B, D]``, upper bounds.
        budget: Function evaluations a problem; never exceeded.
        population: Moths (N of Eq. 4); reduced to what the budget allows.
        seed: Of all random numbers.
        start: ``[M, D]`` or ``[B, M, D]``, positions that join the first population; what is not finite is drawn.
        steps: ``[D]`` or ``[B, D]``, scale of the Cauchy steps of Eq. 13; None takes 1 % of the box.
        rules: Which equations are in force.

    Raises:
        ValueError: The bounds are not finite or crossed, or the budget is not positive.
    """
    low, high = _box(lower, upper)
    if budget < 1:
        raise ValueError(f"budget must be positive, got {budget}")
    problems, dimensions = low.shape
    rng = np.random.default_rng(seed)
    low, high = low[:, None], high[:, None]
    scale = CAUCHY_SHARE * (high - low) if steps is None else np.atleast_2d(steps)[:, None]
    population = max(1, min(population, budget))
    moths = low + (high - low) * rng.random((problems, population, dimensions))
    if start is not None:
        _join(moths, np.asarray(start, dtype=np.float64), low, high)
    flames = np.empty((problems, 0, dimensions))
    values = np.empty((problems, 0))
    history: list[Floats] = []
    spent = 0

    def evaluate(positions: Floats) -> None:
        """Spend evaluations on the first positions that the budget allows; merge them into the flames (Eq. 5-7)."""
        nonlocal flames, values, spent
        positions = positions[:, : max(0, budget - spent)]
        if not positions.shape[1]:
            return
        found = np.asarray(fun(positions), dtype=np.float64).reshape(problems, -1)
        spent += positions.shape[1]
        values = np.concatenate([values, np.where(np.isnan(found), np.inf, found)], axis=1)
        flames = np.concatenate([flames, positions], axis=1)
        order = np.argsort(values, axis=1, kind="stable")[:, :population]
        values = np.take_along_axis(values, order, axis=1)
        flames = np.take_along_axis(flames, order[..., None], axis=1)
        history.append(values[:, 0].copy())

    evaluate(moths)
    if rules.opposition and spent < budget:
        least, greatest = moths.min(axis=1, keepdims=True), moths.max(axis=1, keepdims=True)  # Eq. 20
        evaluate(opposites(np, moths, least, greatest, low, high, rng.random))
        moths = flames.copy()  # the best N of X and its opposites
    iterations = -(-(budget - spent) // population)
    for iteration in range(1, iterations + 1):
        position = population_positions(np, moths, flames, iteration, iterations, rules, scale, rng.random)
        moths = np.clip(position, low, high)
        evaluate(moths)
    return Minimum(flames[:, 0], values[:, 0], spent, np.asarray(history))
