"""Reading the trials of a study."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.tuning.instances import ProblemInstance, parse_instances
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.study_file import StudySpec

if TYPE_CHECKING:
    import pandas as pd


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best complete trials that fulfil the constraints, without repeats of the same settings.

    With several objectives the front: the best in the first one, the best in the second, and so on in turn. If no trial
    is feasible, the least bad ones.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    candidates = [trial for trial in complete if is_feasible(trial)] or complete
    if len(study.directions) > 1:
        front = {trial.number for trial in study.best_trials}
        candidates = [trial for trial in candidates if trial.number in front] or candidates
    distinct: list[FrozenTrial] = []
    orders = [sorted(candidates, key=lambda trial: trial.values[at]) for at in range(len(study.directions))]
    for trial in chain.from_iterable(zip(*orders, strict=True)):
        if all(trial.params != other.params for other in distinct):
            distinct.append(trial)
    return distinct[:count]


def count_states(study: optuna.Study) -> dict[str, int]:
    """How many trials are complete, pruned, fail, running, waiting; states without a trial are left out."""
    return dict(Counter(trial.state.name.lower() for trial in study.get_trials(deepcopy=False)))


def errors_of(trial: FrozenTrial) -> dict[ProblemInstance, float]:
    """ATE in metres on each instance that a trial ran on."""
    return {parse_instances(text)[0]: float(ate) for text, _, ate, *_ in trial.user_attrs.get("instances", [])}


# A study's trials as a pandas frame: one row a trial.


def trials_frame(spec: StudySpec, study: optuna.Study) -> pd.DataFrame:
    """All trials.

    Returns:
        One row a trial, in order; what is missing is ``pd.NA``. ``Int64``: trial (0 is the default), runs
        (that it was evaluated on). ``string``: state (``complete``, ``pruned``, ``fail``, ``running``, ``waiting``),
        reason (why it was pruned or failed; missing else). ``boolean``: feasible (all constraints hold; missing for
        incomplete trials). ``Float64``: one column for each objective, named after ``value_``, as Optuna has them
        (natural logarithms of ratios to the default settings, less is better), ratio (the ATE ratio, below 1 is better
        than the default; missing if accuracy is no objective), coverage (share, 0 to 1), fps (frames a second),
        duration_s (seconds from the start of the trial to its end). Then a column ``params.NAME`` for each tuned
        setting, in its own unit: ``Float64``, ``Int64``, ``boolean`` or ``string``, missing where its condition did
        not hold.
    """
    import pandas as pd

    trials = study.get_trials(deepcopy=False)
    objectives = [f"value_{objective}" for objective in spec.objectives]
    kinds = {"trial": "Int64", "state": "string"} | dict.fromkeys([*objectives, "ratio"], "Float64")
    kinds |= {"duration_s": "Float64", "coverage": "Float64", "fps": "Float64"}
    kinds |= {"runs": "Int64", "feasible": "boolean", "reason": "string"}
    frame = pd.DataFrame([_row(spec, trial) for trial in trials], columns=list(kinds)).astype(kinds)
    for name in sorted({name for trial in trials for name in trial.params}):
        frame[f"params.{name}"] = pd.array([trial.params.get(name) for trial in trials])
    return frame


def _row(spec: StudySpec, trial: FrozenTrial) -> dict[str, Any]:
    values = dict(zip(spec.objectives, trial.values or [], strict=False))
    accuracy = values.get("accuracy")
    return {
        **{f"value_{objective}": value for objective, value in values.items()},
        **{name: trial.user_attrs.get(name) for name in ("coverage", "fps", "reason")},
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "ratio": None if accuracy is None else math.exp(accuracy),
        "duration_s": None if trial.duration is None else trial.duration.total_seconds(),
        "runs": len(trial.user_attrs.get("instances", ())),
        "feasible": is_feasible(trial) if trial.state == TrialState.COMPLETE else None,
    }


# Importances.

FEWEST_TRIALS = 30
"""With fewer complete trials importances are luck."""


def importances(study: optuna.Study) -> dict[str, float]:
    """Optuna's importances for the first objective (PED-ANOVA, Watanabe et al. 2023), largest first.

    Returns:
        Shares that add up to 1; empty below `FEWEST_TRIALS` complete trials, or where their values are all equal.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < FEWEST_TRIALS or len({trial.values[0] for trial in complete}) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return optuna.importance.get_param_importances(
            study, evaluator=evaluator, target=lambda trial: float(trial.values[0])
        )
