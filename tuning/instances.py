"""Problem instances, the units of a study: part of one sequence, from one start, with one seed."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from collections.abc import Sequence as PySequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import SequenceError, StudyError, did_you_mean
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.sequences.catalogue import entry_of, open_sequence, parse_frames
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.sequences.view import SequenceView

FEWEST_FRAMES = 2
"""A shorter instance has no motion."""
_TEXT = re.compile(r"(?P<name>[^\[\]?]+)(?:\[(?P<frames>[^\]]*)\])?(?:\?(?P<query>.*))?")
_NUMBER, _NUMBERS = "[1-9][0-9]{0,8}", "[0-9]{1,9}(-[0-9]{1,9})?(,[0-9]{1,9}(-[0-9]{1,9})?)*"
_STRENGTHS = r"[a-z]+:[0-9]*\.?[0-9]+(,[a-z]+:[0-9]*\.?[0-9]+)*"
_OPTIONS = {
    "scene": _NUMBERS, "frames": _NUMBER, "offsets": _NUMBERS, "stride": _NUMBER, "seeds": _NUMBERS,
    "degrade": _STRENGTHS, "noise": "[0-9]{1,9}",
}  # fmt: skip
"""What may stand behind the question mark, and how its value is written."""
_FORM = 'write it as "bonn/crowd[0:120]" or "synthetic/walking_xyz?scene=0-19&frames=80&offsets=0-4"'


@dataclass(frozen=True, order=True)
class ProblemInstance:
    """What a configuration is tried on: some frames of one sequence, from one start.

    Attributes:
        sequence: Id or folder of the sequence.
        frames: First frame and one past the last (None: the end); None for the whole sequence.
        offset: So many leading frames of that part are left out: a repeat of the same scene from another start.
        stride: Every so many frames.
        degradation: Kinds and strengths of `DegradeFrames`, for example ``(("blur", 0.5),)``.
        seed: Seed of the run; changes nothing for a tracker that draws nothing from it.
    """

    sequence: str
    frames: tuple[int, int | None] | None = None
    offset: int = 0
    stride: int = 1
    degradation: tuple[tuple[str, float], ...] = ()
    seed: int = 0

    def __str__(self) -> str:
        """The text that `parse_instances` reads as this instance alone."""
        name, _, query = self.sequence.partition("?")
        first, last = self.frames or (0, None)
        part = "" if self.frames is None else f"[{first}:{'' if last is None else last}]"
        options = [query] if query else []
        options += [f"offsets={self.offset}"]
        options += [f"stride={self.stride}"] if self.stride > 1 else []
        options += [f"seeds={self.seed}"] if self.seed else []
        if self.degradation:
            options.append("degrade=" + ",".join(f"{kind}:{strength:g}" for kind, strength in self.degradation))
        return f"{name}{part}?{'&'.join(options)}"

    @property
    def scene(self) -> str:
        """What is filmed, as far as the name tells: equal for all parts, lengths, starts and noises of a sequence."""
        return scene_of(self.sequence)

    def run_spec(self, tracker: str, **how: Any) -> RunSpec:
        """The run of a tracker on this instance; `how` holds further fields of `RunSpec`."""
        return RunSpec(
            tracker=tracker, sequence=self.sequence, frames=self.frames, offset=self.offset, stride=self.stride,
            seed=self.seed, degrade=dict(self.degradation), **how,
        )  # fmt: skip

    def open(self, data_root: str | None = None) -> SequenceView:
        """The sequence, cut to what a tracker sees of it; see `cut` for what is raised beside `SequenceError`."""
        return self.cut(open_sequence(self.sequence, data_root=data_root))

    def cut(self, whole: Sequence) -> SequenceView:
        """The instance of an opened sequence.

        Raises:
            StudyError: The instance is longer than the sequence or too short, or the sequence has no ground truth.
        """
        first, last = self.frames or (0, None)
        stop = len(whole) if last is None else last
        if stop > len(whole) or first >= stop:
            raise StudyError(
                f"instance '{self}' takes the frames {first} to {stop - 1}, but '{whole.id}' has {len(whole)} frames"
            )
        cut = SequenceView(whole, first + self.offset, stop, self.stride)
        if len(cut) < FEWEST_FRAMES:
            raise StudyError(f"instance '{self}' holds {len(cut)} frames, it needs {FEWEST_FRAMES} or more")
        if whole.ground_truth is None:
            raise StudyError(f"'{whole.id}' has no ground truth, so nothing can be tuned on it", "leave it out")
        return cut


def parse_instances(
    text: str, *, offsets: PySequence[int] = (0,), seeds: PySequence[int] = (0,)
) -> tuple[ProblemInstance, ...]:
    """Read one text of a study file.

    ``[A:B]`` takes a part of any sequence, ``?frames=N`` its first N frames (a rendered one is made that long).
    ``?scene=0-19`` names scenes of a rendered one (``@0-19`` is read as well), ``noise=SEED`` a draw of its noise.
    ``scene``, ``offsets`` and ``seeds`` are numbers and ranges (``0-4,7``), ``degrade`` strengths
    (``blur:0.5,glare:0.2``), ``stride`` a step between frames.

    Args:
        text: Of a study's `tune`, `confirm` or `held_out`.
        offsets: Start offsets where the text names none.
        seeds: Seeds where the text names none.

    Returns:
        The instances: for each scene in turn all offsets with all seeds.

    Raises:
        StudyError: It cannot be read; says how it is written.
    """
    if os.path.isdir(os.path.expanduser(text)):  # noqa: PTH111, PTH112  # no error for what cannot be a path
        return tuple(ProblemInstance(text, offset=offset, seed=seed) for offset, seed in product(offsets, seeds))
    match = _TEXT.fullmatch(text)
    if match is None:
        raise StudyError(f"'{text}' names no instances", _FORM)
    name, query = match["name"], match["query"] or ""
    rendered = name.startswith("synthetic/")
    if rendered:
        name, separator, scenes = name.partition("@")
        query = f"scene={scenes}&{query}".rstrip("&") if separator else query
    options = _options(query, text)
    frames = _frames(match["frames"], text)
    if rendered:
        rest = [f"{key}={options[key]}" for key in ("frames", "noise") if key in options]
        numbers = [f"scene={scene}" for scene in _numbers(options["scene"], text)] if "scene" in options else [""]
        queries = ["&".join(filter(None, [number, *rest])) for number in numbers]
        names = [f"{name}?{query}" if query else name for query in queries]
    else:
        for option in ({"scene", "noise"} | ({"frames"} if frames else set())) & options.keys():
            raise StudyError(f"'{text}' may not have a {option}", _FORM)
        frames = (0, int(options["frames"])) if "frames" in options else frames
        names = [name]
    starts = _numbers(options["offsets"], text) if "offsets" in options else offsets
    seeds = _numbers(options["seeds"], text) if "seeds" in options else seeds
    stride, strengths = int(options.get("stride", 1)), _strengths(options.get("degrade", ""), text)
    return tuple(
        ProblemInstance(name, frames, offset, stride, strengths, seed)
        for name, offset, seed in product(names, starts, seeds)
    )


def scene_of(name: str) -> str:
    """What a sequence's name stands for, as far as the name alone tells (see `splits` for the content).

    The frames that are taken of a sequence, and the draw of its noise, make no other scene.
    """
    if name.startswith("synthetic/"):
        try:
            parsed = parse_synthetic_id(name)
        except SequenceError:
            return name  # refused with a did-you-mean where it is opened
        return replace(parsed, noise=None).whole
    entry = entry_of(name)
    return entry.id if entry is not None else str(Path(name).expanduser().resolve())


def scenes(instances: Iterable[ProblemInstance]) -> dict[str, list[ProblemInstance]]:
    """Instances by their scene, both in order of appearance."""
    groups: dict[str, list[ProblemInstance]] = {}
    for instance in instances:
        groups.setdefault(instance.scene, []).append(instance)
    return groups


def further_scenes(
    instances: Iterable[ProblemInstance], count: int, taken: Iterable[str], numbers: range
) -> list[ProblemInstance]:
    """Further scenes of rendered sequences, one of each sequence in turn, each with the starts and seeds of its first.

    Args:
        instances: Those to be continued.
        count: Scenes.
        taken: Scenes, as `scene_of` gives them, that are in use.
        numbers: Scene numbers to choose from.

    Raises:
        StudyError: None of the instances is rendered, or the numbers are used up.
    """
    taken, models = set(taken), dict[str, list[ProblemInstance]]()
    for group in scenes(instances).values():
        if group[0].sequence.startswith("synthetic/"):
            models.setdefault(parse_synthetic_id(group[0].sequence).name, group)
    added: list[list[ProblemInstance]] = []
    for number, group in product(numbers, models.values()):
        moved = [
            replace(instance, sequence=str(replace(parse_synthetic_id(instance.sequence), scene=number)))
            for instance in group
        ]
        if len(added) < count and moved[0].scene not in taken:
            added.append(moved)
    if len(added) < count:
        raise StudyError(
            f"{count} further scenes cannot be made, only {len(added)}",
            "scenes can be made of rendered sequences alone",
        )
    return [instance for group in added for instance in group]


def stretches_behind(instances: Iterable[ProblemInstance], data_root: str | None) -> list[ProblemInstance]:
    """The parts of recordings moved behind the last frame that is named of each, as far as the recording goes."""
    parts: dict[str, list[tuple[ProblemInstance, int, int]]] = {}
    for instance in instances:
        first, last = instance.frames or (0, None)
        if last is not None and not instance.sequence.startswith("synthetic/"):
            parts.setdefault(instance.sequence, []).append((instance, first, last))
    moved = []
    for sequence, group in parts.items():
        shift = max(last for _, _, last in group) - min(first for _, first, _ in group)
        length = len(open_sequence(sequence, data_root=data_root))
        moved += [
            replace(instance, frames=(first + shift, last + shift))
            for instance, first, last in group
            if last + shift <= length
        ]
    return moved


def _options(query: str, text: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for option in query.split("&") if query else ():
        key, _, value = option.partition("=")
        if key not in _OPTIONS or not value:
            raise StudyError(f"'{text}' has an unknown option '{option}'", did_you_mean(key, list(_OPTIONS)))
        if key in options:
            raise StudyError(f"'{text}' names {key} twice", "leave one out")
        if not re.fullmatch(_OPTIONS[key], value):
            raise StudyError(f"'{option}' of '{text}' cannot be read", _FORM)
        options[key] = value
    return options


def _frames(text: str | None, whole: str) -> tuple[int, int | None] | None:
    try:
        frames = parse_frames(text)
    except SequenceError as error:
        raise StudyError(f"'{whole}': {error.args[0]}", error.hint) from error
    return None if frames == (0, None) else frames


def _numbers(text: str, whole: str) -> list[int]:
    """``0-4,7`` as ``[0, 1, 2, 3, 4, 7]``."""
    numbers: list[int] = []
    for piece in text.split(","):
        first, _, last = piece.partition("-")
        chosen = range(int(first), int(last or first) + 1)
        if not chosen or not set(numbers).isdisjoint(chosen):
            raise StudyError(f"'{piece}' of '{whole}' is no range of numbers, or repeats one", "write 0-4,7")
        numbers += chosen
    return numbers


def _strengths(text: str, whole: str) -> tuple[tuple[str, float], ...]:
    from dynslam_bench.envs import Degradation

    strengths: dict[str, float] = {}
    kinds = [name for name in Degradation.__dataclass_fields__ if name != "seed"]
    for piece in text.split(",") if text else ():
        kind, _, strength = piece.partition(":")
        if kind not in kinds:
            raise StudyError(f"'{whole}': unknown degradation '{kind}'", did_you_mean(kind, kinds))
        strengths[kind] = float(strength)
    Degradation(**strengths)  # type: ignore[arg-type]  # refuses a strength out of range
    return tuple(sorted(strengths.items()))
