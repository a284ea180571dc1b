"""A study before it runs: its space, baseline and instances, what they could show, and how long that takes.

The instances come in splits: to tune on, to choose on and to judge on. It is checked that these are
apart.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations, islice, product, zip_longest
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
import optuna
import pandas as pd

from dynslam_bench.contracts import Frame
from dynslam_bench.contracts import Sequence as Frames
from dynslam_bench.core import StudyError, did_you_mean, find_data_root, read_settings
from dynslam_bench.core.records import Record
from dynslam_bench.core.seeding import stream
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
from dynslam_bench.evaluation.verdicts import (
    FEWEST,
    LOOKS,
    POWER,
    detectable,
    power,
    scenes_needed,
)
from dynslam_bench.geometry import Camera
from dynslam_bench.reports.model.row import SEEN, grouped
from dynslam_bench.runs import RunRecord, RunSpec, RunStore, load_frames, resolve
from dynslam_bench.runs.lookup import LookUp
from dynslam_bench.segmentation.training_scenes import seen_in_training
from dynslam_bench.sequences.catalogue import catalogue, open_public, open_sequence
from dynslam_bench.sequences.families import same_path
from dynslam_bench.sequences.synthetic import HELD_OUT_SCENES, TUNE_SCENES
from dynslam_bench.sequences.view import Part, part_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.objectives import (
    Configuration,
    Objective,
    find_objective,
    hold_last_pose_protocol,
    log_errors,
    outcome,
    place_of,
)
from dynslam_bench.tuning.study_file import (
    ProblemInstance,
    SpaceSpec,
    StudySpec,
    further_scenes,
    scenes,
    stretches_behind,
)


def search_space(
    settings: Settings, spec: SpaceSpec, sequences: Iterable[str] = ()
) -> list[Parameter]:
    """The parameters of a study; what has no effect with the baseline's settings is no part of it.

    Args:
        settings: The tracker's, the baseline's and the fixed ones among them.
        spec: Which of them are tuned.
        sequences: What the study runs on, which decides what the source of masks ``auto`` is.

    Raises:
        StudyError: A pattern matches nothing, names a setting that has no effect, or nothing is
            left to tune.
    """
    every = parameters(type(settings))
    for pattern in (*spec.include, *spec.exclude):
        if not any(fnmatchcase(parameter.name, pattern) for parameter in every):
            similar = did_you_mean(pattern, [parameter.name for parameter in every])
            hint = (
                "it exists, but is not tunable"
                if pattern in field_names(type(settings))
                else similar
            )
            raise StudyError(f"'{pattern}' matches no tunable setting", hint)
    chosen = [
        parameter
        for parameter in every
        if any(fnmatchcase(parameter.name, pattern) for pattern in spec.include)
        and not any(fnmatchcase(parameter.name, pattern) for pattern in spec.exclude)
        and parameter.name not in spec.fixed
    ]
    if hasattr(settings, "segmentation"):  # "auto" stands for a source
        settings = apply_overrides(
            settings, {"segmentation.source": source_of_masks(settings, list(sequences))}
        )
    unused = {
        parameter.name: why for parameter in chosen if (why := why_unused(settings, parameter.name))
    }
    chosen = [parameter for parameter in chosen if parameter.name not in unused]
    if not chosen:
        raise StudyError(
            "the space is empty: all that matches is excluded, fixed, or switched off by a fixed value"
        )
    for name in spec.include:
        if name in unused:
            raise StudyError(
                f"'{name}' has no effect in this study: {unused[name]}",
                "leave it out, or fix that otherwise",
            )
    return chosen


def distributions(space: Sequence[Parameter]) -> dict[str, optuna.distributions.BaseDistribution]:
    """A space of `search_space` as ``optuna.Study.ask`` takes it."""
    return {parameter.name: distribution(parameter) for parameter in space}


def distribution(parameter: Parameter) -> optuna.distributions.BaseDistribution:
    """Optuna's distribution of a parameter."""
    if parameter.low is None or parameter.high is None:
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    if parameter.kind == "int":
        low = int(parameter.low)
        high = int(parameter.high)
        return optuna.distributions.IntDistribution(low, high, log=parameter.scale == "log")
    return optuna.distributions.FloatDistribution(
        parameter.low, parameter.high, log=parameter.scale == "log"
    )


def starting_point(
    preset: Mapping[str, Any], space: Sequence[Parameter], base: Mapping[str, Any]
) -> dict[str, Scalar]:
    """A preset as a configuration of a study; what it does not say is as the baseline has it.

    Args:
        preset: Settings by dotted name.
        space: The study's, from `search_space`.
        base: Values of all settings that are not tuned.

    Raises:
        StudyError: The preset sets what the study does not tune to something else, or to a value
            out of its range.
    """
    tuned = {parameter.name: parameter for parameter in space}
    for name, value in preset.items():
        if name not in base:
            raise StudyError(
                f"the preset to start from sets an unknown '{name}'", did_you_mean(name, list(base))
            )
        if name not in tuned and base[name] != value:
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, but the study holds it at {base[name]!r}",
                f'tune it, or say "{name}" = ... under [space.fixed]',
            )
    point = {name: preset.get(name, base[name]) for name in tuned}
    for name, value in point.items():
        span = distribution(tuned[name])
        fits = False
        with suppress(ValueError):  # no number, or none of the choices
            fits = span._contains(span.to_internal_repr(value))
        if not fits:
            raise StudyError(
                f"the preset to start from sets {name} = {value!r}, out of the range that the study tunes"
            )
    return point


def held_settings(spec: StudySpec) -> dict[str, Any]:
    """What every trial has beside the tuned settings: the baseline's, where that is a preset, and the fixed ones."""
    preset = read_settings(Path(spec.baseline)) if spec.baseline.endswith(".toml") else {}
    return {**preset, **spec.space.fixed}


GAIN = 0.20
"""The gain of which a preview says how surely this study would show it."""
SPREAD = 0.39
"""Standard deviation over scenes of the log ratio of two configurations, one start each: measured 0.34 to 0.5 with
settings that have effects."""
START_S = 0.5
FRAME_S = 0.05
"""Seconds of a run and of a frame of it, where no runs are stored."""
FLOW_FILTERS = {"box_epipolar", "class_rule", "correlation", "epipolar", "motion", "probability"}
"""Filters that judge the optical flow."""


class Preview(Record):
    """What a study could show, before it runs.

    Attributes:
        scenes: Scenes that judge it: held-out ones, or those of `confirm`.
        runs: Stored runs of the baseline that the figures come from; 0 for figures of other
            trackers.
        spread: Standard deviation over scenes of the log ratio of two configurations.
        level: One-sided level of its claims.
        power: Chance of *proven* for a candidate with `GAIN` less error.
        detectable: Smallest gain, as a share, that is proven in four of five studies.
        needed: Scenes that prove `GAIN` in four of five.
        minutes: Of the whole study if no trial is pruned.
        unused: Settings of the space that belong to a part whose verdicts are not used on these
            scenes, and why.
        include: The space without them, as a study names it; empty where nothing is unused.
    """

    scenes: int
    runs: int
    spread: float
    level: float
    power: float
    detectable: float
    needed: int
    minutes: float
    unused: dict[str, str]
    include: list[str]

    @property
    def figures(self) -> list[str]:
        """What the scenes could show and how long it takes, for people."""
        source = (
            f"{self.runs} stored runs of the baseline"
            if self.runs
            else "other trackers' runs, none is stored yet"
        )
        scatter = f"spread {self.spread:.2f} over scenes, from {source}"
        if self.scenes < FEWEST:
            shown = f"{self.scenes} scenes judge this study; below {FEWEST} it claims nothing ({scatter})."
        else:
            shown = (
                f"{self.scenes} scenes judge this study: a candidate with {100 * GAIN:.0f} % less error is proven in "
                f"{100 * self.power:.0f} % of such studies, one with {100 * self.detectable:.0f} % less in four of "
                f"five ({scatter}; one-sided level {100 * self.level:.2g} %)."
            )
        lines = [shown]
        if self.power < POWER:
            lines.append(
                f"A design that proves {100 * GAIN:.0f} % in four of five has {self.needed} held-out scenes with one "
                f"start each (offsets = [0]); clips of 40 frames show as much as longer ones."
            )
        lines.append(
            f"The study takes about {max(1, math.ceil(self.minutes))} min if no trial is pruned."
        )
        return lines

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
        self.objectives = (
            [find_objective(name) for name in spec.objectives]
            if objectives is None
            else list(objectives)
        )
        fixed = spec.space.fixed
        settings = TRACKERS.get(spec.tracker).settings
        self.held = held_settings(spec)
        self.baseline = Configuration(spec.tracker, self.held)
        if spec.baseline and not spec.baseline.endswith(".toml"):
            names = field_names(TRACKERS.get(spec.baseline).settings)
            self.baseline = Configuration(
                spec.baseline, {name: fixed[name] for name in fixed if name in names}
            )
        hold_last_pose_protocol(spec.protocol).check_scale(
            spec.tracker, TRACKERS.get(spec.tracker).sensors
        )
        self.shipped = Configuration(spec.tracker, fixed) if spec.baseline else None
        self.defaults: Settings = apply_overrides(settings(), self.held)
        self.base = flatten(self.defaults)
        sequences = {instance.sequence for instance in spec.instances(*spec.tune)}
        self.space = search_space(self.defaults, spec.space, sequences)
        starting_point({}, self.space, self.base)
        self.design = design_of(spec)

    def preview(self, jobs: int = 1) -> Preview:
        """What the study could show, from the baseline's stored runs where there are some."""
        design = self.design
        spec = self.spec
        records = {
            instance: record
            for instance in design.reference
            if (record := self._stored(instance)) is not None
        }
        judged = scenes(design.judging)
        starts = sum(map(len, judged.values())) / len(judged) if judged else 1.0
        spread = (self._scatter(records) or SPREAD) / math.sqrt(starts)
        level = spec.level(len(judged))
        run_s = START_S + FRAME_S * len(design.tune[0].open(spec.data_root))
        if records:
            run_s = float(np.mean([record.wall_s for record in records.values()]))
        chosen = 2 * (len(design.judging) + len(design.recorded))
        if design.held_out:
            chosen += (spec.top + 1) * len(design.confirm)
        runs = len(design.reference) + spec.trials * len(design.tune) + chosen
        unused = self._unused(list(records.values()))
        return Preview(
            scenes=len(judged),
            runs=len(records),
            spread=spread,
            level=level,
            power=power(GAIN, spread, len(judged), level),
            detectable=detectable(spread, len(judged), level),
            needed=scenes_needed(GAIN, spread),
            minutes=math.ceil(runs / jobs) * run_s / 60,
            unused=unused,
            include=[parameter.name for parameter in self.space if parameter.name not in unused]
            if unused
            else [],
        )

    def run_spec(
        self, instance: ProblemInstance, configuration: Configuration, *, cache: bool | None = None
    ) -> RunSpec:
        """The run of a configuration on an instance; with the stage cache as the study says, unless `cache` does."""
        spec = self.spec
        settings = dict(configuration.settings)
        how = {
            "study": spec.name,
            "threads": spec.threads,
            "cache": spec.cache if cache is None else cache,
        }
        return instance.run_spec(
            configuration.tracker, settings=settings, data_root=spec.data_root, **how
        )

    def _stored(self, instance: ProblemInstance) -> RunRecord | None:
        """The baseline's run on an instance, if it is stored and came to its end."""
        record = LookUp(self.store).find(resolve(self.run_spec(instance, self.baseline)))
        return None if record is None or record.failed or record.status == "stopped" else record

    def check_plugins(self) -> None:
        """Refuse to go on where what the plug-ins read has changed since the baseline ran.

        What a plug-in reads is known only from its runs, so that the study's identity cannot hold
        it.

        Raises:
            StudyError: It names what has changed.
        """
        run = resolve(self.run_spec(self.design.tune[0], self.baseline))
        changed = LookUp(self.store).changed(run) if run.foreign else ""
        if changed:
            raise StudyError(
                f"study '{self.spec.name}': {changed} has changed since the baseline ran",
                "undo the change, or give the study another name",
            )

    def _scatter(self, records: dict[ProblemInstance, RunRecord]) -> float:
        """Standard deviation between starts of the log ratio of two runs; 0 where no scene has two stored runs."""
        protocol = hold_last_pose_protocol(self.spec.protocol)
        root = self.spec.data_root
        errors = {
            at: outcome(self.store, record, at, protocol, root).ate_m
            for at, record in records.items()
        }
        logs = log_errors(errors).values()
        free = sum(len(values) - 1 for values in logs)
        return (
            math.sqrt(2 * sum(float(np.var(values)) * len(values) for values in logs) / free)
            if free
            else 0.0
        )

    def _unused(self, records: list[RunRecord]) -> dict[str, str]:
        """Settings of parts that dropped no feature on any frame of the baseline's runs."""
        if not records or self.baseline.tracker != self.spec.tracker:
            return {}
        frames = pd.concat([load_frames(record, self.store) for record in records])
        most = frames.filter(regex="^stat_.*_dropped$").max()
        most.index = most.index.str.removeprefix("stat_").str.removesuffix("_dropped")
        idle = dict.fromkeys(
            most.index[most == 0], f"its test dropped no feature in {len(records)} runs"
        )
        if all(record.epipolar_skipped == 1 for record in records):
            idle["epipolar"] = "F was skipped on all frames"
        if "semantic" in idle:
            idle["segmentation"] = "there were no masks on any frame"
        if (judging := FLOW_FILTERS & set(most.index)) and judging <= idle.keys():
            idle["flow"] = f"no verdict of {' and '.join(sorted(judging))} on it was used"
        groups = ((parameter.name, parameter.name.split(".")[0]) for parameter in self.space)
        return {name: idle[group] for name, group in groups if group in idle}


# The splits of a study.

FEWEST_STARTS = 3
"""The baseline runs from so many starts at every place: all trials would share the luck of a single one."""
JUDGING_SCENES = 28
"""Scenes that are made to judge on where a study names none: they prove a gain of 20 % in four of five studies at the
usual scatter (`SPREAD`)."""
RECORDED_FRAMES = 120
RECORDED_STARTS = 4


@dataclass(frozen=True)
class Design:
    """The instances of a study.

    Attributes:
        tune: What trials run on, in the order of all trials.
        reference: What the baseline runs on beforehand: `tune`, and more starts where those are
            few.
        confirm: What the best trials and the baseline run on for the choice; shares no frame with
            `tune`. Where nothing is held out it judges, and the trials' own values choose.
        held_out: What judges the choice.
        recorded: Recordings on which the choice must not be worse.
    """

    tune: tuple[ProblemInstance, ...]
    reference: tuple[ProblemInstance, ...]
    confirm: tuple[ProblemInstance, ...]
    held_out: tuple[ProblemInstance, ...]
    recorded: tuple[ProblemInstance, ...]

    @property
    def judging(self) -> tuple[ProblemInstance, ...]:
        """What judges: the held-out instances, or else `confirm`."""
        return self.held_out or self.confirm


def design_of(spec: StudySpec, *, further: int = 0) -> Design:
    """Lay out the instances of a study and check them.

    Args:
        spec: The study.
        further: Rendered scenes that are added to those that judge.

    Raises:
        DynslamError: See `plan.check_splits`; or further scenes cannot be made.
    """
    tune, confirm, held_out = (
        spec.instances(*texts) for texts in (spec.tune, spec.confirm, spec.held_out)
    )
    taken = {instance.scene for instance in (*tune, *confirm, *held_out)}
    if not confirm and not held_out:
        is_rendered = any(instance.sequence.startswith("synthetic/") for instance in tune)
        count = min(LOOKS) if spec.extendable else JUDGING_SCENES
        confirm = further_scenes(tune, count, taken, TUNE_SCENES) if is_rendered else []
        confirm += stretches_behind(tune, spec.data_root)
    if further:
        # what chooses stays as it is: the same candidate is looked at again
        taken |= {instance.scene for instance in confirm}
        if held_out:
            held_out += further_scenes(held_out, further, taken, HELD_OUT_SCENES)
        else:
            confirm += further_scenes(confirm, further, taken, TUNE_SCENES)
    judging = len(scenes(held_out or confirm))
    if spec.extendable and judging not in LOOKS:
        raise StudyError(
            f"study '{spec.name}' is extendable, and {judging} scenes judge it",
            f"judge on {', '.join(map(str, LOOKS))} scenes: each look has its share of the level",
        )
    splits: dict[Split, list[ProblemInstance]] = {
        "tune": tune,
        "confirm": confirm,
        "held_out": held_out,
    }
    check_splits(spec.name, splits, data_root=spec.data_root)
    recorded = _recordings(spec, taken) if spec.recorded is None else spec.instances(*spec.recorded)
    if spec.recorded:
        check_splits(
            spec.name, {"tune": [*tune, *confirm], "held_out": recorded}, data_root=spec.data_root
        )
    tune = running_order(tune, spec.sampler_seed)
    return Design(
        tuple(tune), tuple(with_more_starts(tune)), tuple(confirm), tuple(held_out), tuple(recorded)
    )


def running_order(instances: Sequence[ProblemInstance], seed: int) -> list[ProblemInstance]:
    """The instances in the order of all trials: one of each scene in turn, so that small sets hold different scenes."""
    groups = list(scenes(instances).values())
    stream(seed, "order").shuffle(groups)
    return [instance for turn in zip_longest(*groups) for instance in turn if instance is not None]


def with_more_starts(instances: Sequence[ProblemInstance]) -> list[ProblemInstance]:
    """The instances, and more starts of each place that has fewer than `FEWEST_STARTS`."""
    more = list(instances)
    for repeats in grouped(instances, place_of).values():
        used = {instance.offset for instance in repeats}
        unused = (offset for offset in itertools.count() if offset not in used)
        more += [
            replace(repeats[0], offset=offset)
            for offset in islice(unused, max(FEWEST_STARTS - len(used), 0))
        ]
    return more


def _recordings(spec: StudySpec, taken: set[str]) -> list[ProblemInstance]:
    """The first frames of the first held-out recording that is here and that the study does not name itself."""
    root = find_data_root(spec.data_root)
    for entry in catalogue().values():
        if entry.split == "held-out" and entry.id not in taken and entry.find(root) is not None:
            frames = min(
                RECORDED_FRAMES + RECORDED_STARTS - 1, len(open_public(entry.id, data_root=root))
            )
            return [
                ProblemInstance(entry.id, (0, frames), offset) for offset in range(RECORDED_STARTS)
            ]
    return []


# Whether a study's instances are what they say: apart by content, by the catalogue, by the scenes.

Split = Literal["tune", "confirm", "held_out"]


def check_splits(
    name: str,
    splits: Mapping[Split, Sequence[ProblemInstance]],
    *,
    data_root: str | None = None,
) -> None:
    """Open every instance of a study and compare its splits.

    Two splits overlap if they film the same content, however it is called: other frames or another
    draw of the noise of a sequence are no other sequence, nor is a copy or an excerpt of a
    recording in another folder, with other file names, other stamps or other image files
    (`same_recording`). `tune` and `confirm` may share a recording, but no frame. A sequence that
    the catalogue, or its scene, gives to one split must not stand in the other.

    Args:
        name: Of the study.
        splits: Its instances: to tune on, to judge the survivors on, and held out.
        data_root: Folder of the recorded sequences.

    Raises:
        StudyError: They are not apart, a split names the same frames twice, or an instance is too
            long, too short or without ground truth; names both spellings.
        SequenceError: A sequence is unknown or missing.
    """
    tune = [*splits.get("tune", ()), *splits.get("confirm", ())]
    held_out = list(splits.get("held_out", ()))
    tuned = dict.fromkeys(instance.sequence for instance in tune)
    judged = dict.fromkeys(instance.sequence for instance in held_out)
    opened: dict[str, Any] = {
        name: open_sequence(name, data_root=data_root) for name in (*tuned, *judged)
    }
    for names in (tuned, judged):
        _check_copies(name, names, opened)
    for instances in (tune, held_out):
        _check_repeats(instances, opened, apart=set(splits.get("confirm", ())))
    scenes_of = {name: part_of(sequence).scene for name, sequence in opened.items()}
    faults = [
        f"'{one}' to tune on and '{other}' held out are the same sequence"
        for one, other in product(tuned, judged)
        if scenes_of[one] == scenes_of[other] or same_recording(opened[one], opened[other])
    ]
    for names, used, own in ((tuned, "tune", "held-out"), (judged, "held-out", "tune")):
        faults += [
            _misplaced(name, used, own)
            for name in names
            if getattr(opened[name], "split", "") == own
        ]
    if faults:
        raise StudyError(
            f"the splits of study '{name}' are not apart: {faults[0]}", "leave one out"
        )


def _check_copies(study: str, names: Iterable[str], opened: Mapping[str, Any]) -> None:
    """Refuse one recording under several names within a split: it would count as several scenes."""
    recorded = [name for name in names if not hasattr(opened[name], "scene_digest")]
    for one, other in combinations(recorded, 2):
        if part_of(opened[one]).scene == part_of(opened[other]).scene:
            continue
        if same_recording(opened[one], opened[other]):
            raise StudyError(
                f"study '{study}': '{one}' and '{other}' are the same recording, and would count as two scenes",
                "leave one out",
            )


def _check_repeats(
    instances: Sequence[ProblemInstance], opened: Mapping[str, Any], apart: set[ProblemInstance]
) -> None:
    """Instances of one scene are repeats of the same frames or share none; those in `apart` share none with others."""
    parts: dict[ProblemInstance, Part] = {}
    for instance in instances:
        if instance in parts:
            raise StudyError(f"instance '{instance}' is named twice", "leave one out")
        parts[instance] = part_of(
            cast("Any", instance.cut(opened[instance.sequence])), instance.offset
        )
    for (one, here), (other, there) in combinations(parts.items(), 2):
        if here.scene != there.scene:
            continue
        same = [
            (part.block, part.noise, instance.offset, instance.degradation, instance.seed)
            for instance, part in ((one, here), (other, there))
        ]
        if same[0] == same[1]:
            raise StudyError(f"'{one}' and '{other}' are the same frames", "leave one out")
        shared = min(here.stop, there.stop) - max(here.start, there.start)
        repeats = place_of(one) == place_of(other) or (here.start, here.stop) == (
            there.start,
            there.stop,
        )
        if shared > 0 and not (repeats and (one in apart) == (other in apart)):
            raise StudyError(
                f"'{one}' and '{other}' share {shared} frames",
                "write instances of a sequence apart",
            )


def _misplaced(name: str, used: str, own: str) -> str:
    numbers = HELD_OUT_SCENES if own == "held-out" else TUNE_SCENES
    who = (
        f"its scene ({numbers.start}-{numbers.stop - 1})"
        if name.startswith("synthetic/")
        else "the catalogue"
    )
    return f"'{name}' is used as {used}, but {who} puts it into the {own} split"


# Whether two recordings show the same: by their images, never by names.

_PAIRS = 6
"""So many pairs of frames are compared by their images."""
_ENOUGH = 3
"""Pairs with equal images; fewer may be chance, as two paths may cross."""
_THUMB = (32, 24)
_GREY_LEVELS = 1.5
_DEPTH_SHARE = 0.002


def same_recording(one: Frames, other: Frames) -> bool:
    """Whether frames of one recording are frames of the other; of two rendered scenes never: their digests tell.

    Where the camera moves, equal stamps and equal true poses say it, whatever was done to the images. Else of a
    few frames with equal stamps (without any, of frames spread evenly over both) the decoded images are
    compared, reduced to `_THUMB` pixels. Other names, other image files and a smaller size leave a copy a copy,
    and so do frames that are left out or other stamps, one of the two.
    """
    if hasattr(one, "scene_digest") and hasattr(other, "scene_digest"):
        return False
    if same_path(one.ground_truth, other.ground_truth):
        return True
    stamps = (np.round(one.timestamps, 6), np.round(other.timestamps, 6))
    _, *frames = np.intersect1d(*stamps, assume_unique=True, return_indices=True)
    if not len(frames[0]):
        frames = [np.arange(len(one)), np.arange(len(other))]
    chosen = (
        numbers[np.linspace(0, len(numbers) - 1, _PAIRS).astype(int)].tolist() for numbers in frames
    )
    pairs = set(zip(*chosen, strict=True))
    alike = sum(
        _alike(one[first], other[second], one.camera, other.camera) for first, second in pairs
    )
    return alike >= min(_ENOUGH, len(one), len(other))


def _alike(here: Frame, there: Frame, one: Camera, other: Camera) -> bool:
    """Whether two frames show the same colour, and depth in the numbers that their files hold."""
    colours = [
        cv2.resize(frame.rgb.astype(np.float32), _THUMB, interpolation=cv2.INTER_AREA)
        for frame in (here, there)
    ]
    if np.abs(colours[0] - colours[1]).mean() > _GREY_LEVELS:
        return False
    raw = (here.depth * one.written_depth_factor, there.depth * other.written_depth_factor)
    depths = [
        cv2.resize(depth.astype(np.float32), _THUMB, interpolation=cv2.INTER_NEAREST)
        for depth in raw
    ]
    allowed = _DEPTH_SHARE * float(np.median(depths[0])) + 0.5
    return bool(np.median(np.abs(depths[0] - depths[1])) <= allowed)


# Which instances of a study show scenes that the network behind the masks was trained on: a best
# case there.


def source_of_masks(settings: Settings, sequences: Sequence[str]) -> str:
    """Where a system's masks come from; the embedded network for ``auto`` where everything is rendered.

    Args:
        settings: Of the system.
        sequences: What it runs on.

    Returns:
        For example ``embedded``; empty for a system without masks.
    """
    source = str(getattr(getattr(settings, "segmentation", None), "source", ""))
    rendered = bool(sequences) and all(name.startswith("synthetic/") for name in sequences)
    return "embedded" if source == "auto" and rendered else source


def splits_seen(settings: Settings, design: Design) -> list[str]:
    """Names of a study's splits with a scene that the network behind the masks was trained on, in their order."""
    splits = {"tune": design.tune, "confirm": design.confirm, "held_out": design.held_out}
    names = {
        split: {instance.sequence for instance in instances} for split, instances in splits.items()
    }
    return [
        split
        for split, sequences in names.items()
        if any(seen_in_training(source_of_masks(settings, [name]), name) for name in sequences)
    ]


def seen_note(splits: Sequence[str]) -> str:
    """What such splits mean for a study, in one sentence; empty without any."""
    if not splits:
        return ""
    names = {"tune": "trials", "confirm": "choice", "held_out": "held-out instances"}
    named = " and ".join(names[split] for split in splits)
    judged = (
        "so nothing here judges the masks: held-out instances are rendered scenes from 100 on"
        if "held_out" in splits
        else "so errors there are optimistic, and the held-out instances, which it has not seen, may gain less or more"
    )
    return f"{SEEN} In the {named} the masks come from a network that was trained on those very scenes, {judged}."
