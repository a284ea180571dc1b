"""How a budget is divided into phases, and which kernel spends it: the one interface of all searches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow import moth_flame
from dynslam_bench.flow.matching_cost import MatchingCosts
from dynslam_bench.flow.search_kernels import SearchState, moth_flame_phase, shrinking_window_phase
from dynslam_bench.flow.settings import FlowSettings, SearchName


class Strategy(NamedTuple):
    """What a search spends its evaluations on.

    Attributes:
        rules: The moth-flame equations in force; None for random searches.
        shrink: Factor of the random window an evaluation: 0.5 PatchMatch, 1 uniform random search of the whole box, 0
            draws nothing, so that the labels known beforehand and those of the neighbours are all there is.
        propagates: Whether neighbours exchange their labels between phases.
    """

    rules: moth_flame.MothFlameRules | None
    shrink: float
    propagates: bool


STRATEGIES: dict[SearchName, Strategy] = {
    "emfoa+propagation": Strategy(moth_flame.EMFOA, 0.5, True),
    "emfoa-literal+propagation": Strategy(moth_flame.EMFOA_LITERAL, 0.5, True),
    "patchmatch": Strategy(None, 0.5, True),
    "random+propagation": Strategy(None, 1.0, True),
    "none+propagation": Strategy(None, 0.0, True),
    "emfoa": Strategy(moth_flame.EMFOA, 0.5, False),
    "mfo": Strategy(moth_flame.MFO, 0.5, False),
    "emfoa-literal": Strategy(moth_flame.EMFOA_LITERAL, 0.5, False),
    "random": Strategy(None, 1.0, False),
}
PROPAGATING: frozenset[SearchName] = frozenset(name for name, each in STRATEGIES.items() if each.propagates)

Phase = Callable[[int, NDArray[np.float32]], None]
Stripes = Callable[..., Any]
"""Called as ``stripes(kernel, count, *arguments)``; see `kernels.workers.run_stripes`."""


@dataclass(frozen=True)
class Plan:
    """A budget's division.

    Attributes:
        population: Labels kept a point.
        ends: Evaluations a point at which each phase ends; between phases labels are exchanged.
        rules: The moth-flame equations in force; None for random searches.
        iterations: Of the moth-flame algorithm (T).
        shrink: Factor of the random window (`Strategy.shrink`).
    """

    population: int
    ends: tuple[int, ...]
    rules: moth_flame.MothFlameRules | None
    iterations: int
    shrink: float


def make_plan(settings: FlowSettings) -> Plan:
    """Divide `FlowSettings.budget`; small budgets get fewer sweeps and smaller populations."""
    budget = settings.budget
    rules, shrink, propagates = STRATEGIES[settings.search]
    sweeps = min(settings.sweeps, max(1, budget // 16)) if propagates else 0
    population = max(2, min(settings.population, budget // 8)) if rules else 1
    # founding the population takes a double share
    ends = tuple(budget * (k + 2) // (sweeps + 2) for k in range(sweeps + 1))
    founding = population * (2 if rules and rules.opposition else 1)
    iterations = max(1, -(-(budget - founding) // population))
    return Plan(population, ends, rules, iterations, shrink)


def cauchy_steps(settings: FlowSettings) -> NDArray[np.float32]:
    """Scale of the Cauchy steps of Eq. 13 per dimension of a label: px, px, octaves, radians."""
    step = settings.cauchy_step_px
    return np.array([step, step, 0.1, np.deg2rad(5.0)], dtype=np.float32)


def phase_runner(
    plan: Plan, settings: FlowSettings, costs: MatchingCosts, state: SearchState, seed: int, stripes: Stripes
) -> Phase:
    """The function that runs one phase: ``run(number, candidates)``, on all points; `stripes` divides them."""
    count = len(costs.reference.points)
    if plan.rules is None:

        def random_phase(number: int, candidates: NDArray[np.float32]) -> None:
            limits = (plan.ends[number], number, np.uint64(seed), np.float32(plan.shrink))
            stripes(shrinking_window_phase, count, *costs, state, candidates, *limits)

        return random_phase
    table = moth_flame.flight_table(plan.population, plan.iterations, plan.rules)
    looked_up = (table, moth_flame.spiral_table(), moth_flame.cauchy_table(), cauchy_steps(settings))

    def flying_phase(number: int, candidates: NDArray[np.float32]) -> None:
        limits = (plan.ends[number], number, np.uint64(seed))
        stripes(moth_flame_phase, count, *costs, state, candidates, *limits, *looked_up)

    return flying_phase
