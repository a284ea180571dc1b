"""Beginning a study from settings that are known to be good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.settings import Parameter, Scalar

from .space import default_configuration, distribution


def starting_point(preset: Mapping[str, Any], space: Sequence[Parameter], base: Mapping[str, Any]) -> dict[str, Scalar]:
    """A preset as a configuration of a study; what it does not say is as the default has it.

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
            raise StudyError(
                f"the preset to start from sets '{name}', which there is not", did_you_mean(name, list(base))
            )
        if name not in tuned and base[name] != value:
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, but the study holds it at {base[name]!r}",
                f'tune it, or say "{name}" = ... under [space.fixed]',
            )
        if name in tuned and not _fits(tuned[name], value):
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, outside the range that the study tunes"
            )
    given = {**base, **preset}
    live = default_configuration(list(space), given)
    return {name: given[name] for name in live}


def _fits(parameter: Parameter, value: Any) -> bool:
    span = distribution(parameter)
    try:
        return bool(span._contains(span.to_internal_repr(value)))
    except ValueError:
        return False
