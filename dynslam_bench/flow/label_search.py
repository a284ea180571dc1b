"""Label searches: which there are, how their budget is divided into phases, and which kernel runs a phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow import moth_flame
from dynslam_bench.flow.matching_cost import MatchingCosts
from dynslam_bench.flow.search_kernels import SearchState, moth_flame_phase, shrinking_window_phase
from dynslam_bench.flow.settings import DaisySettings, SearchName
from dynslam_bench.flow.workers import Workers


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
    "patchmatch": Strategy(None, 0.5, True),
    "random+propagation": Strategy(None, 1.0, True),
    "none+propagation": Strategy(None, 0.0, True),
    "emfoa": Strategy(moth_flame.EMFOA, 0.5, False),
    "mfo": Strategy(moth_flame.MFO, 0.5, False),
    "emfoa-literal": Strategy(moth_flame.EMFOA_LITERAL, 0.5, False),
    "random": Strategy(None, 1.0, False),
}
PROPAGATING: frozenset[SearchName] = frozenset(name for name, strategy in STRATEGIES.items() if strategy.propagates)

Phase = Callable[[int, NDArray[np.float32]], None]


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


def make_plan(settings: DaisySettings) -> Plan:
    """Divide `FlowSettings.budget`; small budgets get fewer sweeps and smaller populations."""
    budget = settings.budget
    rules, shrink, propagates = STRATEGIES[settings.search]
    sweeps = min(settings.sweeps, max(1, budget // 16)) if propagates else 0
    population = max(2, min(settings.population, budget // 8)) if rules else 1
    # initialising the population takes a double share
    ends = tuple(budget * (k + 2) // (sweeps + 2) for k in range(sweeps + 1))
    founding = population * (2 if rules and rules.opposition else 1)
    iterations = max(1, -(-(budget - founding) // population))
    return Plan(population, ends, rules, iterations, shrink)


def cauchy_steps(settings: DaisySettings) -> NDArray[np.float32]:
    """Scale of the Cauchy steps of Eq. 13 per dimension of a label: px, px, octaves, radians."""
    step = settings.cauchy_step_px
    return np.array([step, step, 0.1, np.deg2rad(5.0)], dtype=np.float32)


def phase_runner(
    plan: Plan, settings: DaisySettings, costs: MatchingCosts, state: SearchState, seed: int, workers: Workers
) -> Phase:
    """The function that runs one phase on all points: ``run(number, candidates)``."""
    kernel: Callable[..., Any] = shrinking_window_phase
    options: tuple[Any, ...] = (np.float32(plan.shrink),)
    if plan.rules is not None:
        table = moth_flame.flight_table(plan.population, plan.iterations, plan.rules)
        kernel = moth_flame_phase
        options = (table, moth_flame.spiral_table(), moth_flame.cauchy_table(), cauchy_steps(settings))

    def run(number: int, candidates: NDArray[np.float32]) -> None:
        limits = (plan.ends[number], number, np.uint64(seed))
        workers.run(kernel, len(costs.reference.points), *costs, state, candidates, *limits, *options)

    return run
