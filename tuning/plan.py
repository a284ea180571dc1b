"""A study before it runs: its space, baseline and instances, what they could show, and how long that takes."""

import math
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd

from dynslam_bench.core import StudyError, did_you_mean, read_settings
from dynslam_bench.core.records import Record
from dynslam_bench.core.settings import (
    Parameter,
    Scalar,
    Settings,
    apply_overrides,
    field_names,
    flatten,
    parameters,
    why_unused,
)
from dynslam_bench.runs import RunRecord, RunStore, load_frames
from dynslam_bench.runs.identity import resolve
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.objectives import (
    FEWEST_SCENES,
    Configuration,
    Objective,
    detectable,
    find_objective,
    held_protocol,
    log_errors,
    outcome,
    scenes_needed,
)
from dynslam_bench.tuning.splits import design_of, source_of_masks
from dynslam_bench.tuning.study_file import ProblemInstance, SpaceSpec, StudySpec, scenes


def search_space(settings: Settings, spec: SpaceSpec, sequences: Iterable[str] = ()) -> list[Parameter]:
    """The parameters of a study; what has no effect with the baseline's settings is no part of it.

    Args:
        settings: The tracker's, the baseline's and the fixed ones among them.
        spec: Which of them are tuned.
        sequences: What the study runs on, which decides what the source of masks ``auto`` is.

    Raises:
        StudyError: A pattern matches nothing, names a setting that has no effect, or nothing is left to tune.
    """
    every = parameters(type(settings))
    for pattern in (*spec.include, *spec.exclude):
        if not any(fnmatchcase(parameter.name, pattern) for parameter in every):
            similar = did_you_mean(pattern, [parameter.name for parameter in every])
            hint = "it exists, but is not tunable" if pattern in field_names(type(settings)) else similar
            raise StudyError(f"'{pattern}' matches no tunable setting", hint)
    chosen = [
        parameter
        for parameter in every
        if any(fnmatchcase(parameter.name, pattern) for pattern in spec.include)
        and not any(fnmatchcase(parameter.name, pattern) for pattern in spec.exclude)
        and parameter.name not in spec.fixed
    ]
    if hasattr(settings, "segmentation"):  # "auto" stands for a source
        settings = apply_overrides(settings, {"segmentation.source": source_of_masks(settings, list(sequences))})
    unused = {parameter.name: why for parameter in chosen if (why := why_unused(settings, parameter.name))}
    chosen = [parameter for parameter in chosen if parameter.name not in unused]
    if not chosen:
        raise StudyError("the space is empty: all that matches is excluded, fixed, or switched off by a fixed value")
    for name in spec.include:
        if name in unused:
            raise StudyError(
                f"'{name}' has no effect in this study: {unused[name]}", "leave it out, or fix that otherwise"
            )
    return chosen


def distributions(space: Sequence[Parameter]) -> dict[str, optuna.distributions.BaseDistribution]:
    """A space of `search_space` as ``optuna.Study.ask`` takes it."""
    return {parameter.name: distribution(parameter) for parameter in space}


def distribution(parameter: Parameter) -> optuna.distributions.BaseDistribution:
    """Optuna's distribution of a parameter."""
    if parameter.kind in ("bool", "categorical"):
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    assert parameter.low is not None and parameter.high is not None
    log = parameter.scale == "log"
    if parameter.kind == "int":
        return optuna.distributions.IntDistribution(int(parameter.low), int(parameter.high), log=log)
    return optuna.distributions.FloatDistribution(parameter.low, parameter.high, log=log)


def starting_point(preset: Mapping[str, Any], space: Sequence[Parameter], base: Mapping[str, Any]) -> dict[str, Scalar]:
    """A preset as a configuration of a study; what it does not say is as the baseline has it.

    Args:
        preset: Settings by dotted name.
        space: The study's, from `search_space`.
        base: Values of all settings that are not tuned.

    Raises:
        StudyError: The preset sets what the study does not tune to something else, or to a value out of its range.
    """
    tuned = {parameter.name: parameter for parameter in space}
    for name, value in preset.items():
        if name not in base:
            raise StudyError(f"the preset to start from sets an unknown '{name}'", did_you_mean(name, list(base)))
        if name not in tuned and base[name] != value:
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, but the study holds it at {base[name]!r}",
                f'tune it, or say "{name}" = ... under [space.fixed]',
            )
    point = {name: preset.get(name, base[name]) for name in tuned}
    for name, value in point.items():
        if not _fits(tuned[name], value):
            raise StudyError(f"the preset to start from sets {name} = {value!r}, out of the range that the study tunes")
    return point


def _fits(parameter: Parameter, value: Any) -> bool:
    span = distribution(parameter)
    try:
        return bool(span._contains(span.to_internal_repr(value)))
    except ValueError:
        return False


def held_settings(spec: StudySpec) -> dict[str, Any]:
    """What every trial has beside the tuned settings: the baseline's, where that is a preset, and the fixed ones."""
    preset = read_settings(Path(spec.baseline)) if spec.baseline.endswith(".toml") else {}
    return {**preset, **spec.space.fixed}


GAIN = 0.10
"""The gain of which a preview says how many scenes would show it."""
SPREAD = 0.31
"""Standard deviation of the log ratio of two runs of one scene, where no runs are stored: measured 0.24 to 0.31."""
START_S, FRAME_S = 0.5, 0.05
"""Seconds of a run and of a frame of it, where no runs are stored."""
FLOW_FILTERS = {"box_epipolar", "class_rule", "correlation", "epipolar", "motion", "probability"}
"""Filters that judge the optical flow."""


class Preview(Record):
    """What a study could show, before it runs.

    Attributes:
        scenes: Scenes that judge it: held-out ones, or those of the choice.
        runs: Stored runs of the baseline that the figures come from; 0 for figures of other trackers.
        spread: Standard deviation over scenes of the log ratio of two equal configurations.
        detectable: Smallest gain, as a share, that so many scenes can show.
        needed: Scenes that show a gain of `GAIN`.
        minutes: Of the whole study if no trial is pruned.
        unused: Settings of the space that belong to a part whose verdicts are not used on these scenes, and why.
        include: The space without them, as a study names it; empty where nothing is unused.
    """

    scenes: int
    runs: int
    spread: float
    detectable: float
    needed: int
    minutes: float
    unused: dict[str, str]
    include: list[str]

    @property
    def figures(self) -> list[str]:
        """What the scenes could show and how long it takes, for people."""
        source = f"{self.runs} stored runs of the baseline" if self.runs else "other trackers' runs, none is stored yet"
        needed = f"A gain of {100 * GAIN:.0f} % takes {self.needed} scenes to show"
        shown = f"the {self.scenes} that judge this study show {100 * self.detectable:.0f} %"
        if self.scenes < FEWEST_SCENES:
            shown = f"{self.scenes} can judge this study, and below {FEWEST_SCENES} it claims nothing"
        return [
            f"{needed}; {shown} (spread {self.spread:.2f} over scenes, from {source}).",
            f"The study takes about {max(1, math.ceil(self.minutes))} min if no trial is pruned.",
        ]

    @property
    def proposal(self) -> list[str]:
        """The settings that are not used here, and the space without them; it takes runs of the baseline to know."""
        if not self.unused:
            return []
        left = f"The space without them: include = {self.include}".replace("'", '"')
        return [
            *(f"{name} is not used here: {why}." for name, why in self.unused.items()),
            left if self.include else "Nothing would be left of the space without them.",
        ]


class Plan:
    """What follows from a study alone; nothing runs, and nothing is stored.

    Args:
        spec: The study.
        results: The results folder.
        objectives: In place of those that the study names, in their order.

    Attributes:
        held: See `held_settings`.
        baseline: What ratios are to.
        shipped: The tracker's default settings, where the baseline is something else.
        defaults: The settings of trial 0.
        base: The same by dotted name.
        space: What is tuned.
        design: On which instances.

    Raises:
        DynslamError: Anything in the spec is unknown, unfit or missing.
    """

    def __init__(
        self,
        spec: StudySpec,
        results: str | Path = "results",
        *,
        objectives: Sequence[Objective] | None = None,
    ) -> None:
        self.spec, self.results, self.store = spec, Path(results), RunStore(results)
        self.objectives = [find_objective(name) for name in spec.objectives] if objectives is None else list(objectives)
        fixed, settings = spec.space.fixed, TRACKERS.get(spec.tracker).settings
        self.held = held_settings(spec)
        self.baseline = Configuration(spec.tracker, self.held)
        if spec.baseline and not spec.baseline.endswith(".toml"):
            names = field_names(TRACKERS.get(spec.baseline).settings)
            self.baseline = Configuration(spec.baseline, {name: fixed[name] for name in fixed if name in names})
        held_protocol(spec.protocol).check_scale(spec.tracker, TRACKERS.get(spec.tracker).sensors)
        self.shipped = Configuration(spec.tracker, fixed) if spec.baseline else None
        self.defaults: Settings = apply_overrides(settings(), self.held)
        self.base = flatten(self.defaults)
        sequences = {instance.sequence for instance in spec.instances(*spec.tune)}
        self.space = search_space(self.defaults, spec.space, sequences)
        starting_point({}, self.space, self.base)
        self.design = design_of(spec)

    def preview(self, jobs: int = 1) -> Preview:
        """What the study could show, from the baseline's stored runs where there are some."""
        design, spec = self.design, self.spec
        records = {instance: record for instance in design.reference if (record := self._stored(instance)) is not None}
        judged = scenes(design.held_out or design.confirm if design.confirm else ())
        starts = sum(map(len, judged.values())) / len(judged) if judged else 1.0
        spread = (self._scatter(records) or SPREAD) / math.sqrt(starts)
        seconds = [record.wall_s for record in records.values()]
        frames = [len(instance.open(spec.data_root)) for instance in design.tune[:1]]
        run_s = float(np.mean(seconds)) if seconds else START_S + FRAME_S * frames[0]
        runs = len(design.reference) + spec.trials * len(design.tune) + (spec.top + 1) * len(design.confirm)
        runs += 2 * (len(design.held_out) + len(design.recorded))
        unused = self._unused(list(records.values()))
        return Preview(
            scenes=len(judged), runs=len(records), spread=spread, detectable=detectable(spread, len(judged)),
            needed=scenes_needed(GAIN, spread), minutes=math.ceil(runs / jobs) * run_s / 60, unused=unused,
            include=[parameter.name for parameter in self.space if parameter.name not in unused] if unused else [],
        )  # fmt: skip

    def _stored(self, instance: ProblemInstance) -> RunRecord | None:
        """The baseline's run on an instance, if it is stored and came to its end."""
        (tracker, settings), spec = self.baseline, self.spec
        how = {"threads": spec.threads, "cache": spec.cache, "data_root": spec.data_root}
        record = self.store.get(resolve(instance.run_spec(tracker, settings=dict(settings), **how)).run_id)
        return None if record is None or record.failed or record.status == "stopped" else record

    def _scatter(self, records: dict[ProblemInstance, RunRecord]) -> float:
        """Standard deviation between starts of the log ratio of two runs; 0 where no scene has two stored runs."""
        protocol, root = held_protocol(self.spec.protocol), self.spec.data_root
        runs = {at: outcome(self.store, record, at, protocol, root) for at, record in records.items()}
        logs = log_errors({at: run.ate_m for at, run in runs.items()})
        free = sum(len(values) - 1 for values in logs.values())
        squares = sum(float(np.var(values)) * len(values) for values in logs.values())
        return math.sqrt(2 * squares / free) if free else 0.0

    def _unused(self, records: list[RunRecord]) -> dict[str, str]:
        """Settings of parts that dropped no feature on any frame of the baseline's runs."""
        if not records or self.baseline.tracker != self.spec.tracker:
            return {}
        frames = pd.concat([load_frames(record, self.store) for record in records])
        most = frames.filter(regex="^stat_.*_dropped$").max()
        most.index = most.index.str.removeprefix("stat_").str.removesuffix("_dropped")
        idle = dict.fromkeys(most.index[most == 0], f"its test dropped no feature in {len(records)} runs")
        if all(record.epipolar_skipped == 1 for record in records):
            idle["epipolar"] = "F was skipped on all frames"
        if "semantic" in idle:
            idle["segmentation"] = "there were no masks on any frame"
        if (judging := FLOW_FILTERS & set(most.index)) and judging <= idle.keys():
            idle["flow"] = f"no verdict of {' and '.join(sorted(judging))} on it was used"
        groups = ((parameter.name, parameter.name.split(".")[0]) for parameter in self.space)
        return {name: idle[group] for name, group in groups if group in idle}
