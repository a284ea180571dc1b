"""Pruning: all trials meet the same growing sets of instances, and Optuna's pruners end the worse ones early.

With one objective the rules are Optuna's: asynchronous successive halving (Li et al. 2020) or Wilcoxon's signed-rank
test against the best trial. Optuna prunes no trials of several objectives; there a trial ends once other trials
dominate it at the same step.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.tuning.study_file import PrunerName

FIRST_STEP = 3
"""Instances that every trial runs on before it is compared."""
DOMINATED_SHARE = 0.1
"""With several objectives a trial ends once this share of the trials, at least two, beats it in all of them."""
WILCOXON_LEVEL = 0.1


def build_pruner(name: PrunerName) -> optuna.pruners.BasePruner:
    """Optuna's pruner of that name."""
    if name == "halving":
        return optuna.pruners.SuccessiveHalvingPruner(min_resource=FIRST_STEP, reduction_factor=2)
    if name == "wilcoxon":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return optuna.pruners.WilcoxonPruner(p_threshold=WILCOXON_LEVEL, n_startup_steps=FIRST_STEP)
    return optuna.pruners.NopPruner()


def steps(name: PrunerName, count: int) -> list[int]:
    """After how many of `count` instances a trial may be pruned; the last one is the whole set.

    ``halving`` doubles the set (the rungs of successive halving), ``wilcoxon`` tests after every instance.
    """
    if name == "none" or count <= FIRST_STEP:
        return [count]
    if name == "wilcoxon":
        return list(range(FIRST_STEP, count + 1))
    rungs = [FIRST_STEP]
    while rungs[-1] * 2 < count:
        rungs.append(rungs[-1] * 2)
    return [*rungs, count]


def is_dominated(trials: Sequence[FrozenTrial], number: int, step: int) -> bool:
    """Whether enough of the trials that came as far beat a trial in every objective at the same step."""
    name = step_name(step)
    reported = {trial.number: trial.user_attrs[name] for trial in trials if name in trial.user_attrs}
    rivals, own = np.array(list(reported.values())), reported[number]
    better = ((rivals <= own).all(axis=1) & (rivals != own).any(axis=1)).sum()
    return bool(better >= max(2, DOMINATED_SHARE * len(rivals)))


def step_name(step: int) -> str:
    """User attribute that holds a trial's values after so many instances; Optuna has none for several objectives."""
    return f"values_after_{step}_instances"
