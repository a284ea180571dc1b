"""Screening: which settings matter, by elementary effects (Morris 1991), with chance taken off.

Each setting is moved by a step from the default and from points near it. Any change of a run
has a random effect on its error; the mean effect over instances is compared with its scatter over instances.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record, write_atomic
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.tuning.evaluate import InstanceFailedError
from dynslam_bench.tuning.objectives import ACCURACY, Objective, Outcomes
from dynslam_bench.tuning.samplers import from_unit, to_unit
from dynslam_bench.tuning.space import distribution
from dynslam_bench.tuning.tuner import Tuner

SCREENING_FILE = "screening.json"
SCREENED_INSTANCES = 4
"""Instances that a screening takes if nothing else is asked for."""
STEP = 1 / 3
"""How far a setting is moved, as a share of its range (of its logarithm where its scale is that)."""
NEARNESS = 0.3
"""Distance of the further points from the default, as a share of that to a drawn one: broken systems tell little."""
Values = dict[str, Scalar]


def plan(space: Sequence[Parameter], base: Mapping[str, Any], points: int, seed: int) -> list[tuple[Values, Values]]:
    """Points to move from, the default first, then others near it: their values, and a step of each setting."""
    chosen = []
    for number in range(points):
        rng = stream(seed, "screening", number)
        start = {p.name: base[p.name] if number == 0 else toward(p, base[p.name], rng) for p in space}
        chosen.append((start, {p.name: stepped(p, start[p.name], rng) for p in space}))
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


def screen_study(
    tuner: Tuner, *, points: int = 2, instances: int = SCREENED_INSTANCES, jobs: int = 1,
    on_done: Callable[[int, int], None] | None = None,
) -> Screening:  # fmt: skip
    """Find the settings of a study's space that matter; `SCREENING_FILE` in its folder holds them.

    Args:
        tuner: The study.
        points: From how many points settings are moved: the default and others near it.
        instances: On how many of its instances, of different scenes where there are so many.
        jobs: Configurations at a time.
        on_done: Called with the number of finished configurations and of all.

    Raises:
        StudyError: Fewer than two instances, or the default itself fails.
    """
    chosen = tuner.design.tune[:instances]
    if len(chosen) < FEWEST_INSTANCES:
        raise StudyError(f"screening on {len(chosen)} instance cannot tell an effect from chance", "name two or more")
    starts = plan(tuner.space, tuner.base, points, tuner.spec.sampler_seed)
    names = list(starts[0][0])
    todo: dict[tuple[int, str], Values] = {}
    for number, (start, steps) in enumerate(starts):
        todo[number, ""] = start
        todo |= {(number, name): {**start, name: steps[name]} for name in names}
    failed: dict[str, str] = {}
    outcomes: dict[tuple[int, str], Outcomes] = {}

    def run(number: int, name: str) -> None:
        try:
            outcomes[number, name] = tuner.evaluate({**tuner.spec.space.fixed, **todo[number, name]}, chosen)
        except InstanceFailedError as error:
            failed.setdefault(name or "a point near the default", error.args[0])

    run(0, "")
    if (0, "") not in outcomes:
        text = failed["a point near the default"]
        raise StudyError(f"the default settings fail: {text}", "screening needs a default that runs")
    with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-screen") as pool:
        pending = [pool.submit(run, *key) for key in todo if key != (0, "")]
        for done, future in enumerate(as_completed(pending), start=2):
            future.result()
            if on_done is not None:
                on_done(done, len(todo))
    objectives = list(dict.fromkeys([*tuner.objectives, ACCURACY]))
    effects = [effect for name in names if (effect := _effect_of(name, outcomes, points, objectives))]
    effects.sort(key=lambda effect: (-effect.low, -effect.size))
    screening = Screening(
        effects=effects,
        kept=[effect.name for effect in effects if effect.low > 0][:KEPT],
        dead=[effect.name for effect in effects if effect.dead],
        failed=failed,
        points=points,
        instances=len(chosen),
        runs=len(chosen) * len(todo),
    )
    write_atomic(tuner.folder / SCREENING_FILE, screening.to_json())
    return screening


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
    name: str, outcomes: Mapping[tuple[int, str], Outcomes], points: int, objectives: Sequence[Objective]
) -> Effect | None:
    """The effect on the objective that shows it most; None where all its steps broke a run."""
    measured = [number for number in range(points) if (number, "") in outcomes and (number, name) in outcomes]
    if not measured:
        return None
    pairs = [(outcomes[number, name], outcomes[number, ""]) for number in measured]
    effects, dead = [], all(_errors(moved) == _errors(base) for moved, base in pairs)
    for objective in objectives:
        logs = [list(objective.log_ratios(moved, base).values()) for moved, base in pairs]
        size, low, high = size_of(np.array(logs))
        effects.append(Effect(name=name, objective=objective.what, size=size, low=low, high=high, dead=dead))
    return max(effects, key=lambda effect: (effect.low, effect.size))


def _errors(outcomes: Outcomes) -> list[tuple[float, float]]:
    return [(outcome.ate_m, outcome.coverage) for outcome in outcomes.values()]
