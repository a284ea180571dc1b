"""A study as one TOML file: what is tuned, on which sequences, by which means."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.records import Record
from dynslam_bench.core.sanitise import without_passwords
from dynslam_bench.core.toml import read_toml
from dynslam_bench.tuning.instances import ProblemInstance, parse_instances

SamplerName = Literal["tpe", "random", "nsga2", "gp", "cmaes", "emfoa"]
PrunerName = Literal["halving", "wilcoxon", "none"]
EQUALLY_ACCURATE = ("accuracy", "worst", "robustness")
"""Objectives that hold the error themselves."""
Offset = Annotated[int, Field(ge=0)]


class SpaceSpec(Record, frozen=True):
    """Which settings are tuned.

    Attributes:
        include: Patterns of dotted names, e.g. ``flow.*``; a parameter must match one.
        exclude: Patterns that take parameters out again.
        fixed: Values for every run, dotted name to value; fixed parameters are not tuned.
    """

    include: tuple[str, ...] = ("*",)
    exclude: tuple[str, ...] = ()
    fixed: dict[str, Any] = Field(default_factory=dict)


class StudySpec(Record, frozen=True):
    """A tuning study.

    Attributes:
        name: Of the study; names its folder ``studies/<name>`` under the results.
        tracker: Id, ``module:Attr`` or ``file.py:Attr``.
        baseline: What ratios are to: empty for the tracker's default settings, a preset (a TOML file), on which trials
            then build, or another tracker with its default settings.
        start: What a new study tries right after its baseline: presets (TOML files, or settings by dotted name), and
            the best trials of earlier studies (``results/studies/NAME``), whose trials the sampler learns from.
        tune: Instances that trials run on, written as `instances.parse_instances` reads them:
            ``synthetic/walking_xyz?scene=0-19&frames=80&offsets=0-4``.
        confirm: Instances without a frame of `tune`. The best trials are judged again on them, and one is chosen. Empty
            for further scenes of rendered sequences, and for the frames behind the named part of a recording.
        held_out: Instances that decide at the end whether tuning helped; neither trials nor the choice see them.
        recorded: Instances of recordings that the choice must not be worse on; None for the first frames of a held-out
            recording where one is present.
        space: Which settings are tuned.
        allow_overlap: Accept splits that share content, or sequences that the catalogue or their scene gives to the
            other split; every table of the study then says so.
        objectives: ``accuracy``: geometric mean over scenes of the ATE ratio to the baseline (its logarithm is
            minimised, see `objectives.by_scene`); ``speed``: the same of the processor time a frame; ``worst``: ATE in
            the worst quarter of the scenes; ``robustness``: ATE on the degraded instances; ``coverage``: share of lost
            frames.
        ate_margin: What a study of anything but error alone may lose of accuracy, as a share: the upper bound of the
            ATE ratio must lie below 1 + this.
        min_coverage: Hard constraint on the mean coverage; None for none.
        min_fps: Hard constraint on frames a second, segmentation included; None for none.
        seeds: Seeds of the instances that name none. A seed changes nothing for a tracker that draws nothing from it.
        offsets: Start offsets of the instances that name none: so many leading frames are left out.
        trials: Finished trials, trial 0 (the baseline's settings) included.
        timeout_s: No trial begins after this many seconds; None for no limit.
        top: How many of the best configurations are judged again on `confirm`.
        sampler: Who proposes settings.
        sampler_seed: Seed of the sampler.
        pruner: ``wilcoxon`` is Optuna's `WilcoxonPruner` over the single instances, ``halving`` its
            `SuccessiveHalvingPruner` over growing sets of them, ``none`` its `NopPruner`. Trials of several objectives
            are pruned by dominance, with either of the first two.
        storage: Empty for a journal file beside the study, else an Optuna storage URL (``sqlite:///``,
            ``postgresql://``, ``grpc://host:port``). A password is better left to the driver (``PGPASSWORD``,
            ``~/.pgpass``): it is in no file that is written.
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
    recorded: tuple[str, ...] | None = None
    allow_overlap: bool = False
    space: SpaceSpec = SpaceSpec()
    objectives: tuple[str, ...] = Field(default=("accuracy",), min_length=1)
    ate_margin: float = Field(default=0.05, gt=0, le=1)
    min_coverage: float | None = Field(default=0.95, ge=0, le=1)
    min_fps: float | None = Field(default=None, gt=0)
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    offsets: tuple[Offset, ...] = Field(default=(0, 3), min_length=1)
    trials: int = Field(default=40, ge=2)
    timeout_s: float | None = Field(default=None, gt=0)
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
            instance for text in texts for instance in parse_instances(text, offsets=self.offsets, seeds=self.seeds)
        ]

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
        StudyError: No such file, no TOML, an unknown key (with a did-you-mean) or an unfit value, in one line.
    """
    path = Path(path)
    return make_spec({"name": path.stem, **read_toml(path, kind=StudyError)}, str(path))


def make_spec(values: Any, where: str) -> StudySpec:
    """A study from its values.

    Args:
        values: Fields of `StudySpec`.
        where: Where they come from, for messages.

    Raises:
        StudyError: An unknown key (with a did-you-mean) or an unfit value, in one line.
    """
    try:
        return StudySpec.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            key_names = [*StudySpec.model_fields, *(f"space.{name}" for name in SpaceSpec.model_fields)]
            raise StudyError(f"{where}: unknown key '{field}'", did_you_mean(field, key_names)) from None
        text = first["msg"].removeprefix("Value error, ")
        raise StudyError(f"{where}: {field + ': ' if field else ''}{text}") from None
