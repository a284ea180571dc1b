"""Search space of a study: settings with their ranges and choices, the tracker among them, and when each one counts.

A setting is proposed only where it has an effect: where the chosen tracker has it, where its group is
enabled, where the other values chosen do not switch it off (`core.settings.why_unused`), and where the
study's own conditions hold.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import chain, islice, product
from typing import Any, cast

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from dynslam_bench.core import SettingsError, StudyError, did_you_mean
from dynslam_bench.core.settings import (
    Parameter,
    Scalar,
    Settings,
    apply_overrides,
    field_names,
    flatten,
    parameters,
    why_unused,
)
from dynslam_bench.tuning.study_file import TRACKER, Range, SpaceSpec

_MOST_COMBINATIONS = 10_000
"""So many combinations of choices are tried to find one in which a setting has an effect."""


@dataclass(frozen=True)
class SearchSpace:
    """The space of a study.

    Attributes:
        parameters: What is tuned, in the order in which it is shown.
        settings: Settings around which each tracker is tuned, by its name; the study's own tracker
            is the first.
        conditions: The study's own: a setting is tuned only where the named ones have one of these
            values.
        steps: Distance between the values of a setting, by its name, where a study gives one.
    """

    parameters: tuple[Parameter, ...]
    settings: Mapping[str, Settings]
    conditions: Mapping[str, Mapping[str, Sequence[Scalar]]]
    steps: Mapping[str, float]

    @property
    def base(self) -> dict[str, Any]:
        """Values of all settings where nothing is tuned, by dotted name, the tracker's name among them."""
        first = next(iter(self.settings))
        values: dict[str, Any] = {}
        for settings in reversed(list(self.settings.values())):
            values |= flatten(settings)
        return values | ({TRACKER: first} if len(self.settings) > 1 else {})

    def distributions(self) -> dict[str, BaseDistribution]:
        """Optuna's distribution of each setting."""
        return {
            parameter.name: distribution(parameter, self.steps.get(parameter.name))
            for parameter in self.parameters
        }

    def suggest(self, trial: optuna.Trial) -> dict[str, Scalar]:
        """Let Optuna propose the tracker, then what switches others on and off, then all that has an effect."""
        values: dict[str, Scalar] = {}
        for parameter in self._in_order():
            if not self.why_not(parameter.name, values):
                step = self.steps.get(parameter.name)
                values[parameter.name] = _suggest(trial, parameter, step)
        return values

    def effective(self, values: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """The values of a configuration that have an effect."""
        return {name: value for name, value in values.items() if not self.why_not(name, values)}

    def why_not(self, name: str, values: Mapping[str, Any]) -> str:
        """Why a setting has no effect beside other values; empty where it has one."""
        if name == TRACKER:
            return ""
        tracker = str(values.get(TRACKER, next(iter(self.settings))))
        settings = self.settings[tracker]
        names = set(field_names(type(settings)))
        if name not in names:
            return f"{tracker} has no such setting"
        # the study's own conditions
        for other, wanted in self.conditions.get(name, {}).items():
            value = values[other] if other in values else self.base.get(other)
            if value not in wanted:
                return f"{other} is {value!r}"
        # those of the settings themselves
        others = {key: value for key, value in values.items() if key in names and key != name}
        return why_unused(apply_overrides(settings, others), name)

    def why_never(self, name: str) -> str:
        """Why a setting has no effect whatever is chosen; empty where some choices give it one.

        A group decides for itself, so that choices of other groups are left alone.
        """
        group = name.partition(".")[0]
        deciding = [
            parameter
            for parameter in self.parameters
            if parameter.name != name
            and _is_switch(parameter)
            and (
                parameter.name.partition(".")[0] in (group, TRACKER)
                or parameter.name in self.conditions.get(name, {})
            )
        ]
        combinations = product(*(parameter.choices for parameter in deciding))
        reason = self.why_not(name, {})
        for combination in islice(combinations, _MOST_COMBINATIONS):
            chosen = dict(zip((one.name for one in deciding), combination, strict=True))
            if not self.why_not(name, chosen):
                return ""
        return reason

    def _in_order(self) -> Iterator[Parameter]:
        """The tracker first, then switches of whole groups, other choices, and numbers; each behind its conditions."""

        def rank(parameter: Parameter) -> int:
            """Position of a parameter's kind: tracker, switch of a group, other choice, number."""
            if parameter.name == TRACKER:
                return 0
            if parameter.name.endswith(".enabled"):
                return 1
            return 2 if _is_switch(parameter) else 3

        waiting = sorted(self.parameters, key=rank)
        while waiting:
            names = {parameter.name for parameter in waiting}
            # the first one whose conditions are decided
            ready = next(
                (one for one in waiting if not names & set(self.conditions.get(one.name, {}))), None
            )
            if ready is None:
                raise StudyError(
                    f"the conditions of {' and '.join(sorted(names))} depend on each other",
                    "leave one of them out of space.when",
                )
            waiting.remove(ready)
            yield ready


def build_space(
    spec: SpaceSpec, settings: Mapping[str, Settings], shown: Mapping[str, Settings] | None = None
) -> SearchSpace:
    """The space of a study; what has no effect in it whatever is chosen is no part of it.

    Args:
        spec: Which settings are tuned, in which ranges, and when.
        settings: Settings of each tracker by the tracker's name, with the baseline's and the fixed
            values filled in; the study's own tracker first.
        shown: Settings of each tracker where a setting that stands for another is replaced by it,
            e.g. ``auto`` by a source of masks; they decide what has an effect.

    Raises:
        StudyError: A pattern or a name matches nothing, a range or a choice is refused by the
            setting, a setting can have no effect, or nothing is left to tune.
    """
    _check_names(spec, settings)
    by_tracker = [_chosen(spec, defaults) for defaults in settings.values()]

    # one parameter a name, in the order of the trackers
    merged: dict[str, Parameter] = {}
    for parameter in chain.from_iterable(by_tracker):
        there = merged.get(parameter.name)
        merged[parameter.name] = parameter if there is None else _merged(there, parameter)
    every = list(merged.values())
    if len(settings) > 1:
        meaning = "the system"
        names = tuple(settings)
        every.insert(0, Parameter(TRACKER, "categorical", names[0], choices=names, meaning=meaning))
    steps = {name: span.step for name, span in spec.range.items() if span.step}
    space = SearchSpace(tuple(every), shown or settings, spec.when, steps)
    list(space._in_order())

    # what has an effect
    unused = {one.name: space.why_never(one.name) for one in every}
    named = {*spec.include, *spec.range, *spec.choices}
    for name, why in unused.items():
        if why and name in named:
            raise StudyError(
                f"'{name}' has no effect in this study: {why}",
                "leave it out, or fix that otherwise",
            )
    used = tuple(one for one in every if not unused[one.name])
    if not used:
        raise StudyError(
            "the space is empty: all that matches is excluded, fixed, or switched off by a fixed value"
        )
    return replace(space, parameters=used)


def _check_names(spec: SpaceSpec, settings: Mapping[str, Settings]) -> None:
    """Refuse patterns and names that match no setting of any tracker, and names that are tuned and fixed."""
    groups = [type(defaults) for defaults in settings.values()]
    tunable = [parameter.name for group in groups for parameter in parameters(group)]
    fields = {name for group in groups for name in field_names(group)}
    for pattern in (*spec.include, *spec.exclude):
        if any(fnmatchcase(name, pattern) for name in tunable):
            continue
        hint = did_you_mean(pattern, tunable)
        if pattern in fields:
            hint = f'it exists, but has no range: say space.range."{pattern}" or space.choices."{pattern}"'
        raise StudyError(f"'{pattern}' matches no tunable setting", hint)
    conditions = [name for wanted in spec.when.values() for name in wanted]
    for name in (*spec.fixed, *spec.range, *spec.choices, *spec.when, *conditions):
        if name not in fields and name != TRACKER:
            raise StudyError(f"the space names an unknown '{name}'", did_you_mean(name, fields))
    for name in (*spec.range, *spec.choices):
        if name in spec.fixed:
            raise StudyError(f"'{name}' is both tuned and fixed", "leave one out")
    for name in spec.range.keys() & spec.choices.keys():
        raise StudyError(f"'{name}' has both a range and choices", "leave one out")


def _chosen(spec: SpaceSpec, settings: Settings) -> list[Parameter]:
    """The parameters of one tracker that a study tunes, as it wants them, in the order of definition."""
    declared = {one.name: one for one in parameters(type(settings))}
    values = flatten(settings)
    chosen = []
    for name in field_names(type(settings)):
        is_named = name in spec.range or name in spec.choices
        matches = name in declared and any(fnmatchcase(name, one) for one in spec.include)
        is_left_out = name in spec.fixed or any(fnmatchcase(name, one) for one in spec.exclude)
        if not is_named and (is_left_out or not matches):
            continue
        parameter = declared.get(name) or _undeclared(name, values[name])
        if name in spec.range:
            parameter = _with_range(parameter, spec.range[name], settings)
        elif name in spec.choices:
            parameter = _with_choices(parameter, spec.choices[name], settings)
        chosen.append(parameter)
    return chosen


def _undeclared(name: str, value: Any) -> Parameter:
    """A setting that is not declared as tunable, without its range."""
    kind: Any = type(value).__name__ if isinstance(value, int | float) else "categorical"
    return Parameter(name, kind, value, choices=(False, True) if kind == "bool" else ())


def _with_range(parameter: Parameter, span: Range, settings: Settings) -> Parameter:
    """A parameter with a study's range in place of its own; the range's step is only checked here.

    Raises:
        StudyError: The setting is no number, or it does not take an end of the range.
    """
    name = parameter.name
    if parameter.kind not in ("int", "float"):
        what = " or ".join(map(repr, parameter.choices)) or "text"
        raise StudyError(
            f"'{name}' takes no range: it is {what}", f'write space.choices."{name}" = [...]'
        )
    scale = span.scale or parameter.scale
    # a step and a log scale exclude each other
    if span.step and span.scale is None:
        scale = "linear"
    numbers = {"low": span.low, "high": span.high} | ({"step": span.step} if span.step else {})
    for end, value in numbers.items():
        if parameter.kind == "int" and value != int(value):
            raise StudyError(
                f"the range of '{name}' has {end} = {value:g}, but it takes whole numbers",
                f"write {round(value)}",
            )
    for value in (span.low, span.high):
        _check_value(parameter, value, settings, "range")
    if scale == "log" and span.low <= 0:
        raise StudyError(
            f"the range of '{name}' begins at {span.low:g}, which has no logarithm",
            'begin above 0, or write scale = "linear"',
        )
    return replace(parameter, low=span.low, high=span.high, scale=scale, choices=())


def _with_choices(parameter: Parameter, choices: Sequence[Scalar], settings: Settings) -> Parameter:
    """A parameter with a study's choices in place of its own.

    Raises:
        StudyError: The setting does not take one of them.
    """
    for choice in choices:
        _check_value(parameter, choice, settings, "choices")
    return replace(
        parameter, kind="categorical", low=None, high=None, scale="linear", choices=tuple(choices)
    )


def _check_value(parameter: Parameter, value: Scalar, settings: Settings, what: str) -> None:
    """Refuse a value that the setting refuses, with what it takes."""
    number = int(value) if parameter.kind == "int" and isinstance(value, float) else value
    try:
        apply_overrides(settings, {parameter.name: number})
    except SettingsError as error:
        ends = ""
        if parameter.low is not None and parameter.high is not None:
            ends = f"its own range is {parameter.low:g} to {parameter.high:g}"
        elif parameter.choices:
            ends = f"its own choices are {', '.join(map(str, parameter.choices))}"
        raise StudyError(f"the {what} of '{parameter.name}': {error.args[0]}", ends) from None


def _merged(one: Parameter, other: Parameter) -> Parameter:
    """Merge a setting that two trackers share into one with the values that both take.

    Raises:
        StudyError: They share no values.
    """
    if replace(other, default=one.default, meaning=one.meaning) == one:
        return one
    fault = StudyError(
        f"the trackers of this study take different values of '{one.name}'",
        f'give it a range or choices that all of them take, as space.range."{one.name}"',
    )
    if one.kind != other.kind:
        raise fault
    if one.low is None or one.high is None or other.low is None or other.high is None:
        shared = tuple(choice for choice in one.choices if choice in other.choices)
        if one.kind == "categorical" and not shared:
            raise fault
        return replace(one, choices=shared)
    low = max(one.low, other.low)
    high = min(one.high, other.high)
    if low >= high:
        raise fault
    return replace(one, low=low, high=high)


def _is_switch(parameter: Parameter) -> bool:
    """Whether a parameter has choices, which may switch others on and off."""
    return parameter.low is None or parameter.high is None


def distribution(parameter: Parameter, step: float | None = None) -> BaseDistribution:
    """Optuna's distribution of a parameter; `step` is the distance between its values."""
    if parameter.low is None or parameter.high is None:
        return CategoricalDistribution(parameter.choices)
    is_log = parameter.scale == "log"
    if parameter.kind == "int":
        low = int(parameter.low)
        high = int(parameter.high)
        return IntDistribution(low, high, log=is_log, step=int(step or 1))
    return FloatDistribution(parameter.low, parameter.high, log=is_log, step=step)


def _suggest(trial: optuna.Trial, parameter: Parameter, step: float | None) -> Scalar:
    """The value of a parameter that Optuna proposes for a trial."""
    span = distribution(parameter, step)
    if isinstance(span, IntDistribution):
        return trial.suggest_int(parameter.name, span.low, span.high, step=span.step, log=span.log)
    if isinstance(span, FloatDistribution):
        return trial.suggest_float(
            parameter.name, span.low, span.high, step=span.step, log=span.log
        )
    assert isinstance(span, CategoricalDistribution)
    return cast("Scalar", trial.suggest_categorical(parameter.name, span.choices))


def search_space(settings: Settings, spec: SpaceSpec) -> list[Parameter]:
    """The parameters of a study of one tracker, for a study of your own.

    Args:
        settings: The tracker's.
        spec: Which of them are tuned.

    Raises:
        StudyError: See `build_space`.
    """
    return list(build_space(spec, {"the tracker": settings}).parameters)


def distributions(space: Iterable[Parameter]) -> dict[str, BaseDistribution]:
    """Parameters of `search_space` as ``optuna.Study.ask`` takes them."""
    return {parameter.name: distribution(parameter) for parameter in space}


def starting_point(
    preset: Mapping[str, Any], space: SearchSpace, *, what: str = "the preset to start from"
) -> dict[str, Scalar]:
    """A preset as a configuration of a study; what it does not say is as the baseline has it.

    Args:
        preset: Settings by dotted name.
        space: The study's.
        what: What the preset is, for messages.

    Raises:
        StudyError: The preset sets what the study does not tune to something else, or to a value
            out of its range.
    """
    # what is not tuned has the baseline's value
    base = space.base
    spans = space.distributions()
    for name, value in preset.items():
        if name not in base:
            raise StudyError(f"{what} sets an unknown '{name}'", did_you_mean(name, list(base)))
        if name not in spans and base[name] != value:
            raise StudyError(
                f"{what} sets {name} = {value!r}, but the study holds it at {base[name]!r}",
                f'tune it, or say "{name}" = ... under [space.fixed]',
            )

    # what is tuned has a value that the sampler could propose, unless nothing uses it
    point = {name: preset.get(name, base[name]) for name in spans}
    misfits = [name for name, value in point.items() if not _is_within(spans[name], name, value)]
    if misfits:
        used = space.effective(point | {name: base[name] for name in misfits})
        for name in misfits:
            if name not in used:
                continue
            tuned = _span_text(spans[name])
            raise StudyError(
                f"{what} sets {name} = {point[name]!r}, out of the range that the study tunes: {tuned}",
                'make the range wider, or begin with a baseline within it (baseline = "PRESET.toml")',
            )
    return point


def _is_within(span: BaseDistribution, name: str, value: Scalar) -> bool:
    """Whether a distribution contains a value: Optuna makes no trial of one that lies outside."""
    try:
        optuna.trial.create_trial(params={name: value}, distributions={name: span}, value=0.0)
    except ValueError:  # out of the range, no number, or none of the choices
        return False
    return True


def _span_text(span: BaseDistribution) -> str:
    """A distribution for people."""
    if isinstance(span, CategoricalDistribution):
        return ", ".join(map(str, span.choices))
    assert isinstance(span, IntDistribution | FloatDistribution)
    step = f" in steps of {span.step:g}" if span.step not in (None, 1) else ""
    return f"{span.low:g} to {span.high:g}{step}"
