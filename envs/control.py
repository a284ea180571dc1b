"""Steering a tracker's online settings with a normalised action."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dynslam_bench.core.errors import SettingsError, did_you_mean
from dynslam_bench.core.settings import Parameter, Scalar, Settings, apply_overrides, flatten, parameters, value_of
from dynslam_bench.core.steering import why_idle

_ONLY = spaces.Discrete(1)
"""The action space without steered settings; for membership alone, since each environment seeds its own."""


class ActionMap:
    """Maps actions to settings.

    Without steered settings the action space is ``Discrete(1)``: the only action lets the tracker be. Otherwise it is
    ``Box(-1, 1, (k,), float32)``, one coordinate a setting, in the order of `control`. With ``u = (a + 1) / 2``:

    - float: ``low + u * (high - low)``, or ``low * (high / low) ** u`` on a log scale;
    - int: the same, rounded to the nearest integer;
    - bool and categorical: the ``floor(u * n)``-th of the n choices, each with an equal share of the axis.

    A coordinate that is that of the neutral action leaves its setting exactly as it is in `settings`; an action has 24
    bits a coordinate, from which most values come back changed in the last places.

    Args:
        settings: The settings of the episode; what is not steered stays as it is here.
        control: Dotted names of online settings.

    Raises:
        SettingsError: A name is unknown or given twice, or its setting may not change in mid-episode, has no effect
            with these settings, or has a value outside the range that actions span.
    """

    def __init__(self, settings: Settings, control: Sequence[str]) -> None:
        self.base = settings
        self.parameters: tuple[Parameter, ...] = _select(settings, control)
        for parameter in self.parameters:
            _check_effect(settings, parameter)
        self._values = {parameter.name: value_of(settings, parameter.name) for parameter in self.parameters}
        self._neutral = self.encode(settings)

    @property
    def neutral(self) -> NDArray[np.float32]:
        """The action ``[k]`` that leaves the settings exactly as they are."""
        return self._neutral.copy()

    @property
    def names(self) -> tuple[str, ...]:
        """Dotted names of the steered settings, in the order of the action's coordinates."""
        return tuple(parameter.name for parameter in self.parameters)

    def space(self) -> spaces.Space[NDArray[np.float32]] | spaces.Discrete:
        """The action space."""
        if not self.parameters:
            return spaces.Discrete(1)
        return spaces.Box(-1.0, 1.0, (len(self.parameters),), np.float32)

    def settings(self, action: object) -> Settings:
        """The settings that an action asks for.

        Args:
            action: float ``[k]``; values beyond [-1, 1] are clipped. Without steered settings 0.

        Raises:
            SettingsError: The action is none of the space: not 0, of another shape, no numbers, or NaN.
        """
        if not self.parameters:
            if not _ONLY.contains(action):
                raise SettingsError(
                    f"the action {reprlib.repr(action)} is not in {_ONLY}",
                    "without control the only action is 0; name settings in control to change them",
                )
            return self.base
        return apply_overrides(self.base, self.values(action))

    def values(self, action: object) -> dict[str, Scalar]:
        """Dotted name to value of the steered settings under an action."""
        try:
            vector = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise SettingsError(
                f"the action {reprlib.repr(action)} holds no numbers", f"one in [-1, 1] for each of {self.names}"
            ) from None
        if vector.shape != (len(self.parameters),):
            raise SettingsError(
                f"the action has shape {vector.shape}, {len(self.parameters)} settings are steered: {self.names}"
            )
        if np.isnan(vector).any():
            raise SettingsError(f"the action holds NaN: {vector.tolist()}")
        shares = (np.clip(vector, -1.0, 1.0) + 1.0) / 2.0
        asked = zip(self.parameters, shares, vector.astype(np.float32) == self._neutral, strict=True)
        return {p.name: self._values[p.name] if same else _decode(p, float(u)) for p, u, same in asked}

    def encode(self, settings: Settings) -> NDArray[np.float32]:
        """The action ``[k]`` that asks for given settings; values beyond the search range are clipped to its ends."""
        flat = flatten(settings)
        shares = [_encode(p, flat[p.name]) for p in self.parameters]
        return np.asarray(np.clip(2.0 * np.array(shares, dtype=np.float64) - 1.0, -1.0, 1.0), dtype=np.float32)


def _select(settings: Settings, control: Sequence[str]) -> tuple[Parameter, ...]:
    if isinstance(control, str):
        raise SettingsError(f"control is the string '{control}'", "give a list of setting names")
    tunable = {parameter.name: parameter for parameter in parameters(type(settings))}
    online = {name: parameter for name, parameter in tunable.items() if parameter.online}
    chosen = []
    for name in control:
        if name not in online:
            if name in tunable or name in flatten(settings):
                raise SettingsError(f"setting '{name}' may not change in mid-episode", did_you_mean(name, online))
            hint = did_you_mean(name, online) or "this tracker has no online settings"
            raise SettingsError(f"unknown setting '{name}' in control", hint)
        if online[name] in chosen:
            raise SettingsError(f"setting '{name}' is given twice in control")
        chosen.append(online[name])
    return tuple(chosen)


def _check_effect(settings: Settings, parameter: Parameter) -> None:
    if idle := why_idle(settings, parameter):
        raise SettingsError(f"setting '{parameter.name}' in control has no effect: {idle}", "leave it out of control")
    value = value_of(settings, parameter.name)
    if parameter.low is not None and parameter.high is not None and not parameter.low <= value <= parameter.high:
        raise SettingsError(
            f"setting '{parameter.name}' in control is {value:g}, actions span {parameter.low:g} to {parameter.high:g}",
            "set it within, or leave it out of control",
        )


def _decode(parameter: Parameter, share: float) -> Scalar:
    if parameter.kind in ("bool", "categorical"):
        return parameter.choices[min(int(share * len(parameter.choices)), len(parameter.choices) - 1)]
    assert parameter.low is not None and parameter.high is not None
    low, high = float(parameter.low), float(parameter.high)
    value = low * (high / low) ** share if parameter.scale == "log" else low + share * (high - low)
    value = min(max(value, low), high)  # rounding may carry a power a hair beyond its end
    return round(value) if parameter.kind == "int" else value


def _encode(parameter: Parameter, value: Scalar) -> float:
    if parameter.kind in ("bool", "categorical"):
        return (parameter.choices.index(value) + 0.5) / len(parameter.choices)
    assert parameter.low is not None and parameter.high is not None
    low, high, x = float(parameter.low), float(parameter.high), float(value)
    if parameter.scale == "log":
        return math.log(max(x, low) / low) / math.log(high / low)
    return (x - low) / (high - low)
