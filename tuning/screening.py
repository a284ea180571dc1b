"""Screening: which settings matter, by elementary effects (Morris 1991), with chance taken off.

Each setting is moved by a step from the default and from points near it. Any change of a run
has a random effect on its error; the mean effect over instances is compared with its scatter over instances.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.tuning.evaluate import InstanceFailedError
from dynslam_bench.tuning.objectives import Objective, Outcomes
from dynslam_bench.tuning.samplers import from_unit, to_unit
from dynslam_bench.tuning.space import distribution

STEP = 1 / 3
"""How far a setting is moved, as a share of its range (of its logarithm where its scale is that)."""
NEARNESS = 0.3
"""Distance of the further points from the default, as a share of that to a drawn one: broken systems tell little."""
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
    """The points: the default first, then others near it; a step of each setting from each."""
    chosen: list[Point] = []
    for number in range(points):
        rng = stream(seed, "screening", number)
        start = {p.name: base[p.name] if number == 0 else toward(p, base[p.name], rng) for p in space}
        chosen.append(Point(start, {p.name: stepped(p, start[p.name], rng) for p in space}))
    return chosen


def stepped(parameter: Parameter, value: Scalar, rng: np.random.Generator) -> Scalar:
    """Another value, `STEP` of the range away; up or down as there is room, at random where there is for both."""
    if parameter.kind in ("bool", "categorical"):
        others = [choice for choice in parameter.choices if choice != value]
        return others[int(rng.integers(len(others)))] if others else value
    span = distribution(parameter)
    unit = min(max(to_unit(value, span), 0.0), 1.0)
    signs = [sign for sign in (-1, 1) if 0 <= unit + sign * STEP <= 1]
    moved = from_unit(unit + STEP * (signs[int(rng.integers(len(signs)))] if signs else 1), span)
    if moved == value and parameter.kind == "int":  # a short range
        moved = int(value) + (1 if value < parameter.high else -1)  # type: ignore[operator]
    return cast("Scalar", moved)


def toward(parameter: Parameter, value: Scalar, rng: np.random.Generator) -> Scalar:
    """A value part of the distance to a drawn one; switches and choices stay."""
    if parameter.kind in ("bool", "categorical"):
        return value
    span = distribution(parameter)
    unit = min(max(to_unit(value, span), 0.0), 1.0)
    return cast("Scalar", from_unit(unit + NEARNESS * (float(rng.uniform()) - unit), span))


# Which settings matter, before any study: one at a time from several points (Morris 1991), with chance taken off.

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
    """The result of a screening.

    Attributes:
        effects: Of each setting the largest over the objectives; the surest first.
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
        base = run(points[0].base)
    except InstanceFailedError as error:
        raise StudyError(
            f"the default settings fail: {error.args[0]}", "screening needs a default that runs"
        ) from error
    if len(base) < FEWEST_INSTANCES:
        raise StudyError(f"screening on {len(base)} instance cannot tell an effect from chance", "name two or more")
    names = list(points[0].base)
    todo: list[tuple[int, str | None]] = [(number, None) for number in range(1, len(points))]
    todo += [(number, name) for number in range(len(points)) for name in names]
    failed: dict[str, str] = {}
    outcomes: dict[tuple[int, str | None], Outcomes] = {(0, None): base}

    def evaluate(number: int, name: str | None) -> None:
        point = points[number]
        try:
            outcomes[number, name] = run(point.base if name is None else {**point.base, name: point.steps[name]})
        except InstanceFailedError as error:
            failed.setdefault(name or "a point near the default", error.args[0])

    with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-screen") as pool:
        pending = [pool.submit(evaluate, number, name) for number, name in todo]
        for done, future in enumerate(as_completed(pending), start=2):
            future.result()
            if on_done is not None:
                on_done(done, len(todo) + 1)
    effects = [effect for name in names if (effect := _effect_of(name, outcomes, len(points), objectives))]
    effects.sort(key=lambda effect: (-effect.low, -effect.size))
    return Screening(
        effects=effects,
        kept=[effect.name for effect in effects if effect.low > 0][:KEPT],
        dead=[effect.name for effect in effects if effect.dead],
        failed=failed,
        points=len(points),
        instances=len(base),
        runs=len(base) * (len(todo) + 1),
    )


def size_of(effects: NDArray[np.float64]) -> tuple[float, float, float]:
    """How large the mean effect over instances is, and its 90 % interval.

    The square of a mean holds the variance of the mean besides; that is taken off, so that a setting that does nothing
    on average has 0.

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
    name: str, outcomes: Mapping[tuple[int, str | None], Outcomes], points: int, objectives: Sequence[Objective]
) -> Effect | None:
    """The effect on the objective that shows it most; None where all its steps broke a run."""
    pairs = [
        (outcomes[number, None], outcomes[number, name])
        for number in range(points)
        if (number, None) in outcomes and (number, name) in outcomes
    ]
    if not pairs:
        return None
    dead = all(
        (base[instance].ate_m, base[instance].coverage) == (outcome.ate_m, outcome.coverage)
        for base, moved in pairs
        for instance, outcome in moved.items()
    )
    effects = []
    for objective in objectives:
        logs = [
            [math.log(objective.cost(outcome) / objective.cost(base[instance])) for instance, outcome in moved.items()]
            for base, moved in pairs
        ]
        size, low, high = size_of(np.array(logs))
        effects.append(Effect(name=name, objective=objective.what, size=size, low=low, high=high, dead=dead))
    return max(effects, key=lambda effect: (effect.low, effect.size))
