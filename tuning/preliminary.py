"""Before a study: a screening finds the settings that matter, a pilot measures what the instances could show at all.

Screening (elementary effects, Morris 1991): each setting is moved by a step from the default and from points near it.
Any change of a run has a random effect on its error; the mean effect over instances is compared with its scatter.

Pilot: how far two configurations differ on one instance is mostly chance, as a start one frame later changes the
result. The pilot measures that spread with a few changed settings, and computes the smallest effect that the study
could tell from nothing (one-sided 2.5 %, with 80 % of the studies finding it).
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
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
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.objectives import ACCURACY, Objective, Outcomes, together
from dynslam_bench.tuning.samplers import from_unit, to_unit
from dynslam_bench.tuning.space import distribution
from dynslam_bench.tuning.tuner import OnEvent, StudyEvent, Tuner

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


PILOT_FILE = "pilot.json"
EFFECTS = (0.05, 0.10, 0.20)
"""Gains, as shares, of which the pilot says what they would take."""
HOPELESS = 0.5
"""A study that could not even tell a gain of half is refused."""
DOUBTFUL = 0.2
"""One that could not tell a gain of a fifth is warned about."""
CONFIGURATIONS = 2
"""Changed settings that a pilot tries."""
PILOT_SCENES, PILOT_STARTS = 6, 3
FEWEST = 3
"""Scenes that a spread can be told from."""
_LEVEL, _POWER = 0.975, 0.8
_MOST_SCENES = 100_000


class Need(Record):
    """What one effect would take.

    Attributes:
        effect: The gain, as a share.
        scenes: Different scenes, each with as many starts as in the pilot.
        instances: Runs of one configuration on them.
        minutes: Wall-clock time of those, at the pilot's seconds a run and its jobs.
    """

    effect: float
    scenes: int
    instances: int
    minutes: float


class Pilot(Record):
    """The result of a pilot; all spreads are of natural logarithms of ratios.

    Attributes:
        objective: What the ratio is one of.
        scenes: Different scenes that they ran on.
        starts: Starts a scene.
        within: Standard deviation between starts of one scene.
        between: Standard deviation between scenes, that within taken off.
        run_s: Seconds of one run.
        detectable: Smallest gain, as a share, that all instances of the split could tell from nothing.
        needs: What `EFFECTS` would take.
    """

    objective: str
    scenes: int
    starts: float
    within: float
    between: float
    run_s: float
    detectable: float
    needs: list[Need]

    @property
    def sentence(self) -> str:
        """What may be hoped for, in one sentence."""
        return (
            f"{self.scenes} scenes with {self.starts:g} starts can tell a gain of {100 * self.detectable:.0f} % in "
            f"{self.objective} from nothing (spread of the log ratio: {self.within:.2f} between starts, "
            f"{self.between:.2f} between scenes)"
        )

    @property
    def warning(self) -> str:
        """Why the study promises little; empty if it does not."""
        if self.detectable <= DOUBTFUL:
            return ""
        return f"a smaller gain than {100 * self.detectable:.0f} % will look like nothing here; {self.way_out}"

    @property
    def way_out(self) -> str:
        """What a gain of a fifth would take."""
        need = self.needs[-1]
        return (
            f"{100 * need.effect:.0f} % would take {need.scenes} scenes ({need.instances} runs, {need.minutes:.0f} min)"
        )


def spread(logs: Mapping[ProblemInstance, float]) -> tuple[float, float]:
    """Standard deviations of one configuration's log ratios: between starts of a scene, and between scenes.

    One-way analysis of variance; the scenes' part is free of that of the starts, and 0 where it would be negative. With
    one start a scene the two cannot be told apart, and all counts as between scenes.
    """
    groups = [np.array([logs[instance] for instance in instances]) for instances in scenes(logs).values()]
    counts = np.array([len(group) for group in groups])
    inside = sum(float(((group - group.mean()) ** 2).sum()) for group in groups)
    free = int((counts - 1).sum())
    within = inside / free if free else 0.0
    means = float(np.var([group.mean() for group in groups], ddof=1)) if len(groups) > 1 else 0.0
    between = max(0.0, means - within * float(np.mean(1 / counts)))
    return math.sqrt(within), math.sqrt(between)


def detectable(within: float, between: float, count: int, starts: float) -> float:
    """Smallest gain, as a share, that so many scenes can tell from nothing; 1 for fewer than two."""
    if count < 2:
        return 1.0
    error = math.sqrt((between**2 + within**2 / starts) / count)
    factor = stats.t.ppf(_LEVEL, count - 1) + stats.t.ppf(_POWER, count - 1)
    return float(1 - math.exp(-factor * error))


def scenes_needed(effect: float, within: float, between: float, starts: float) -> int:
    """The fewest scenes that tell a gain from nothing, at most `_MOST_SCENES`."""
    counts = range(2, _MOST_SCENES)
    return 2 + bisect_left(counts, True, key=lambda count: detectable(within, between, count, starts) <= effect)


def begin(tuner: Tuner, *, jobs: int = 1, on_event: OnEvent | None = None) -> None:
    """Run a new study's pilot, if it asks for one, and report what it shows.

    Raises:
        StudyError: Not even a gain of half would be told from nothing.
    """
    if not tuner.spec.pilot or (tuner.folder / PILOT_FILE).is_file() or tuner.study.get_trials(deepcopy=False)[1:]:
        return
    pilot, texts = None, [f"no pilot: it takes {FEWEST} scenes to tune on"]
    if len(scenes(tuner.design.tune)) >= FEWEST:
        pilot = pilot_of(tuner, jobs=jobs)
        texts = [pilot.sentence, *filter(None, [pilot.warning])]
    for text in texts:
        if on_event is not None:
            on_event(StudyEvent("pilot", 0, 1, text))
    speed_alone = tuner.spec.at_equal_accuracy  # settings that leave the poses alone show their speed
    if pilot is not None and not speed_alone and pilot.detectable > HOPELESS:
        raise StudyError(f"this study could show nothing: {pilot.sentence}; {pilot.way_out}", "or pilot = false to try")


def pilot_of(tuner: Tuner, *, jobs: int = 1) -> Pilot:
    """Run the default and a few changed settings, and judge what they say; `PILOT_FILE` in the study's folder holds it.

    It looks at the study's own objectives, or at accuracy where a gain counts only at equal accuracy, and at the
    instances that the study would judge on, or its own where those are of too few scenes.

    Raises:
        StudyError: The default settings fail, all changed ones do, or there are too few scenes to tell a spread.
    """
    chosen = some_of(tuner.design.reference)
    objective = ACCURACY if tuner.spec.at_equal_accuracy else together(tuner.objectives)
    count = len(scenes(chosen))
    if count < FEWEST:
        raise StudyError(
            f"a pilot over {count} scene{'s' * (count != 1)} says nothing, it takes {FEWEST}",
            'name more scenes, e.g. "synthetic/walking_xyz?scene=0-5&frames=80&offsets=0-2"',
        )
    default = tuner.default_outcomes(chosen, jobs=jobs)
    began, spreads, reason = time.perf_counter(), [], ""
    for number in range(CONFIGURATIONS):
        change = small_change(tuner.space, tuner.base, stream(tuner.spec.sampler_seed, "pilot", number))
        try:
            outcomes = tuner.evaluate({**tuner.spec.space.fixed, **change}, chosen, jobs=jobs)
            spreads.append(spread(objective.log_ratios(outcomes, default)))
        except InstanceFailedError as error:
            reason = str(error.args[0])
    if not spreads:
        raise StudyError(f"no pilot: all settings tried near the default fail: {reason}", "narrow the space")
    run_s = (time.perf_counter() - began) * jobs / (CONFIGURATIONS * len(chosen))
    within, between = np.sqrt(np.square(spreads).mean(axis=0)).tolist()
    judged = scenes(tuner.design.held_out)
    judged = judged if len(judged) >= FEWEST else scenes(chosen)
    starts = sum(map(len, judged.values())) / len(judged)
    needs = []
    for effect in EFFECTS:
        count = scenes_needed(effect, within, between, starts)
        runs = math.ceil(count * starts)
        needs.append(Need(effect=effect, scenes=count, instances=runs, minutes=math.ceil(runs / jobs) * run_s / 60))
    pilot = Pilot(
        objective=objective.what, scenes=len(judged), starts=round(starts, 2), within=within,
        between=between, run_s=run_s, detectable=detectable(within, between, len(judged), starts), needs=needs,
    )  # fmt: skip
    write_atomic(tuner.folder / PILOT_FILE, pilot.to_json())
    return pilot


def some_of(instances: Sequence[ProblemInstance]) -> list[ProblemInstance]:
    """The first starts of the first scenes: `PILOT_STARTS` of `PILOT_SCENES` at most."""
    groups = list(scenes(instances).values())[:PILOT_SCENES]
    return [instance for group in groups for instance in group[:PILOT_STARTS]]


def small_change(space: Sequence[Parameter], base: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Scalar]:
    """Settings near the default: numbers moved toward drawn ones; choices too where there are no numbers."""
    changed = {parameter.name: toward(parameter, base[parameter.name], rng) for parameter in space}
    if any(changed[name] != base[name] for name in changed):
        return changed
    return {parameter.name: stepped(parameter, base[parameter.name], rng) for parameter in space}
