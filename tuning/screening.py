"""From where and by how much a screening moves each setting: the default, points near it, a step of each from each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.tuning.evaluate import InstanceFailedError
from dynslam_bench.tuning.objectives import Objective, Outcomes

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


# Which settings matter, before any study: one at a time from several points (Morris 1991), with chaos taken off.

KEPT = 8
"""So many settings at most are worth a study."""
FEWEST_INSTANCES = 2


class Effect(Record):
    """What one setting does.

    Attributes:
        name: The setting.
        objective: In what: see `Objective.what`.
        size: Root mean square over the points of the mean log ratio that a third of the range makes, free of chance.
        low: Lower end of its 90 % interval over instances (jackknife); above 0 where the setting matters.
        high: Upper end.
        dead: It changed nothing, to the last bit, at any point on any instance.
    """

    name: str
    objective: str
    size: float
    low: float
    high: float
    dead: bool = False


class Screening(Record):
    """What a screening found.

    Attributes:
        effects: Of each setting the largest over the objectives; the one most surely felt first.
        kept: At most `KEPT` settings worth a study; empty where none matters more than chance.
        dead: Settings that changed nothing, to the last bit, on any of the instances.
        failed: Settings whose step broke a run, and how.
        points: From how many points.
        instances: On how many instances.
        runs: How many runs that took.
    """

    effects: list[Effect]
    kept: list[str]
    dead: list[str]
    failed: dict[str, str]
    points: int
    instances: int
    runs: int


def screen(
    points: Sequence[Point],
    run: Callable[[Mapping[str, Scalar]], Outcomes],
    objectives: Sequence[Objective],
    *,
    jobs: int = 1,
    on_done: Callable[[int, int], None] | None = None,
) -> Screening:
    """Measure the effect of every setting.

    Args:
        points: From `plan`.
        run: Gives the outcomes of values on the instances, always the same ones.
        objectives: In what effects are looked for.
        jobs: Configurations at a time.
        on_done: Told how many configurations of how many are done.

    Raises:
        StudyError: Fewer than two instances, or the default itself fails.
    """
    try:
        bases = [run(point.base) for point in points[:1]]
    except InstanceFailedError as error:
        raise StudyError(
            f"the default settings fail: {error.args[0]}", "screening needs a default that runs"
        ) from error
    if len(bases[0]) < FEWEST_INSTANCES:
        raise StudyError(f"screening on {len(bases[0])} instance cannot tell an effect from chance", "name two or more")
    names = list(points[0].base)
    todo: list[tuple[int, str | None]] = [(number, None) for number in range(1, len(points))]
    todo += [(number, name) for number in range(len(points)) for name in names]
    failed: dict[str, str] = {}
    done = [1]

    def one(item: tuple[int, str | None]) -> Outcomes | None:
        number, name = item
        point = points[number]
        try:
            return run(point.base if name is None else {**point.base, name: point.steps[name]})
        except InstanceFailedError as error:
            failed.setdefault(name or "a point near the default", error.args[0])
            return None
        finally:
            done[0] += 1
            if on_done is not None:
                on_done(done[0], len(todo) + 1)

    with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-screen") as pool:
        found = dict(zip(todo, pool.map(one, todo), strict=True))
    found[(0, None)] = bases[0]
    effects = [_effect_of(name, found, len(points), objectives) for name in names]
    measured = sorted((e for e in effects if e is not None), key=lambda e: (-e.low, -e.size))
    kept = [effect.name for effect in measured if effect.low > 0][:KEPT]
    dead = [effect.name for effect in measured if effect.dead]
    instances = len(bases[0])
    return Screening(effects=measured, kept=kept, dead=dead, failed=failed, points=len(points), instances=instances,
                     runs=instances * len(found))  # fmt: skip


def size_of(effects: NDArray[np.float64]) -> tuple[float, float, float]:
    """How large the mean effect over instances is, and its 90 % interval.

    The square of a mean holds the variance of the mean besides; that is taken off, so that a setting that does nothing
    but stir the chaos has 0 on average.

    Args:
        effects: Log ratios ``[points, instances]``.

    Returns:
        Size, lower and upper end; the ends are jackknife intervals over instances, with Student's t.
    """
    instances = effects.shape[1]

    def square(sample: NDArray[np.float64]) -> float:
        count = sample.shape[1]
        chance = sample.var(axis=1, ddof=1) / count if count > 1 else 0.0
        return float(np.mean(sample.mean(axis=1) ** 2 - chance))

    whole = square(effects)
    if instances < 3:
        half = math.inf if effects.any() else 0.0
    else:
        left_out = np.array([square(np.delete(effects, index, axis=1)) for index in range(instances)])
        scatter = (instances - 1) / instances * float(((left_out - left_out.mean()) ** 2).sum())
        half = float(stats.t.ppf(0.95, instances - 1)) * math.sqrt(scatter)
    ends = [math.sqrt(max(0.0, value)) if math.isfinite(value) else math.inf for value in (whole - half, whole + half)]
    return math.sqrt(max(0.0, whole)), 0.0 if math.isinf(half) else ends[0], ends[1]


def _effect_of(
    name: str, found: Mapping[tuple[int, str | None], Outcomes | None], points: int, objectives: Sequence[Objective]
) -> Effect | None:
    """The effect on the objective that shows it most; None where all its steps broke a run."""
    pairs = [(found[(number, None)], found[(number, name)]) for number in range(points)]
    usable = [(base, moved) for base, moved in pairs if base is not None and moved is not None]
    if not usable:
        return None
    dead = all(
        (base[instance].ate_m, base[instance].coverage) == (outcome.ate_m, outcome.coverage)
        for base, moved in usable
        for instance, outcome in moved.items()
    )
    best: Effect | None = None
    for objective in objectives:
        logs = np.array(
            [
                [
                    math.log(objective.cost(outcome) / objective.cost(base[instance]))
                    for instance, outcome in moved.items()
                ]
                for base, moved in usable
            ]
        )
        size, low, high = size_of(logs)
        effect = Effect(name=name, objective=objective.what, size=size, low=low, high=high, dead=dead)
        best = effect if best is None or (effect.low, effect.size) > (best.low, best.size) else best
    return best
