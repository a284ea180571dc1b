"""Moth-flame label search (Eq. 4-22, corrected Algorithm 1), one population a point.

Positions are labels; a moth's fitness is the matching cost of its label (Eq. 5-7). The equations stand in `moth_flame`;
what depends on the iteration alone comes from there as a table, and `fly` is `moth_flame.flown` for one point, with
looked-up spirals and Cauchy numbers.
"""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel

from ..daisy.cost import CostTables, Reference, Side, label_cost
from ..kernels.arrays import Floats
from .common import SearchState, advance, first_state, insert, scrambled, uniform, widen
from .moth_flame import FlightTable

CANDIDATES, FOUNDING, OPPOSITES, FLIGHT = 0, 1, 2, 3
"""Stages of a phase; all but the first and the last belong to phase 0."""


@kernel
def moth_flame_phase(
    start: int, stop: int, reference: Reference, target: Side, tables: CostTables, state: SearchState,
    candidates: Floats, end: int, phase: int, seed: Scalar, table: FlightTable, spiral: Floats, cauchy: Floats,
    steps: Floats,
) -> None:  # fmt: skip
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        reference: `cost.Reference`.
        target: `cost.Side`.
        tables: `cost.CostTables`.
        state: `common.SearchState`, changed in place.
        candidates: float32 ``[N, C, 4]``, labels to try first (neighbours', the guess, ...); not finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase; 0 founds the population.
        seed: Of the frame.
        table: `moth_flame.FlightTable`.
        spiral: `moth_flame.spiral_table`.
        cauchy: `moth_flame.cauchy_table`.
        steps: float32 ``[4]``, scale of the Cauchy steps.
    """
    population, iterations = state.costs.shape[1], len(table.counts)
    founding = population * (2 if table.opposition else 1)
    moths, flames = np.empty((population, 4), dtype=np.float32), np.empty((population, 4), dtype=np.float32)
    costs = np.empty(population, dtype=np.int64)
    lower, upper = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    low, high = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    trials = np.empty((max(population, candidates.shape[1]), 4), dtype=np.float32)
    label = np.empty(4, dtype=np.float32)
    for i in range(start, stop):
        copy_population(state.lower[i], state.upper[i], state.moths[i], state.flames[i], lower, upper, moths, flames)
        for m in range(population):
            costs[m] = state.costs[i, m]
        random = first_state(seed, i, phase)
        used, placed = state.used[i], 0
        stage = CANDIDATES
        while True:  # one place where costs are computed: what differs is which labels are tried
            count = 0
            if stage == CANDIDATES:
                count = finite_labels(candidates[i], trials)
                if phase == 0:
                    placed = min(count, population, end - used)
                    for m in range(placed):
                        for j in range(4):
                            moths[m, j] = trials[m, j]
            elif stage == FOUNDING:
                random = scatter(moths, placed, lower, upper, trials, random)
                count = population - placed
            elif stage == OPPOSITES:
                random = oppose(moths, lower, upper, low, high, trials, random)
                count = population
            else:
                if used >= end:
                    break
                iteration = min(max((used - founding) // population, 0), iterations - 1)
                random = fly(moths, flames, lower, upper, iteration, table, spiral, cauchy, steps, random)
                count = population
                for m in range(population):
                    for j in range(4):
                        trials[m, j] = moths[m, j]
            for k in range(min(count, end - used)):
                for j in range(4):
                    label[j] = trials[k, j]
                cost = label_cost(
                    i, label[0], label[1], label[2], label[3], reference, target, tables, costs[population - 1]
                )
                insert(flames, costs, label, cost)
                used += 1
            if stage == CANDIDATES:
                widen(lower, upper, flames)
                stage = FOUNDING if phase == 0 else FLIGHT
            elif stage == FOUNDING:
                stage = OPPOSITES if table.opposition else FLIGHT
            elif stage == OPPOSITES:
                for m in range(population):  # the best N of X and its opposites
                    if costs[m] < tables.ceiling:
                        for j in range(4):
                            moths[m, j] = flames[m, j]
                stage = FLIGHT
        state.used[i] = used
        copy_population(lower, upper, moths, flames, state.lower[i], state.upper[i], state.moths[i], state.flames[i])
        for m in range(population):
            state.costs[i, m] = costs[m]


@inlined
def copy_population(
    from_lower: Floats, from_upper: Floats, from_moths: Floats, from_flames: Floats, lower: Floats, upper: Floats,
    moths: Floats, flames: Floats,
) -> None:  # fmt: skip
    """Copy a point's box, moths and flames."""
    for j in range(4):
        lower[j], upper[j] = from_lower[j], from_upper[j]
        for m in range(len(moths)):
            moths[m, j], flames[m, j] = from_moths[m, j], from_flames[m, j]


@inlined
def finite_labels(candidates: Floats, trials: Floats) -> int:
    """Fill `trials` with the candidates that are finite; returns how many."""
    count = 0
    for c in range(len(candidates)):
        total = np.float32(0)
        for j in range(4):
            trials[count, j] = candidates[c, j]
            total += candidates[c, j]
        count += np.isfinite(total)
    return count


@inlined
def scatter(moths: Floats, placed: int, lower: Floats, upper: Floats, trials: Floats, random: Scalar) -> Scalar:
    """Place the moths from `placed` on anywhere in the box, and try them; returns the next random state."""
    for m in range(placed, len(moths)):
        random = advance(random)
        bits = scrambled(random)
        for j in range(4):  # LB + (UB - LB) rand
            moths[m, j] = lower[j] + (upper[j] - lower[j]) * uniform(bits, j)
            trials[m - placed, j] = moths[m, j]
    return random


@inlined
def oppose(
    moths: Floats, lower: Floats, upper: Floats, low: Floats, high: Floats, trials: Floats, random: Scalar
) -> Scalar:
    """Fill `trials` with the moths' opposites (`moth_flame.opposites`); returns the next random state."""
    population = len(moths)
    for j in range(4):  # dynamic bounds dy, dz (Eq. 20)
        low[j], high[j] = moths[0, j], moths[0, j]
        for m in range(1, population):
            low[j], high[j] = min(low[j], moths[m, j]), max(high[j], moths[m, j])
    for m in range(population):
        random = advance(random)
        factor = uniform(scrambled(random), 0)
        random = advance(random)
        bits = scrambled(random)
        for j in range(4):
            opposite = factor * (low[j] + high[j]) - moths[m, j]  # Eq. 19
            if opposite < lower[j] or opposite > upper[j]:  # Eq. 21-22
                opposite = lower[j] + (upper[j] - lower[j]) * uniform(bits, j)
            trials[m, j] = opposite
    return random


@inlined
def fly(
    moths: Floats, flames: Floats, lower: Floats, upper: Floats, iteration: int, table: FlightTable, spiral: Floats,
    cauchy: Floats, steps: Floats, random: Scalar,
) -> Scalar:  # fmt: skip
    """Move every moth once (Eq. 8-18); returns the next random state."""
    population = len(moths)
    span, own, best = table.span[iteration], table.own[iteration], table.best[iteration]
    stepping, pulling = table.stepping[iteration], best > 0
    fewest = table.counts[iteration] - 1
    for m in range(population):
        flame = min(m, fewest)  # Eq. 8
        random = advance(random)
        bits, jumps = scrambled(random), np.uint64(0)
        if stepping:
            random = advance(random)
            jumps = scrambled(random)
        for j in range(4):
            t = span * uniform(bits, j) + np.float32(1)  # Eq. 10
            turn = spiral[min(max(np.int64((t + np.float32(2)) * np.float32(1024)), np.int64(0)), np.int64(4095))]
            distance = abs(flames[m, j] - moths[m, j])
            goal = flames[flame, j]
            if pulling:  # Eq. 17
                goal = own * goal + best * flames[0, j]
            position = distance * turn + goal
            if stepping:  # Eq. 13
                position += cauchy[np.int64((jumps >> np.uint64(16 * j)) & np.uint64(4095))] * steps[j]
            moths[m, j] = min(max(position, lower[j]), upper[j])
    return random
