"""Outcomes of configurations, and objectives over them: each is a cost of a run, compared with the baseline's.

A configuration runs on each instance in its own process; the run store makes no run twice. All
objectives are natural logarithms of ratios to the baseline: less is better, 0 is the baseline's
own. Below them the statistics of such ratios: interval, power, and the test of whether settings
matter at all.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core import StudyError, did_you_mean
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.reports.model.row import grouped
from dynslam_bench.runs import RunRecord, RunStore, score
from dynslam_bench.tuning.study_file import ProblemInstance, StudySpec, scenes


@dataclass(frozen=True)
class Outcome:
    """One configuration on one instance.

    Attributes:
        instance: Where.
        run_id: The run.
        ate_m: ATE RMSE in metres, lost frames held at the last pose.
        coverage: Share of frames that were tracked.
        frame_s: Mean seconds a frame, segmentation included.
        processor_s: Mean processor seconds of that, all threads together; `frame_s` where the work
            is done elsewhere (a foreign program, a GPU). Unlike `frame_s` it hardly depends on what
            else the machine does.
        rtf: Real-time factor: duration of the instance's frames over the time they took.
    """

    instance: ProblemInstance
    run_id: str
    ate_m: float
    coverage: float
    frame_s: float
    processor_s: float
    rtf: float


class Configuration(NamedTuple):
    """A tracker and the overrides of its settings, by dotted name."""

    tracker: str
    settings: Mapping[str, Any]


FOREIGN = "transfer"
"""Stage that only trackers in another program have."""


class InstanceFailedError(StudyError):
    """A run did not come to its end; carries the instance, the run's status and the reason."""


class CancelledError(StudyError):
    """The study was interrupted."""


def outcome(
    store: RunStore,
    record: RunRecord,
    instance: ProblemInstance,
    protocol: Protocol,
    data_root: str | None,
) -> Outcome:
    """The outcome of a stored run; one in which nothing was tracked has the error of a static camera.

    Raises:
        InstanceFailedError: It did not come to its end.
        CancelledError: It was stopped.
    """
    if record.status == "stopped":
        raise CancelledError(f"interrupted on {instance}")
    if record.failed:
        raise InstanceFailedError(f"{instance}: {record.status}: {record.reason}")

    # error, that of a static camera where nothing was tracked
    evaluation = score(store, record, protocol).online
    if evaluation is None:
        ate_m = static_camera_m(instance, data_root)
    else:
        ate_m = float(evaluation.metrics["ate_rmse_m"])

    # time: this process's processor seconds tell nothing of work that is done elsewhere
    total = record.timings["total"]
    elsewhere = record.device.startswith("cuda") or FOREIGN in record.timings
    processor = total if elsewhere else record.timings.get("processor", total)
    period_s = record.sequence.duration_s / max(record.sequence.frames - 1, 1)
    return Outcome(
        instance=instance,
        run_id=record.run_id,
        ate_m=ate_m,
        coverage=record.coverage or 0.0,
        frame_s=total.mean_s,
        processor_s=processor.mean_s,
        rtf=period_s / total.mean_s,
    )


def hold_last_pose_protocol(protocol: Protocol | str) -> Protocol:
    """The protocol with lost frames held at the last pose, so that losing track never pays."""
    protocol = get_protocol(protocol)
    if protocol.lost_frames == "hold":
        return protocol
    return protocol.model_copy(update={"id": f"{protocol.id}+hold", "lost_frames": "hold"})


@lru_cache(maxsize=256)
def static_camera_m(instance: ProblemInstance, data_root: str | None) -> float:
    """ATE RMSE in metres of a static camera on an instance, from the ground truth of its frames alone."""
    sequence: Any = instance.open(data_root)
    truth = sequence.ground_truth
    stamps = sequence.timestamps
    positions = truth.positions[(truth.timestamps >= stamps[0]) & (truth.timestamps <= stamps[-1])]
    # alignment puts the one point of a static camera into the mean of the true positions, [N, 3]
    return float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))


Outcomes = Mapping[ProblemInstance, Outcome]
Cost = Callable[[Outcome], float]
"""Positive number of a run, less is better."""
WORST_SHARE = 0.25
"""Share of the scenes, the worst ones, that the worst case is the mean of; always one at least."""
_MANY = 1e9
"""Factor of a user's costs, which lifts them above `FLOOR_M`; it cancels out of ratios."""
_LOST_FLOOR = 0.01
"""So many lost frames are added on both sides, as a share, so that a baseline without any can be compared with."""


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

    def by_start(self, outcomes: Outcomes, baseline: Outcomes) -> list[float]:
        """Natural logarithm of the ratio on each instance that counts and that both ran."""
        reference = self._costs(baseline)
        return [
            math.log(max(cost, FLOOR_M) / max(reference[instance], FLOOR_M))
            for instance, cost in self._costs(outcomes).items()
            if instance in reference
        ]

    def ratios(self, outcomes: Outcomes, baseline: Outcomes) -> dict[str, float]:
        """Natural logarithm of the ratio to the baseline by scene; empty without any instance that counts."""
        return by_scene(self._costs(outcomes), self._costs(baseline))

    def _costs(self, outcomes: Outcomes) -> dict[ProblemInstance, float]:
        """The cost on each instance that counts."""
        return {
            instance: self.cost(outcome)
            for instance, outcome in outcomes.items()
            if self.counts(instance)
        }

    def value(self, outcomes: Outcomes, baseline: Outcomes) -> float:
        """Natural logarithm of the ratio to the baseline over the scenes; below 0 is better.

        Raises:
            StudyError: None of the instances counts.
        """
        counted = self.counted(self.ratios(outcomes, baseline).values())
        if not counted:
            raise StudyError(
                f"objective '{self.name}' counts degraded instances alone, but none of the study's is",
                'name some, e.g. "synthetic/walking_xyz?scene=0-3&frames=80&degrade=blur:0.5"',
            )
        return centre(counted)

    def counted(self, ratios: Iterable[float]) -> list[float]:
        """Those scenes' ratios that the value is the centre of, the worst first."""
        ranked = sorted(ratios, reverse=True)
        if not self.worst:
            return ranked
        return ranked[: max(1, round(WORST_SHARE * len(ranked)))]

    def counts(self, instance: ProblemInstance) -> bool:
        """Whether an instance counts."""
        return not self.degraded or any(strength > 0 for _, strength in instance.degradation)


OBJECTIVES = {
    objective.name: objective
    for objective in (
        Objective("accuracy", "ATE", lambda run: run.ate_m),
        # ms: all are above FLOOR_M
        Objective("speed", "processor time", lambda run: 1000 * run.processor_s),
        Objective(
            "worst", "ATE in the worst quarter of the scenes", lambda run: run.ate_m, worst=True
        ),
        Objective("robustness", "ATE on degraded instances", lambda run: run.ate_m, degraded=True),
        Objective("coverage", "share of lost frames", lambda run: 1 - run.coverage + _LOST_FLOOR),
    )
}
"""Objectives by name."""

# Two that are needed whatever a study's own objectives are.
ACCURACY = OBJECTIVES["accuracy"]
SPEED = OBJECTIVES["speed"]


def combined_objective(objectives: Sequence[Objective]) -> Objective:
    """Several objectives as one: the geometric mean of their ratios; one stays what it is."""
    if len(objectives) == 1:
        return objectives[0]
    names = " and ".join(objective.what for objective in objectives)

    def geometric_mean(run: Outcome) -> float:
        logs = sum(math.log(objective.cost(run)) for objective in objectives)
        return math.exp(logs / len(objectives))

    return Objective("balance", f"geometric mean of {names}", geometric_mean)


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
        cost: Positive number of a run, less is better, e.g.
            ``lambda run: run.ate_m * run.processor_s``.
    """
    name = getattr(cost, "__name__", "own").strip("<>")

    def checked(run: Outcome) -> float:
        value = float(cost(run))
        if not (math.isfinite(value) and value > 0):
            raise StudyError(
                f"objective '{name}' gives {value:g} on instance '{run.instance}'",
                "give numbers above 0",
            )
        # the floor of errors in metres does not apply; ratios stay as they are
        return _MANY * value

    return Objective(name, name.replace("_", " "), checked)


# Constraints.


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time."""
    return 1.0 / float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def violations(
    spec: StudySpec, outcomes: Outcomes, baseline: Outcomes | None = None
) -> dict[str, float]:
    """How far each constraint is violated, relatively; <= 0 is fulfilled.

    Args:
        spec: The study. One of anything but error alone must not pay for its gain with accuracy:
            the ATE ratio has to stay below 1 + `StudySpec.ate_margin`; a front of several
            objectives holds the error itself.
        outcomes: Of a configuration.
        baseline: Outcomes of the baseline at the same places, for that ratio; None to leave it out.
    """
    values = {}
    if spec.min_coverage is not None:
        values["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        values["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    if baseline is not None and spec.at_equal_accuracy and len(spec.objectives) == 1:
        values["ate"] = ACCURACY.value(outcomes, baseline) - math.log1p(spec.ate_margin)
    return values


# Comparing a configuration with the baseline: paired by place, robust to single runs, with
# intervals that cover.

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


def by_scene(errors: Errors, baseline: Errors) -> dict[str, float]:
    """Log ATE ratio of a configuration to the baseline in each scene.

    At each place the median over the configuration's starts is compared with the median over all of
    the baseline's, so that no single start decides; a scene is the mean of its places.

    Args:
        errors: Of the configuration.
        baseline: At every place of `errors`; more starts make it steadier.

    Returns:
        Natural logarithm by scene, below 0 is better than the baseline.
    """
    reference = log_errors(baseline)
    # at each place: median over starts against median over starts
    ratios = {
        place: np.median(logs) - np.median(reference[place])
        for place, logs in log_errors(errors).items()
    }
    return {
        scene: float(np.mean([ratios[place] for place in places]))
        for scene, places in scenes(ratios).items()
    }


def log_errors(errors: Errors) -> dict[ProblemInstance, list[float]]:
    """Natural logarithms of the errors in metres, by place."""
    groups = grouped(errors, place_of).items()
    return {
        place: [math.log(max(errors[instance], FLOOR_M)) for instance in group]
        for place, group in groups
    }


def centre(values: Iterable[float]) -> float:
    """Trimmed mean; the mean of fewer than ten."""
    ranked = sorted(values)
    cut = int(TRIMMED * len(ranked))
    return fmean(ranked[cut : len(ranked) - cut])


def bounds(values: Iterable[float], confidence: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the centre: Student's, of the trimmed mean (Tukey and McLaughlin 1963) from ten on.

    Args:
        values: One a scene, two or more, taken as independent.
        confidence: Of both sides together.
    """
    # the trimmed mean's standard error is that of the winsorised sample, whose `cut` smallest and
    # largest values are set to the ones beside them
    sample = np.sort(list(values))
    cut = int(TRIMMED * len(sample))
    count = len(sample)
    kept = count - 2 * cut
    winsorised = np.clip(sample, sample[cut], sample[-1 - cut])
    error = float(winsorised.std(ddof=1)) * math.sqrt(count) / kept
    # Student's t with as many degrees of freedom as values are kept, less one
    half = float(stats.t.ppf(0.5 + confidence / 2, kept - 1)) * error
    middle = centre(sample)
    return middle - half, middle + half


# What scenes can show.

_POWER = 0.8
"""Share of studies in which a gain is to be told from nothing: four of five."""
_MOST_SCENES = 100_000
"""`scenes_needed` looks no further."""


def detectable(spread: float, count: int) -> float:
    """Smallest gain, as a share, that so many scenes tell from nothing in four of five studies; 1 for fewer than two.

    Args:
        spread: Standard deviation over scenes of the log ratio.
        count: Scenes.
    """
    if count < 2:
        return 1.0
    # power of a t-test over scenes: the quantile of its level and that of its power, in standard errors
    factor = stats.t.ppf(0.975, count - 1) + stats.t.ppf(_POWER, count - 1)
    return float(1 - math.exp(-factor * spread / math.sqrt(count)))


def scenes_needed(gain: float, spread: float) -> int:
    """The fewest scenes that tell a gain from nothing, at most `_MOST_SCENES`; see `detectable`."""
    return 2 + bisect_left(
        range(2, _MOST_SCENES), True, key=lambda count: detectable(spread, count) <= gain
    )


MATTER_LEVEL = 0.01
"""Level of `spread_test`. Pruning depends on the values, so the test finds a difference where there is none more often
(`tests/benchmarks/study_null.py`)."""


def spread_test(trials: Sequence[Mapping[str, float]]) -> float | None:
    """Whether trials differ by more than chance: the p-value of an F-test for trials x scenes (additive model).

    Chance is what is left of the log ratios once each trial and each scene has its mean: the
    scatter between starts, and what any change does to one scene but not to another. Pruned trials
    count with the scenes that they ran on.

    Args:
        trials: Log ratio by scene of each trial.

    Returns:
        Above `MATTER_LEVEL` the settings do not matter on these scenes; None with too few trials or
        scenes for a test.
    """
    # one cell for each trial and scene that it ran on: row, column, log ratio
    names = sorted({scene for trial in trials for scene in trial})
    cells = [
        (row, names.index(scene), value)
        for row, trial in enumerate(trials)
        for scene, value in trial.items()
    ]
    free = len(cells) - len(names) - len(trials) + 1
    if len(trials) < 2 or free < 1:
        return None
    rows, columns, values = (np.array(column) for column in zip(*cells, strict=True))

    # sums of squared residuals without and with the trials' means, the scenes' being in both
    by_scene = np.eye(len(names))[columns]
    by_trial = np.eye(len(trials))[rows]
    scatter = _squared_residuals(by_scene, values)
    chance = _squared_residuals(np.hstack([by_scene, by_trial]), values)

    # F: mean square that the trials explain over the mean square of chance
    explained = max(0.0, scatter - chance) / (len(trials) - 1)
    ratio = explained / max(chance / free, _SAME)
    return 1.0 if explained < _SAME else float(stats.f.sf(ratio, len(trials) - 1, free))


def _squared_residuals(model: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Sum of the squared residuals of a linear least-squares fit; `model` has a row for each value."""
    return float(np.square(values - model @ np.linalg.lstsq(model, values)[0]).sum())


_SAME = 1e-18
"""Variances below this are rounding."""
