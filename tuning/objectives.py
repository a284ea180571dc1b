"""Objectives and constraints: each objective is a cost of a run, compared with the default's in each scene.

All objectives are natural logarithms of ratios to the default settings: less is better, 0 is the default's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.tuning.evaluate import Outcome
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.study_file import StudySpec

Outcomes = Mapping[ProblemInstance, Outcome]
Cost = Callable[[Outcome], float]
WORST_SHARE = 0.25
"""Share of the scenes, the worst ones, that the worst case is the mean of; always one at least."""
_MANY = 1e9
_LOST_FLOOR = 0.01
"""So many lost frames are added on both sides, as a share, so that a default without any can be compared with."""


@dataclass(frozen=True)
class Objective:
    """Something to be made small.

    Attributes:
        name: As a study names it.
        what: What the ratio is one of, for tables and sentences.
        cost: Positive number of a run, less is better.
        worst: Count the worst scenes alone, not all.
        degraded: Count instances with a degradation alone, not all.
    """

    name: str
    what: str
    cost: Cost
    worst: bool = False
    degraded: bool = False

    def log_ratios(self, outcomes: Outcomes, default: Outcomes) -> dict[ProblemInstance, float]:
        """Natural logarithm of the ratio on each instance, whether it counts or not."""
        return {
            instance: math.log(self.cost(outcome) / self.cost(default[instance]))
            for instance, outcome in outcomes.items()
        }

    def by_start(self, outcomes: Outcomes, default: Outcomes) -> list[float]:
        """Natural logarithm of the ratio on each instance that counts and that both ran."""
        reference = self._costs(default)
        return [
            math.log(max(cost, FLOOR_M) / max(reference[instance], FLOOR_M))
            for instance, cost in self._costs(outcomes).items()
            if instance in reference
        ]

    def ratios(self, outcomes: Outcomes, default: Outcomes) -> dict[str, float]:
        """Natural logarithm of the ratio to the default by scene; empty without any instance that counts."""
        return by_scene(self._costs(outcomes), self._costs(default))

    def _costs(self, outcomes: Outcomes) -> dict[ProblemInstance, float]:
        return {instance: self.cost(outcome) for instance, outcome in outcomes.items() if self.counts(instance)}

    def value(self, outcomes: Outcomes, default: Outcomes) -> float:
        """Natural logarithm of the ratio to the default over the scenes; below 0 is better.

        Raises:
            StudyError: None of the instances counts.
        """
        counted = self.counted(self.ratios(outcomes, default).values())
        if not counted:
            raise StudyError(
                f"objective '{self.name}' counts degraded instances alone, but none of the study's is",
                'name some, e.g. "synthetic/walking_xyz?scene=0-3&frames=80&degrade=blur:0.5"',
            )
        return centre(counted)

    def counted(self, ratios: Iterable[float]) -> list[float]:
        """Those scenes' ratios that the value is the centre of."""
        ranked = sorted(ratios, reverse=True)
        return ranked[: max(1, round(WORST_SHARE * len(ranked)))] if self.worst else ranked

    def counts(self, instance: ProblemInstance) -> bool:
        """Whether an instance counts."""
        return not self.degraded or any(strength > 0 for _, strength in instance.degradation)


OBJECTIVES = {
    objective.name: objective
    for objective in (
        Objective("accuracy", "ATE", lambda run: run.ate_m),
        Objective("speed", "processor time", lambda run: run.processor_s),
        Objective("worst", "ATE in the worst quarter of the scenes", lambda run: run.ate_m, worst=True),
        Objective("robustness", "ATE on degraded instances", lambda run: run.ate_m, degraded=True),
        Objective("coverage", "share of lost frames", lambda run: 1 - run.coverage + _LOST_FLOOR),
    )
}
"""Objectives by name."""
ACCURACY, SPEED = OBJECTIVES["accuracy"], OBJECTIVES["speed"]


def together(objectives: Sequence[Objective]) -> Objective:
    """Several objectives as one: the geometric mean of their ratios; one stays what it is."""
    if len(objectives) == 1:
        return objectives[0]
    return Objective(
        "balance",
        f"geometric mean of {' and '.join(objective.what for objective in objectives)}",
        lambda run: math.exp(sum(math.log(objective.cost(run)) for objective in objectives) / len(objectives)),
    )


def find_objective(name: str) -> Objective:
    """An objective by its name.

    Raises:
        StudyError: There is none of that name.
    """
    if name not in OBJECTIVES:
        raise StudyError(f"unknown objective '{name}'", did_you_mean(name, list(OBJECTIVES)))
    return OBJECTIVES[name]


def own_objective(cost: Cost) -> Objective:
    """A user's objective, from what a run costs.

    Args:
        cost: Positive number of a run, less is better, e.g. ``lambda run: run.ate_m * run.processor_s``.
    """
    name = getattr(cost, "__name__", "own").strip("<>")

    def checked(run: Outcome) -> float:
        value = float(cost(run))
        if not (math.isfinite(value) and value > 0):
            raise StudyError(f"objective '{name}' gives {value:g} on instance '{run.instance}'", "give numbers above 0")
        return _MANY * value  # the floor of errors in metres does not apply; ratios stay as they are

    return Objective(name, name.replace("_", " "), checked)


# Constraints.


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time."""
    return 1.0 / float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def violations(spec: StudySpec, outcomes: Outcomes, default: Outcomes | None = None) -> dict[str, float]:
    """How far each constraint is violated, relatively; <= 0 is fulfilled.

    Args:
        spec: The study. One of anything but error alone must not pay for its gain with accuracy: the ATE ratio has to
            stay below 1 + `StudySpec.ate_margin`; a front of several objectives holds the error itself.
        outcomes: Of a configuration.
        default: Of the default settings at the same places, for that ratio; None to leave it out.
    """
    values = {}
    if spec.min_coverage is not None:
        values["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        values["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    if default is not None and spec.at_equal_accuracy and len(spec.objectives) == 1:
        values["ate"] = ACCURACY.value(outcomes, default) - math.log1p(spec.ate_margin)
    return values


# Comparing a configuration with the default: paired by place, robust to single runs, with intervals that cover.

FLOOR_M = 1e-4
"""Errors below a tenth of a millimetre count as that: a ratio of two perfect runs tells nothing."""
FEWEST_SCENES = 3
"""With fewer scenes an interval over scenes means nothing."""
TRIMMED = 0.1
"""This share of the scenes is left out at either end (none below ten): one catastrophe decides nothing."""

Errors = Mapping[ProblemInstance, float]
"""ATE in metres on each instance, lost frames held."""


def place_of(instance: ProblemInstance) -> ProblemInstance:
    """The instance without its start and seed: all runs there are repeats of each other."""
    return replace(instance, offset=0, seed=0)


def by_scene(errors: Errors, default: Errors) -> dict[str, float]:
    """Log ATE ratio of a configuration to the default in each scene.

    At each place the median over the configuration's starts is compared with the median over all of the default's, so
    that no single start decides; a scene is the mean of its places.

    Args:
        errors: Of the configuration.
        default: Of the default settings, at every place of `errors`; more starts make it steadier.

    Returns:
        Natural logarithm by scene, below 0 is better than the default.
    """
    reference = _log_errors(default)
    ratios: dict[str, list[float]] = {}
    for place, values in _log_errors(errors).items():
        ratios.setdefault(place.scene, []).append(float(np.median(values) - np.median(reference[place])))
    return {scene: float(np.mean(values)) for scene, values in ratios.items()}


def _log_errors(errors: Errors) -> dict[ProblemInstance, list[float]]:
    """Natural logarithms of the errors in metres, by place."""
    logs: dict[ProblemInstance, list[float]] = {}
    for instance, error in errors.items():
        logs.setdefault(place_of(instance), []).append(math.log(max(error, FLOOR_M)))
    return logs


def centre(values: Iterable[float]) -> float:
    """Trimmed mean; the mean of fewer than ten."""
    sample = np.sort(np.fromiter(values, np.float64))
    cut = int(TRIMMED * len(sample))
    return float(sample[cut : len(sample) - cut].mean())


def bounds(values: Iterable[float], confidence: float = 0.95) -> tuple[float, float] | None:
    """Confidence interval of the centre: Student's, of the trimmed mean (Tukey and McLaughlin 1963) from ten on.

    Args:
        values: One a scene, taken as independent.
        confidence: Of both sides together; a one-sided bound of confidence c is the end of the interval of 2 c - 1.

    Returns:
        Lower and upper end; None for fewer than two values.
    """
    sample = np.sort(np.fromiter(values, np.float64))
    count = len(sample)
    if count < 2:
        return None
    cut = int(TRIMMED * count)
    kept = count - 2 * cut
    winsorised = np.clip(sample, sample[cut], sample[count - 1 - cut])
    error = float(winsorised.std(ddof=1)) * math.sqrt(count) / kept
    half = float(stdtrit(kept - 1, 0.5 + confidence / 2)) * error
    middle = centre(sample)
    return middle - half, middle + half


def upper(values: Iterable[float], confidence: float) -> float:
    """One-sided upper confidence bound of the centre; infinite for fewer than two values."""
    interval = bounds(values, 2 * confidence - 1)
    return math.inf if interval is None else interval[1]
