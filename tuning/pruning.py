"""Who stays in the race: trials meet the same growing sets of instances, and the worse ones are dropped on the way.

Trials need not run at the same time: one is compared with all that have come as far, as in asynchronous successive
halving (Li et al. 2020). A trial that was lucky early is compared again at every later step, and nothing is dropped for
the luck of another instance: everyone's values at a step come from the same instances.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState
from scipy import stats

from dynslam_bench.core.seeding import stream
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.study_file import PrunerName

FIRST_STEP = 3
"""Instances that every trial runs on before it is compared."""
AHEAD = 0.1
"""With several objectives a trial is dropped once this share of the trials beats it in all of them, two at least."""
WILCOXON_LEVEL = 0.1
"""A trial is dropped if it is worse than the best one at this level of significance."""
_COURSE = "values_after_{}_blocks"


def running_order(instances: Sequence[ProblemInstance], seed: int) -> list[ProblemInstance]:
    """The instances as all trials meet them: one of each scene in turn, so that small sets hold different scenes."""
    groups = list(scenes(instances).values())
    stream(seed, "order").shuffle(groups)
    longest = max(len(group) for group in groups)
    return [group[turn] for turn in range(longest) for group in groups if turn < len(group)]


def steps(rule: PrunerName, instances: int) -> list[int]:
    """After how many instances a trial is compared with the others; the last one is the whole set.

    ``halving`` doubles the set, ``rejection`` and ``wilcoxon`` compare after every instance, ``none`` never.
    """
    if rule == "none" or instances <= FIRST_STEP:
        return [instances]
    if rule != "halving":
        return list(range(FIRST_STEP, instances + 1))
    found = [FIRST_STEP]
    while found[-1] * 2 < instances:
        found.append(found[-1] * 2)
    return [*found, instances]


def is_dropped(mine: Sequence[float], rivals: Iterable[Sequence[float]], entered: int, share: float) -> bool:
    """Whether too many rivals are better in every objective at the same step.

    Args:
        mine: Values of the trial, all to be minimised.
        rivals: Those of the others that came as far.
        entered: Trials that were compared at the first step, this one among them.
        share: The share of those that may go on: first step over next step, so that every step costs the same.

    Returns:
        Always False for a trial that no other beats.
    """
    better = sum(_dominates(other, mine) for other in rivals)
    if len(mine) > 1:  # few beat a trial in everything: waiting for as many as with one objective would drop nobody
        return better >= max(2, AHEAD * entered)
    return better >= max(1, int(entered * share))


def is_worse(mine: Mapping[ProblemInstance, float], best: Mapping[ProblemInstance, float]) -> bool:
    """Wilcoxon's signed-rank test on the instances that both ran: whether the first has the larger errors."""
    differences = np.array([mine[instance] - best[instance] for instance in mine if instance in best])
    if len(differences) < FIRST_STEP or not differences.any():
        return False
    return bool(stats.wilcoxon(differences, alternative="greater").pvalue < WILCOXON_LEVEL)


def leaves(trials: Sequence[FrozenTrial], number: int, passed: Sequence[int], position: int) -> bool:
    """Whether a trial drops out after a step, by halving or rejection.

    Args:
        trials: All of the study.
        number: The trial's, whose values at the step are noted.
        passed: The study's steps, from `steps`.
        position: Which of them it has come to; not the last.
    """
    values = {trial.number: noted(trial, passed[position]) for trial in trials}
    rivals = [found for trial in trials if (found := values[trial.number]) is not None and is_feasible(trial)]
    entered = sum(noted(trial, passed[0]) is not None for trial in trials)
    mine = values[number]
    assert mine is not None, "noted before"
    return is_dropped(mine, rivals, entered, passed[0] / passed[position + 1])


def note(trial: optuna.Trial, step: int, values: Sequence[float]) -> None:
    """Keep a trial's values after so many instances, where the others and the dashboard find them."""
    if len(values) == 1:
        trial.report(values[0], step)
    else:  # Optuna takes no intermediate values of several objectives
        trial.set_user_attr(_COURSE.format(step), list(values))


def noted(trial: FrozenTrial, step: int) -> list[float] | None:
    """A trial's values after so many instances; None if it did not come as far, or failed."""
    if trial.state == TrialState.FAIL:
        return None
    if step in trial.intermediate_values:
        return [trial.intermediate_values[step]]
    found = trial.user_attrs.get(_COURSE.format(step))
    return None if found is None else list(found)


def _dominates(one: Sequence[float], other: Sequence[float]) -> bool:
    return list(one) != list(other) and all(a <= b for a, b in zip(one, other, strict=True))
