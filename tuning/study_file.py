"""A study as one TOML file: what is tuned, on which sequences, by which means."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator

from dynslam_bench.core.errors import SequenceError, StudyError, did_you_mean
from dynslam_bench.core.passwords import without_passwords
from dynslam_bench.core.records import Record, digest
from dynslam_bench.core.toml import read_toml
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.sequences.synthetic import parse_synthetic_id

SamplerName = Literal["tpe", "random", "nsga2", "gp", "cmaes", "emfoa"]
PrunerName = Literal["none", "median", "hyperband", "wilcoxon"]
ObjectiveName = Literal["accuracy", "speed"]
Offset = Annotated[int, Field(ge=0)]


class _Part(Record):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SpaceSpec(_Part):
    """Which settings are tuned.

    Attributes:
        include: Patterns of dotted names, e.g. ``flow.*``; a parameter must match one.
        exclude: Patterns that take parameters out again.
        fixed: Values for every run, dotted name to value; fixed parameters are not tuned.
    """

    include: tuple[str, ...] = ("*",)
    exclude: tuple[str, ...] = ()
    fixed: dict[str, Any] = Field(default_factory=dict)


class StudySpec(_Part):
    """A tuning study.

    Attributes:
        name: Of the study; names its folder ``studies/<name>`` under the results.
        tracker: Id, ``module:Attr`` or ``file.py:Attr``.
        tune: Sequences that trials run on.
        held_out: Sequences that decide at the end whether tuning helped; no trial sees them.
        space: Which settings are tuned.
        allow_overlap: Accept splits that share content, or sequences that the catalogue or their instance gives to the
            other split; every table of the study then says so.
        objectives: ``accuracy``: geometric mean over sequences and repeats of the ATE ratio to the default settings
            (its logarithm is minimised); ``speed``: real-time factor (maximised).
        min_coverage: Hard constraint on the mean coverage; None for none.
        min_fps: Hard constraint on frames a second, segmentation included; None for none.
        seeds: Seeds that every configuration runs with (common random numbers). A seed changes nothing for a tracker
            that draws nothing from it.
        offsets: Start offsets that every configuration runs with: so many leading frames are left out.
        trials: Finished trials, trial 0 (the default settings) included.
        timeout_s: No trial begins after this many seconds; None for no limit.
        top: How many of the best configurations are run again with fresh repeats.
        sampler: Who proposes settings.
        sampler_seed: Seed of the sampler.
        pruner: Who ends hopeless trials early; several objectives are ended early by dominance instead.
        storage: Empty for a journal file beside the study, else an Optuna storage URL (``sqlite:///``,
            ``postgresql://``, ``grpc://host:port``). A password is better left to the driver (``PGPASSWORD``,
            ``~/.pgpass``): it is in no file that is written.
        protocol: Protocol of the errors; lost frames are always held at the last pose.
        cache: Whether trials use the stage cache.
        threads: Threads of a run.
        data_root: Folder of the recorded sequences.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    tracker: str = "emfoa-oft"
    tune: tuple[str, ...] = Field(min_length=1)
    held_out: tuple[str, ...] = ()
    allow_overlap: bool = False
    space: SpaceSpec = SpaceSpec()
    objectives: tuple[ObjectiveName, ...] = Field(default=("accuracy",), min_length=1)
    min_coverage: float | None = Field(default=0.95, ge=0, le=1)
    min_fps: float | None = Field(default=None, gt=0)
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    offsets: tuple[Offset, ...] = Field(default=(0, 3), min_length=1)
    trials: int = Field(default=40, ge=2)
    timeout_s: float | None = Field(default=None, gt=0)
    top: int = Field(default=3, ge=1)
    sampler: SamplerName = "tpe"
    sampler_seed: int = 0
    pruner: PrunerName = "median"
    storage: str = ""
    protocol: str = "tum-rgbd/v1"
    cache: bool = True
    threads: int = Field(default=1, ge=1)
    data_root: str | None = None

    @model_validator(mode="after")
    def _splits_are_apart(self) -> StudySpec:
        for name, values in (("tune", self.tune), ("held_out", self.held_out), ("seeds", self.seeds),
                             ("offsets", self.offsets), ("objectives", self.objectives)):  # fmt: skip
            twice = sorted({str(value) for value in values if list(values).count(value) > 1})
            if twice:
                raise ValueError(f"{name} names '{twice[0]}' twice")
        held_out = {_identity(name): name for name in reversed(self.held_out)}
        both = [(name, held_out[_identity(name)]) for name in self.tune if _identity(name) in held_out]
        if both and not self.allow_overlap:
            one, other = both[0]
            spelled = "" if one == other else f", held out as '{other}'"
            raise ValueError(f"the tune and held_out splits share {len(both)} sequences, the first is '{one}'{spelled}")
        return self

    def digest(self) -> str:
        """Digest of everything that decides the result: not the number of trials, the limits or the storage."""
        free = {"trials", "timeout_s", "top", "storage"}
        return digest(self.model_dump(mode="json", exclude=free))

    def for_others(self) -> dict[str, Any]:
        """The study as it is written down beside its trials: without the password of its storage."""
        return self.model_dump(mode="json") | {"storage": without_passwords(self.storage)}


def read_study(path: str | Path) -> StudySpec:
    """Read a study file.

    Raises:
        StudyError: No such file, no TOML, an unknown key (with a did-you-mean) or an unfit value, in one line.
    """
    path = Path(path)
    values = read_toml(path, kind=StudyError)
    values.setdefault("name", path.stem)
    return make_study(values, path)


def make_study(values: Any, path: Path) -> StudySpec:
    """Validate what a study's file holds.

    Raises:
        StudyError: An unknown key (with a did-you-mean) or an unfit value, in one line.
    """
    try:
        return StudySpec.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            known = [*StudySpec.model_fields, *(f"space.{name}" for name in SpaceSpec.model_fields)]
            raise StudyError(f"{path}: unknown key '{where}'", did_you_mean(where, known)) from None
        text = first["msg"].removeprefix("Value error, ")
        raise StudyError(f"{path}: {where + ': ' if where else ''}{text}") from None


def _identity(name: str) -> str:
    """What a name stands for, as far as the name alone tells (see `splits.check_splits` for the content).

    The frames that are taken of a sequence, and the draw of its noise, make no other sequence.
    """
    if name.startswith("synthetic/"):
        try:
            parsed = parse_synthetic_id(name)
        except SequenceError:
            return name  # refused with a did-you-mean where it is opened
        return f"{parsed.name}@{parsed.instance}"
    entry = entry_of(name)
    return entry.id if entry is not None else str(Path(name).expanduser().resolve())
