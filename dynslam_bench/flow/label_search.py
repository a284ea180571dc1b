"""The label search: searches and their phases, the kernels that run a phase, and propagation between neighbours.

Positions are labels; a moth's fitness is the matching cost of its label (Eq. 5-7). The moth-flame
equations (Eq. 4-22, corrected Algorithm 1) are those of `moth_flame`: values that depend on the
iteration alone come from there as a table, and `move_moths` is `moth_flame.moth_positions` for one
point, with spirals and Cauchy numbers from tables. Between the phases neighbouring points exchange
their best labels, and points try the motions with which most of them agree.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.core.simd import Flags, Floats, Longs
from dynslam_bench.flow import moth_flame
from dynslam_bench.flow.matching_cost import Label, MatchingCost, label_cost
from dynslam_bench.flow.moth_flame import FlightTable
from dynslam_bench.flow.settings import DaisySettings, SearchName

Run = Callable[..., Any]
"""`Workers.run`, which divides a kernel's points among threads."""
HYPOTHESES = 192
"""Pairs of points tried for a common motion (RANSAC)."""
INLIER_PX = np.float32(5.0)
"""Distance in pixels at which a point agrees with a motion."""
VOTERS = 256
"""Approximate number of points that vote on a hypothesis."""
LEAST_INLIERS = 6
"""Points that must agree with a common motion."""
SHORTEST_PAIR_PX2 = 400
"""Squared distance in pixels of two points, below which their motion is not tried."""
LEAST_SCALE2 = 0.15
"""Smallest square of a common motion's scale."""
MOST_SCALE2 = 6.5
"""Largest square of a common motion's scale."""
NO_MOTION = np.empty((0, 4), dtype=np.float32)
"""No common motions."""
NEIGHBOUR_WINDOW = 40
"""Points compared on each side, in the order of x, to find the nearest neighbours."""
MOST_NEIGHBOURS = 8
"""Neighbours that are found of each point; settings use as many or fewer."""
BOUND_MARGIN_PX = np.float32(8)
"""The bounds of a point leave at least this much around its best displacement."""
# constants of splitmix64: the state's step, and the factors of its two mixing rounds
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)


class Strategy(NamedTuple):
    """A strategy of label search: how it chooses the labels that it evaluates.

    Attributes:
        rules: The moth-flame equations in force; None for random searches.
        shrink: Factor of the random window an evaluation: 0.5 PatchMatch, 1 uniform random search
            of the whole box, 0 draws nothing: only start labels and those of the neighbours are
            tried.
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
"""Label searches by the value of the setting ``search``."""


class SearchRules(NamedTuple):
    """A `Strategy` with its tables, as `run_phase` reads it.

    Attributes:
        flights: Number of flames and coefficients of each iteration.
        spiral: `moth_flame.spiral_table`.
        cauchy: `moth_flame.cauchy_table`.
        steps: float32 ``[4]``, scale of the Cauchy steps of Eq. 13 by dimension of a label.
        moth_flame: Whether moths fly; else labels are drawn from a window that shrinks.
        shrink: Factor of that window an evaluation, see `Strategy.shrink`; with 0 the rest of the
            budget is left.
    """

    flights: FlightTable
    spiral: NDArray[np.float32]
    cauchy: NDArray[np.float32]
    steps: NDArray[np.float32]
    moth_flame: bool
    shrink: np.float32


class SearchPlan(NamedTuple):
    """The plan of a search: how its budget of evaluations is spent.

    Attributes:
        population: Labels kept a point.
        ends: Evaluations a point at which each phase ends; labels are exchanged between phases.
        rules: How labels are chosen within a phase.
    """

    population: int
    ends: tuple[int, ...]
    rules: SearchRules


def make_plan(settings: DaisySettings) -> SearchPlan:
    """Divide `FlowSettings.budget`; small budgets get fewer sweeps and smaller populations."""
    budget = settings.budget
    strategy = STRATEGIES[settings.search]
    equations = strategy.rules
    # initialising the population takes a double share
    sweeps = min(settings.sweeps, max(1, budget // 16)) if strategy.propagates else 0
    ends = tuple(budget * (k + 2) // (sweeps + 2) for k in range(sweeps + 1))
    # with opposition the first population is evaluated twice: itself and its opposites
    population = max(2, min(settings.population, budget // 8)) if equations else 1
    initial = population * (2 if equations and equations.opposition else 1)
    iterations = max(1, -(-(budget - initial) // population))
    # of Eq. 13, per dimension of a label: px, px, octaves, radians
    steps = [settings.cauchy_step_px, settings.cauchy_step_px, 0.1, np.deg2rad(5.0)]
    rules = SearchRules(
        flights=moth_flame.flight_table(population, iterations, equations or moth_flame.MFO),
        spiral=moth_flame.spiral_table(),
        cauchy=moth_flame.cauchy_table(),
        steps=np.array(steps, dtype=np.float32),
        moth_flame=equations is not None,
        shrink=np.float32(strategy.shrink),
    )
    return SearchPlan(population, ends, rules)


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


def search_labels(
    settings: DaisySettings,
    run: Run,
    matching: MatchingCost,
    neighbours: NDArray[np.int64],
    guess: NDArray[np.float32] | None,
    seed: int,
) -> SearchState:
    """The label search of all points: phases of `DaisySettings.search` with propagation between them.

    Args:
        settings: Which search, its budget and its range.
        run: Divides the points among threads.
        matching: Points, target and tables of the matching cost.
        neighbours: int64 ``[N, K]`` of `nearest`.
        guess: float32 ``[N, 2]``, predicted positions; not finite means none.
        seed: Seed of the frame's random draws.

    Returns:
        The final state; ``flames[:, 0]`` and ``costs[:, 0]`` are the best labels and their costs.
    """
    # the plan, and labels to begin with: the prediction, or zero flow
    points = matching.reference.points
    n = len(points)
    plan = make_plan(settings)
    start = start_labels(points, guess)
    state = initial_state(settings, start, plan.population, matching.tables.ceiling)
    candidates = start
    # nothing is drawn: zero flow is tried beside the prediction
    if STRATEGIES[settings.search].shrink == 0:
        zero = np.where(start.any(axis=2, keepdims=True), np.float32(0), np.float32(np.nan))
        candidates = np.concatenate([start, np.broadcast_to(zero, start.shape)], axis=1)
    neighbours = np.ascontiguousarray(neighbours[:, : settings.neighbours])
    motions = np.full((2, 4), np.nan, dtype=np.float32)
    for phase, end in enumerate(plan.ends):
        # propagation: the neighbours' best labels and the common motions are tried first
        if phase > 0:
            best = state.flames[:, 0].copy()
            if settings.similarity_seeds:
                motions = common_motions(points, best, state.costs[:, 0], seed + phase)
            candidates = np.empty((n, neighbours.shape[1] + 2, 4), dtype=np.float32)
            sources = (points, best, scaled_rotations(best), neighbours, motions)
            run(propagated_labels, 0, n, *sources, state.lower, state.upper, candidates)
        # then every point spends its evaluations of the phase
        run(run_phase, 0, n, matching, state, candidates, end, phase, np.uint64(seed), plan.rules)
    return state


def start_labels(
    points: NDArray[np.float32], guess: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """Labels ``[N, 1, 4]`` of zero flow, or of the motion model's prediction where it is finite."""
    # u, v, scale in octaves, rotation in radians
    start = np.zeros((len(points), 1, 4), dtype=np.float32)
    if guess is not None:
        offset = guess - points
        start[:, 0, :2] = np.where(np.isfinite(offset).all(axis=1, keepdims=True), offset, 0)
    return start


def initial_state(
    settings: DaisySettings, start: NDArray[np.float32], population: int, ceiling: int
) -> SearchState:
    """The state before anything was evaluated, with bounds around the start labels ``[N, 1, 4]``.

    Args:
        settings: Range of the search along each dimension of a label.
        start: Labels in the middle of the bounds: u, v (pixels), log2 of the scale, rotation
            (radians).
        population: Labels kept a point.
        ceiling: Largest possible cost, which no label has been better than yet.
    """
    n = len(start)
    rotation = np.deg2rad(settings.rotation_range_deg)
    extent = np.array(
        [settings.range_px, settings.range_px, settings.scale_range_octaves, rotation], np.float32
    )
    flames = np.repeat(start, population, axis=1)
    return SearchState(
        moths=np.zeros_like(flames),
        flames=flames,
        costs=np.full((n, population), ceiling, np.int64),
        used=np.zeros(n, np.int64),
        lower=start[:, 0] - extent,
        upper=start[:, 0] + extent,
    )


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
    number = np.int32((bits >> np.uint64(16 * quarter)) & np.uint64(65535))
    return np.float32(number) * np.float32(1.0 / 65536)


@inlined
def insert(flames: Floats, costs: Longs, trials: Floats, trial: int, cost: Scalar) -> None:
    """Merge an evaluated label into a point's sorted flames if it is better than the worst (``F = best N``).

    Args:
        flames: float32 ``[P, 4]``, changed in place.
        costs: int64 ``[P]``, their costs, changed in place.
        trials: float32 ``[T, 4]``, evaluated labels.
        trial: Which of them.
        cost: Its cost.
    """
    # worse than the worst flame
    k = len(costs) - 1
    if cost >= costs[k]:
        return
    # move worse flames down, and put it in its place
    while k > 0 and costs[k - 1] > cost:
        costs[k] = costs[k - 1]
        for j in range(4):
            flames[k, j] = flames[k - 1, j]
        k -= 1
    costs[k] = cost
    for j in range(4):
        flames[k, j] = trials[trial, j]


@inlined
def widen(lower: Floats, upper: Floats, flames: Floats) -> None:
    """Extend a point's bounds to 8 px around its best displacement, which may come from a neighbour."""
    for j in range(2):
        lower[j] = min(lower[j], flames[0, j] - BOUND_MARGIN_PX)
        upper[j] = max(upper[j], flames[0, j] + BOUND_MARGIN_PX)


# Stages of a phase, in this order; the second and the third belong to phase 0 of a moth-flame search.
CANDIDATES = 0
"""Labels of neighbours, of common motions, or of the guess."""
INITIAL = 1
"""The first population."""
OPPOSITES = 2
"""Opposites of the first population."""
SEARCH = 3
"""Moths that fly, or labels that are drawn, until the evaluations are spent."""


@kernel
def run_phase(
    start: int,
    stop: int,
    matching: MatchingCost,
    state: SearchState,
    candidates: Floats,
    end: int,
    phase: int,
    seed: Scalar,
    rules: SearchRules,
) -> None:
    """Spend evaluations on points start..stop until each has used `end`.

    Args:
        start: First point.
        stop: One past the last.
        matching: `matching_cost.MatchingCost`.
        state: `SearchState`, changed in place; a search that is no moth-flame search has a
            population of one.
        candidates: float32 ``[N, C, 4]``, labels to try first (neighbours', the guess, ...); not
            finite means none.
        end: Evaluations a point, counted from the very start, at which the phase ends.
        phase: Number of the phase; 0 initialises the population.
        seed: Seed of the frame's random draws.
        rules: `SearchRules`.
    """
    # numbers that hold for all points, and scratch arrays
    population = state.costs.shape[1]
    opposition = rules.flights.opposition
    iterations = len(rules.flights.counts)
    initial = population * (2 if opposition else 1)
    ceiling = matching.tables.ceiling
    low = np.empty(4, dtype=np.float32)
    high = np.empty(4, dtype=np.float32)
    trials = np.empty((max(population, candidates.shape[1]), 4), dtype=np.float32)
    for i in range(start, stop):
        # the point's bounds, and its moths and flames so far
        lower = state.lower[i]
        upper = state.upper[i]
        moths = state.moths[i]
        flames = state.flames[i]
        costs = state.costs[i]
        # random numbers of the point and the phase, whatever the order of the points
        stream = np.uint64(i) * np.uint64(64) + np.uint64(phase) + np.uint64(1)
        random = scrambled(np.uint64(seed) + _GOLDEN * stream)
        used = state.used[i]
        n_placed = 0
        stage = CANDIDATES
        window = np.float32(0.5)
        # costs are computed in one place; the stages differ in the labels that are tried
        while True:
            # choose `count` labels to try: each stage writes them into `trials`
            count = population
            if stage == CANDIDATES:
                count = finite_labels(candidates[i], trials)
                if phase == 0 and rules.moth_flame:
                    n_placed = min(count, population, end - used)
                    copy_labels(trials, moths, n_placed)
            elif stage == INITIAL:
                random = place_moths(moths, n_placed, lower, upper, trials, random)
                count = population - n_placed
            elif stage == OPPOSITES:
                random = opposite_labels(moths, lower, upper, low, high, trials, random)
            elif used >= end:
                break
            elif rules.moth_flame:
                iteration = min(max((used - initial) // population, 0), iterations - 1)
                random = move_moths(moths, flames, lower, upper, iteration, rules, trials, random)
            elif rules.shrink == 0:
                break
            else:
                random = advance(random)
                draw_label(
                    trials[0], scrambled(random), lower, upper, flames[0], window, rules.shrink
                )
                window *= rules.shrink
                # below a pixel the window begins again
                if window * (upper[0] - lower[0]) < np.float32(1):
                    window = np.float32(0.5)

            # evaluate Eq. 1 for the labels, and keep each that is better than a flame
            for k in range(min(count, end - used)):
                label = (trials[k, 0], trials[k, 1], trials[k, 2], trials[k, 3])
                cost = label_cost(i, label, matching, costs[population - 1])
                insert(flames, costs, trials, k, cost)
                used += 1

            # candidates are followed by the first population, its opposites, then the search itself
            if stage == CANDIDATES:
                widen(lower, upper, flames)
                stage = INITIAL if phase == 0 and rules.moth_flame else SEARCH
            elif stage == INITIAL:
                stage = OPPOSITES if opposition else SEARCH
            elif stage == OPPOSITES:
                # the moths become the best N of the population and its opposites; flames that lie
                # outside of the image have the cost `ceiling`, and leave their moth where it is
                for m in range(population):
                    if costs[m] < ceiling:
                        for j in range(4):
                            moths[m, j] = flames[m, j]
                stage = SEARCH
        state.used[i] = used


@inlined
def copy_labels(source: Floats, target: Floats, count: int) -> None:
    """Copy the first `count` labels."""
    for m in range(count):
        for j in range(4):
            target[m, j] = source[m, j]


@inlined
def finite_labels(candidates: Floats, trials: Floats) -> int:
    """Fill `trials` with the candidates that are finite; returns how many."""
    count = 0
    for c in range(len(candidates)):
        for j in range(4):
            trials[count, j] = candidates[c, j]
        # one that is not finite is written over
        total = candidates[c, 0] + candidates[c, 1] + candidates[c, 2] + candidates[c, 3]
        count += np.isfinite(total)
    return count


@inlined
def place_moths(
    moths: Floats, placed: int, lower: Floats, upper: Floats, trials: Floats, random: Scalar
) -> Scalar:
    """Draw the moths from `placed` on within the bounds, and try them; returns the next random state.

    Args:
        moths: float32 ``[P, 4]``, the population; filled from `placed` on.
        placed: Moths that have a place already.
        lower: float32 ``[4]``, least values of a label.
        upper: float32 ``[4]``, largest values of a label.
        trials: float32 ``[P, 4]``, filled with the moths that are placed now.
        random: State of the point's random numbers.
    """
    for m in range(placed, len(moths)):
        random = advance(random)
        bits = scrambled(random)
        # a draw within the bounds, LB + (UB - LB) rand
        for j in range(4):
            moths[m, j] = lower[j] + (upper[j] - lower[j]) * uniform(bits, j)
            trials[m - placed, j] = moths[m, j]
    return random


@inlined
def opposite_labels(
    moths: Floats,
    lower: Floats,
    upper: Floats,
    low: Floats,
    high: Floats,
    trials: Floats,
    random: Scalar,
) -> Scalar:
    """Fill `trials` with the moths' opposites (`moth_flame.opposites`); returns the next random state.

    `low` and `high`, float32 ``[4]``, are scratch.
    """
    population = len(moths)
    # dynamic bounds dy, dz (Eq. 20)
    for j in range(4):
        low[j] = moths[0, j]
        high[j] = moths[0, j]
        for m in range(1, population):
            low[j] = min(low[j], moths[m, j])
            high[j] = max(high[j], moths[m, j])
    for m in range(population):
        # one number for the factor, four for the draw, whether they are needed or not
        random = advance(random)
        factor = uniform(scrambled(random), 0)
        random = advance(random)
        bits = scrambled(random)
        for j in range(4):
            # the opposite in the population's bounds (Eq. 19)
            opposite = factor * (low[j] + high[j]) - moths[m, j]
            # outside the label's bounds: a draw within them (Eq. 21-22)
            if opposite < lower[j] or opposite > upper[j]:
                opposite = lower[j] + (upper[j] - lower[j]) * uniform(bits, j)
            trials[m, j] = opposite
    return random


@inlined
def move_moths(
    moths: Floats,
    flames: Floats,
    lower: Floats,
    upper: Floats,
    iteration: int,
    rules: SearchRules,
    trials: Floats,
    random: Scalar,
) -> Scalar:
    """Move every moth once (Eq. 8, 10, 12, 13, 17), as `moth_flame.moth_positions`, and try where it is.

    Args:
        moths: float32 ``[P, 4]``, changed in place.
        flames: float32 ``[P, 4]``, best first.
        lower: float32 ``[4]``, bounds that moths are moved into.
        upper: float32 ``[4]``.
        iteration: Row of ``rules.flights``.
        rules: `SearchRules`.
        trials: float32 ``[P, 4]``, filled with the moths.
        random: State of the draws.

    Returns:
        The next random state.
    """
    # the fields of `moth_flame.Flight`
    flight = rules.flights.coefficients[iteration]
    span = flight[0]
    own = flight[1]
    best = flight[2]
    pulling = flight[2] > 0
    stepping = flight[3] > 0
    last_flame = rules.flights.counts[iteration] - 1
    for m in range(len(moths)):
        # moths beyond the number of flames fly around the last one (Eq. 8)
        flame = min(m, last_flame)
        random = advance(random)
        bits = scrambled(random)
        cauchy_bits = np.uint64(0)
        if stepping:
            random = advance(random)
            cauchy_bits = scrambled(random)
        for j in range(4):
            # where on the spiral (Eq. 10)
            t = span * uniform(bits, j) + np.float32(1)
            distance = abs(flames[m, j] - moths[m, j])
            goal = flames[flame, j]
            # the goal: the flame, pulled towards the best one (Eq. 17)
            if pulling:
                goal = own * goal + best * flames[0, j]
            # a spiral around it (Eq. 8, 12)
            position = distance * spiral_factor(t, rules.spiral) + goal
            # a Cauchy step, looked up for 12 random bits (Eq. 13)
            if stepping:
                draw = np.int64((cauchy_bits >> np.uint64(16 * j)) & np.uint64(4095))
                position += rules.cauchy[draw] * rules.steps[j]
            position = min(max(position, lower[j]), upper[j])
            moths[m, j] = position
            trials[m, j] = position
    return random


@inlined
def spiral_factor(t: Scalar, spiral: Floats) -> Scalar:
    """``e^t cos(2 pi t)`` from `moth_flame.spiral_table`: t from -2 on, 1024 steps a unit."""
    step = np.int64((t + np.float32(2)) * np.float32(1024))
    return spiral[min(max(step, np.int64(0)), np.int64(4095))]


@inlined
def draw_label(
    label: Floats,
    bits: Scalar,
    lower: Floats,
    upper: Floats,
    best: Floats,
    window: Scalar,
    shrink: Scalar,
) -> None:
    """Fill a label: anywhere in the bounds (`shrink` 1), or in a window around the best label.

    Args:
        label: float32 ``[4]``, filled.
        bits: 64 random bits.
        lower: float32 ``[4]``, least values.
        upper: float32 ``[4]``, largest values.
        best: float32 ``[4]``, the best label so far.
        window: Half side of the window around it, as a share of the bounds' extent.
        shrink: Factor by which the window shrinks a draw; 1 for draws anywhere.
    """
    for j in range(4):
        extent = upper[j] - lower[j]
        if shrink == 1:
            label[j] = lower[j] + extent * uniform(bits, j)
        else:
            step = (np.float32(2) * uniform(bits, j) - np.float32(1)) * window * extent
            label[j] = min(max(best[j] + step, lower[j]), upper[j])


@kernel
def parabola(
    start: int, stop: int, labels: Floats, step: float, matching: MatchingCost, used: Longs
) -> None:
    """Move each label to the vertex of the parabolas through its cost and those `step` pixels beside it.

    Args:
        start: First point.
        stop: One past the last.
        labels: float32 ``[N, 4]``, changed in place; moves by at most `step`.
        step: Pixels.
        matching: `matching_cost.MatchingCost`.
        used: int64 ``[N]``, cost evaluations, counted on.
    """
    unbounded = np.int64(1 << 40)
    for i in range(start, stop):
        # costs at the label, and one step to each side along x and along y
        u = labels[i, 0]
        v = labels[i, 1]
        s = labels[i, 2]
        theta = labels[i, 3]
        middle = label_cost(i, (u, v, s, theta), matching, unbounded)
        left = label_cost(i, (u - step, v, s, theta), matching, unbounded)
        right = label_cost(i, (u + step, v, s, theta), matching, unbounded)
        up = label_cost(i, (u, v - step, s, theta), matching, unbounded)
        down = label_cost(i, (u, v + step, s, theta), matching, unbounded)
        used[i] += 5

        # each axis has a parabola of its own
        labels[i, 0] = u + step * vertex(left, middle, right)
        labels[i, 1] = v + step * vertex(up, middle, down)


@inlined
def vertex(before: Scalar, middle: Scalar, after: Scalar) -> Scalar:
    """Position of the minimum of a parabola through values at -1, 0, 1, within these; 0 if it is not convex."""
    # second difference: of a parabola the curvature
    curvature = before + after - 2 * middle
    if curvature <= 0:
        return np.float32(0)
    position = np.float32(before - after) / np.float32(2 * curvature)
    return min(max(position, np.float32(-1)), np.float32(1))


# Propagation between neighbouring points.


@kernel
def propagated_labels(
    start: int,
    stop: int,
    points: Floats,
    labels: Floats,
    rotations: Floats,
    neighbours: Longs,
    motions: Floats,
    lower: Floats,
    upper: Floats,
    out: Floats,
) -> None:
    """Labels of neighbours and of common motions, as seen from each point.

    A neighbour's label is a similarity around the neighbour; at point p it means the displacement
    that this similarity gives p. Scale and rotation are clipped to the point's bounds; the
    displacement is not: a label of a neighbour is a tested match, and the bounds limit only where
    the search draws.

    Args:
        start: First point.
        stop: One past the last.
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, 4]``, best labels of the previous phase.
        rotations: float32 ``[N, 2]`` of `scaled_rotations`.
        neighbours: int64 ``[N, K]``, indices; negative means none.
        motions: float32 ``[M, 4]``, similarities ``(a, b, tx, ty)``:
            ``p' = [[a, -b], [b, a]] p + t``; NaN means none.
        lower: float32 ``[N, 4]``.
        upper: float32 ``[N, 4]``.
        out: float32 ``[N, K + M, 4]``, NaN where there is none.
    """
    count = neighbours.shape[1]
    # log2 of the scale, and rotation of each common motion
    octaves = np.empty(len(motions), dtype=np.float32)
    angles = np.empty(len(motions), dtype=np.float32)
    for m in range(len(motions)):
        a = motions[m, 0]
        b = motions[m, 1]
        octaves[m] = np.float32(0.5) * np.float32(np.log2(max(a * a + b * b, np.float32(1e-12))))
        angles[m] = np.float32(np.arctan2(b, a))
    for i in range(start, stop):
        x = points[i, 0]
        y = points[i, 1]
        for k in range(count):
            j = neighbours[i, k]
            if j < 0:
                out[i, k, 0] = np.nan
                continue
            # the neighbour's similarity, applied to this point
            c = rotations[j, 0]
            n = rotations[j, 1]
            dx = x - points[j, 0]
            dy = y - points[j, 1]
            u = points[j, 0] + labels[j, 0] + c * dx - n * dy - x
            v = points[j, 1] + labels[j, 1] + n * dx + c * dy - y
            store_candidate(out[i, k], (u, v, labels[j, 2], labels[j, 3]), lower[i], upper[i])
        # the common motions, applied to this point
        for m in range(len(motions)):
            a = motions[m, 0]
            b = motions[m, 1]
            u = a * x - b * y + motions[m, 2] - x
            v = b * x + a * y + motions[m, 3] - y
            store_candidate(out[i, count + m], (u, v, octaves[m], angles[m]), lower[i], upper[i])


@inlined
def store_candidate(out: Floats, label: Label, lower: Floats, upper: Floats) -> None:
    """Write a label ``[4]`` whose scale and rotation are clipped to the bounds ``[4]``."""
    u, v, s, theta = label
    out[0] = u
    out[1] = v
    out[2] = min(max(s, lower[2]), upper[2])
    out[3] = min(max(theta, lower[3]), upper[3])


@kernel
def scaled_rotations(labels: Floats) -> Floats:
    """``2**s (cos theta, sin theta)`` of labels ``[N, 4]``, float32 ``[N, 2]``: a, b of ``[[a, -b], [b, a]]``."""
    rotations = np.empty((len(labels), 2), dtype=np.float32)
    for i in range(len(labels)):
        scale = np.float32(np.exp2(labels[i, 2]))
        rotations[i, 0] = np.float32(np.cos(labels[i, 3])) * scale
        rotations[i, 1] = np.float32(np.sin(labels[i, 3])) * scale
    return rotations


def labels_as_seen(
    points: Floats, labels: Floats, neighbours: Longs, motions: Floats = NO_MOTION
) -> Floats:
    """`propagated_labels` without bounds that matter, float32 ``[N, K + M, 4]``."""
    count = len(points)
    # octaves and radians that no label reaches
    extent = np.full((count, 4), 8.0, dtype=np.float32)
    out = np.empty((count, neighbours.shape[1] + len(motions), 4), dtype=np.float32)
    propagated_labels(
        0,
        count,
        points,
        labels,
        scaled_rotations(labels),
        neighbours,
        motions,
        -extent,
        extent,
        out,
    )
    return out


def common_motions(points: Floats, labels: Floats, costs: Longs, seed: int) -> Floats:
    """Up to two similarity motions with which most points agree (RANSAC over pairs of well-matched points).

    Args:
        points: float32 ``[N, 2]``.
        labels: float32 ``[N, 4]``.
        costs: int64 ``[N]``; pairs are drawn from the better half.
        seed: Seed of the frame's random draws.

    Returns:
        float32 ``[2, 4]``, ``(a, b, tx, ty)``; NaN where fewer than 6 points agree.
    """
    motions = np.full((2, 4), np.nan, dtype=np.float32)
    if len(points) < 4:
        return motions
    # the better half by cost; of equal costs the first
    half = max(len(costs) // 2, 4)
    keys = costs * len(costs) + np.arange(len(costs))
    # partitioned in numpy: in a kernel it would add a tenth to the compile time of all kernels
    good = np.sort(np.argpartition(keys, half - 1)[:half])
    # where the good points lie and where their labels take them; coordinates are rows, so that the
    # compiler makes vector code
    tracks = np.concatenate([points[good], points[good] + labels[good, :2]], axis=1).T.copy()
    random = np.uint64(seed) ^ np.uint64(0x5DEECE66D)
    for motion in motions:
        count = tracks.shape[1]
        if count < LEAST_INLIERS:
            break
        every = -(-count // VOTERS)
        voters = tracks[:, ::every].copy()
        random = np.uint64(ransac_similarity(tracks, voters, HYPOTHESES, INLIER_PX, random, motion))
        # the second motion is fitted to the points that do not follow the first
        x, y, to_x, to_y = tracks
        a, b, tx, ty = motion
        missed = (a * x - b * y + tx - to_x) ** 2 + (b * x + a * y + ty - to_y) ** 2
        tracks = np.compress(missed >= 4 * INLIER_PX**2, tracks, axis=1)
    return motions


@kernel
def ransac_similarity(
    tracks: Floats,
    voters: Floats,
    hypotheses: int,
    tolerance: Scalar,
    random: Scalar,
    motion: Floats,
) -> Scalar:
    """Choose the similarity, of those through two tracks, with which most voters agree.

    Args:
        tracks: float32 ``[4, N]``, x and y of points, and where they go.
        voters: float32 ``[4, M]``, the tracks that vote.
        hypotheses: Number of pairs tried.
        tolerance: Distance in pixels at which a voter agrees.
        random: State of the draws.
        motion: float32 ``[4]``, filled with ``(a, b, tx, ty)`` if at least `LEAST_INLIERS` voters
            agree.

    Returns:
        The next state of the draws.
    """
    # where the tracks begin and end
    x = tracks[0]
    y = tracks[1]
    to_x = tracks[2]
    to_y = tracks[3]
    count = np.uint64(len(x))
    limit = np.float32(tolerance * tolerance)
    most = LEAST_INLIERS - 1
    for _ in range(hypotheses):
        # draw a pair
        random = advance(random)
        bits = scrambled(random)
        i = np.int64(((bits & np.uint64(0xFFFFFFFF)) * count) >> np.uint64(32))
        j = np.int64(((bits >> np.uint64(32)) * count) >> np.uint64(32))
        dx = x[j] - x[i]
        dy = y[j] - y[i]
        length = dx * dx + dy * dy
        if length < SHORTEST_PAIR_PX2:
            continue
        # the similarity that takes both where their labels do: rotation and scale, then translation
        ex = to_x[j] - to_x[i]
        ey = to_y[j] - to_y[i]
        a = (ex * dx + ey * dy) / length
        b = (ey * dx - ex * dy) / length
        scale2 = a * a + b * b
        if scale2 < LEAST_SCALE2 or scale2 > MOST_SCALE2:
            continue
        tx = to_x[i] - a * x[i] + b * y[i]
        ty = to_y[i] - b * x[i] - a * y[i]
        # the motion with the most voters is kept
        inliers = count_inliers(voters, a, b, tx, ty, limit)
        if inliers > most:
            most = inliers
            motion[0] = a
            motion[1] = b
            motion[2] = tx
            motion[3] = ty
    return random


@inlined
def count_inliers(
    voters: Floats, a: Scalar, b: Scalar, tx: Scalar, ty: Scalar, limit: Scalar
) -> int:
    """Count the voters that a motion takes to where their labels do, by squared distance.

    Args:
        voters: float32 ``[4, M]``: x and y of points, and where their labels take them.
        a: Scale times cosine of the rotation.
        b: Scale times sine of the rotation.
        tx: Translation along x, pixels.
        ty: Translation along y, pixels.
        limit: Squared distance, pixels, below which a voter agrees.
    """
    # where voters are, and where they go
    from_x = voters[0]
    from_y = voters[1]
    goal_x = voters[2]
    goal_y = voters[3]
    inliers = np.int32(0)
    for k in range(voters.shape[1]):
        # what the motion misses the goal by
        rx = a * from_x[k] - b * from_y[k] + tx - goal_x[k]
        ry = b * from_x[k] + a * from_y[k] + ty - goal_y[k]
        inliers = np.int32(inliers + np.int32(rx * rx + ry * ry < limit))
    return int(inliers)


def nearest(points: Floats, run: Run) -> Longs:
    """Indices of each point's nearest others, nearest first; approximate, see `nearest_neighbours`.

    Args:
        points: ``[N, 2]``, pixels.
        run: Divides the points among threads.

    Returns:
        int64 ``[N, K]``, K = `MOST_NEIGHBOURS` or N - 1; -1 where there are fewer.
    """
    # sorted by x, so that near points follow each other
    n = len(points)
    neighbours = np.empty((n, max(0, min(MOST_NEIGHBOURS, n - 1))), dtype=np.int64)
    if n > 1:
        order = np.argsort(points[:, 0], kind="stable")
        run(nearest_neighbours, 0, n, points[order], order, NEIGHBOUR_WINDOW, neighbours)
    return neighbours


@kernel
def nearest_neighbours(
    start: int, stop: int, ordered: Floats, order: Longs, width: int, out: Longs
) -> None:
    """The nearest other points of each point, among those that follow each other in x: approximate, deterministic.

    Args:
        start: First position in the order.
        stop: One past the last.
        ordered: float32 ``[N, 2]``, the points sorted by x.
        order: int64 ``[N]``, their indices.
        width: Number of points compared on each side in that order.
        out: int64 ``[N, K]``, nearest first; -1 where there are fewer. Rows are points, not
            positions in the order.
    """
    n, count = out.shape
    best = np.empty(count, dtype=np.float32)
    distances = np.empty(2 * width + 1, dtype=np.float32)
    for place in range(start, stop):
        # squared distances of the points near it in x
        x = ordered[place, 0]
        y = ordered[place, 1]
        first = max(0, place - width)
        last = min(n, place + width + 1)
        for k in range(last - first):
            dx = ordered[first + k, 0] - x
            dy = ordered[first + k, 1] - y
            distances[k] = dx * dx + dy * dy
        distances[place - first] = np.inf
        # the nearest ones, by insertion into a sorted list
        index = out[order[place]]
        best[:] = np.inf
        index[:] = -1
        worst = np.float32(np.inf)
        for k in range(last - first):
            distance = distances[k]
            if distance < worst:
                slot = count - 1
                while slot > 0 and best[slot - 1] > distance:
                    best[slot] = best[slot - 1]
                    index[slot] = index[slot - 1]
                    slot -= 1
                index[slot] = order[first + k]
                best[slot] = distance
                worst = best[count - 1]


def dissenting_labels(
    predictions: Floats, labels: Floats, tolerance: Scalar
) -> tuple[Floats, Flags]:
    """Find points whose neighbours agree with each other but not with the point, e.g. one period off on a texture.

    Args:
        predictions: float32 ``[N, K, 4]``, the neighbours' labels as seen from each point; NaN
            means none.
        labels: float32 ``[N, 4]``, the points' own labels.
        tolerance: Displacements this close agree, pixels.

    Returns:
        float32 ``[N, 4]``, the prediction on which most neighbours agree, and bool ``[N]``, whether
        it has more support than the point's own label.
    """
    limit = tolerance * tolerance
    # displacements by prediction and point, [K, N] each
    u, v = np.ascontiguousarray(predictions[:, :, :2].T)
    # how many predictions agree with each: [K, N]
    du = u[:, None] - u
    dv = v[:, None] - v
    support = np.count_nonzero(du * du + dv * dv < limit, axis=1)
    # and how many with the point's own label: [N]
    du = u - labels[:, 0]
    dv = v - labels[:, 1]
    away = du * du + dv * dv
    own = np.count_nonzero(away < limit, axis=0)
    # the prediction of most support, where it has more than one supporter and is another one
    neighbour = support.argmax(axis=0)
    point = np.arange(len(labels))
    most = support[neighbour, point]
    dissents = (most > 1) & (most > own) & (away[neighbour, point] >= limit)
    return predictions[point, neighbour], dissents
