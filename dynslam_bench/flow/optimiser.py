"""The enhanced moth-flame optimiser over a box, batched over many independent problems (numpy).

The same algorithm as the label search (Eq. 4-22, corrected Algorithm 1), for any function; `searches.moth_flame` is its
compiled form for matching costs. Fitness is evaluated for whole populations of all problems at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .searches.rules import EMFOA, MothFlameRules, flame_counts

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
    least: Floats = np.atleast_2d(np.asarray(lower, dtype=np.float64))
    most: Floats = np.atleast_2d(np.asarray(upper, dtype=np.float64))
    least, most = least + np.zeros_like(most), most + np.zeros_like(least)
    if not (np.isfinite(least).all() and np.isfinite(most).all() and (least <= most).all()):
        raise ValueError("bounds must be finite, and lower <= upper")
    if budget < 1:
        raise ValueError(f"budget must be positive, got {budget}")
    problems, dimensions = least.shape
    rng = np.random.default_rng(seed)
    low, high = least[:, None], most[:, None]
    scale = CAUCHY_SHARE * (high - low) if steps is None else np.atleast_2d(steps)[:, None]
    population = max(1, min(population, budget))
    moths = low + (high - low) * rng.random((problems, population, dimensions))
    if start is not None:
        given = np.asarray(start, dtype=np.float64)
        given = np.broadcast_to(given, (problems, *given.shape[-2:]))[:, :population]
        joined = moths[:, : given.shape[1]]
        moths[:, : given.shape[1]] = np.where(np.isfinite(given), np.clip(given, low, high), joined)
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
        moths_opposite = _opposites(moths, low, high, rng)
        evaluate(moths_opposite)
        moths = flames.copy()  # the best N of X and its opposites
    iterations = -(-(budget - spent) // population)
    counts = flame_counts(population, iterations, rules)
    for iteration in range(1, iterations + 1):
        moths = np.clip(_fly(moths, flames, iteration, iterations, counts, scale, rules, rng), low, high)
        evaluate(moths)
    return Minimum(flames[:, 0], values[:, 0], spent, np.asarray(history))


def _opposites(moths: Floats, low: Floats, high: Floats, rng: np.random.Generator) -> Floats:
    """Elite opposition-based learning (Eq. 19-22) with the population's dynamic bounds."""
    least, greatest = moths.min(axis=1, keepdims=True), moths.max(axis=1, keepdims=True)
    factor = rng.random((*moths.shape[:2], 1))
    opposite = factor * (least + greatest) - moths
    outside = (opposite < low) | (opposite > high)
    return np.where(outside, low + (high - low) * rng.random(moths.shape), opposite)


def _fly(
    moths: Floats, flames: Floats, iteration: int, iterations: int, counts: NDArray[np.int64], scale: Floats,
    rules: MothFlameRules, rng: np.random.Generator,
) -> Floats:  # fmt: skip
    """Move every moth once (Eq. 8-18)."""
    progress = iteration / iterations
    r = 1 + progress if rules.as_printed else -1 - progress  # Eq. 9
    t = (r - 1) * rng.random(moths.shape) + 1  # Eq. 10
    index = np.minimum(np.arange(moths.shape[1]), counts[iteration - 1] - 1)  # Eq. 8, 11
    goal = flames[:, index]
    first_half = 2 * iteration <= iterations
    if rules.best_flame and not first_half:
        a = 0.6 - 0.4 * progress  # Eq. 18
        goal = a * goal + (1 - a) * flames[:, :1]  # Eq. 17
        if rules.half:
            goal = goal / 2
    position = np.abs(flames - moths) * np.exp(t) * np.cos(2 * np.pi * t) + goal  # Eq. 8 with b = 1
    if rules.cauchy and first_half:
        position = position + np.tan(np.pi * (rng.random(moths.shape) - 0.5)) * scale  # Eq. 13-16
    return np.asarray(position, dtype=np.float64)
