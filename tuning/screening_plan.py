"""From where and by how much a screening moves each setting: the default, points near it, a step of each from each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Parameter, Scalar

STEP = 1 / 3
"""How far a setting is moved, as a share of its range (of its logarithm where its scale is that)."""
NEARNESS = 0.3
"""How far from the default the further points lie, as a share of the way to a drawn one: broken systems tell little."""
Values = dict[str, Scalar]


@dataclass(frozen=True)
class Point:
    """Where effects are measured from, and the steps from there.

    Attributes:
        base: Values of all screened settings.
        steps: Value of each setting after its step.
    """

    base: Values
    steps: Values


def plan(space: Sequence[Parameter], base: Mapping[str, Any], points: int, seed: int) -> list[Point]:
    """The points: the default first, then others near it; a step of each setting from each.

    Settings that another one switches off at the default are no part of it: see `live`.
    """
    found = []
    for number in range(points):
        rng = stream(seed, "screening", number)
        start = {p.name: base[p.name] if number == 0 else toward(p, base[p.name], rng) for p in space}
        if number > 0:  # what switches others off stays as it is
            start |= {name: base[name] for p in space for name, _ in p.when if name in start}
        found.append(Point(start, {p.name: stepped(p, start[p.name], rng) for p in space}))
    return found


def live(space: Sequence[Parameter], base: Mapping[str, Any]) -> list[Parameter]:
    """The settings whose conditions hold at the default."""
    return [p for p in space if all(base.get(name) in allowed for name, allowed in p.when)]


def stepped(parameter: Parameter, value: Scalar, rng: np.random.Generator) -> Scalar:
    """Another value, `STEP` of the range away; up or down as there is room, at random where there is for both."""
    if parameter.kind in ("bool", "categorical"):
        others = [choice for choice in parameter.choices if choice != value]
        return others[int(rng.integers(len(others)))] if others else value
    unit = _unit(parameter, value)
    signs = [sign for sign in (-1, 1) if 0 <= unit + sign * STEP <= 1]
    moved = _value(parameter, unit + STEP * (signs[int(rng.integers(len(signs)))] if signs else 1))
    if moved == value and parameter.kind == "int":  # a short range
        moved = int(value) + (1 if value < parameter.high else -1)  # type: ignore[operator]
    return moved


def toward(parameter: Parameter, value: Scalar, rng: np.random.Generator) -> Scalar:
    """Part of the way to a drawn value; switches and choices stay."""
    if parameter.kind in ("bool", "categorical"):
        return value
    unit = _unit(parameter, value)
    return _value(parameter, unit + NEARNESS * (float(rng.uniform()) - unit))


def _unit(parameter: Parameter, value: Scalar) -> float:
    """Where in its range a number lies, 0 to 1."""
    low, high, x = _scaled(parameter, float(value))
    return min(max((x - low) / (high - low), 0.0), 1.0)


def _value(parameter: Parameter, unit: float) -> Scalar:
    low, high, _ = _scaled(parameter, 1.0)
    x = low + min(max(unit, 0.0), 1.0) * (high - low)
    value = math.exp(x) if parameter.scale == "log" else x
    assert parameter.low is not None and parameter.high is not None
    value = min(max(value, parameter.low), parameter.high)
    return round(value) if parameter.kind == "int" else value


def _scaled(parameter: Parameter, value: float) -> tuple[float, float, float]:
    """Ends of the range and a value, as logarithms where the scale is that."""
    assert parameter.low is not None and parameter.high is not None
    if parameter.scale == "log":
        return math.log(parameter.low), math.log(parameter.high), math.log(max(value, parameter.low))
    return float(parameter.low), float(parameter.high), value
