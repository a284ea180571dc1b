"""Before a study: what its instances could show at all, and what it would take to show more.

How far two configurations differ on one instance is mostly chance: a start one frame later changes the result. The
pilot measures that spread with a few changed settings, and computes the smallest effect that the study could tell from
nothing (one-sided 2.5 %, with 80 % of the studies finding it).
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.tuning.evaluate import InstanceFailedError
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.objectives import Objective, Outcomes
from dynslam_bench.tuning.screening import stepped, toward

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


def judge_pilot(
    objective: Objective,
    default: Outcomes,
    changed: Sequence[Outcomes],
    *,
    run_s: float,
    jobs: int = 1,
    split: Sequence[ProblemInstance] | None = None,
) -> Pilot:
    """Make a pilot's numbers of its runs.

    Args:
        objective: Whose ratios are looked at.
        default: The default settings' outcomes.
        changed: Outcomes of changed settings, on instances that the default ran on.
        run_s: Seconds of one run.
        jobs: Runs at a time.
        split: Instances that the study would judge on; those of the pilot if None.

    Raises:
        StudyError: Too few scenes to tell a spread, or the changed settings changed nothing.
    """
    pairs = [_paired(objective, outcomes, default) for outcomes in changed]
    count = len(scenes(pairs[0])) if pairs else 0
    if count < FEWEST:
        raise StudyError(
            f"a pilot over {count} scene{'s' * (count != 1)} says nothing, it takes {FEWEST}",
            'name more scenes, e.g. "synthetic/walking_xyz?scene=0-5&frames=80&offsets=0-2"',
        )
    within, between = np.sqrt(np.square([spread(logs) for logs in pairs]).mean(axis=0)).tolist()
    judged = scenes(split if split is not None else list(pairs[0]))
    starts = sum(map(len, judged.values())) / len(judged)
    needs = []
    for effect in EFFECTS:
        count = scenes_needed(effect, within, between, starts)
        runs = math.ceil(count * starts)
        needs.append(Need(effect=effect, scenes=count, instances=runs, minutes=math.ceil(runs / jobs) * run_s / 60))
    return Pilot(
        objective=objective.what, scenes=len(judged), starts=round(starts, 2), within=within,
        between=between, run_s=run_s, detectable=detectable(within, between, len(judged), starts), needs=needs,
    )  # fmt: skip


def refuse_hopeless(pilot: Pilot) -> None:
    """Refuse a study that could not show anything.

    Raises:
        StudyError: Not even a gain of half would be told from nothing.
    """
    if pilot.detectable > HOPELESS:
        raise StudyError(f"this study could show nothing: {pilot.sentence}; {pilot.way_out}", "or pilot = false to try")


def run_pilot(
    space: Sequence[Parameter],
    base: Mapping[str, Any],
    run: Callable[[Mapping[str, Any], Sequence[ProblemInstance]], Outcomes],
    instances: Sequence[ProblemInstance],
    objective: Objective,
    *,
    seed: int = 0,
    jobs: int = 1,
    split: Sequence[ProblemInstance] | None = None,
) -> Pilot:
    """Run the default and a few changed settings, and judge what they say.

    Args:
        space: The study's settings.
        base: Default value of every setting, dotted name to value.
        run: Gives the outcomes of values of the space on instances, `jobs` at a time.
        instances: What the study tunes on; `some_of` them are run.
        objective: See `judge_pilot`, as `split` is.
        seed: Of the changes.
        jobs: Runs at a time.
        split: Instances that the study would judge on.

    Raises:
        StudyError: See `judge_pilot`.
    """
    chosen = some_of(instances)
    try:
        default = run({}, chosen)
    except InstanceFailedError as error:
        raise StudyError(f"the default settings fail: {error.args[0]}", "a study needs a default that runs") from error
    began, changed, reason = time.perf_counter(), [], ""
    for number in range(CONFIGURATIONS):
        try:
            changed.append(run(small_change(space, base, stream(seed, "pilot", number)), chosen))
        except InstanceFailedError as error:
            reason = str(error.args[0])
    if not changed:
        raise StudyError(f"no pilot: all settings tried near the default fail: {reason}", "narrow the space")
    run_s = (time.perf_counter() - began) * jobs / (CONFIGURATIONS * len(chosen))
    return judge_pilot(objective, default, changed, run_s=run_s, jobs=jobs, split=split)


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


def _paired(objective: Objective, outcomes: Outcomes, default: Outcomes) -> dict[ProblemInstance, float]:
    """Log ratio on each instance that both ran."""
    return {
        instance: math.log(objective.cost(outcome) / objective.cost(default[instance]))
        for instance, outcome in outcomes.items()
        if instance in default
    }
