"""Reading the trials of a study."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.seeding import stream
from dynslam_bench.tuning.instances import ProblemInstance, parse_instances
from dynslam_bench.tuning.objectives import Outcomes
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.study_file import StudySpec

if TYPE_CHECKING:
    import pandas as pd


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best trials that came to their end and fulfil the constraints, without repeats of the same settings.

    With several objectives the front: the best in the first one, the best in the second, and so on in turn. If no trial
    is feasible, the least bad ones.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    feasible = [trial for trial in finished if is_feasible(trial)] or finished
    if len(study.directions) > 1:
        front = {trial.number for trial in study.best_trials}
        feasible = [trial for trial in feasible if trial.number in front] or feasible
    count_of = len(study.directions)
    orders = [sorted(feasible, key=lambda trial: (trial.values[index], trial.number)) for index in range(count_of)]
    ranked = [trial for turn in zip(*orders, strict=True) for trial in turn]
    distinct: list[FrozenTrial] = []
    for trial in ranked:
        if all(trial.params != other.params for other in distinct):
            distinct.append(trial)
    return distinct[:count]


def count_states(study: optuna.Study) -> dict[str, int]:
    """How many trials are complete, pruned, failed, running, waiting."""
    counts: dict[str, int] = {}
    for trial in study.get_trials(deepcopy=False):
        counts[trial.state.name.lower()] = counts.get(trial.state.name.lower(), 0) + 1
    return counts


def errors_in(outcomes: Outcomes) -> dict[ProblemInstance, float]:
    """ATE in metres on each instance."""
    return {instance: outcome.ate_m for instance, outcome in outcomes.items()}


def errors_of(trial: FrozenTrial) -> dict[ProblemInstance, float]:
    """ATE in metres on each instance that a trial ran on."""
    return {parse_instances(text)[0]: float(ate) for text, _, ate, *_ in trial.user_attrs.get("instances", [])}


# A study's trials as a pandas frame: one row a trial.


def trials_frame(spec: StudySpec, study: optuna.Study) -> pd.DataFrame:
    """All trials.

    Returns:
        One line a trial, in order; whatever is missing is ``pd.NA``. ``Int64``: trial (0 is the default), runs
        (that it was evaluated on). ``string``: state (``complete``, ``pruned``, ``fail``, ``running``, ``waiting``),
        reason (why it dropped out or failed; missing else). ``boolean``: feasible (all constraints hold; missing where
        nothing was measured). ``Float64``: one column for each objective, named after ``value_``, as told to Optuna
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
    names = sorted({name for trial in trials for name in trial.params})
    lines = [_line(spec, trial) for trial in trials]
    frame = pd.DataFrame(lines, columns=list(kinds)).astype(kinds)
    for name in names:
        drawn = [trial.params.get(name) for trial in trials]
        frame[f"params.{name}"] = pd.Series(drawn, dtype=_dtype(drawn))
    return frame


def _line(spec: StudySpec, trial: FrozenTrial) -> dict[str, Any]:
    values = dict(zip(spec.objectives, trial.values or [], strict=False))
    notes, constraints = trial.user_attrs, trial.user_attrs.get("constraints")
    accuracy = values.get("accuracy")
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        **{f"value_{objective}": value for objective, value in values.items()},
        "ratio": None if accuracy is None else math.exp(accuracy),
        "duration_s": None if trial.duration is None else trial.duration.total_seconds(),
        "coverage": notes.get("coverage"),
        "fps": notes.get("fps"),
        "runs": len(notes.get("instances", ())),
        "feasible": None if constraints is None else all(value <= 0 for value in constraints.values()),
        "reason": notes.get("reason"),
    }


def _dtype(values: list[Any]) -> str:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return "boolean"
    if kinds == {int}:
        return "Int64"
    return "Float64" if kinds <= {int, float} else "string"


# Which parameters of a study matter: only from enough trials on, and never one that changed nothing.

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
