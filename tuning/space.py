"""From the settings' annotations to what a sampler draws."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any, cast

import optuna

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.settings import Parameter, Scalar, Settings, apply_overrides, field_names, flatten, parameters

from .study_file import SpaceSpec


def search_space(settings: type[Settings], spec: SpaceSpec) -> list[Parameter]:
    """The parameters of a study, those that conditions refer to before those that depend on them.

    Args:
        settings: The tracker's settings class.
        spec: Which of them are tuned.

    Raises:
        StudyError: A pattern matches nothing, or nothing is left to tune.
        SettingsError: A fixed value is unknown or unfit.
    """
    apply_overrides(settings(), spec.fixed)
    every = parameters(settings)
    for pattern in (*spec.include, *spec.exclude):
        if not any(fnmatchcase(parameter.name, pattern) for parameter in every):
            known = [parameter.name for parameter in every]
            hint = "it exists, but is not tunable" if pattern in field_names(settings) else did_you_mean(pattern, known)
            raise StudyError(f"'{pattern}' matches no tunable setting", hint)
    chosen = [
        parameter
        for parameter in every
        if any(fnmatchcase(parameter.name, pattern) for pattern in spec.include)
        and not any(fnmatchcase(parameter.name, pattern) for pattern in spec.exclude)
        and parameter.name not in spec.fixed
    ]
    base = flatten(apply_overrides(settings(), spec.fixed))
    tuned = {parameter.name for parameter in chosen}
    chosen = [parameter for parameter in chosen if _possible(parameter, base, tuned)]
    if not chosen:
        raise StudyError("the space is empty: all that matches is excluded, fixed, or switched off by a fixed value")
    return sorted(chosen, key=lambda parameter: len(parameter.when) > 0)


def suggest(trial: optuna.trial.BaseTrial, space: list[Parameter], base: Mapping[str, Any]) -> dict[str, Scalar]:
    """Draw a configuration; parameters whose conditions do not hold are not drawn.

    Args:
        trial: Draws.
        space: From `search_space`.
        base: Values of all settings that are not tuned, dotted name to value.
    """
    values: dict[str, Scalar] = {}
    for parameter in space:
        if all((values.get(name, base.get(name))) in allowed for name, allowed in parameter.when):
            values[parameter.name] = _draw(trial, parameter)
    return values


def distribution(parameter: Parameter) -> optuna.distributions.BaseDistribution:
    """Optuna's distribution of a parameter."""
    if parameter.kind in ("bool", "categorical"):
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    assert parameter.low is not None and parameter.high is not None
    log = parameter.scale == "log"
    if parameter.kind == "int":
        return optuna.distributions.IntDistribution(int(parameter.low), int(parameter.high), log=log)
    return optuna.distributions.FloatDistribution(parameter.low, parameter.high, log=log)


def default_configuration(space: list[Parameter], base: Mapping[str, Any]) -> dict[str, Scalar]:
    """The default settings as a configuration: what trial 0 runs."""
    values: dict[str, Scalar] = {}
    for parameter in space:
        if all((values.get(name, base.get(name))) in allowed for name, allowed in parameter.when):
            values[parameter.name] = base[parameter.name]
    return values


def _draw(trial: optuna.trial.BaseTrial, parameter: Parameter) -> Scalar:
    if parameter.kind in ("bool", "categorical"):
        return cast("Scalar", trial.suggest_categorical(parameter.name, parameter.choices))
    assert parameter.low is not None and parameter.high is not None
    log = parameter.scale == "log"
    if parameter.kind == "int":
        return trial.suggest_int(parameter.name, int(parameter.low), int(parameter.high), log=log)
    return trial.suggest_float(parameter.name, parameter.low, parameter.high, log=log)


def _possible(parameter: Parameter, base: Mapping[str, Any], tuned: set[str]) -> bool:
    """Whether the parameter's conditions can hold at all."""
    return all(name in tuned or base.get(name) in allowed for name, allowed in parameter.when)
