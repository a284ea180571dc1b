"""Settings: nested pydantic models whose tunable fields are annotated once.

From the one annotation come validation, ``--set a.b=1`` on the command line, the search space of a
study, the action space of an environment and the table in the documentation. Nothing here knows
Optuna or Gymnasium.

Example:
    >>> class Epipolar(Settings):
    ...     threshold_px: float = tunable(
    ...         1.0, low=0.1, high=5.0, scale="log", unit="px", online=True,
    ...         meaning="distance to the epipolar line above which a point is dynamic",
    ...     )
    >>> class Tracker(Settings):
    ...     epipolar: Epipolar = Epipolar()
    >>> apply_overrides(Tracker(), {"epipolar.threshold_px": "1.5"}).epipolar.threshold_px
    1.5
"""

import json
import os
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from dynslam_bench.core.errors import SettingsError, did_you_mean

S = TypeVar("S", bound="Settings")
Scalar = bool | int | float | str
_TUNABLE = "tunable"
"""Key in a field's JSON schema under which `tunable` stores range, scale, unit and whether it is online."""
_NAMES = "names"
"""Key in a field's JSON schema under which `names` stores what the field names."""


class Settings(BaseModel):
    """Base of all settings: immutable, JSON-able, unknown keys are errors."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Refuse a class with a default that lies outside its own range: studies and actions could not name it."""
        for name, field, default in _leaves(cls):
            if _annotation(field, _TUNABLE) is None:
                continue
            parameter = _describe(name, field, default)
            low = parameter.low
            high = parameter.high
            # booleans and categoricals have no range, optional fields may have no default
            if low is None or high is None or default is None:
                continue
            if not low <= default <= high:
                raise TypeError(
                    f"{cls.__name__}: the default of '{name}' is {default!r}, outside its range {low:g} to {high:g}"
                )

    @property
    def unused(self) -> Mapping[str, str]:
        """Fields that have no effect with the present values of those that are not tunable, each with the reason."""
        return {}

    def verify(self) -> None:
        """Check that values, each valid by itself, go together; called before anything runs.

        Raises:
            SettingsError: They do not.
        """


@dataclass(frozen=True)
class Parameter:
    """One tunable setting, described without reference to any optimiser.

    Attributes:
        name: Dotted path from the root settings, e.g. ``epipolar.threshold_px``.
        kind: What values it takes.
        default: Its default value.
        low: Lower end of the range (int and float), inclusive.
        high: Upper end of the range (int and float), inclusive.
        scale: How the range is to be sampled.
        choices: The values of a categorical.
        unit: Physical unit, empty for none.
        online: Whether it may change in mid-episode.
        tunable: Whether studies tune it.
        meaning: One line.
    """

    name: str
    kind: Literal["float", "int", "bool", "categorical"]
    default: Scalar
    low: float | None = None
    high: float | None = None
    scale: Literal["linear", "log"] = "linear"
    choices: tuple[Scalar, ...] = ()
    unit: str = ""
    online: bool = False
    tunable: bool = True
    meaning: str = ""


def tunable(
    default: Any,
    *,
    meaning: str,
    low: float | None = None,
    high: float | None = None,
    scale: Literal["linear", "log"] = "linear",
    limits: tuple[float | None, float | None] | None = None,
    unit: str = "",
    online: bool = False,
    tuned: bool = True,
) -> Any:
    """A field that studies may tune.

    Args:
        default: The default value; bool and ``Literal`` fields take no range.
        meaning: One line for the documentation table.
        low: Lower end of the search range, inclusive.
        high: Upper end of the search range, inclusive.
        scale: ``log`` for values whose ratio matters; needs ``low > 0``.
        limits: What validation accepts, where that is wider than the search range; None leaves an
            end open.
        unit: Physical unit, e.g. ``px``.
        online: True if the field may change in mid-episode.
        tuned: False if no study tunes the field: it is online, and a decision for single frames.
    """
    if scale == "log" and (low is None or low <= 0):
        raise ValueError(f"a log scale needs low > 0, got {low=}")
    annotation: dict[str, Any] = {
        "low": low,
        "high": high,
        "scale": scale,
        "unit": unit,
        "online": online,
        "tunable": tuned,
    }
    least, most = (low, high) if limits is None else limits
    return Field(
        default, description=meaning, json_schema_extra={_TUNABLE: annotation}, ge=least, le=most
    )


def names(
    default: str,
    kind: Literal["file", "description", "features", "flow"],
    *,
    meaning: str,
    otherwise: str = "",
) -> Any:
    """A field of text that names something else, whose content decides the result as well.

    Args:
        default: The default value.
        kind: ``file``: a path of a file or folder; ``description``: a file that describes the tracker,
            in whose version counts what of it decides; else a plug-in of that kind, by id or
            ``module:Attr``.
        meaning: One line for the documentation table.
        otherwise: Environment variable that names it where the field is empty.
    """
    extra: Any = {_NAMES: {"kind": kind, "otherwise": otherwise}}
    return Field(default, description=meaning, json_schema_extra=extra)


def references_of(settings: Settings) -> dict[str, tuple[str, str]]:
    """References in the settings: dotted name to ``(kind, value)``, see `names`; fields that name nothing are left out.

    A field of type `Path` counts as a file, too.
    """
    references: dict[str, tuple[str, str]] = {}
    for name, field, _ in _leaves(type(settings)):
        annotation = _annotation(field, _NAMES)
        value = attrgetter(name)(settings)
        if annotation is not None:
            # an empty field leaves the choice to an environment variable
            target = value or os.environ.get(annotation["otherwise"], "")
            references[name] = (annotation["kind"], target)
        elif isinstance(value, Path):
            references[name] = ("file", str(value))
    return {name: (kind, target) for name, (kind, target) in references.items() if target}


def build(cls: type[S], values: Mapping[str, Any] | None = None) -> S:
    """Validate a nested mapping into settings.

    Raises:
        SettingsError: One line naming the first offending field by its dotted path, its value and
            what is expected.
    """
    try:
        return cls.model_validate(dict(values or {}))
    except ValidationError as error:
        raise _explain(cls, error) from None


def apply_overrides(settings: S, overrides: Mapping[str, Any]) -> S:
    """Copy settings with some fields replaced.

    Args:
        settings: The settings to start from.
        overrides: Dotted name to value. Text is parsed by the field's type: ``"0.5"``, ``"true"`` and ``"[1,2]"`` for
            numbers, booleans and lists, as on the command line; a field of text takes it as it is.

    Raises:
        SettingsError: Unknown name (with a did-you-mean), or a value that does not fit.
    """
    values = settings.model_dump()
    leaves = {name: field for name, field, _ in _leaves(type(settings))}
    for name, value in overrides.items():
        if name not in leaves:
            is_group = any(field.startswith(f"{name}.") for field in leaves)
            if is_group:
                raise SettingsError(f"setting '{name}' is a group", f"set one of {name}.*")
            raise SettingsError(f"unknown setting '{name}'", did_you_mean(name, leaves))

        # go down to the group that holds the field
        *groups, field_name = name.split(".")
        group = values
        for key in groups:
            group = group[key]
        group[field_name] = _parse(value, leaves[name].annotation)
    return build(type(settings), values)


def parse_assignments(assignments: Iterable[str]) -> dict[str, str]:
    """Split ``a.b=1`` strings of the command line.

    Raises:
        SettingsError: An assignment has no ``=`` or no name.
    """
    values = {}
    for text in assignments:
        name, separator, value = text.partition("=")
        if not separator or not name.strip():
            raise SettingsError(f"'{text}' is not an assignment", "write it as --set name=value")
        values[name.strip()] = value.strip()
    return values


def flatten(settings: Settings) -> dict[str, Any]:
    """Dotted name to value of every leaf field."""
    return {name: attrgetter(name)(settings) for name in field_names(type(settings))}


def field_names(cls: type[Settings]) -> list[str]:
    """Dotted names of every leaf field, tunable or not, in order of definition."""
    return [name for name, _, _ in _leaves(cls)]


def parameters(cls: type[Settings], *, online_only: bool = False) -> list[Parameter]:
    """The fields of a settings class that studies tune, in order of definition.

    Args:
        cls: The settings class.
        online_only: The online fields instead, whether studies tune them or not.
    """
    described = _described_parameters(cls)
    if online_only:
        return [parameter for parameter in described if parameter.online]
    return [parameter for parameter in described if parameter.tunable]


@cache
def _described_parameters(cls: type[Settings]) -> tuple[Parameter, ...]:
    """Every field that `tunable` made, in order of definition."""
    return tuple(
        _describe(name, field, default)
        for name, field, default in _leaves(cls)
        if _annotation(field, _TUNABLE) is not None
    )


def settings_table(cls: type[Settings]) -> str:
    """Markdown table of every leaf field: name, default, range, unit, online, meaning."""
    described = {parameter.name: parameter for parameter in _described_parameters(cls)}
    rows = [
        "| setting | default | range | unit | online | meaning |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, field, default in _leaves(cls):
        parameter = described.get(name)
        if parameter is None:
            search = " |  | "
        else:
            online = "yes" if parameter.online else ""
            search = f"{_range_text(parameter)} | {parameter.unit} | {online}"
        default_text = json.dumps(default, default=str)
        rows.append(f"| `{name}` | `{default_text}` | {search} | {field.description or ''} |")
    return "\n".join(rows) + "\n"


def _range_text(parameter: Parameter) -> str:
    """The values that a study may choose, in Markdown: ``0.1 to 5 (log)``."""
    if parameter.kind == "categorical":
        return ", ".join(f"`{choice}`" for choice in parameter.choices)
    if parameter.kind == "bool":
        return "`false`, `true`"
    scale = " (log)" if parameter.scale == "log" else ""
    return f"{parameter.low:g} to {parameter.high:g}{scale}"


def _leaves(
    cls: type[Settings], prefix: str = "", defaults: Settings | None = None
) -> Iterator[tuple[str, FieldInfo, Any]]:
    """The leaf fields of a settings class, in order of definition.

    Args:
        cls: The class.
        prefix: Begins every name; ends in a dot, or is empty.
        defaults: The group's values where the class around it gives it other defaults than its own.

    Yields:
        Dotted name, field, and default.
    """
    for key, field in cls.model_fields.items():
        group = _group_class(field)
        default = _default(field) if defaults is None else getattr(defaults, key)
        if group is None:
            yield f"{prefix}{key}", field, default
            continue
        group_defaults = default if isinstance(default, Settings) else None
        yield from _leaves(group, f"{prefix}{key}.", group_defaults)


def _default(field: FieldInfo) -> Any:
    """A field's default; pydantic's own way to ask copies whole groups, which cannot change."""
    if isinstance(field.default, Settings):
        return field.default
    return field.get_default(call_default_factory=True)


def _group_class(field: FieldInfo) -> type[Settings] | None:
    """The settings class of a field that holds a group; None for a leaf."""
    kind = field.annotation
    # Python 3.10 takes tuple[float, ...] for a class, too
    if typing.get_origin(kind) is None and isinstance(kind, type) and issubclass(kind, Settings):
        return kind
    return None


def _annotation(field: FieldInfo, key: str) -> dict[str, Any] | None:
    """The value that `tunable` or `names` stored with a field under a key; None where nothing is stored."""
    extra = field.json_schema_extra
    if not isinstance(extra, dict):
        return None
    return typing.cast("dict[str, Any] | None", extra.get(key))


def _describe(name: str, field: FieldInfo, default: Any) -> Parameter:
    """The parameter that a tunable field is.

    Raises:
        TypeError: Its type has neither a range nor choices.
    """
    annotation = _annotation(field, _TUNABLE)
    assert annotation is not None

    # an optional field is searched over the values of its other type
    kinds = [kind for kind in _alternatives(field.annotation) if kind is not type(None)]
    base = kinds[0] if len(kinds) == 1 else field.annotation

    choices: tuple[Scalar, ...] = ()
    if base is bool:
        choices = (False, True)
    elif typing.get_origin(base) is Literal:
        choices = typing.get_args(base)

    has_range = annotation["low"] is not None and annotation["high"] is not None
    if not choices and not (base in (int, float) and has_range):
        raise TypeError(
            f"tunable field '{name}' of type {base} needs low and high, or a bool or Literal type"
        )
    kind: Any = base.__name__ if base in (bool, int, float) else "categorical"
    meaning = field.description or ""
    return Parameter(name, kind, default, choices=choices, meaning=meaning, **annotation)


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """The types that a union allows; a type that is no union by itself."""
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return typing.get_args(annotation) if is_union else (annotation,)


def _parse(value: Any, annotation: Any) -> Any:
    """A text becomes the JSON value that it spells, unless the field takes the text itself; all else stays as it is."""
    if not isinstance(value, str):
        return value

    kinds = _alternatives(annotation)
    literals: list[Any] = []
    for kind in kinds:
        if typing.get_origin(kind) is Literal:
            literals += typing.get_args(kind)

    takes_text = str in kinds or Path in kinds or value in literals
    is_none = value == "null" and type(None) in kinds
    if takes_text and not is_none:
        return value
    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        return value


def _explain(cls: type[Settings], error: ValidationError) -> SettingsError:
    """One line on the first fault that pydantic found."""
    first = error.errors()[0]
    name = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        return SettingsError(f"unknown setting '{name}'", did_you_mean(name, field_names(cls)))
    message = first["msg"][0].lower() + first["msg"][1:]
    return SettingsError(f"setting '{name}' is {shown(first['input'])}: {message}")


def shown(value: Any) -> str:
    """A value for a message; one of thousands of digits or characters is cut short."""
    try:
        text = repr(value)
    except ValueError:  # more digits than Python writes out
        return "a number of thousands of digits"
    return text if len(text) <= 200 else f"{text[:200]}..."


# -- online reconfiguration ------------------------------------------------------------------------


@runtime_checkable
class Reconfigurable(Protocol):
    """A part whose online settings may change in mid-episode."""

    def configure(self, settings: Any) -> None:
        """Put settings into force from the next frame on.

        Args:
            settings: All settings of the part, of the class that it was built with; only fields
                marked ``online`` differ from those in force.
        """


def online_parameters(settings: Settings) -> list[Parameter]:
    """The online settings that have an effect with these settings (see `why_unused`), in order of definition."""
    online = parameters(type(settings), online_only=True)
    return [parameter for parameter in online if not why_unused(settings, parameter.name)]


def why_unused(settings: Settings, name: str) -> str:
    """Why a field has no effect with these settings, for a message; empty where it has one."""
    group: Settings = settings
    # the field may be without effect at every level of its dotted name
    for part in name.split("."):
        reason = group.unused.get(part, "")
        if reason:
            return reason
        if part != "enabled" and not getattr(group, "enabled", True):
            return f"{type(group).__name__} is not enabled"
        group = getattr(group, part)
    return ""


class OnlineSettings:
    """Hands the groups of a system's settings to the parts of the system that take them.

    Args:
        settings: The complete settings that the system was built with.
        parts: Name of a group and what takes its settings; several parts may take one group.

    Raises:
        SettingsError: An online setting that has an effect lies in a group that no part takes.
    """

    def __init__(
        self, settings: Settings, parts: Iterable[tuple[str, Callable[[Any], None]]]
    ) -> None:
        self._built = settings
        self._in_force = settings
        self._parts = tuple(parts)
        for parameter in online_parameters(settings):
            group = parameter.name.split(".")[0]
            if group not in dict(self._parts):
                raise SettingsError(
                    f"online setting '{parameter.name}' of {type(settings).__name__} is taken by no part of the system",
                    f"give the part a method configure(settings) and the group '{group}', "
                    "or leave the group out of the settings",
                )

    def configure(self, settings: Settings) -> None:
        """Hand the groups that differ from those in force to their parts."""
        for group, take in self._parts:
            wanted = getattr(settings, group)
            if wanted != getattr(self._in_force, group):
                take(wanted)
        self._in_force = settings

    def restore(self) -> None:
        """Hand every part the settings that it was built with."""
        for group, take in self._parts:
            take(getattr(self._built, group))
        self._in_force = self._built
