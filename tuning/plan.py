"""A study before it runs: its space, baseline and instances, what they could show, and how long that takes.

The instances come in splits: to tune on, to choose on and to judge on. It is checked that these are
apart.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, product, zip_longest
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
import pandas as pd

from dynslam_bench.contracts import Frame
from dynslam_bench.contracts import Sequence as Frames
from dynslam_bench.core import StudyError, find_data_root, read_settings
from dynslam_bench.core.records import Record
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import (
    Settings,
    apply_overrides,
    field_names,
    flatten,
)
from dynslam_bench.evaluation.verdicts import (
    FEWEST,
    LOOKS,
    ONE_SIDED,
    POWER,
    USUAL_SPREAD,
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
from dynslam_bench.sequences.view import SequencePart, sequence_part_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.objectives import (
    Configuration,
    Objective,
    Outcome,
    Outcomes,
    find_objective,
    hold_last_pose_protocol,
    instance_without_repeat,
    log_errors,
    outcome,
    quantity,
    violations,
)
from dynslam_bench.tuning.space import build_space, starting_point
from dynslam_bench.tuning.study_file import (
    TRACKER,
    ProblemInstance,
    StudySpec,
    further_scenes,
    scenes,
    stretches_behind,
)


def _trackers(spec: StudySpec) -> list[str]:
    """The trackers to choose from, the study's own first, whose settings are trial 0.

    Raises:
        StudyError: The study's own is none of them.
    """
    choices = [str(name) for name in spec.space.choices.get(TRACKER, (spec.tracker,))]
    if spec.tracker not in choices:
        raise StudyError(
            f"the trackers to choose from lack '{spec.tracker}', with which trial 0 runs",
            f'add it to space.choices.tracker, or say tracker = "{choices[0]}"',
        )
    return [spec.tracker, *(name for name in choices if name != spec.tracker)]


def known_settings(tracker: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a tracker has settings for."""
    names = set(field_names(TRACKERS.get(tracker).settings))
    return {name: value for name, value in values.items() if name in names}


def _with_source(settings: Settings, sequences: Iterable[str]) -> Settings:
    """The settings with the source of masks that ``auto`` stands for on these sequences."""
    if not hasattr(settings, "segmentation"):
        return settings
    source = source_of_masks(settings, list(sequences))
    return apply_overrides(settings, {"segmentation.source": source})


def held_settings(spec: StudySpec) -> dict[str, Any]:
    """Settings of every trial beside the tuned ones: those of a preset as baseline, and the fixed ones."""
    preset = read_settings(Path(spec.baseline)) if spec.baseline.endswith(".toml") else {}
    return {**preset, **spec.space.fixed}


GAIN = 0.20
"""The gain of which a preview says how surely this study would show it."""
START_S = 0.5
"""Seconds of a run beside its frames, where no runs are stored."""
FRAME_S = 0.05
"""Seconds of a frame, where no runs are stored."""
FLOW_FILTERS = {"box_epipolar", "class_rule", "correlation", "epipolar", "motion", "probability"}
"""Filters that judge the optical flow."""


class Preview(Record):
    """Preview of a study before it runs: the differences that it could show, and its time.

    Attributes:
        scenes: Scenes that judge it: held-out ones, or those of `confirm`.
        runs: Stored runs of the baseline that the figures come from; 0 for figures of other
            trackers.
        spread: Standard deviation over scenes of the log ratio of two configurations.
        level: One-sided level of its claims.
        power: Chance of *proven* for a candidate with `GAIN` less error.
        detectable: Smallest gain, as a share, that is proven in four of five studies.
        needed: Scenes that prove `GAIN` in four of five.
        minutes: Estimated minutes of the whole study if no trial is pruned.
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
        """Sentences on what the scenes could show and how long the study takes."""
        source = "the usual one"
        if self.spread > USUAL_SPREAD:
            source = f"from {self.runs} stored runs of the baseline"
        scatter = f"scatter {self.spread:.2f} over scenes, {source}"
        if self.scenes < FEWEST:
            shown = f"{self.scenes} scenes judge this study; below {FEWEST} it claims nothing ({scatter})."
        else:
            shown = (
                f"{self.scenes} scenes judge this study: a candidate with {100 * GAIN:.0f} % less error is proven in "
                f"{100 * self.power:.0f} % of such studies, one with {100 * self.detectable:.0f} % less in four of "
                f"five ({scatter}; one-sided level {100 * self.level:.2g} %)."
            )
        lines = [shown]
        if self.power < POWER and self.level < ONE_SIDED:
            lines.append(
                f"An extendable study proves {100 * GAIN:.0f} % in four of five after its looks at 24 to 48 scenes."
            )
        elif self.power < POWER:
            lines.append(
                f"A design that proves {100 * GAIN:.0f} % in four of five has {self.needed} held-out scenes with one "
                f"start each (offsets = [0]); clips of 40 frames show as much as longer ones."
            )
        basis = ""
        if not self.runs:
            basis = f", at {1000 * FRAME_S:.0f} ms a frame: no run of the baseline is stored that tells more"
        minutes = max(1, math.ceil(self.minutes))
        lines.append(f"The study takes about {minutes} min if no trial is pruned{basis}.")
        return lines

    @property
    def proposal(self) -> list[str]:
        """The settings that are not used here, and the space without them; it takes runs of the baseline to know."""
        if not self.unused:
            return []
        lines = [f"{name} is not used here: {why}." for name, why in self.unused.items()]
        if self.include:
            # as TOML writes it, to be copied into the study
            lines.append(f"The space without them: include = {self.include}".replace("'", '"'))
        else:
            lines.append("Nothing would be left of the space without them.")
        return lines


class StudyPlan:
    """A study resolved before it runs: trackers, baseline, search space, instances.

    Nothing runs, and nothing is stored.

    Args:
        spec: The study.
        results: The results folder.
        objectives: In place of those that the study names, in their order.
        constraints: Further ones by name: functions of `objectives.Outcome` whose mean over the
            instances has to be <= 0.

    Attributes:
        held: See `held_settings`.
        baseline: What ratios are to.
        default_configuration: The tracker's default settings, where the baseline is something else.
        defaults: The settings of trial 0.
        base: Settings of trial 0 by dotted name, with those of the other trackers to choose from.
        trackers: The trackers to choose from, the study's own first.
        search: The space.
        space: What is tuned, as its parameters.
        design: Instances that the study runs on, by what they are for.

    Raises:
        DynslamError: Anything in the spec is unknown, unfit or missing.
    """

    def __init__(
        self,
        spec: StudySpec,
        results: str | Path = "results",
        *,
        objectives: Sequence[Objective] | None = None,
        constraints: Mapping[str, Callable[[Outcome], float]] | None = None,
    ) -> None:
        self.spec = spec
        self.results = Path(results)
        self.store = RunStore(results)
        if objectives is None:
            objectives = [find_objective(name) for name in spec.objectives]
        self.objectives = list(objectives)
        self.constraints = dict(constraints or {})
        for name in spec.limits:
            quantity(name)  # refuses an unknown one

        # the trackers to choose from, the study's own first, each with those settings that it has
        fixed = spec.space.fixed
        self.held = held_settings(spec)
        self.trackers = _trackers(spec)
        protocol = hold_last_pose_protocol(spec.protocol)
        settings_by_tracker: dict[str, Settings] = {}
        for tracker in self.trackers:
            tracker_spec = TRACKERS.get(tracker)
            protocol.check_scale(tracker, tracker_spec.sensors)
            held = self.configuration({TRACKER: tracker}).settings
            settings_by_tracker[tracker] = apply_overrides(tracker_spec.settings(), held)

        # the baseline: the study's tracker with a preset or its defaults, or another tracker, which
        # has no settings but those of the fixed ones that it knows
        self.baseline = self.configuration({})
        if spec.baseline and not spec.baseline.endswith(".toml"):
            self.baseline = Configuration(spec.baseline, known_settings(spec.baseline, fixed))
        self.default_configuration = None
        if spec.baseline:
            defaults = fixed if len(self.trackers) == 1 else known_settings(spec.tracker, fixed)
            self.default_configuration = Configuration(spec.tracker, defaults)

        # the space around trial 0, and the instances; in `resolved_by_tracker` a source stands for ``auto``
        self.defaults = settings_by_tracker[spec.tracker]
        sequences = {instance.sequence for instance in spec.instances(*spec.tune)}
        resolved_by_tracker = {
            tracker: _with_source(settings, sequences)
            for tracker, settings in settings_by_tracker.items()
        }
        self.search = build_space(spec.space, settings_by_tracker, resolved_by_tracker)
        self.space = list(self.search.parameters)
        self.base = self.search.base | flatten(self.defaults)
        # refuse a study whose trial 0 lies outside its space
        starting_point({}, self.search, what="the baseline")
        self.design = design_of(spec)

    def preview(self, jobs: int = 1) -> Preview:
        """Estimate what the study could show, from the baseline's stored runs where there are some."""
        design = self.design
        stored = {instance: self._stored(instance) for instance in design.reference}
        records = {instance: record for instance, record in stored.items() if record is not None}

        # scatter over scenes: more starts of a scene hardly lessen it, and runs of the baseline alone show but a part
        judged = scenes(design.judging)
        spread = max(USUAL_SPREAD, self._scatter(records))
        level = self.spec.level(len(judged))

        # mean time of a run, times the runs of the baseline, the trials, the choice and the judgement
        run_s = START_S + FRAME_S * len(design.tune[0].open(self.spec.data_root))
        if records:
            run_s = float(np.mean([record.wall_s for record in records.values()]))
        minutes = math.ceil(self._run_count() / jobs) * run_s / 60

        unused = self._unused(list(records.values()))
        include = []
        if unused:
            include = [parameter.name for parameter in self.space if parameter.name not in unused]
        return Preview(
            scenes=len(judged),
            runs=len(records),
            spread=spread,
            level=level,
            power=power(GAIN, spread, len(judged), level),
            detectable=detectable(spread, len(judged), level),
            needed=scenes_needed(GAIN, spread),
            minutes=minutes,
            unused=unused,
            include=include,
        )

    def _run_count(self) -> int:
        """Runs of the whole study if no trial is pruned."""
        design = self.design
        spec = self.spec
        tried = len(design.reference) + spec.trials * len(design.tune)
        # the best trials and the baseline to choose, then the best one and the baseline to judge
        chosen = (spec.top + 1) * len(design.confirm) if design.held_out else 0
        judged = 2 * (len(design.judging) + len(design.recorded))
        return tried + chosen + judged

    def violations(self, outcomes: Outcomes, baseline: Outcomes | None = None) -> dict[str, float]:
        """Violation of each constraint, see `objectives.violations`."""
        return violations(self.spec, outcomes, baseline, self.constraints)

    def configuration(self, params: Mapping[str, Any]) -> Configuration:
        """Tracker and settings that a configuration of the space runs with."""
        settings = {**self.held, **params}
        tracker = str(settings.pop(TRACKER, self.spec.tracker))
        if len(self.trackers) > 1:
            settings = known_settings(tracker, settings)
        return Configuration(tracker, settings)

    def run_spec(
        self, instance: ProblemInstance, configuration: Configuration, *, cache: bool | None = None
    ) -> RunSpec:
        """The run of a configuration on an instance; with the stage cache as the study says, unless `cache` does."""
        spec = self.spec
        return instance.run_spec(
            configuration.tracker,
            settings=dict(configuration.settings),
            data_root=spec.data_root,
            study=spec.name,
            threads=spec.threads,
            cache=spec.cache if cache is None else cache,
        )

    def _stored(self, instance: ProblemInstance) -> RunRecord | None:
        """The baseline's run on an instance, if it is stored and came to its end."""
        record = LookUp(self.store).find(resolve(self.run_spec(instance, self.baseline)))
        if record is None or record.failed or record.status == "stopped":
            return None
        return record

    def check_plugins(self) -> None:
        """Refuse to go on where what the plug-ins read has changed since the baseline ran.

        What a plug-in reads is known only from its runs, so that the study's identity cannot hold
        it.

        Raises:
            StudyError: It names what has changed.
        """
        run = resolve(self.run_spec(self.design.tune[0], self.baseline))
        changed = LookUp(self.store).changed(run) if run.has_plugins_or_programs else ""
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
        # variance within places, pooled over them; that of a difference of two runs is twice it
        logs = log_errors(errors).values()
        degrees_of_freedom = sum(len(values) - 1 for values in logs)
        if not degrees_of_freedom:
            return 0.0
        squares = sum(float(np.var(values)) * len(values) for values in logs)
        return math.sqrt(2 * squares / degrees_of_freedom)

    def _unused(self, records: list[RunRecord]) -> dict[str, str]:
        """Names of settings without effect in the baseline's runs, with the reason: their part dropped no feature."""
        if not records or self.baseline.tracker != self.spec.tracker or len(self.trackers) > 1:
            return {}
        # the most features that each filter dropped on any frame, by the filter's name
        frames = pd.concat([load_frames(record, self.store) for record in records])
        most = frames.filter(regex="^stat_.*_dropped$").max()
        most.index = most.index.str.removeprefix("stat_").str.removesuffix("_dropped")

        # parts without effect, and why; the first part of a setting's name is its part
        why = f"its test dropped no feature in {len(records)} runs"
        idle = dict.fromkeys(most.index[most == 0], why)
        if all(record.epipolar_skipped == 1 for record in records):
            idle["epipolar"] = "F was skipped on all frames"
        if "semantic" in idle:
            idle["segmentation"] = "masks held no feature on any frame"
        flow_filters = FLOW_FILTERS & set(most.index)
        if flow_filters and flow_filters <= idle.keys():
            idle["flow"] = f"no verdict of {' and '.join(sorted(flow_filters))} on it was used"
        parts = {parameter.name: parameter.name.split(".")[0] for parameter in self.space}
        return {name: idle[part] for name, part in parts.items() if part in idle}


# The splits of a study.

FEWEST_STARTS = 3
"""The baseline runs from so many starts at every place: all trials would share the luck of a single one."""
JUDGING_SCENES = 28
"""Scenes that are made to judge on where a study names none: they prove a gain of 20 % in four of five studies at the
usual scatter (`USUAL_SPREAD`)."""
RECORDED_FRAMES = 120
"""Frames of each start on the recording that a study does not name itself."""
RECORDED_STARTS = 4
"""Starts on that recording."""


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
        recorded: Recordings that the best trial is run on at the end; they decide nothing.
    """

    tune: tuple[ProblemInstance, ...]
    reference: tuple[ProblemInstance, ...]
    confirm: tuple[ProblemInstance, ...]
    held_out: tuple[ProblemInstance, ...]
    recorded: tuple[ProblemInstance, ...]

    @property
    def judging(self) -> tuple[ProblemInstance, ...]:
        """Instances that judge: the held-out ones, or else `confirm`."""
        return self.held_out or self.confirm


def design_of(spec: StudySpec, *, further: int = 0) -> Design:
    """Lay out the instances of a study and check them.

    Args:
        spec: The study.
        further: Rendered scenes that are added to those that judge.

    Raises:
        DynslamError: See `plan.check_splits`; or further scenes cannot be made.
    """
    tune = spec.instances(*spec.tune)
    confirm = spec.instances(*spec.confirm)
    held_out = spec.instances(*spec.held_out)
    taken = {instance.scene for instance in (*tune, *confirm, *held_out)}

    # instances that judge where none are named, and those that `tune extend` has added
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

    # the splits have to be apart, recordings that the study names included
    splits: dict[Split, list[ProblemInstance]] = {
        "tune": tune,
        "confirm": confirm,
        "held_out": held_out,
    }
    check_splits(spec.name, splits, data_root=spec.data_root)
    if spec.recorded is None:
        recorded = _recordings(spec, taken)
    else:
        recorded = spec.instances(*spec.recorded)
    if spec.recorded:
        splits = {"tune": [*tune, *confirm], "held_out": recorded}
        check_splits(spec.name, splits, data_root=spec.data_root)

    tune = running_order(tune, spec.sampler_seed)
    return Design(
        tune=tuple(tune),
        reference=tuple(with_more_starts(tune)),
        confirm=tuple(confirm),
        held_out=tuple(held_out),
        recorded=tuple(recorded),
    )


def running_order(instances: Sequence[ProblemInstance], seed: int) -> list[ProblemInstance]:
    """The instances in the order of all trials: one of each scene in turn, so that small sets hold different scenes."""
    groups = list(scenes(instances).values())
    stream(seed, "order").shuffle(groups)
    # a round holds an instance of each scene that has one left
    rounds = zip_longest(*groups)
    return [instance for one_each in rounds for instance in one_each if instance is not None]


def with_more_starts(instances: Sequence[ProblemInstance]) -> list[ProblemInstance]:
    """The instances, and more starts of each place that has fewer than `FEWEST_STARTS`."""
    more = list(instances)
    for repeats in grouped(instances, instance_without_repeat).values():
        used = {instance.offset for instance in repeats}
        unused = (offset for offset in itertools.count() if offset not in used)
        added = islice(unused, max(FEWEST_STARTS - len(used), 0))
        more += [replace(repeats[0], offset=offset) for offset in added]
    return more


def _recordings(spec: StudySpec, taken: set[str]) -> list[ProblemInstance]:
    """The first frames of the first held-out recording that is here and that the study does not name itself."""
    root = find_data_root(spec.data_root)
    for entry in catalogue().values():
        if entry.split != "held-out" or entry.id in taken or entry.find(root) is None:
            continue
        # the last start has as many frames as asked for, where the recording is that long
        length = len(open_public(entry.id, data_root=root))
        frames = min(RECORDED_FRAMES + RECORDED_STARTS - 1, length)
        return [ProblemInstance(entry.id, (0, frames), offset) for offset in range(RECORDED_STARTS)]
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
        name: Name of the study.
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

    # content: no sequence of one split may be one of the other
    scenes_of = {name: sequence_part_of(sequence).scene for name, sequence in opened.items()}
    faults = [
        f"'{one}' to tune on and '{other}' held out are the same sequence"
        for one, other in product(tuned, judged)
        if scenes_of[one] == scenes_of[other] or same_recording(opened[one], opened[other])
    ]
    # catalogue and scene numbers: none may stand in the split that it is not of
    for names, used_as, other_split in ((tuned, "tune", "held-out"), (judged, "held-out", "tune")):
        for name in names:
            if getattr(opened[name], "split", "") == other_split:
                faults.append(_misplaced(name, used_as, other_split))
    if faults:
        raise StudyError(
            f"the splits of study '{name}' are not apart: {faults[0]}", "leave one out"
        )


def _check_copies(study: str, names: Iterable[str], opened: Mapping[str, Any]) -> None:
    """Refuse one recording under several names within a split: it would count as several scenes."""
    recorded = [name for name in names if not hasattr(opened[name], "scene_digest")]
    for one, other in combinations(recorded, 2):
        if sequence_part_of(opened[one]).scene == sequence_part_of(opened[other]).scene:
            continue
        if same_recording(opened[one], opened[other]):
            raise StudyError(
                f"study '{study}': '{one}' and '{other}' are the same recording, and would count as two scenes",
                "leave one out",
            )


def _check_repeats(
    instances: Sequence[ProblemInstance], opened: Mapping[str, Any], apart: set[ProblemInstance]
) -> None:
    """Refuse instances of one scene that share frames and are no repeats of each other.

    Args:
        instances: Instances of the splits that may share a recording.
        opened: Sequences of the instances, by name.
        apart: Instances that may share no frame with the others, whether they are repeats or not.

    Raises:
        StudyError: Two share frames, or an instance is named twice.
    """
    parts: dict[ProblemInstance, SequencePart] = {}
    for instance in instances:
        if instance in parts:
            raise StudyError(f"instance '{instance}' is named twice", "leave one out")
        cut = cast("Any", instance.cut(opened[instance.sequence]))
        parts[instance] = sequence_part_of(cut, instance.offset)
    for (one, here), (other, there) in combinations(parts.items(), 2):
        if here.scene != there.scene:
            continue
        if _images(one, here) == _images(other, there):
            raise StudyError(f"'{one}' and '{other}' are the same frames", "leave one out")
        shared = min(here.stop, there.stop) - max(here.start, there.start)
        same_frames = (here.start, here.stop) == (there.start, there.stop)
        repeats = instance_without_repeat(one) == instance_without_repeat(other) or same_frames
        if shared > 0 and not (repeats and (one in apart) == (other in apart)):
            raise StudyError(
                f"'{one}' and '{other}' share {shared} frames",
                "write instances of a sequence apart",
            )


def _images(instance: ProblemInstance, part: SequencePart) -> tuple[object, ...]:
    """Key of the images that a tracker sees, and of the random numbers that it draws, within a scene."""
    return part.block, part.noise, instance.offset, instance.degradation, instance.seed


def _misplaced(name: str, used_as: str, other_split: str) -> str:
    """The fault of a sequence that is used in one split and belongs to the other."""
    reason = "the catalogue"
    if name.startswith("synthetic/"):
        held_out = f"{HELD_OUT_SCENES.start} and above"
        tuning = f"{TUNE_SCENES.start}-{TUNE_SCENES.stop - 1}"
        reason = f"its scene ({held_out if other_split == 'held-out' else tuning})"
    return f"'{name}' is used as {used_as}, but {reason} puts it into the {other_split} split"


# Whether two recordings show the same: by their images, never by names.

_PAIRS = 6
"""So many pairs of frames are compared by their images."""
_ENOUGH = 3
"""Pairs with equal images; fewer may be chance, as two paths may cross."""
_MOST_LEFT_OUT = 20
"""So many frames that one sequence lacks at the beginning are looked for, and more where they are left out evenly."""
_THUMB = (32, 24)
"""Width and height in pixels to which images are reduced before they are compared."""
_GREY_LEVELS = 1.5
"""Equal colours differ by no more than so many levels (of 255) on average."""
_DEPTH_SHARE = 0.002
"""Equal depths differ by no more than this share of the median depth, half a step of the file added."""


def same_recording(one: Frames, other: Frames) -> bool:
    """Whether frames of one recording are frames of the other; False for two rendered scenes, whose digests tell.

    Where the camera moves, equal true poses say it, whatever was done to stamps and images. Else the decoded images
    of a few frames are compared, reduced to `_THUMB` pixels: of frames with equal stamps, then of frames spread
    over the shorter one with those of the other that may be the same. Other names, other image files and a smaller
    size leave a copy a copy, and so do frames that are left out and other stamps.
    """
    if hasattr(one, "scene_digest") and hasattr(other, "scene_digest"):
        return False
    if same_path(one.ground_truth, other.ground_truth):
        return True

    shorter, longer = sorted((one, other), key=len)
    enough = min(_ENOUGH, len(shorter))

    # frames of equal stamps
    stamps = (np.round(shorter.timestamps, 6), np.round(longer.timestamps, 6))
    _, *frames = np.intersect1d(*stamps, assume_unique=True, return_indices=True)
    if len(frames[0]):
        chosen = _spread_over(len(frames[0]))
        pairs = zip(frames[0][chosen].tolist(), frames[1][chosen].tolist(), strict=True)
        equal = sum(_any_same_image(shorter, first, longer, [second]) for first, second in pairs)
        if equal >= enough:
            return True

    # whatever the stamps: frames may be left out anywhere, or evenly
    left_out = len(longer) - len(shorter)
    equal = 0
    for first in _spread_over(len(shorter)):
        evenly = round(first * (len(longer) - 1) / max(len(shorter) - 1, 1))
        near = {first + shift for shift in range(min(left_out, _MOST_LEFT_OUT) + 1)}
        near |= {evenly - 1, evenly, evenly + 1}
        near_frames = sorted(number for number in near if 0 <= number < len(longer))
        equal += _any_same_image(shorter, first, longer, near_frames)
    return equal >= enough


def _spread_over(count: int) -> list[int]:
    """Up to `_PAIRS` of so many numbers, spread evenly."""
    return sorted(set(np.linspace(0, count - 1, _PAIRS).astype(int).tolist()))


def _any_same_image(one: Frames, first: int, other: Frames, candidates: Sequence[int]) -> bool:
    """Whether a frame of one sequence shows the same as one of the other's."""
    frame = one[first]
    return any(_same_image(frame, other[second], one.camera, other.camera) for second in candidates)


def _same_image(here: Frame, there: Frame, one: Camera, other: Camera) -> bool:
    """Whether two frames show the same colour, and depth in the numbers that their files hold."""
    colours = [
        cv2.resize(frame.rgb.astype(np.float32), _THUMB, interpolation=cv2.INTER_AREA)
        for frame in (here, there)
    ]
    if np.abs(colours[0] - colours[1]).mean() > _GREY_LEVELS:
        return False
    # metres times the depth factor: the whole numbers of the files
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
    """Source of a system's masks; the embedded network for ``auto`` where everything is rendered.

    Args:
        settings: Settings of the system.
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
    seen_splits = []
    for split, instances in splits.items():
        names = {instance.sequence for instance in instances}
        if any(seen_in_training(source_of_masks(settings, [name]), name) for name in names):
            seen_splits.append(split)
    return seen_splits


def seen_note(splits: Sequence[str]) -> str:
    """Sentence on splits that the masks' network has seen in training; empty without any."""
    if not splits:
        return ""
    names = {"tune": "trials", "confirm": "choice", "held_out": "held-out instances"}
    named = " and ".join(names[split] for split in splits)
    if "held_out" in splits:
        judged = (
            "so nothing here judges the masks: held-out instances are rendered scenes from 100 on"
        )
    else:
        judged = (
            "so errors there are optimistic, and the held-out instances, which it has not seen, "
            "may gain less or more"
        )
    return f"{SEEN} In the {named} the masks come from a network that was trained on those very scenes, {judged}."
