"""The moth-flame equations (`flow.moth_flame`) over any box, for functions with known optima.

The algorithm of the label search (Eq. 4-22, corrected Algorithm 1); whole populations of B problems at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow.moth_flame import EMFOA, MothFlameRules, opposites, population_positions

Floats = NDArray[np.float64]
CAUCHY_SHARE = 0.01


def emfoa_minimise(
    fun: Callable[[Floats], Floats],
    low: Floats,
    high: Floats,
    *,
    problems: int,
    budget: int,
    population: int = 20,
    seed: int = 0,
    rules: MothFlameRules = EMFOA,
) -> tuple[Floats, Floats]:
    """Minimise a function over a box by the enhanced moth-flame algorithm.

    Args:
        fun: Maps positions ``[B, N, D]`` (N candidates of each of B problems) to values ``[B, N]``.
        low: ``[D]``, lower bounds.
        high: ``[D]``, upper bounds.
        problems: B, independent runs.
        budget: Function evaluations a problem; never exceeded.
        population: Moths (N of Eq. 4).
        seed: Of all random numbers.
        rules: Which equations are in force.

    Returns:
        The best positions ``[B, D]``, and the best values so far ``[evaluated populations, B]``.
    """
    rng = np.random.default_rng(seed)
    shape = (problems, min(population, budget), len(low))
    moths = low + (high - low) * rng.random(shape)
    flames, values = np.empty((problems, 0, len(low))), np.empty((problems, 0))
    history: list[Floats] = []
    spent = 0

    def evaluate(positions: Floats) -> None:
        """Spend evaluations on the first positions that the budget allows; merge them into the flames (Eq. 5-7)."""
        nonlocal flames, values, spent
        positions = positions[:, : max(0, budget - spent)]
        if positions.shape[1]:
            spent += positions.shape[1]
            values = np.concatenate([values, fun(positions)], axis=1)
            flames = np.concatenate([flames, positions], axis=1)
            order = np.argsort(values, axis=1, kind="stable")[:, : shape[1]]
            values = np.take_along_axis(values, order, axis=1)
            flames = np.take_along_axis(flames, order[..., None], axis=1)
            history.append(values[:, 0].copy())

    evaluate(moths)
    if rules.opposition:
        least, greatest = moths.min(axis=1, keepdims=True), moths.max(axis=1, keepdims=True)  # Eq. 20
        evaluate(opposites(np, moths, least, greatest, low, high, rng.random))
        moths = flames.copy()  # the best N of X and its opposites
    iterations = -(-(budget - spent) // shape[1])
    scale = CAUCHY_SHARE * (high - low)
    for iteration in range(1, iterations + 1):
        position = population_positions(np, moths, flames, iteration, iterations, rules, scale, rng.random)
        moths = np.clip(position, low, high)
        evaluate(moths)
    return flames[:, 0], np.asarray(history)
