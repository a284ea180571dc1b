"""A study's trials as a pandas frame: one row a trial."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial

from .study_file import StudySpec

if TYPE_CHECKING:
    import pandas as pd


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
        "runs": len(notes.get("blocks", ())),
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
