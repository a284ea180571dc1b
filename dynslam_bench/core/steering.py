"""Changing settings in mid-episode: the one contract of everything that has online settings.

A *part* (a feature extractor, a filter, the back end, a whole tracker) that has fields marked ``online=True`` has a
method `configure`, which takes its settings; they are in force from the next frame on. The system's `reset` brings back
those that it was built with. `Steering` hands the groups of a system's settings to the parts that take them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, runtime_checkable

from .errors import SettingsError
from .settings import Parameter, Settings, parameters, value_of


@runtime_checkable
class Steerable(Protocol):
    """A part whose online settings may change in mid-episode."""

    def configure(self, settings: Any) -> None:
        """Put settings into force from the next frame on.

        Args:
            settings: All settings of the part, of the class that it was built with; only fields marked ``online``
                differ from those in force.
        """
        ...


def steerable_parameters(settings: Settings) -> list[Parameter]:
    """The online settings that have an effect with these settings, in order of definition.

    A parameter is left out where a condition of its (``when``) does not hold, where a group that it lies in is idle
    (`Settings.idle`), or where it or its group has no effect as the rest is set (`Settings.unused`).
    """
    return [each for each in parameters(type(settings), online_only=True) if not why_idle(settings, each)]


def why_idle(settings: Settings, parameter: Parameter) -> str:
    """Why a parameter has no effect with these settings, for a message; empty where it has one."""
    if reason := why_unused(settings, parameter.name):
        return reason
    for name, allowed in parameter.when:
        if (value := value_of(settings, name)) not in allowed:
            return f"{name} is {value!r}"
    return ""


def why_unused(settings: Settings, name: str) -> str:
    """Why nothing reads a field, as the fields that are not tunable stand; empty where something does."""
    node: Settings = settings
    for part in name.split("."):
        if reason := node.idle or node.unused.get(part, ""):
            return reason
        node = getattr(node, part)
    return ""


class Steering:
    """Which part takes which group of a system's settings.

    Args:
        settings: The complete settings that the system was built with.
        parts: Name of a group and what takes its settings; several parts may take one group.

    Raises:
        SettingsError: An online setting that has an effect lies in a group that no part takes.
    """

    def __init__(self, settings: Settings, parts: Iterable[tuple[str, Callable[[Any], None]]]) -> None:
        self._built = self._in_force = settings
        self._parts = tuple(parts)
        taken = {group for group, _ in self._parts}
        for parameter in steerable_parameters(settings):
            group = parameter.name.split(".")[0]
            if group not in taken:
                raise SettingsError(
                    f"online setting '{parameter.name}' of {type(settings).__name__} is taken by no part of the system",
                    f"give the part a method configure(settings) and the group '{group}', "
                    "or leave the group out of the settings",
                )

    def configure(self, settings: Settings) -> None:
        """Hand the groups that differ from those in force to their parts."""
        for group, take in self._parts:
            if (given := getattr(settings, group)) != getattr(self._in_force, group):
                take(given)
        self._in_force = settings

    def restore(self) -> None:
        """Hand every part the settings that it was built with."""
        for group, take in self._parts:
            take(getattr(self._built, group))
        self._in_force = self._built
