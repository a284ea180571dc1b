"""What users want of a configuration: each objective is a cost of a run, compared with the default's in each scene.

All objectives are natural logarithms of ratios to the default settings: less is better, 0 is the default's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from dynslam_bench.core.errors import StudyError, did_you_mean

from .blocks import Block
from .evaluate import Outcome
from .statistics import by_scene, by_start, centre

Outcomes = Mapping[Block, Outcome]
Cost = Callable[[Outcome], float]
WORST_SHARE = 0.25
"""Share of the scenes, the worst ones, that the worst case is the mean of; always one at least."""
_MANY = 1e9
_LOST_FLOOR = 0.01
"""So many lost frames are added on both sides, as a share, so that a default without any can be compared with."""


@dataclass(frozen=True)
class Objective:
    """Something to be made small.

    Attributes:
        name: As a study names it.
        what: What the ratio is one of, for tables and sentences.
        cost: Positive number of a run, less is better.
        worst: Count the worst scenes alone, not all.
        degraded: Count blocks with a degradation alone, not all.
    """

    name: str
    what: str
    cost: Cost
    worst: bool = False
    degraded: bool = False

    def by_start(self, outcomes: Outcomes, default: Outcomes) -> list[float]:
        """Natural logarithm of the ratio on each block that counts and that both ran."""
        own = {block: self.cost(outcome) for block, outcome in outcomes.items() if self.counts(block)}
        return by_start(own, {block: self.cost(outcome) for block, outcome in default.items()})

    def ratios(self, outcomes: Outcomes, default: Outcomes) -> dict[str, float]:
        """Natural logarithm of the ratio to the default by scene; empty without any block that counts."""
        own = {block: self.cost(outcome) for block, outcome in outcomes.items() if self.counts(block)}
        other = {block: self.cost(outcome) for block, outcome in default.items() if self.counts(block)}
        return by_scene(own, other)

    def value(self, outcomes: Outcomes, default: Outcomes) -> float:
        """Natural logarithm of the ratio to the default over the scenes; below 0 is better.

        Raises:
            StudyError: None of the blocks counts.
        """
        counted = self.counted(self.ratios(outcomes, default).values())
        if not counted:
            raise StudyError(
                f"objective '{self.name}' counts degraded blocks alone, but none of the study's is",
                'name some, e.g. "synthetic/walking_xyz?scene=0-3&frames=80&degrade=blur:0.5"',
            )
        return centre(counted)

    def counted(self, ratios: Iterable[float]) -> list[float]:
        """Those scenes' ratios that the value is the centre of."""
        ranked = sorted(ratios, reverse=True)
        return ranked[: max(1, round(WORST_SHARE * len(ranked)))] if self.worst else ranked

    def counts(self, block: Block) -> bool:
        """Whether a block counts."""
        return not self.degraded or any(strength > 0 for _, strength in block.degradation)


OBJECTIVES = {
    each.name: each
    for each in (
        Objective("accuracy", "ATE", lambda run: run.ate_m),
        Objective("speed", "processor time", lambda run: run.processor_s),
        Objective("worst", "ATE in the worst quarter of the scenes", lambda run: run.ate_m, worst=True),
        Objective("robustness", "ATE on degraded blocks", lambda run: run.ate_m, degraded=True),
        Objective("coverage", "share of lost frames", lambda run: 1 - run.coverage + _LOST_FLOOR),
    )
}
"""Objectives by name."""
ACCURACY, SPEED = OBJECTIVES["accuracy"], OBJECTIVES["speed"]


def together(objectives: Sequence[Objective]) -> Objective:
    """Several objectives as one: the geometric mean of their ratios; one stays what it is."""
    if len(objectives) == 1:
        return objectives[0]
    return Objective(
        "balance",
        f"geometric mean of {' and '.join(each.what for each in objectives)}",
        lambda run: math.exp(sum(math.log(each.cost(run)) for each in objectives) / len(objectives)),
    )


def find_objective(name: str) -> Objective:
    """An objective by its name.

    Raises:
        StudyError: There is none of that name.
    """
    if name not in OBJECTIVES:
        raise StudyError(f"unknown objective '{name}'", did_you_mean(name, list(OBJECTIVES)))
    return OBJECTIVES[name]


def own_objective(cost: Cost) -> Objective:
    """An objective of one's own, from what a run costs.

    Args:
        cost: Positive number of a run, less is better, e.g. ``lambda run: run.ate_m * run.processor_s``.
    """
    name = getattr(cost, "__name__", "own").strip("<>")

    def checked(run: Outcome) -> float:
        value = float(cost(run))
        if not (math.isfinite(value) and value > 0):
            raise StudyError(f"objective '{name}' gives {value:g} on block '{run.block}'", "give numbers above 0")
        return _MANY * value  # ratios do not mind, and the floor of errors in metres is none of this cost

    return Objective(name, name.replace("_", " "), checked)
