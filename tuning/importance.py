"""Which parameters of a study matter: only from enough trials on, and never one that changed nothing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.seeding import stream

FEWEST_TRIALS = 30
"""Below so many finished trials importances are luck."""
_SAME = 1e-9
_SHUFFLES = 60
_ABSENT = "absent"


def inert_parameters(trials: Sequence[FrozenTrial], names: Iterable[str]) -> list[str]:
    """Parameters of which the trials show that they do nothing.

    A parameter is inert if it took part in no trial (its condition never held) or with one value only, or if trials
    that differ in it alone, or in other inert ones too, all had equal values. What the trials cannot tell is not inert.

    Args:
        trials: Finished ones.
        names: The parameters of the study.
    """
    names = list(names)
    constant = [name for name in names if len({trial.params.get(name, _ABSENT) for trial in trials}) < 2]
    unused = [name for name in names if all(name not in trial.params for trial in trials)]
    found = set(constant) | set(unused)
    for name in names:
        if name not in found and _never_changed(trials, name, found):
            found.add(name)
    return [name for name in names if name in found]


def _never_changed(trials: Sequence[FrozenTrial], name: str, inert: set[str]) -> bool:
    """Whether there are trials that differ in this parameter alone, and none of them had another value."""
    groups: dict[object, list[FrozenTrial]] = {}
    for trial in trials:
        rest = {key: value for key, value in trial.params.items() if key != name and key not in inert}
        groups.setdefault(tuple(sorted(rest.items(), key=lambda item: item[0])), []).append(trial)
    several = [group for group in groups.values() if len({trial.params.get(name) for trial in group}) > 1]
    return bool(several) and all(_equal_values(group) for group in several)


def _equal_values(trials: Sequence[FrozenTrial]) -> bool:
    values = [trial.values[0] for trial in trials]
    return bool(max(values) - min(values) <= _SAME * max(1.0, abs(values[0])))


def importances(study: optuna.Study, names: Iterable[str]) -> dict[str, float]:
    """Importances for the first objective (PED-ANOVA), largest first, of the parameters that matter more than chance.

    Chance is what the same trials give when their values are shuffled: the level that the largest importance of any
    parameter then exceeds in 5 % of the shuffles. Inert parameters take no part.

    Args:
        study: The study.
        names: Its parameters.

    Returns:
        Shares that add up to 1. Empty below `FEWEST_TRIALS` finished trials, or where nothing exceeds chance.
    """
    finished = [t for t in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)) if t.params]
    if len(finished) < FEWEST_TRIALS or _equal_values(finished):
        return {}
    dead = inert_parameters(finished, names)
    values = np.array([trial.values[0] for trial in finished])
    found = _scores(study, finished, values, dead)
    rng = stream(0, "importances", len(finished))
    shuffled = [_scores(study, finished, rng.permutation(values), dead) for _ in range(_SHUFFLES)]
    chance = float(np.quantile([max(scores.values(), default=0.0) for scores in shuffled], 0.95))
    live = {name: value for name, value in found.items() if value > chance}
    total = sum(live.values())
    return {name: value / total for name, value in sorted(live.items(), key=lambda item: -item[1])}


def _scores(
    study: optuna.Study, trials: Sequence[FrozenTrial], values: NDArray[np.float64], dead: Sequence[str]
) -> dict[str, float]:
    """PED-ANOVA's scores, not normalised, as if the trials had these values."""
    sign = 1.0 if study.directions[0] == optuna.study.StudyDirection.MINIMIZE else -1.0
    value_of = dict(zip((trial.number for trial in trials), sign * values, strict=True))
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():  # the evaluator counts as experimental
        warnings.simplefilter("ignore")
        try:
            found = optuna.importance.get_param_importances(
                study, evaluator=evaluator, target=lambda trial: float(value_of[trial.number]), normalize=False
            )
        except (ValueError, RuntimeError):  # no parameter common to all trials
            return {}
    return {name: float(score) for name, score in found.items() if name not in dead and math.isfinite(score)}
