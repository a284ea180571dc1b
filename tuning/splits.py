"""The splits of a study: instances to tune on, to choose on and to judge on, and whether they are apart."""

import itertools
from collections.abc import Mapping
from collections.abc import Sequence as PySequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, product, zip_longest
from typing import Any, Literal, cast

import cv2
import numpy as np

from dynslam_bench.contracts import Frame, Sequence
from dynslam_bench.core import StudyError, find_data_root
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera
from dynslam_bench.reports.model.row import SEEN, grouped
from dynslam_bench.segmentation.networks.checkpoints import seen_in_training
from dynslam_bench.sequences.catalogue import catalogue, open_public, open_sequence
from dynslam_bench.sequences.synthetic import HELD_OUT_SCENES, TUNE_SCENES
from dynslam_bench.sequences.view import Part, part_of
from dynslam_bench.tuning.objectives import place_of
from dynslam_bench.tuning.study_file import ProblemInstance, StudySpec, further_scenes, scenes, stretches_behind

FEWEST_STARTS = 3
"""The baseline runs from so many starts at every place: all trials would share the luck of a single one."""
CONFIRM_SCENES = 18
"""Scenes at least that are made for the choice; half as many as to tune on where that is more."""
RECORDED_FRAMES, RECORDED_STARTS = 120, 4


@dataclass(frozen=True)
class Design:
    """The instances of a study.

    Attributes:
        tune: What trials run on, in the order of all trials.
        reference: What the baseline runs on beforehand: `tune`, and more starts where those are few.
        confirm: What the best trials and the baseline run on for the choice; shares no frame with `tune`. Empty where
            recordings have no further frames: then nothing can be claimed.
        held_out: What judges the choice.
        recorded: Recordings on which the choice must not be worse.
    """

    tune: tuple[ProblemInstance, ...]
    reference: tuple[ProblemInstance, ...]
    confirm: tuple[ProblemInstance, ...]
    held_out: tuple[ProblemInstance, ...]
    recorded: tuple[ProblemInstance, ...]


def design_of(spec: StudySpec, *, further: int = 0) -> Design:
    """Lay out the instances of a study and check them.

    Args:
        spec: The study.
        further: Rendered scenes that are added to the choice and to the judgement.

    Raises:
        DynslamError: See `splits.check_splits`; or further scenes cannot be made.
    """
    tune, confirm, held_out = (spec.instances(*texts) for texts in (spec.tune, spec.confirm, spec.held_out))
    taken = {instance.scene for instance in (*tune, *confirm, *held_out)}
    if not confirm:
        rendered = {instance.scene for instance in tune if instance.sequence.startswith("synthetic/")}
        if rendered:
            confirm = further_scenes(tune, max(CONFIRM_SCENES, (len(rendered) + 1) // 2), taken, TUNE_SCENES)
        confirm += stretches_behind(tune, spec.data_root)
    if further:
        taken |= {instance.scene for instance in confirm}
        confirm += further_scenes(confirm, further, taken, TUNE_SCENES)
        held_out += further_scenes(held_out, further, taken, HELD_OUT_SCENES) if held_out else []
    splits: dict[Split, list[ProblemInstance]] = {"tune": tune, "confirm": confirm, "held_out": held_out}
    check_splits(spec.name, splits, data_root=spec.data_root)
    recorded = _recordings(spec, taken) if spec.recorded is None else spec.instances(*spec.recorded)
    if spec.recorded:
        splits = {"tune": [*tune, *confirm], "held_out": recorded}
        check_splits(spec.name, splits, data_root=spec.data_root)
    tune = running_order(tune, spec.sampler_seed)
    return Design(tuple(tune), tuple(with_more_starts(tune)), tuple(confirm), tuple(held_out), tuple(recorded))


def running_order(instances: PySequence[ProblemInstance], seed: int) -> list[ProblemInstance]:
    """The instances in the order of all trials: one of each scene in turn, so that small sets hold different scenes."""
    groups = list(scenes(instances).values())
    stream(seed, "order").shuffle(groups)
    return [instance for turn in zip_longest(*groups) for instance in turn if instance is not None]


def with_more_starts(instances: PySequence[ProblemInstance]) -> list[ProblemInstance]:
    """The instances, and more starts of each place that has fewer than `FEWEST_STARTS`."""
    more = []
    for repeats in grouped(instances, place_of).values():
        used = {instance.offset for instance in repeats}
        unused = (offset for offset in itertools.count() if offset not in used)
        more += [replace(repeats[0], offset=offset) for offset in islice(unused, max(FEWEST_STARTS - len(used), 0))]
    return [*instances, *more]


def _recordings(spec: StudySpec, taken: set[str]) -> list[ProblemInstance]:
    """The first frames of the first held-out recording that is here and that the study does not name itself."""
    root = find_data_root(spec.data_root)
    for entry in catalogue().values():
        if entry.split == "held-out" and entry.id not in taken and entry.find(root) is not None:
            frames = min(RECORDED_FRAMES + RECORDED_STARTS - 1, len(open_public(entry.id, data_root=root)))
            return [ProblemInstance(entry.id, (0, frames), offset) for offset in range(RECORDED_STARTS)]
    return []


# Whether a study's instances are what they say: apart by content, by the catalogue, by the scenes.

Split = Literal["tune", "confirm", "held_out"]


def check_splits(
    name: str,
    splits: Mapping[Split, PySequence[ProblemInstance]],
    *,
    data_root: str | None = None,
) -> None:
    """Open every instance of a study and compare its splits.

    Two splits overlap if they film the same content, however it is called: other frames or another draw of the noise of
    a sequence are no other sequence, nor is a copy or an excerpt of a recording in another folder, with other file
    names, other stamps or other image files (`same_recording`). `tune` and `confirm` may share a recording, but no
    frame. A sequence that the catalogue, or its scene, gives to one split must not stand in the other.

    Args:
        name: Of the study.
        splits: Its instances: to tune on, to judge the survivors on, and held out.
        data_root: Folder of the recorded sequences.

    Raises:
        StudyError: They are not apart, a split names the same frames twice, or an instance is too long, too short or
            without ground truth; names both spellings.
        SequenceError: A sequence is unknown or missing.
    """
    tune, held_out = [*splits.get("tune", ()), *splits.get("confirm", ())], list(splits.get("held_out", ()))
    tuned = dict.fromkeys(instance.sequence for instance in tune)
    judged = dict.fromkeys(instance.sequence for instance in held_out)
    opened: dict[str, Any] = {name: open_sequence(name, data_root=data_root) for name in (*tuned, *judged)}
    for instances in (tune, held_out):
        _check_repeats(instances, opened, apart=set(splits.get("confirm", ())))
    scenes_of = {name: part_of(sequence).scene for name, sequence in opened.items()}
    faults = [
        f"'{one}' to tune on and '{other}' held out are the same sequence"
        for one, other in product(tuned, judged)
        if scenes_of[one] == scenes_of[other] or same_recording(opened[one], opened[other])
    ]
    for names, used, own in ((tuned, "tune", "held-out"), (judged, "held-out", "tune")):
        faults += [_misplaced(name, used, own) for name in names if getattr(opened[name], "split", "") == own]
    if faults:
        raise StudyError(f"the splits of study '{name}' are not apart: {faults[0]}", "leave one out")


def _check_repeats(
    instances: PySequence[ProblemInstance], opened: Mapping[str, Any], apart: set[ProblemInstance]
) -> None:
    """Instances of one scene are repeats of the same frames or share none; those in `apart` share none with others."""
    parts: dict[ProblemInstance, Part] = {}
    for instance in instances:
        if instance in parts:
            raise StudyError(f"instance '{instance}' is named twice", "leave one out")
        parts[instance] = part_of(cast("Any", instance.cut(opened[instance.sequence])), instance.offset)
    for (one, here), (other, there) in combinations(parts.items(), 2):
        if here.scene != there.scene:
            continue
        if (here.block, here.noise, _drawn(one)) == (there.block, there.noise, _drawn(other)):
            raise StudyError(f"'{one}' and '{other}' are the same frames", "leave one out")
        shared = min(here.stop, there.stop) - max(here.start, there.start)
        repeats = place_of(one) == place_of(other) or (here.start, here.stop) == (there.start, there.stop)
        if shared > 0 and not (repeats and (one in apart) == (other in apart)):
            raise StudyError(f"'{one}' and '{other}' share {shared} frames", "write instances of a sequence apart")


def _drawn(instance: ProblemInstance) -> tuple[object, ...]:
    return instance.offset, instance.degradation, instance.seed


def _misplaced(name: str, used: str, own: str) -> str:
    numbers = HELD_OUT_SCENES if own == "held-out" else TUNE_SCENES
    who = f"its scene ({numbers.start}-{numbers.stop - 1})" if name.startswith("synthetic/") else "the catalogue"
    return f"'{name}' is used as {used}, but {who} puts it into the {own} split"


# Whether two recordings show the same: by their images, never by names.

_PAIRS = 6
"""So many pairs of frames are compared by their images."""
_ENOUGH = 3
"""Pairs with equal images; fewer may be chance, as two paths may cross."""
_THUMB = (32, 24)
_GREY_LEVELS = 1.5
_DEPTH_SHARE = 0.002


def same_recording(one: Sequence, other: Sequence) -> bool:
    """Whether frames of one recording are frames of the other; of two rendered scenes never: their digests tell.

    Of a few frames with equal stamps (without any, of frames spread evenly over both) the decoded images are compared,
    reduced to `_THUMB` pixels. Other names, other image files and a smaller size leave a copy a copy, and so do frames
    that are left out or other stamps, one of the two.
    """
    if hasattr(one, "scene_digest") and hasattr(other, "scene_digest"):
        return False
    stamps = (np.round(one.timestamps, 6), np.round(other.timestamps, 6))
    _, *frames = np.intersect1d(*stamps, assume_unique=True, return_indices=True)
    if not len(frames[0]):
        frames = [np.arange(len(one)), np.arange(len(other))]
    here, there = (numbers[np.linspace(0, len(numbers) - 1, _PAIRS).astype(int)].tolist() for numbers in frames)
    pairs = set(zip(here, there, strict=True))
    alike = sum(_alike(one[first], other[second], one.camera, other.camera) for first, second in pairs)
    return alike >= min(_ENOUGH, len(one), len(other))


def _alike(here: Frame, there: Frame, one: Camera, other: Camera) -> bool:
    """Whether two frames show the same colour, and depth in the numbers that their files hold."""
    colours = [
        cv2.resize(frame.rgb.astype(np.float32), _THUMB, interpolation=cv2.INTER_AREA) for frame in (here, there)
    ]
    if np.abs(colours[0] - colours[1]).mean() > _GREY_LEVELS:
        return False
    raw = (here.depth * one.depth_factor, there.depth * other.depth_factor)
    depths = [cv2.resize(depth.astype(np.float32), _THUMB, interpolation=cv2.INTER_NEAREST) for depth in raw]
    allowed = _DEPTH_SHARE * float(np.median(depths[0])) + 0.5
    return bool(np.median(np.abs(depths[0] - depths[1])) <= allowed)


# Which instances of a study show scenes that the network behind the masks was trained on: a best case there.


def source_of_masks(settings: Settings, sequences: PySequence[str]) -> str:
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
    names = {split: {instance.sequence for instance in instances} for split, instances in splits.items()}
    return [
        split
        for split, sequences in names.items()
        if any(seen_in_training(source_of_masks(settings, [name]), name) for name in sequences)
    ]


def seen_note(splits: PySequence[str]) -> str:
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
