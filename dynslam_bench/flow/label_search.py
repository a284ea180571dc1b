"""The label search: which searches there are, how a budget is divided into phases, and the kernels that run a phase.

Positions are labels; a moth's fitness is the matching cost of its label (Eq. 5-7). The moth-flame equations (Eq. 4-22,
corrected Algorithm 1) are those of `moth_flame`: values that depend on the iteration alone come from there as a table,
and `move_moths` is `moth_flame.moth_positions` for one point, with spirals and Cauchy numbers from tables.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.flow import moth_flame
from dynslam_bench.flow.matching_cost import CostTables, Reference, label_cost
from dynslam_bench.flow.moth_flame import FlightTable
from dynslam_bench.flow.orientation_maps import Side
from dynslam_bench.flow.settings import DaisySettings, SearchName
from dynslam_bench.flow.simd import Floats, Longs

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)


class Strategy(NamedTuple):
    """How a search chooses the labels that it evaluates.

    Attributes:
        rules: The moth-flame equations in force; None for random searches.
        shrink: Factor of the random window an evaluation: 0.5 PatchMatch, 1 uniform random search of the whole box, 0
            draws nothing: only start labels and those of the neighbours are tried.
        propagates: Whether neighbours exchange their labels between phases.
    """

    rules: moth_flame.MothFlameRules | None
    shrink: float
    propagates: bool


STRATEGIES: dict[SearchName, Strategy] = {
    "emfoa+propagation": Strategy(moth_flame.EMFOA, 0.5, True),
    "emfoa-literal+propagation": Strategy(moth_flame.EMFOA_LITERAL, 0.5, True),
    "mfo+propagation": Strategy(moth_flame.MFO, 0.5, True),
    "patchmatch": Strategy(None, 0.5, True),
    "random+propagation": Strategy(None, 1.0, True),
    "none+propagation": Strategy(None, 0.0, True),
    "emfoa": Strategy(moth_flame.EMFOA, 0.5, False),
    "mfo": Strategy(moth_flame.MFO, 0.5, False),
    "emfoa-literal": Strategy(moth_flame.EMFOA_LITERAL, 0.5, False),
    "random": Strategy(None, 1.0, False),
}


def make_plan(settings: DaisySettings) -> tuple[int, tuple[int, ...], tuple[Any, ...]]:
    """Divide `FlowSettings.budget`; small budgets get fewer sweeps and smaller populations.

    Returns:
        The number of labels kept a point; the evaluations a point at which each phase ends (between phases labels are
        exchanged); the last arguments of `run_phase`.
    """
    budget = settings.budget
    rules, shrink, propagates = STRATEGIES[settings.search]
    sweeps = min(settings.sweeps, max(1, budget // 16)) if propagates else 0
    # initialising the population takes a double share
    ends = tuple(budget * (k + 2) // (sweeps + 2) for k in range(sweeps + 1))
    population = max(2, min(settings.population, budget // 8)) if rules else 1
    founding = population * (2 if rules and rules.opposition else 1)
    iterations = max(1, -(-(budget - founding) // population))
    table = moth_flame.flight_table(population, iterations, rules or moth_flame.MFO)
    # of Eq. 13, per dimension of a label: px, px, octaves, radians
    steps = np.array([*[settings.cauchy_step_px] * 2, 0.1, np.deg2rad(5.0)], dtype=np.float32)
    tables = table, moth_flame.spiral_table(), moth_flame.cauchy_table(), steps
    return population, ends, (*tables, rules is not None, np.float32(shrink))


class SearchState(NamedTuple):
    """The state of a search at all points.

    Attributes:
        moths: float32 ``[N, P, 4]``, positions of each point's population.
        flames: float32 ``[N, P, 4]``, the best labels ever evaluated, best first.
        costs: int64 ``[N, P]``, their costs (Eq. 5, 7).
        used: int64 ``[N]``, cost evaluations spent.
        lower: float32 ``[N, 4]``, bounds of the search.
        upper: float32 ``[N, 4]``.
    """

    moths: NDArray[np.float32]
    flames: NDArray[np.float32]
    costs: NDArray[np.int64]
    used: NDArray[np.int64]
    lower: NDArray[np.float32]
    upper: NDArray[np.float32]


@inlined
def scrambled(state: Scalar) -> Scalar:
    """64 random bits of a state (splitmix64)."""
    z = (state ^ (state >> np.uint64(30))) * _MIX1
    z = (z ^ (z >> np.uint64(27))) * _MIX2
    return z ^ (z >> np.uint64(31))


@inlined
def advance(state: Scalar) -> Scalar:
    """The next state of a point's random numbers."""
    return state + _GOLDEN


@inlined
def uniform(bits: Scalar, quarter: int) -> Scalar:
    """One of the four float32 in [0, 1) that `scrambled` bits make, in steps of 2**-16."""
    return np.float32(np.int32((bits >> np.uint64(16 * quarter)) & np.uint64(65535))) * np.float32(1.0 / 65536)


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
    """Extend a point's bounds to 8 px around its best displacement, which may come from a neighbour."""
    for j in range(2):
        lower[j] = min(lower[j], flames[0, j] - np.float32(8))
        upper[j] = max(upper[j], flames[0, j] + np.float32(8))


CANDIDATES, INITIAL, OPPOSITES, SEARCH = 0, 1, 2, 3
"""Stages of a phase; the second and the third belong to phase 0 of a moth-flame search."""


@kernel
def run_phase(
    start: int, stop: int, reference: Reference, target: Side, tables: CostTables, state: SearchState,
    candidates: Floats, end: int, phase: int, seed: Scalar, table: FlightTable, spiral: Floats, cauchy: Floats,
    steps: Floats, moth_flame: bool, shrink: Scalar,
) -> None:  # fmt: skip
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        reference: `matching_cost.Reference`.
        target: `orientation_maps.Side`.
        tables: `matching_cost.CostTables`.
        state: `SearchState`, changed in place; a search that is no moth-flame search has a population of one.
        candidates: float32 ``[N, C, 4]``, labels to try first (neighbours', the guess, ...); not finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase; 0 initialises the population.
        seed: Of the frame.
        table: `moth_flame.FlightTable`.
        spiral: `moth_flame.spiral_table`.
        cauchy: `moth_flame.cauchy_table`.
        steps: float32 ``[4]``, scale of the Cauchy steps.
        moth_flame: Whether moths fly; else labels are drawn from a window that shrinks.
        shrink: Factor of that window an evaluation, see `Strategy.shrink`; with 0 the rest of the budget is left.
    """
    population, iterations = state.costs.shape[1], len(table.counts)
    initial = population * (2 if table.opposition else 1)
    low, high = np.empty(4, dtype=np.float32), np.empty(4, dtype=np.float32)
    trials = np.empty((max(population, candidates.shape[1]), 4), dtype=np.float32)
    for i in range(start, stop):
        lower, upper, moths = state.lower[i], state.upper[i], state.moths[i]
        flames, costs = state.flames[i], state.costs[i]
        random = scrambled(np.uint64(seed) + _GOLDEN * (np.uint64(i) * np.uint64(64) + np.uint64(phase) + np.uint64(1)))
        used, placed, stage, window = state.used[i], 0, CANDIDATES, np.float32(0.5)
        while True:  # costs are computed in one place; the stages differ in the labels that are tried
            count = population
            if stage == CANDIDATES:
                count = finite_labels(candidates[i], trials)
                if phase == 0 and moth_flame:
                    placed = min(count, population, end - used)
                    moths[:placed] = trials[:placed]
            elif stage == INITIAL:
                random = place_moths(moths, placed, lower, upper, trials, random)
                count = population - placed
            elif stage == OPPOSITES:
                random = oppose(moths, lower, upper, low, high, trials, random)
            elif used >= end:
                break
            elif moth_flame:
                iteration = min(max((used - initial) // population, 0), iterations - 1)
                random = move_moths(moths, flames, lower, upper, iteration, table, spiral, cauchy, steps, random)
                trials[:population] = moths
            elif shrink == 0:
                break
            else:
                random = advance(random)
                draw(trials[0], scrambled(random), lower, upper, flames, window, shrink)
                window *= shrink
                if window * (upper[0] - lower[0]) < np.float32(1):
                    window = np.float32(0.5)
            for k in range(min(count, end - used)):
                label = trials[k]
                cost = label_cost(
                    i, label[0], label[1], label[2], label[3], reference, target, tables, costs[population - 1]
                )
                insert(flames, costs, label, cost)
                used += 1
            if stage == CANDIDATES:
                widen(lower, upper, flames)
                stage = INITIAL if phase == 0 and moth_flame else SEARCH
            elif stage == INITIAL:
                stage = OPPOSITES if table.opposition else SEARCH
            elif stage == OPPOSITES:
                for m in range(population):  # the best N of X and its opposites
                    if costs[m] < tables.ceiling:
                        moths[m] = flames[m]
                stage = SEARCH
        state.used[i] = used


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
def place_moths(moths: Floats, placed: int, lower: Floats, upper: Floats, trials: Floats, random: Scalar) -> Scalar:
    """Draw the moths from `placed` on within the bounds, and try them; returns the next random state."""
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
def move_moths(
    moths: Floats, flames: Floats, lower: Floats, upper: Floats, iteration: int, table: FlightTable, spiral: Floats,
    cauchy: Floats, steps: Floats, random: Scalar,
) -> Scalar:  # fmt: skip
    """Move every moth once (Eq. 8, 10, 12, 13, 17), as `moth_flame.moth_positions`; returns the next random state."""
    population = len(moths)
    now = table.coefficients[iteration]
    span, own, best, stepping, pulling = now[0], now[1], now[2], now[3] > 0, now[2] > 0
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


@inlined
def draw(
    label: Floats, bits: Scalar, lower: Floats, upper: Floats, flames: Floats, window: Scalar, shrink: Scalar
) -> None:
    """Fill a label: anywhere in the box (`shrink` 1), or in a window of it around the best label."""
    for j in range(4):
        extent = upper[j] - lower[j]
        if shrink == 1:
            label[j] = lower[j] + extent * uniform(bits, j)
        else:
            step = (np.float32(2) * uniform(bits, j) - np.float32(1)) * window * extent
            label[j] = min(max(flames[0, j] + step, lower[j]), upper[j])
