"""The search space: from the settings' annotations to Optuna's distributions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import optuna

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.settings import (
    Parameter,
    Scalar,
    Settings,
    apply_overrides,
    field_names,
    parameters,
    why_unused,
)
from dynslam_bench.tuning.splits import source_of_masks
from dynslam_bench.tuning.study_file import SpaceSpec


def search_space(settings: Settings, spec: SpaceSpec, sequences: Iterable[str] = ()) -> list[Parameter]:
    """The parameters of a study; what has no effect with the baseline's settings is no part of it.

    Args:
        settings: The tracker's, the baseline's and the fixed ones among them.
        spec: Which of them are tuned.
        sequences: What the study runs on, which decides what the source of masks ``auto`` is.

    Raises:
        StudyError: A pattern matches nothing, names a setting that has no effect, or nothing is left to tune.
    """
    every = parameters(type(settings))
    for pattern in (*spec.include, *spec.exclude):
        if not any(fnmatchcase(parameter.name, pattern) for parameter in every):
            similar = did_you_mean(pattern, [parameter.name for parameter in every])
            hint = "it exists, but is not tunable" if pattern in field_names(type(settings)) else similar
            raise StudyError(f"'{pattern}' matches no tunable setting", hint)
    chosen = [
        parameter
        for parameter in every
        if any(fnmatchcase(parameter.name, pattern) for pattern in spec.include)
        and not any(fnmatchcase(parameter.name, pattern) for pattern in spec.exclude)
        and parameter.name not in spec.fixed
    ]
    if hasattr(settings, "segmentation"):  # "auto" stands for a source
        settings = apply_overrides(settings, {"segmentation.source": source_of_masks(settings, list(sequences))})
    unused = {parameter.name: why for parameter in chosen if (why := why_unused(settings, parameter.name))}
    chosen = [parameter for parameter in chosen if parameter.name not in unused]
    if not chosen:
        raise StudyError("the space is empty: all that matches is excluded, fixed, or switched off by a fixed value")
    for name in spec.include:
        if name in unused:
            raise StudyError(
                f"'{name}' has no effect in this study: {unused[name]}", "leave it out, or fix that otherwise"
            )
    return chosen


def distributions(space: Sequence[Parameter]) -> dict[str, optuna.distributions.BaseDistribution]:
    """A space of `search_space` as ``optuna.Study.ask`` takes it."""
    return {parameter.name: distribution(parameter) for parameter in space}


def distribution(parameter: Parameter) -> optuna.distributions.BaseDistribution:
    """Optuna's distribution of a parameter."""
    if parameter.kind in ("bool", "categorical"):
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    assert parameter.low is not None and parameter.high is not None
    log = parameter.scale == "log"
    if parameter.kind == "int":
        return optuna.distributions.IntDistribution(int(parameter.low), int(parameter.high), log=log)
    return optuna.distributions.FloatDistribution(parameter.low, parameter.high, log=log)


def starting_point(preset: Mapping[str, Any], space: Sequence[Parameter], base: Mapping[str, Any]) -> dict[str, Scalar]:
    """A preset as a configuration of a study; what it does not say is as the baseline has it.

    Args:
        preset: Settings by dotted name.
        space: The study's, from `search_space`.
        base: Values of all settings that are not tuned.

    Raises:
        StudyError: The preset sets what the study does not tune to something else, or to a value out of its range.
    """
    tuned = {parameter.name: parameter for parameter in space}
    for name, value in preset.items():
        if name not in base:
            raise StudyError(f"the preset to start from sets an unknown '{name}'", did_you_mean(name, list(base)))
        if name not in tuned and base[name] != value:
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, but the study holds it at {base[name]!r}",
                f'tune it, or say "{name}" = ... under [space.fixed]',
            )
    point = {name: preset.get(name, base[name]) for name in tuned}
    for name, value in point.items():
        if not _fits(tuned[name], value):
            raise StudyError(f"the preset to start from sets {name} = {value!r}, out of the range that the study tunes")
    return point


def _fits(parameter: Parameter, value: Any) -> bool:
    span = distribution(parameter)
    try:
        return bool(span._contains(span.to_internal_repr(value)))
    except ValueError:
        return False
