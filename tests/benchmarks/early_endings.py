"""Ending trials of two objectives early: what each rule costs, what it keeps of the front, what it tells the sampler.

    python tests/benchmarks/early_endings.py [STUDIES]

Simulated: trials with a true log ATE ratio and a true log time ratio, seen on each instance through chaos (0.3 and 0.03,
as measured). Every rule sees the same trials on the same instances, in the same order. A value is told falsely if it is
told as complete and is not the mean over all instances.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in

from dynslam_bench.tuning.pruning import FIRST_STEP, is_dropped, steps

BLOCKS, TRIALS, CHAOS = 12, 40, (0.3, 0.03)
Values = NDArray[np.float64]
Rule = Callable[[Values, list[Values], int, int, int], bool]
"""Whether to drop: values so far, those of rivals at this step, entered, this step, the next."""


@dataclass
class Result:
    """Of one rule over many studies.

    Attributes:
        runs: Share of the full grid.
        lost: Share of the trials on the true front that were dropped.
        regret: Hypervolume that the trials told as complete miss of the true front's, as a share.
        false: Values told falsely, a study.
    """

    runs: float
    lost: float
    regret: float
    false: float


def race_rule(mine: Values, rivals: list[Values], entered: int, step: int, following: int) -> bool:
    """The project's: dropped for those that are better in every objective."""
    return is_dropped(list(mine), [list(other) for other in rivals], entered, step / following)


def any_objective(mine: Values, rivals: list[Values], entered: int, step: int, following: int) -> bool:
    """An objective by itself: dropped for being outside the best share in any of them."""
    ranks = (np.array(rivals) < mine).sum(axis=0)
    return bool((ranks >= max(1, int(entered * step / following))).any())


def every_objective(mine: Values, rivals: list[Values], entered: int, step: int, following: int) -> bool:
    """The lenient form: outside the best share in every one of them."""
    ranks = (np.array(rivals) < mine).sum(axis=0)
    return bool((ranks >= max(1, int(entered * step / following))).all())


def pareto_rank(mine: Values, rivals: list[Values], entered: int, step: int, following: int) -> bool:
    """Fronts are peeled off; dropped if those before one's own hold the share that may stay."""
    left, ahead = [*rivals], 0
    while left and any((other <= mine).all() and (other < mine).any() for other in left):
        front = [a for a in left if not any((b <= a).all() and (b < a).any() for b in left)]
        ahead += len(front)
        left = [a for a in left if not any(a is b for b in front)]
    return ahead >= max(1, int(entered * step / following))


RULES: dict[str, Rule | None] = {
    "none": None,
    "race (the project's)": race_rule,
    "Pareto rank": pareto_rank,
    "per objective, any": any_objective,
    "per objective, every": every_objective,
}


def draw(rng: np.random.Generator) -> tuple[Values, Values]:
    """True values ``[TRIALS, 2]``, and what is seen of them on each instance ``[TRIALS, BLOCKS, 2]``."""
    truth = rng.multivariate_normal([0.2, 0.0], [[0.16, -0.05], [-0.05, 0.09]], TRIALS)
    return truth, truth[:, None] + rng.normal(0, CHAOS, (TRIALS, BLOCKS, 2))


def race(seen: Values, rule: Rule | None) -> tuple[list[int], int]:
    """Trials that come to their end, and runs that it took."""
    passed = steps("halving" if rule else "none", BLOCKS)
    course: dict[int, list[Values]] = {step: [] for step in passed}
    done, runs = [], 0
    for number in range(TRIALS):
        for step, following in zip(passed, [*passed[1:], 0], strict=True):
            mine = seen[number, :step].mean(axis=0)
            course[step].append(mine)
            if rule and following and rule(mine, course[step], len(course[FIRST_STEP]), step, following):
                break
        else:
            done.append(number)
        runs += step
    return done, runs


def as_it_was(seen: Values) -> tuple[list[int], dict[int, Values], int]:
    """The rule before: dominated by the optimistic bound; what is left out was told as the worst seen so far."""
    told: dict[int, Values] = {}
    whole, runs = [], 0
    for number in range(TRIALS):
        for count in range(1, BLOCKS + 1):
            sofar = seen[number, :count]
            if count == BLOCKS:
                told[number] = sofar.mean(axis=0)
                whole.append(number)
                break
            best = min([sofar[:, 0].min(), *(each[0] for each in told.values())])
            bound = np.array([(sofar[:, 0].sum() + (BLOCKS - count) * best) / BLOCKS, sofar[:, 1].mean()])
            if count >= 2 and any((each <= bound).all() for each in told.values()):
                filled = (sofar[:, 0].sum() + (BLOCKS - count) * sofar[:, 0].max()) / BLOCKS
                told[number] = np.array([filled, sofar[:, 1].mean()])
                break
        runs += count
    return whole, told, runs


def front(values: Values) -> list[int]:
    """Indices of the trials that none dominates."""
    return [
        i
        for i, mine in enumerate(values)
        if not any((other <= mine).all() and (other < mine).any() for other in values)
    ]


def hypervolume(values: Values, reference: tuple[float, float] = (2.0, 1.5)) -> float:
    """Area that the values dominate below a reference point."""
    area, ceiling = 0.0, reference[1]
    for x, y in sorted(map(tuple, values)):
        if y < ceiling and x < reference[0]:
            area += (reference[0] - x) * (ceiling - y)
            ceiling = y
    return area


def compare(studies: int, seed: int = 0) -> dict[str, Result]:
    """Every rule on the same simulated studies."""
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    for number in range(studies):
        truth, seen = draw(np.random.default_rng([seed, number]))
        best = front(truth)
        outcomes = {name: (*race(seen, rule), 0) for name, rule in RULES.items()}
        whole, told, runs = as_it_was(seen)
        false = sum(not np.allclose(value, seen[key].mean(axis=0)) for key, value in told.items())
        outcomes["as it was"] = (whole, runs, false)
        for name, (done, used, wrong) in outcomes.items():
            lost = sum(trial not in done for trial in best) / len(best)
            regret = 1 - hypervolume(truth[done]) / hypervolume(truth)
            found.setdefault(name, []).append((used / (TRIALS * BLOCKS), lost, regret, wrong))
    return {name: Result(*np.mean(rows, axis=0)) for name, rows in found.items()}


if __name__ == "__main__":
    print(f"| {TRIALS} trials, {BLOCKS} instances | runs | front lost | hypervolume lost | told falsely |")
    print("| --- | --- | --- | --- | --- |")
    for name, result in compare(int(sys.argv[1]) if sys.argv[1:] else 30).items():
        share = " | ".join(f"{100 * value:.1f} %" for value in (result.runs, result.lost, result.regret))
        print(f"| {name} | {share} | {result.false:.1f} |")
