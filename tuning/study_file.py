"""A study as one TOML file, and the problem instances that its texts name: parts of sequences, each from one start."""

import os
import re
from collections.abc import Iterable
from collections.abc import Sequence as PySequence
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from dynslam_bench.contracts import Sequence
from dynslam_bench.core import SequenceError, StudyError, did_you_mean, read_toml, without_passwords
from dynslam_bench.core.records import Record, validated
from dynslam_bench.core.settings import Scalar
from dynslam_bench.evaluation.verdicts import LOOKS, ONE_SIDED
from dynslam_bench.reports.model.row import grouped
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.sequences import SequenceView
from dynslam_bench.sequences.catalogue import entry_of, open_sequence, parse_frames
from dynslam_bench.sequences.synthetic import parse_synthetic_id

FEWEST_FRAMES = 2
"""A shorter instance has no motion."""

# A text of a study file, NAME[A:B]?OPTIONS, and the values of its options.
_TEXT = re.compile(r"(?P<name>[^\[\]?]+)(?:\[(?P<frames>[^\]]*)\])?(?:\?(?P<query>.*))?")
_NUMBER = "[1-9][0-9]{0,8}"
_NUMBERS = "[0-9]{1,9}(-[0-9]{1,9})?(,[0-9]{1,9}(-[0-9]{1,9})?)*"
_STRENGTHS = r"[a-z]+:[0-9]*\.?[0-9]+(,[a-z]+:[0-9]*\.?[0-9]+)*"
_OPTIONS = {
    "scene": _NUMBERS,
    "frames": _NUMBER,
    "offsets": _NUMBERS,
    "stride": _NUMBER,
    "seeds": _NUMBERS,
    "degrade": _STRENGTHS,
    "noise": "[0-9]{1,9}",
}
"""Options behind the question mark of an id, and how their values are written."""
_FORM = (
    'write it as "bonn/crowd[0:120]" or "synthetic/walking_xyz?scene=0-19&frames=80&offsets=0-4"'
)


@dataclass(frozen=True, order=True)
class ProblemInstance:
    """Frames that a configuration is tried on: a part of one sequence, from one start.

    Attributes:
        sequence: Id or folder of the sequence.
        frames: First frame and one past the last (None: the end); None for the whole sequence.
        offset: So many leading frames of that part are left out: a repeat of the same scene from
            another start.
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
        part = ""
        if self.frames is not None:
            first, stop = self.frames
            part = f"[{first}:{'' if stop is None else stop}]"
        options = [query] if query else []
        options.append(f"offsets={self.offset}")
        if self.stride > 1:
            options.append(f"stride={self.stride}")
        if self.seed:
            options.append(f"seeds={self.seed}")
        if self.degradation:
            strengths = ",".join(f"{kind}:{strength:g}" for kind, strength in self.degradation)
            options.append(f"degrade={strengths}")
        return f"{name}{part}?{'&'.join(options)}"

    @property
    def scene(self) -> str:
        """Name of the filmed scene: equal for all parts, lengths, starts and noises of a sequence."""
        return scene_of(self.sequence)

    def run_spec(self, tracker: str, **how: Any) -> RunSpec:
        """The run of a tracker on this instance; `how` holds further fields of `RunSpec`."""
        return RunSpec(
            tracker=tracker,
            sequence=self.sequence,
            frames=self.frames,
            offset=self.offset,
            stride=self.stride,
            seed=self.seed,
            degrade=dict(self.degradation),
            **how,
        )

    def open(self, data_root: str | None = None) -> SequenceView:
        """The sequence, cut to what a tracker sees of it; see `cut` for what is raised beside `SequenceError`."""
        return self.cut(open_sequence(self.sequence, data_root=data_root))

    def cut(self, whole: Sequence) -> SequenceView:
        """The instance of an opened sequence.

        Raises:
            StudyError: The instance is longer than the sequence or too short, or the sequence has
                no ground truth.
        """
        first, last = self.frames or (0, None)
        stop = len(whole) if last is None else last
        if stop > len(whole) or first >= stop:
            raise StudyError(
                f"instance '{self}' takes the frames {first} to {stop - 1}, but '{whole.id}' has {len(whole)} frames"
            )
        cut = SequenceView(whole, first + self.offset, stop, self.stride)
        if len(cut) < FEWEST_FRAMES:
            raise StudyError(
                f"instance '{self}' holds {len(cut)} frames, it needs {FEWEST_FRAMES} or more"
            )
        if whole.ground_truth is None:
            raise StudyError(
                f"'{whole.id}' has no ground truth, so nothing can be tuned on it", "leave it out"
            )
        return cut


def parse_instances(
    text: str, *, offsets: PySequence[int] = (0,), seeds: PySequence[int] = (0,)
) -> tuple[ProblemInstance, ...]:
    """Read one text of a study file.

    ``[A:B]`` takes a part of any sequence, ``?frames=N`` its first N frames (a rendered one is made
    that long). ``?scene=0-19`` names scenes of a rendered one, ``noise=SEED`` a draw of its noise.
    ``scene``, ``offsets`` and ``seeds`` are numbers and ranges (``0-4,7``), ``degrade`` strengths
    (``blur:0.5,glare:0.2``), ``stride`` a step between frames.

    Args:
        text: One entry of a study's `tune`, `confirm` or `held_out`.
        offsets: Start offsets where the text names none.
        seeds: Seeds where the text names none.

    Returns:
        The instances: for each scene in turn all offsets with all seeds.

    Raises:
        StudyError: It cannot be read; says how it is written.
    """
    if os.path.isdir(os.path.expanduser(text)):  # noqa: PTH111, PTH112  # no error for what cannot be a path
        return tuple(
            ProblemInstance(text, offset=offset, seed=seed)
            for offset, seed in product(offsets, seeds)
        )

    # NAME[A:B]?OPTIONS
    match = _TEXT.fullmatch(text)
    if match is None:
        raise StudyError(f"'{text}' names no instances", _FORM)
    name = match["name"]
    options = _options(match["query"] or "", text)
    try:
        frames = None if match["frames"] in (None, ":") else parse_frames(match["frames"])
    except SequenceError as error:
        raise StudyError(f"'{text}': {error.args[0]}", error.hint) from error

    # options that belong to a rendered sequence's name: one name for each scene
    names = [name]
    if name.startswith("synthetic/"):
        names = _rendered_names(name, options, text)
    elif frames is None and "frames" in options:
        frames = (0, int(options.pop("frames")))
    for option in options.keys() & {"scene", "noise", "frames"}:
        raise StudyError(f"'{text}' may not have a {option}", _FORM)

    # the others are fields of the instances
    offsets = _numbers(options.get("offsets", ""), text) or offsets
    seeds = _numbers(options.get("seeds", ""), text) or seeds
    stride = int(options.get("stride", 1))
    strengths = _strengths(options.get("degrade", ""), text)
    return tuple(
        ProblemInstance(name, frames, offset, stride, strengths, seed)
        for name, offset, seed in product(names, offsets, seeds)
    )


def _rendered_names(name: str, options: dict[str, str], text: str) -> list[str]:
    """A rendered sequence's name with each scene, its length and its noise; takes these out of the options."""
    numbers = _numbers(options.pop("scene", ""), text)
    others = [f"{key}={options.pop(key)}" for key in ("frames", "noise") if key in options]
    queries = ["&".join([f"scene={number}", *others]) for number in numbers]
    if not numbers:
        queries = ["&".join(others)]
    return [f"{name}?{query}" if query else name for query in queries]


def scene_of(name: str) -> str:
    """Scene that a sequence's name stands for, as far as the name alone tells.

    `plan.check_splits` looks at the content. The frames that are taken of a sequence, and the draw
    of its noise, make no other scene.
    """
    if name.startswith("synthetic/"):
        try:
            return replace(parse_synthetic_id(name), noise=None).whole
        except SequenceError:
            return name  # refused with a did-you-mean where it is opened
    entry = entry_of(name)
    return entry.id if entry is not None else str(Path(name).expanduser().resolve())


def scenes(instances: Iterable[ProblemInstance]) -> dict[str, list[ProblemInstance]]:
    """Instances by their scene, both in order of appearance."""
    return grouped(instances, lambda instance: instance.scene)


def further_scenes(
    instances: Iterable[ProblemInstance], count: int, taken: Iterable[str], numbers: range
) -> list[ProblemInstance]:
    """Further scenes of rendered sequences, one of each sequence in turn, each with the starts and seeds of its first.

    Args:
        instances: Instances whose sequences are to get further scenes.
        count: Scenes.
        taken: Scenes, as `scene_of` gives them, that are in use.
        numbers: Scene numbers to choose from.

    Raises:
        StudyError: None of the instances is rendered, or the numbers are used up.
    """
    rendered = [
        group for group in scenes(instances).values() if group[0].sequence.startswith("synthetic/")
    ]
    by_name = grouped(rendered, lambda group: parse_synthetic_id(group[0].sequence).name)
    # the first group of each sequence, moved to each scene number in turn, where that is not in use
    moved = (
        [_in_scene(instance, number) for instance in groups[0]]
        for number, groups in product(numbers, by_name.values())
    )
    used = set(taken)
    added = list(islice((group for group in moved if group[0].scene not in used), count))
    if len(added) < count:
        raise StudyError(
            f"{count} further scenes cannot be made, only {len(added)}",
            "scenes can be made of rendered sequences alone",
        )
    return [instance for group in added for instance in group]


def _in_scene(instance: ProblemInstance, number: int) -> ProblemInstance:
    """The instance in another scene of its rendered sequence."""
    sequence = replace(parse_synthetic_id(instance.sequence), scene=number)
    return replace(instance, sequence=str(sequence))


def stretches_behind(
    instances: Iterable[ProblemInstance], data_root: str | None
) -> list[ProblemInstance]:
    """The parts of recordings moved behind the last frame that is named of each, as far as the recording goes."""
    # of each recording, the instances with an end, their first frames and one past their last
    parts: dict[str, list[tuple[ProblemInstance, int, int]]] = {}
    for instance in instances:
        first, last = instance.frames or (0, None)
        if last is not None and not instance.sequence.startswith("synthetic/"):
            parts.setdefault(instance.sequence, []).append((instance, first, last))
    moved = []
    for sequence, group in parts.items():
        # behind the last frame that is named: all parts move by what they span together
        shift = max(last for _, _, last in group) - min(first for _, first, _ in group)
        length = len(open_sequence(sequence, data_root=data_root))
        moved += [
            replace(instance, frames=(first + shift, last + shift))
            for instance, first, last in group
            if last + shift <= length
        ]
    return moved


def _options(query: str, text: str) -> dict[str, str]:
    """The options behind the question mark by name, each known, written as it should be, and named once."""
    options: dict[str, str] = {}
    for option in query.split("&") if query else ():
        key, _, value = option.partition("=")
        if key not in _OPTIONS or not value:
            raise StudyError(
                f"'{text}' has an unknown option '{option}'", did_you_mean(key, list(_OPTIONS))
            )
        if key in options:
            raise StudyError(f"'{text}' names {key} twice", "leave one out")
        if not re.fullmatch(_OPTIONS[key], value):
            raise StudyError(f"'{option}' of '{text}' cannot be read", _FORM)
        options[key] = value
    return options


def _numbers(text: str, whole: str) -> list[int]:
    """``0-4,7`` as ``[0, 1, 2, 3, 4, 7]``; an empty text holds none."""
    numbers: list[int] = []
    for piece in text.split(",") if text else ():
        first, _, last = piece.partition("-")
        chosen = range(int(first), int(last or first) + 1)
        if not chosen or not set(numbers).isdisjoint(chosen):
            raise StudyError(
                f"'{piece}' of '{whole}' is no range of numbers, or repeats one", "write 0-4,7"
            )
        numbers += chosen
    return numbers


def _strengths(text: str, whole: str) -> tuple[tuple[str, float], ...]:
    """``blur:0.5,glare:0.2`` as kinds and strengths in alphabetical order; an empty text holds none."""
    from dynslam_bench.envs.wrappers import Degradation

    kinds = [name for name in Degradation.__dataclass_fields__ if name != "seed"]
    strengths = {
        kind: float(strength)
        for kind, strength in (piece.split(":") for piece in text.split(",") if piece)
    }
    for kind in strengths.keys() - set(kinds):
        raise StudyError(f"'{whole}': unknown degradation '{kind}'", did_you_mean(kind, kinds))
    Degradation(**strengths)  # type: ignore[arg-type]  # refuses a strength out of range
    return tuple(sorted(strengths.items()))


SamplerName = Literal["tpe", "random", "nsga2", "gp"]
PrunerName = Literal["halving", "wilcoxon", "none"]
EQUALLY_ACCURATE = ("accuracy", "worst", "robustness", "relative", "final")
"""Objectives that hold the error themselves."""
Offset = Annotated[int, Field(ge=0)]


TRACKER = "tracker"
"""Name under `SpaceSpec.choices` of the tracker itself."""


class Range(Record, frozen=True):
    """The range of a setting in a study; written as ``[low, high]`` where that is all.

    Attributes:
        low: Its least value.
        high: Its largest value.
        scale: ``log`` where ratios matter; None for what the setting declares.
        step: Distance between its values; None for every number.
    """

    low: float
    high: float
    scale: Literal["linear", "log"] | None = None
    step: float | None = Field(default=None, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _from_ends(cls, given: Any) -> Any:
        """Take a range that is written as ``[low, high]``."""
        if isinstance(given, list | tuple):
            if len(given) != 2:
                raise ValueError("write a range as [low, high]")
            return {"low": given[0], "high": given[1]}
        return given

    @model_validator(mode="after")
    def _check_ends(self) -> "Range":
        """Refuse a range that ends below its beginning, or has both a log scale and a step."""
        if self.low >= self.high:
            raise ValueError(f"the range ends at {self.high:g}, below its beginning {self.low:g}")
        if self.scale == "log" and self.step:
            raise ValueError("a range has a log scale or a step, not both")
        return self


class SpaceSpec(Record, frozen=True):
    """Settings that are tuned, their ranges, and when.

    From Python it may also be a plain mapping of names to `optuna.distributions`.

    Attributes:
        include: Patterns of dotted names, e.g. ``flow.*``, of settings that are tuned in the range
            that they declare. All of them where a study gives neither this nor ranges nor choices.
        exclude: Patterns that take parameters out again.
        fixed: Values for every run, dotted name to value; fixed parameters are not tuned.
        range: Ranges of a study's own: ``[200, 1500]``, or a table with ``low``, ``high``, ``scale``
            and ``step``. They may go beyond what a setting declares, as far as it takes the values.
        choices: Choices of a study's own, also of settings that declare none. Those of ``tracker``
            are the systems to choose from; a setting is tuned where the chosen one has it.
        when: Conditions of a study's own: a setting is tuned only where the named ones have one of
            these values. Settings that others switch off are left out in any case.
    """

    include: tuple[str, ...] = ("*",)
    exclude: tuple[str, ...] = ()
    fixed: dict[str, Any] = Field(default_factory=dict)
    range: dict[str, Range] = Field(default_factory=dict)
    choices: dict[str, Annotated[tuple[Scalar, ...], Field(min_length=2)]] = Field(
        default_factory=dict
    )
    when: dict[str, dict[str, tuple[Scalar, ...]]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any) -> Any:
        """Bring the ways in which a space may be written into one: nested tables, and Optuna's distributions."""
        if not isinstance(given, dict):
            return given
        values = dict(given)
        # a plain mapping of names to distributions
        if values and all(hasattr(value, "to_internal_repr") for value in values.values()):
            values = {"range": values}

        # names in nested tables, and distributions in their place
        spans = flat_names(values.get("range", {}), {"low", "high", "scale", "step"})
        choices = flat_names(values.get("choices", {}), set())
        for name, span in list(spans.items()):
            if hasattr(span, "to_internal_repr"):
                del spans[name]
                kind, written = _written(span)
                (choices if kind == "choices" else spans)[name] = written
        values |= {"range": spans, "choices": choices}
        values["fixed"] = flat_names(values.get("fixed", {}), set())
        if "when" in values:
            values["when"] = {
                name: {
                    other: wanted if isinstance(wanted, list | tuple) else (wanted,)
                    for other, wanted in flat_names(conditions, set()).items()
                }
                for name, conditions in values["when"].items()
            }
        if "include" not in values:
            values["include"] = () if spans or choices else ("*",)
        return values

    @field_validator("choices")
    @classmethod
    def _choices_differ(cls, choices: dict[str, tuple[Scalar, ...]]) -> Any:
        for name, values in choices.items():
            if len({(type(value), value) for value in values}) < len(values):
                raise ValueError(f"the choices of '{name}' name one twice")
        return choices


def flat_names(given: Any, own: set[str]) -> Any:
    """Nested tables as dotted names; a table of nothing but the keys `own` is a value."""
    if not isinstance(given, dict):
        return given
    flat: dict[str, Any] = {}
    for name, value in given.items():
        is_table = isinstance(value, dict) and not (value and value.keys() <= own)
        if is_table:
            inner = flat_names(value, own)
            flat |= {f"{name}.{rest}": entry for rest, entry in inner.items()}
        else:
            flat[name] = value
    return flat


def _written(span: Any) -> tuple[str, Any]:
    """A distribution of Optuna's as a study's file has it: ``range`` or ``choices``, and the value.

    Raises:
        ValueError: It is of another kind.
    """
    if hasattr(span, "choices"):
        return "choices", tuple(span.choices)
    if not (hasattr(span, "low") and hasattr(span, "high")):
        raise ValueError(f"{type(span).__name__} is neither a range nor choices")
    is_plain_step = span.step is None or (span.step == 1 and isinstance(span.low, int))
    return "range", {
        "low": span.low,
        "high": span.high,
        "scale": "log" if span.log else "linear",
        "step": None if is_plain_step else span.step,
    }


class StudySpec(Record, frozen=True):
    """A tuning study.

    Attributes:
        name: Name of the study and of its folder ``studies/<name>`` under the results.
        tracker: Id, ``module:Attr`` or ``file.py:Attr``.
        baseline: What ratios are to: empty for the tracker's default settings, a preset (a TOML
            file), on which trials then build, or another tracker with its default settings.
        start: What a new study tries right after its baseline: presets (TOML files, or settings by
            dotted name), and the best trials of earlier studies (``results/studies/NAME``), whose
            trials the sampler learns from.
        tune: Instances that trials run on, written as `parse_instances` reads them:
            ``synthetic/walking_xyz?scene=0-19&frames=80&offsets=0-4``.
        confirm: Instances without a frame of `tune`, on which the `top` best trials are ranked once
            more. Empty for none: the trials' own values rank them. Where nothing is held out these
            instances judge, empty for further scenes of rendered sequences, and for the frames behind
            the named part of a recording.
        held_out: Instances that decide at the end whether tuning helped; neither trials nor the
            choice see them.
        extendable: Whether scenes may be added after a verdict (12, 24, 36, 48 judge). Each look then
            has a smaller level, so that all together claim falsely as rarely as a single one.
        recorded: Instances of recordings that the best trial is run on beside the baseline; the conclusion says what
            they show, and they decide nothing. None for the first frames of a held-out recording where one is
            present.
        space: Which settings are tuned.
        objectives: ``accuracy``: geometric mean over scenes of the ATE ratio to the baseline (its
            logarithm is minimised, see `objectives.by_scene`); ``speed``: the same of the processor
            time a frame; ``worst``: ATE in the worst quarter of the scenes; ``robustness``: ATE on
            the degraded instances; ``coverage``: share of lost frames; ``relative``: relative error;
            ``final``: ATE of the final trajectory; ``network_calls``: frames on which the segmenter
            ran; ``memory``: largest resident memory; ``time:STAGE``: time of a stage.
        ate_margin: What a study of anything but error alone may lose of accuracy, as a share: the
            upper bound of the ATE ratio must lie below 1 + this.
        min_coverage: Hard constraint on the mean coverage; None for none.
        min_fps: Hard constraint on frames a second, segmentation included; None for none.
        limits: Hard constraints: largest means over the instances, by name: ``processor_s``,
            ``memory_mb``, ``network_calls`` and other fields of `objectives.Outcome`, or
            ``time:STAGE`` in milliseconds.
        seeds: Seeds of the instances that name none. A seed changes nothing for a tracker that
            draws nothing from it.
        offsets: Start offsets of the instances that name none: so many leading frames are left out.
        trials: Finished trials, trial 0 (the baseline's settings) included.
        top: How many of the best configurations are ranked again on `confirm`.
        sampler: Who proposes settings.
        sampler_seed: Seed of the sampler.
        pruner: ``wilcoxon`` is Optuna's `WilcoxonPruner` over the single instances, ``halving`` its
            `SuccessiveHalvingPruner` over growing sets of them, ``none`` its `NopPruner`. Trials of
            several objectives are not pruned.
        storage: Empty for a journal file beside the study, else an Optuna storage URL
            (``sqlite:///``, ``postgresql://``, ``grpc://host:port``). A password is better left to
            the driver (``PGPASSWORD``, ``~/.pgpass``): it is in no file that is written.
        protocol: Protocol of the errors; lost frames are always held at the last pose.
        cache: Whether trials use the stage cache.
        threads: Threads of a run.
        data_root: Folder of the recorded sequences.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)
    tracker: str = "emfoa-oft"
    baseline: str = ""
    start: tuple[str | dict[str, Any], ...] = ()
    tune: tuple[str, ...] = Field(min_length=1)
    confirm: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    extendable: bool = False
    recorded: tuple[str, ...] | None = None
    space: SpaceSpec = SpaceSpec()
    objectives: tuple[str, ...] = Field(default=("accuracy",), min_length=1)
    ate_margin: float = Field(default=0.05, gt=0, le=1)
    min_coverage: float | None = Field(default=0.95, ge=0, le=1)
    min_fps: float | None = Field(default=None, gt=0)
    limits: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    offsets: tuple[Offset, ...] = Field(default=(0, 3), min_length=1)
    trials: int = Field(default=40, ge=2)
    top: int = Field(default=2, ge=1)
    sampler: SamplerName = "tpe"
    sampler_seed: int = 0
    pruner: PrunerName = "wilcoxon"
    storage: str = ""
    protocol: str = "tum-rgbd/v1"
    cache: bool = True
    threads: int = Field(default=1, ge=1)
    data_root: str | None = None

    @field_validator("objectives")
    @classmethod
    def _objectives_differ(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("an objective is named twice")
        return names

    def instances(self, *texts: str) -> list[ProblemInstance]:
        """The instances that texts of this study name.

        Raises:
            StudyError: One cannot be read.
        """
        return [
            instance
            for text in texts
            for instance in parse_instances(text, offsets=self.offsets, seeds=self.seeds)
        ]

    def level(self, judging: int) -> float:
        """One-sided level of the claims of a study that so many scenes judge."""
        return LOOKS.get(judging, ONE_SIDED) if self.extendable else ONE_SIDED

    @property
    def at_equal_accuracy(self) -> bool:
        """Whether a gain counts only at (nearly) the default's accuracy, as it may be paid for with the error."""
        return len(self.objectives) > 1 or self.objectives[0] not in EQUALLY_ACCURATE

    def for_others(self) -> dict[str, Any]:
        """The study as it is written down beside its trials: without the password of its storage."""
        return self.model_dump(mode="json") | {"storage": without_passwords(self.storage)}


def read_study(path: str | Path) -> StudySpec:
    """Read a study file.

    Raises:
        StudyError: No such file, no TOML, an unknown key (with a did-you-mean) or an unfit value,
            in one line.
    """
    path = Path(path)
    return validated(
        StudySpec, {"name": path.stem, **read_toml(path, kind=StudyError)}, str(path), StudyError
    )
