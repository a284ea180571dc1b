"""Moth-flame label search (Eq. 4-22, corrected Algorithm 1), one population a point.

Positions are labels; a moth's fitness is the matching cost of its label (Eq. 5-7). Which equations are in force is
said by `rules.MothFlameRules`: the enhanced algorithm, the plain one, or the equations as printed.
"""

from __future__ import annotations

import numpy as np

from .._jit import inlined, kernel
from ..matching import label_cost
from .common import advance, insert, stream, uniform, widen


@kernel
def moth_flame_phase(  # type: ignore[no-untyped-def]
    start, stop, reference, target, tables, state, candidates, end, phase, seed, rules, counts, spiral, cauchy, steps
):
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        reference: `matching.Reference`.
        target: `matching.Side`.
        tables: `matching.CostTables`.
        state: `common.SearchState`, changed in place.
        candidates: float32 ``[N, C, 4]``, labels to try first (neighbours', the guess, ...); not finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase; 0 founds the population.
        seed: Of the frame.
        rules: `rules.MothFlameRules`.
        counts: int64 ``[T]``, number of flames in every iteration (Eq. 11).
        spiral: `rules.spiral_table`.
        cauchy: `rules.cauchy_table`.
        steps: float32 ``[4]``, scale of the Cauchy steps.
    """
    population = state.costs.shape[1]
    iterations = len(counts)
    label = np.empty(4, dtype=np.float32)
    low, high = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    for i in range(start, stop):
        random = stream(seed, i, phase)
        moths, flames, costs = state.moths[i], state.flames[i], state.costs[i]
        lower, upper = state.lower[i], state.upper[i]
        used = state.used[i]
        placed = 0
        for c in range(candidates.shape[1]):
            u, v, s, theta = candidates[i, c, 0], candidates[i, c, 1], candidates[i, c, 2], candidates[i, c, 3]
            if used >= end or not np.isfinite(u + v + s + theta):
                continue
            cost = label_cost(i, u, v, s, theta, reference, target, tables, costs[population - 1])
            used += 1
            insert(state, i, u, v, s, theta, cost)
            if phase == 0 and placed < population:
                moths[placed, 0], moths[placed, 1], moths[placed, 2], moths[placed, 3] = u, v, s, theta
                placed += 1
        widen(lower, upper, flames[0])
        if phase == 0:
            for m in range(placed, population):
                for j in range(4):  # LB + (UB - LB) rand
                    random = advance(random)
                    moths[m, j] = lower[j] + (upper[j] - lower[j]) * uniform(random)
                if used < end:
                    used += 1
                    u, v, s, theta = moths[m, 0], moths[m, 1], moths[m, 2], moths[m, 3]
                    cost = label_cost(i, u, v, s, theta, reference, target, tables, costs[population - 1])
                    insert(state, i, u, v, s, theta, cost)
            if rules.opposition:
                for j in range(4):  # dynamic bounds dy, dz (Eq. 20)
                    low[j], high[j] = moths[0, j], moths[0, j]
                    for m in range(1, population):
                        low[j], high[j] = min(low[j], moths[m, j]), max(high[j], moths[m, j])
                for m in range(population):
                    random = advance(random)
                    factor = uniform(random)
                    for j in range(4):
                        label[j] = factor * (low[j] + high[j]) - moths[m, j]  # Eq. 19
                        random = advance(random)
                        if label[j] < lower[j] or label[j] > upper[j]:  # Eq. 21-22
                            label[j] = lower[j] + (upper[j] - lower[j]) * uniform(random)
                    if used < end:
                        used += 1
                        cost = label_cost(
                            i, label[0], label[1], label[2], label[3], reference, target, tables,
                            costs[population - 1],
                        )  # fmt: skip
                        insert(state, i, label[0], label[1], label[2], label[3], cost)
                for m in range(population):  # the best N of X and its opposites
                    if costs[m] < tables.ceiling:
                        for j in range(4):
                            moths[m, j] = flames[m, j]
        founding = population * (2 if rules.opposition else 1)
        while used < end:
            iteration = min(max((used - founding) // population, 0), iterations - 1)
            fly(moths, flames, lower, upper, iteration, rules, counts, spiral, cauchy, steps, random)
            random = stream(random, i, phase)
            for m in range(population):
                if used < end:
                    used += 1
                    u, v, s, theta = moths[m, 0], moths[m, 1], moths[m, 2], moths[m, 3]
                    cost = label_cost(i, u, v, s, theta, reference, target, tables, costs[population - 1])
                    insert(state, i, u, v, s, theta, cost)
        state.used[i] = used


@inlined
def fly(moths, flames, lower, upper, iteration, rules, counts, spiral, cauchy, steps, random):  # type: ignore[no-untyped-def]
    """Move every moth once (Eq. 8-18)."""
    population, iterations = len(moths), len(counts)
    progress = np.float32(iteration + 1) / np.float32(iterations)
    r = np.float32(1) + progress if rules.as_printed else np.float32(-1) - progress  # Eq. 9
    first_half = 2 * (iteration + 1) <= iterations
    a = np.float32(0.6) - np.float32(0.4) * progress  # Eq. 18
    for m in range(population):
        flame = flames[min(m, counts[iteration] - 1)]  # Eq. 8
        for j in range(4):
            random = advance(random)
            t = (r - np.float32(1)) * uniform(random) + np.float32(1)  # Eq. 10
            turn = spiral[min(max(np.int64((t + np.float32(2)) * np.float32(1024)), 0), 4095)]
            distance = abs(flames[m, j] - moths[m, j])
            goal = flame[j]
            if rules.best_flame and not first_half:  # Eq. 17
                goal = a * goal + (np.float32(1) - a) * flames[0, j]
                if rules.half:
                    goal = goal * np.float32(0.5)
            position = distance * turn + goal
            if rules.cauchy and first_half:  # Eq. 13
                random = advance(random)
                position += cauchy[np.int64(random >> np.uint64(52))] * steps[j]
            moths[m, j] = min(max(position, lower[j]), upper[j])
