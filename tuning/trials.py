"""Reading the trials of a study."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.trial import FrozenTrial, TrialState, create_trial

from dynslam_bench.core.records import Record
from dynslam_bench.tuning.instances import ProblemInstance, parse_instances
from dynslam_bench.tuning.objectives import centre
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.study_file import StudySpec

EARLIER = "earlier"
"""User attribute of trials that an earlier study made: which, and whether by other code. They are no candidates."""


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best complete trials that fulfil the constraints, without repeats of the same settings.

    With several objectives the front: the best in the first one, the best in the second, and so on in turn. If no trial
    is feasible, the least bad ones. Where they are too few, pruned ones follow, those that came furthest first.
    """
    trials = [trial for trial in study.get_trials(deepcopy=False) if EARLIER not in trial.user_attrs]
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    candidates = [trial for trial in complete if is_feasible(trial)] or complete
    if len(study.directions) > 1:
        front = {trial.number for trial in study.best_trials}
        candidates = [trial for trial in candidates if trial.number in front] or candidates
    orders = [sorted(candidates, key=lambda trial: trial.values[at]) for at in range(len(study.directions))]
    pruned = [trial for trial in trials if trial.state == TrialState.PRUNED and trial.user_attrs.get("scenes")]
    pruned.sort(key=lambda trial: (-len(trial.user_attrs["instances"]), centre(trial.user_attrs["scenes"].values())))
    distinct: list[FrozenTrial] = []
    for trial in chain(chain.from_iterable(zip(*orders, strict=True)), pruned):
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
        One row a trial, in order; what is missing is ``pd.NA``. ``Int64``: trial (0 is the baseline's settings), runs
        (that it was evaluated on). ``string``: state (``complete``, ``pruned``, ``fail``, ``running``, ``waiting``),
        reason (why it was pruned or failed; missing else), earlier (the study that it was taken from, and whether its
        code was another; missing for the study's own). ``boolean``: feasible (all constraints hold; missing for
        incomplete trials). ``Float64``: one column for each objective, named after ``value_``, as Optuna has them
        (natural logarithms of ratios to the baseline, less is better), ratio (the ATE ratio, below 1 is better
        than the baseline; missing if accuracy is no objective), coverage (share, 0 to 1), fps (frames a second),
        duration_s (seconds from the start of the trial to its end). Then a column ``params.NAME`` for each tuned
        setting, in its own unit: ``Float64``, ``Int64``, ``boolean`` or ``string``, missing where its condition did
        not hold.
    """
    trials = study.get_trials(deepcopy=False)
    objectives = [f"value_{objective}" for objective in spec.objectives]
    kinds = {"trial": "Int64", "state": "string"} | dict.fromkeys([*objectives, "ratio"], "Float64")
    kinds |= {"duration_s": "Float64", "coverage": "Float64", "fps": "Float64"}
    kinds |= {"runs": "Int64", "feasible": "boolean", "reason": "string", EARLIER: "string"}
    frame = pd.DataFrame([_row(spec, trial) for trial in trials], columns=list(kinds)).astype(kinds)
    for name in sorted({name for trial in trials for name in trial.params}):
        frame[f"params.{name}"] = pd.array([trial.params.get(name) for trial in trials])
    return frame


def _row(spec: StudySpec, trial: FrozenTrial) -> dict[str, Any]:
    values = dict(zip(spec.objectives, trial.values or [], strict=False))
    accuracy = values.get("accuracy")
    return {
        **{f"value_{objective}": value for objective, value in values.items()},
        **{name: trial.user_attrs.get(name) for name in ("coverage", "fps", "reason", EARLIER)},
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "ratio": None if accuracy is None else math.exp(accuracy),
        "duration_s": None if trial.duration is None else trial.duration.total_seconds(),
        "runs": len(trial.user_attrs.get("instances", ())),
        "feasible": is_feasible(trial) if trial.state == TrialState.COMPLETE else None,
    }


# Importances.

FEWEST_TRIALS = 20
"""With fewer complete or pruned trials importances are luck."""
_RESAMPLES = 50


class Importance(Record):
    """How much a parameter matters, as a share of all, with its 95 % interval over resampled trials (bootstrap)."""

    share: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.share:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def scene_ratios(study: optuna.Study) -> dict[int, dict[str, float]]:
    """Log ratio by scene, of all objectives together, of each complete or pruned trial of the study itself."""
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    return {trial.number: trial.user_attrs["scenes"] for trial in trials if "scenes" in trial.user_attrs}


def importances(study: optuna.Study) -> dict[str, Importance]:
    """Optuna's importances for all objectives together (PED-ANOVA, Watanabe et al. 2023), largest first.

    Returns:
        Shares that add up to 1; empty below `FEWEST_TRIALS` complete or pruned trials, or where their values are equal.
    """
    trials = study.get_trials(deepcopy=False)
    judged = [(trials[number], centre(ratios.values())) for number, ratios in scene_ratios(study).items()]
    if len(judged) < FEWEST_TRIALS or len({value for _, value in judged}) < 2:
        return {}
    copies = [
        create_trial(params=trial.params, distributions=trial.distributions, value=value) for trial, value in judged
    ]
    rng = np.random.default_rng(0)
    whole, *resampled = [
        _shares([copies[index] for index in chosen])
        for chosen in (range(len(copies)), *rng.integers(len(copies), size=(_RESAMPLES, len(copies))))
    ]
    table = pd.DataFrame(resampled).fillna(0.0).quantile([0.025, 0.975])
    return {
        name: Importance(share=share, low=float(table[name].iloc[0]), high=float(table[name].iloc[1]))
        for name, share in whole.items()
    }


def _shares(trials: Sequence[FrozenTrial]) -> dict[str, float]:
    study = optuna.create_study()
    study.add_trials(trials)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental; of resampled trials that are all equal
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return optuna.importance.get_param_importances(study, evaluator=evaluator)
