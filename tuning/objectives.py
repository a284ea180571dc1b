"""Outcomes of configurations, and objectives over them: each is a cost of a run, compared with the baseline's.

A configuration runs on each instance in its own process; the run store makes no run twice. All
objectives are natural logarithms of ratios to the baseline: less is better, 0 is the baseline's
own. Below them configurations are compared over scenes; what that shows is said by `evaluation.verdicts`.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from dynslam_bench.contracts import Trajectory
from dynslam_bench.core import StudyError, did_you_mean
from dynslam_bench.evaluation import Evaluation, Protocol, evaluate, get_protocol
from dynslam_bench.evaluation.verdicts import (
    CATASTROPHE,
    FEWEST,
    FLOOR_M,
    ONE_SIDED,
    PairedRatio,
    hodges_lehmann,
    paired_ratio,
)
from dynslam_bench.reports.model.row import grouped
from dynslam_bench.runs import RunRecord, RunStore, load_frames, score
from dynslam_bench.tuning.study_file import ProblemInstance, StudySpec, scenes


@dataclass(frozen=True)
class Outcome:
    """One configuration on one instance.

    Attributes:
        instance: The instance that was run.
        run_id: The run.
        ate_m: ATE RMSE in metres, lost frames held at the last pose.
        coverage: Share of frames that were tracked.
        frame_s: Mean seconds a frame, segmentation included.
        processor_s: Mean processor seconds of that, all threads together; `frame_s` where the work
            is done elsewhere (a foreign program, a GPU). Unlike `frame_s` it hardly depends on what
            else the machine does.
        rtf: Real-time factor: duration of the instance's frames over the time they took.
        lost: Whether the run lost track, as its status says, or tracked nothing.
        wall_s: Seconds of the whole run.
        crash: Why the run did not come to its end; empty if it did.
        rpe_m: Relative error in metres: translation RMSE over the first delta of the protocol, one
            second under ``tum-rgbd/v1``; NaN where the protocol has none, or the part is shorter.
        final_ate_m: `ate_m` of the final trajectory; of the online one where there is no other.
        network_calls: Frames on which the segmenter ran, as a share; 0 without masks.
        memory_mb: Largest resident memory; NaN where it is not known.
        stages: Mean seconds a frame of each stage, by name, e.g. ``tracking``.
    """

    instance: ProblemInstance
    run_id: str
    ate_m: float
    coverage: float
    frame_s: float
    processor_s: float
    rtf: float
    lost: bool = False
    wall_s: float = 0.0
    crash: str = ""
    rpe_m: float = math.nan
    final_ate_m: float = math.nan
    network_calls: float = 0.0
    memory_mb: float = math.nan
    stages: Mapping[str, float] = field(default_factory=dict)


class Configuration(NamedTuple):
    """A tracker and the overrides of its settings, by dotted name."""

    tracker: str
    settings: Mapping[str, Any]


EXTERNAL_STAGE = "transfer"
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

    # errors, those of a static camera where nothing was tracked; a batch program has a final trajectory alone
    metrics = score(store, record, protocol)
    evaluation = metrics.online if record.tracker.online else metrics.final
    if evaluation is None:
        ate_m = static_camera_m(instance, data_root)
        rpe_m = static_camera_rpe_m(instance, protocol, data_root)
    else:
        ate_m = float(evaluation.metrics["ate_rmse_m"])
        rpe_m = _relative_error(evaluation, protocol)
    final = metrics.final or evaluation
    final_ate_m = ate_m if final is None else float(final.metrics["ate_rmse_m"])

    # time: this process's processor seconds tell nothing of work that is done elsewhere
    total = record.timings["total"]
    elsewhere = record.device.startswith("cuda") or EXTERNAL_STAGE in record.timings
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
        lost=record.status == "lost" or evaluation is None,
        wall_s=record.wall_s or 0.0,
        rpe_m=rpe_m,
        final_ate_m=final_ate_m,
        network_calls=_network_calls(store, record),
        memory_mb=math.nan if record.peak_memory_mb is None else record.peak_memory_mb,
        stages={stage: time.mean_s for stage, time in record.timings.items()},
    )


_NEVER_S = 1e6
"""Frame time of a run that crashed: more than any other."""


def crashed(instance: ProblemInstance, reason: str, data_root: str | None) -> Outcome:
    """The outcome of a run that crashed where scenes judge: lost, and slower than any, with a static camera's error."""
    static_m = static_camera_m(instance, data_root)
    return Outcome(
        instance=instance,
        run_id="",
        ate_m=static_m,
        coverage=0.0,
        frame_s=_NEVER_S,
        processor_s=_NEVER_S,
        rtf=0.0,
        lost=True,
        crash=reason,
        final_ate_m=static_m,
        network_calls=1.0,
    )


def _relative_error(evaluation: Evaluation, protocol: Protocol) -> float:
    """Translation RMSE in metres over the first delta of a protocol; NaN where it has none."""
    if not protocol.rpe:
        return math.nan
    return float(evaluation.metrics.get(protocol.rpe[0].metric("trans"), math.nan))


def _network_calls(store: RunStore, record: RunRecord) -> float:
    """Share of the frames on which a run's segmenter ran; 0 for a run without masks."""
    if not record.segmentation:
        return 0.0
    frames = load_frames(record, store)
    if "stat_segmented" not in frames:
        return 0.0
    return float(frames["stat_segmented"].fillna(0.0).mean())


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


@lru_cache(maxsize=256)
def static_camera_rpe_m(
    instance: ProblemInstance, protocol: Protocol, data_root: str | None
) -> float:
    """Relative error in metres of a static camera on an instance; NaN where the protocol has none."""
    sequence: Any = instance.open(data_root)
    stamps = sequence.timestamps
    still = Trajectory(stamps, np.repeat(np.eye(4)[None], len(stamps), axis=0))
    evaluation = evaluate(still, sequence.ground_truth, protocol, input_timestamps=stamps)
    return _relative_error(evaluation, protocol)


Outcomes = Mapping[ProblemInstance, Outcome]
Cost = Callable[[Outcome], float]
"""Positive number of a run, less is better."""
WORST_SHARE = 0.25
"""Share of the scenes, the worst ones, that the worst case is the mean of; always one at least."""
_ABOVE_FLOOR = 1e9
"""Factor of a user's costs, which lifts them above `FLOOR_M`; it cancels out of ratios."""
_LOST_FLOOR = 0.01
"""So many lost frames are added on both sides, as a share, so that a baseline without any can be compared with."""
_CALLS_FLOOR = 0.01
"""The share that is added on both sides to the frames on which a network ran, for the same reason."""
STAGE = "time:"
"""Begins the name of an objective or a limit on a stage's time, e.g. ``time:tracking``."""


_ERRORS = ("accuracy", "worst", "robustness", "coverage")
"""Objectives that a run which crashed has a value of."""
_CRASHED = 1e9
"""Cost of such a run by all others."""
_LOSS = math.log(CATASTROPHE)
"""Log ratio of a scene that one side alone lost, at least."""


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
        """Natural logarithm of the ratio on each instance that counts and that both ran; losses as in `ratios`."""
        reference = self._costs(baseline)
        return [
            self._with_loss(
                math.log(max(cost, FLOOR_M)) - math.log(max(reference[instance], FLOOR_M)),
                outcomes[instance].lost,
                baseline[instance].lost,
            )
            for instance, cost in self._costs(outcomes).items()
            if instance in reference
        ]

    def ratios(self, outcomes: Outcomes, baseline: Outcomes) -> dict[str, float]:
        """Natural logarithm of the ratio to the baseline by scene; empty without any instance that counts.

        In a scene that one side alone lost that side has `CATASTROPHE` times the other's cost at least, so that
        losing never pays: a run that gives up is fast, and before a fixed camera it has no error.
        """
        lost = lost_scenes(outcomes)
        lost_by_baseline = lost_scenes(baseline)
        ratios = by_scene(self._costs(outcomes), self._costs(baseline))
        return {
            scene: self._with_loss(ratio, scene in lost, scene in lost_by_baseline)
            for scene, ratio in ratios.items()
        }

    def _with_loss(self, log_ratio: float, lost: bool, lost_by_baseline: bool) -> float:
        """A log ratio, or what it is at least where one side alone lost."""
        # lost frames may be the cost themselves
        if self.name == "coverage" or lost == lost_by_baseline:
            return log_ratio
        return max(log_ratio, _LOSS) if lost else min(log_ratio, -_LOSS)

    def _costs(self, outcomes: Outcomes) -> dict[ProblemInstance, float]:
        """The cost on each instance that counts."""
        return {
            instance: self._cost(outcome)
            for instance, outcome in outcomes.items()
            if self.counts(instance)
        }

    def _cost(self, outcome: Outcome) -> float:
        """The cost of a run; one that crashed has an error alone."""
        return _CRASHED if outcome.crash and self.name not in _ERRORS else self.cost(outcome)

    def value(self, outcomes: Outcomes, baseline: Outcomes) -> float:
        """Natural logarithm of the ratio to the baseline over the scenes; below 0 is better.

        Raises:
            StudyError: None of the instances counts.
        """
        counted = self.counted(self.ratios(outcomes, baseline))
        if not counted:
            raise StudyError(
                f"objective '{self.name}' counts degraded instances alone, but none of the study's is",
                'name some, e.g. "synthetic/walking_xyz?scene=0-3&frames=80&degrade=blur:0.5"',
            )
        return centre(counted.values())

    def counted(self, ratios: Mapping[str, float]) -> dict[str, float]:
        """The scenes' ratios that the value is the mean of: all, or the worst ones."""
        if not self.worst:
            return dict(ratios)
        ranked = sorted(ratios.items(), key=lambda scene: scene[1], reverse=True)
        return dict(ranked[: max(1, round(WORST_SHARE * len(ranked)))])

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
        Objective("relative", "relative error", lambda run: _given(run, "rpe_m", run.rpe_m)),
        Objective("final", "final ATE", lambda run: run.final_ate_m),
        Objective("network_calls", "network calls", lambda run: run.network_calls + _CALLS_FLOOR),
        Objective("memory", "memory", lambda run: _given(run, "memory_mb", run.memory_mb)),
    )
}
"""Objectives by name."""


def _given(run: Outcome, name: str, value: float) -> float:
    """The value of an outcome's field.

    Raises:
        StudyError: The run has none.
    """
    if math.isfinite(value):
        return value
    cures = {
        "rpe_m": "take a protocol with a relative error, and instances longer than its delta (one second "
        "under tum-rgbd/v1)",
        "memory_mb": "leave the objective out",
    }
    raise StudyError(f"'{run.instance}' has no {name}", cures[name])


def stage_time(run: Outcome, stage: str) -> float:
    """Mean milliseconds a frame of a stage.

    Raises:
        StudyError: The run has no such stage.
    """
    if stage not in run.stages:
        raise StudyError(
            f"'{run.instance}' has no stage '{stage}'", did_you_mean(stage, list(run.stages))
        )
    return 1000 * run.stages[stage]


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
    if name.startswith(STAGE):
        stage = name.removeprefix(STAGE)
        return Objective(name, f"time of {stage}", lambda run: stage_time(run, stage))
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
        """The cost of a run, which must be a number above 0."""
        given: Any = cost(run)
        try:
            value = float(given)
        except (TypeError, ValueError):
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise StudyError(
                f"objective '{name}' gives {given!r} on instance '{run.instance}'",
                "return a number above 0",
            )
        # lifted above `FLOOR_M`, which would raise small values to it; the factor cancels out of ratios
        return _ABOVE_FLOOR * value

    return Objective(name, name.replace("_", " "), checked)


# Constraints.


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time of the runs that came to their end; 0 without any."""
    frame_s = [outcome.frame_s for outcome in outcomes.values() if not outcome.crash]
    return 1.0 / float(np.mean(frame_s)) if frame_s else 0.0


_QUANTITIES = (
    "ate_m",
    "rpe_m",
    "final_ate_m",
    "frame_s",
    "processor_s",
    "network_calls",
    "memory_mb",
)
"""Fields of an outcome that a study may limit."""


def quantity(name: str) -> Cost:
    """Function that computes a limited quantity of an outcome: a field, or ``time:STAGE`` in milliseconds.

    Raises:
        StudyError: There is none of that name.
    """
    if name.startswith(STAGE):
        return lambda run: stage_time(run, name.removeprefix(STAGE))
    if name not in _QUANTITIES:
        raise StudyError(f"unknown limit '{name}'", did_you_mean(name, [*_QUANTITIES, STAGE]))
    return lambda run: float(getattr(run, name))


def violations(
    spec: StudySpec,
    outcomes: Outcomes,
    baseline: Outcomes | None = None,
    constraints: Mapping[str, Callable[[Outcome], float]] | None = None,
) -> dict[str, float]:
    """Relative violation of each constraint; <= 0 is fulfilled.

    Args:
        spec: The study. One of anything but error alone must not pay for its gain with accuracy:
            the ATE ratio has to stay below 1 + `StudySpec.ate_margin`; a front of several
            objectives holds the error itself.
        outcomes: Outcomes of the configuration, by instance.
        baseline: Outcomes of the baseline at the same places, for that ratio; None to leave it out.
        constraints: A user's own by name: the mean of each over the instances has to be <= 0.
    """
    values = {}
    if spec.min_coverage is not None:
        values["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        values["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    for name, most in spec.limits.items():
        mean = fmean(quantity(name)(run) for run in outcomes.values())
        # what is not known fulfils no limit
        values[name] = mean / most - 1 if math.isfinite(mean) else math.inf
    for name, constraint in (constraints or {}).items():
        values[name] = fmean(float(constraint(run)) for run in outcomes.values())
        if math.isnan(values[name]):
            raise StudyError(
                f"constraint '{name}' gives no number", "return one that is <= 0 where it holds"
            )
    if baseline is not None and spec.at_equal_accuracy and len(spec.objectives) == 1:
        values["ate"] = ACCURACY.value(outcomes, baseline) - math.log1p(spec.ate_margin)
    return values


# Comparing a configuration with the baseline: paired by place, one value a scene.

Errors = Mapping[ProblemInstance, float]
"""ATE in metres on each instance, lost frames held."""


def instance_without_repeat(instance: ProblemInstance) -> ProblemInstance:
    """The instance without its start and seed: all runs there are repeats of each other."""
    return replace(instance, offset=0, seed=0)


def by_scene(errors: Errors, baseline: Errors) -> dict[str, float]:
    """Log ATE ratio of a configuration to the baseline in each scene.

    At each place the median over the configuration's starts is compared with the median over all of
    the baseline's, so that no single start decides; a scene is the mean of its places.

    Args:
        errors: Errors of the configuration in metres, by instance.
        baseline: Errors of the baseline, by instance, at every place of `errors`; more starts make
            it steadier.

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
    groups = grouped(errors, instance_without_repeat).items()
    return {
        place: [math.log(max(errors[instance], FLOOR_M)) for instance in group]
        for place, group in groups
    }


def scene_errors_m(outcomes: Outcomes) -> dict[str, float]:
    """ATE in metres in each scene: the median over the starts at each place, the geometric mean over its places.

    The quotient of two configurations that ran from the same starts is their ratio by `by_scene`.
    """
    errors = {instance: run.ate_m for instance, run in outcomes.items()}
    medians = {place: float(np.median(logs)) for place, logs in log_errors(errors).items()}
    return {
        scene: math.exp(fmean(medians[place] for place in places))
        for scene, places in scenes(medians).items()
    }


def centre(values: Iterable[float]) -> float:
    """Mean of log ratios over scenes, which a search makes small: losses count in full."""
    return fmean(values)


def lost_scenes(outcomes: Outcomes) -> set[str]:
    """Scenes in which at least half of a configuration's starts were lost."""
    return {
        scene
        for scene, instances in scenes(outcomes).items()
        if 2 * sum(outcomes[instance].lost for instance in instances) >= len(instances)
    }


def compare(
    outcomes: Outcomes,
    baseline: Outcomes,
    *,
    objective: Objective = ACCURACY,
    one_sided: float = ONE_SIDED,
) -> PairedRatio:
    """Compare a configuration with the baseline on the same instances, scene by scene.

    A scene has one log ratio, of the medians over its repeats (start offsets and seeds), or it is lost.

    Args:
        outcomes: Outcomes of the configuration, by instance.
        baseline: Outcomes of the baseline, by instance.
        objective: What is compared.
        one_sided: Level of a claim, e.g. 0.025.

    Returns:
        The typical ratio of the objective with its interval, below 1 is better, and the losses.
    """
    # the worst scenes rank trials; chosen by the candidate's own ratios they cannot judge it
    if objective.worst:
        objective = ACCURACY
    ratios = objective.ratios(outcomes, baseline)
    counted = [instance for instance in outcomes if objective.counts(instance)]

    # where frames lost are the cost themselves, a lost scene is a value like others
    lost: set[str] = set()
    lost_by_baseline: set[str] = set()
    if objective.name != "coverage":
        lost = lost_scenes(outcomes) & ratios.keys()
        lost_by_baseline = lost_scenes(baseline) & ratios.keys()
    return paired_ratio(
        ratios,
        lost,
        lost_by_baseline,
        one_sided=one_sided,
        runs=len(counted),
        lost_runs=(
            sum(outcomes[instance].lost for instance in counted),
            sum(baseline[instance].lost for instance in counted if instance in baseline),
        ),
        floored={
            instance.scene
            for runs in (outcomes, baseline)
            for instance, run in runs.items()
            if not run.crash and objective.cost(run) < FLOOR_M
        },
        what=objective.what,
    )


def improvement_bound(trials: Iterable[Mapping[str, float]]) -> tuple[float, int] | None:
    """Upper 95 % confidence bound on the improvement of the best of several trials over the baseline.

    Each trial has a one-sided bound of its own. The largest of them holds for all trials, whichever is the
    best, without a correction for their number (intersection-union test, Berger 1982).

    Args:
        trials: Log ratio by scene of each trial; those with fewer than `FEWEST` scenes have no bound.

    Returns:
        The bound, as a share: 0.1 is 10 % less error; and how many trials have enough scenes. None
        where no trial has.
    """
    # the lower end of a two-sided 90 % interval is a one-sided 95 % bound
    bounds = [
        hodges_lehmann(list(ratios.values()), 0.90).low
        for ratios in trials
        if len(ratios) >= FEWEST
    ]
    return (max(0.0, -math.expm1(min(bounds))), len(bounds)) if bounds else None
