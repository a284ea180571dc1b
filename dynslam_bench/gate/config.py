"""The question of a gate: ``gate.toml``, which says what is run and what counts as a difference."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, Field, model_validator

from dynslam_bench.core import DynslamError, RunError, find_data_root, label_text, read_toml
from dynslam_bench.core.records import Record, digest, validated
from dynslam_bench.envs.slam_env import open_frames
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.evaluation.gate import MARGIN
from dynslam_bench.runs.spec import Limits, RunSpec
from dynslam_bench.runs.store import DEFAULT_PROTOCOL

GATE_FILE = "gate.toml"
"""Where the command line looks for the question."""
TRAJECTORIES = "trajectories"
"""Name of the system where only trajectory files are judged."""
FEWEST_FRAMES = 2
"""Frames that a run needs: the first one is where it begins."""
Cases = dict[str, RunSpec]
"""Name to what is run; each round runs it from another start frame, with another seed."""


class Guardrails(Record):
    """Guardrails: quantities beside the error that must not get worse; None leaves one out.

    Attributes:
        coverage: Share of the frames by which the mean coverage may fall.
        failures: Lost and failed runs that the candidate may have more than the baseline; without a
            number only more than chance explains.
        frame_time: Most times the baseline's median time of a frame, measured in turns.
        memory: Most times the baseline's largest memory.
        sequence: Most times the baseline's median error on any one sequence. A floor for systems
            that repeat exactly: with noisy ones some sequence of many is above 1.1 by chance.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    coverage: float | None = Field(default=0.02, ge=0, le=1)
    failures: int | None = Field(default=None, ge=0)
    frame_time: float | None = Field(default=None, gt=1)
    memory: float | None = Field(default=None, gt=1)
    sequence: float | None = Field(default=None, gt=1)


class GateConfig(Record):
    """The question of a gate: what it runs, and what counts as a difference.

    Attributes:
        trackers: Ids, ``subprocess:COMMAND``, ``batch:FILE.toml``, ``module:Attr`` or
            ``file.py:Attr``; paths begin in the file's folder.
        sequences: Ids, or folders of recordings, which begin in the file's folder or in the data root.
        suite: A suite in place of trackers and sequences.
        cases: Single runs beside them, with the fields of `RunSpec`.
        confirm: Sequences of the confirmation set, which is looked at on request alone.
        settings: Overrides of the trackers' settings; ``$VARIABLE`` in a text is replaced.
        frames: Part of every sequence; without it all.
        stride: Take every so many frames.
        threads: Threads of a run.
        protocol: How errors are evaluated.
        margin: Differences below this share do not matter.
        rounds: Rounds at most. A round runs every sequence once with the baseline and once with the
            candidate, from the same start frame and with the same seed.
        minutes: No round begins later than this; None for no such limit.
        seed: Seed of the first round.
        build: Command that builds a checkout, in the file's folder of it.
        build_minutes: Longest time that a build may take.
        environment: Environment variables of the runs; ``{folder}`` is the file's folder in the
            checkout that is run.
        guardrails: What must not get worse beside the error.
        limits: What a run may take.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    trackers: tuple[str, ...] = ()
    sequences: tuple[str, ...] = ()
    suite: str = ""
    cases: tuple[dict[str, Any], ...] = ()
    confirm: tuple[str, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)
    frames: tuple[int, int | None] | None = None
    stride: int = Field(default=1, ge=1)
    threads: int = Field(default=1, ge=1, le=1024)
    protocol: str = DEFAULT_PROTOCOL
    margin: float = Field(default=MARGIN, gt=0, le=1)
    rounds: Literal[2, 3, 4, 6, 8, 10] = 10
    minutes: float | None = Field(default=None, gt=0)
    seed: int = Field(default=0, ge=0, lt=2**31)
    build: str = ""
    build_minutes: float = Field(default=60, gt=0, allow_inf_nan=False)
    environment: dict[str, str] = Field(default_factory=dict)
    guardrails: Guardrails = Guardrails()
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _names_something(self) -> GateConfig:
        if not (self.cases or self.suite or (self.trackers and self.sequences)):
            raise ValueError("name trackers and sequences, a suite, or [[cases]]")
        if self.suite and (self.trackers or self.sequences):
            raise ValueError("name either a suite, or trackers and sequences")
        if self.confirm and not self.trackers:
            raise ValueError("the sequences to confirm on need trackers")
        return self

    @property
    def question(self) -> str:
        """Digest of everything in the file: a baseline holds that of the question it was recorded for."""
        return digest(self, 16)


class Gate:
    """A gate's question, and where it was read.

    Attributes:
        path: The file.
        config: What it says.
        data_root: Folder of the recorded sequences.
        protocol: How errors are evaluated.
    """

    def __init__(self, path: Path, config: GateConfig, data_root: str | Path | None = None) -> None:
        self.path = path
        self.config = config
        self.data_root = find_data_root(data_root)
        self.protocol = get_protocol(config.protocol)

    @property
    def folder(self) -> Path:
        """The folder of the file: where relative paths begin, and where programs are run."""
        return self.path.parent

    def cases(self, *, confirm: bool = False) -> Cases:
        """Run specs of a round, by the name of their case.

        Args:
            confirm: The confirmation set in place of the development set.

        Raises:
            RunError: There is no confirmation set, or two cases are the same.
            DynslamError: The suite is not known.
        """
        if confirm and not self.config.confirm:
            raise RunError(
                f"{self.path} names no sequences to confirm on",
                "add confirm = [...] with sequences that nobody looked at, and record again",
            )
        specs = self._confirmation() if confirm else self._development()
        return _by_name([self._located(spec) for spec in specs])

    def _confirmation(self) -> list[RunSpec]:
        config = self.config
        return [
            self._spec(tracker, sequence)
            for sequence in config.confirm
            for tracker in config.trackers
        ]

    def _development(self) -> list[RunSpec]:
        config = self.config
        specs = [
            self._spec(tracker, sequence)
            for sequence in config.sequences
            for tracker in config.trackers
        ]
        if config.suite:
            specs += self._specs_of_suite()
        shared = {"threads": config.threads, "limits": config.limits}
        for number, case in enumerate(config.cases, start=1):
            where = f"{self.path}, case {number}"
            specs.append(validated(RunSpec, shared | case, where, RunError))
        return specs

    def _spec(self, tracker: str, sequence: str) -> RunSpec:
        config = self.config
        values = {
            "tracker": tracker,
            "sequence": sequence,
            "settings": config.settings,
            "frames": config.frames,
            "stride": config.stride,
            "threads": config.threads,
            "limits": config.limits,
        }
        return validated(RunSpec, values, str(self.path), RunError)

    def _specs_of_suite(self) -> list[RunSpec]:
        """The runs of the suite without its repeats: a gate's rounds repeat them."""
        from dynslam_bench.suites import load_suite, suite_names

        config = self.config
        name = config.suite
        suite = load_suite(name if name in suite_names() else self.folder / name)
        first_seed = suite.seeds[:1]
        first_offset = suite.offsets[:1]
        specs = suite.specs(seeds=first_seed, offsets=first_offset, frames=config.frames)
        return [
            spec.model_copy(update={"settings": spec.settings | config.settings}) for spec in specs
        ]

    def _located(self, spec: RunSpec) -> RunSpec:
        """A run with the folder of its sequence, and that of its camera, in full."""
        places = (self.folder, self.data_root)
        folders = [place / spec.sequence for place in places]
        existing = [folder for folder in folders if folder.is_dir()]
        sequence = str(existing[0].absolute()) if existing else spec.sequence
        camera = spec.camera
        if camera is not None and (self.folder / camera).is_file():
            camera = str((self.folder / camera).absolute())
        settings = _flat(spec.settings)
        update = {
            "sequence": sequence,
            "settings": settings,
            "camera": camera,
            "data_root": str(self.data_root),
        }
        return spec.model_copy(update=update)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by dotted name, from tables or dotted names; environment variables in texts are replaced."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif isinstance(value, str):
            flat[prefix + name] = os.path.expandvars(value)
        else:
            flat[prefix + name] = value
    return flat


def load_gate(path: str | Path = GATE_FILE, *, data_root: str | Path | None = None) -> Gate:
    """Read a gate's question.

    Args:
        path: The TOML file.
        data_root: Folder of the recorded sequences.

    Raises:
        RunError: There is no such file, or it does not describe a gate (with the first fault).
        DynslamError: The protocol is not known.
    """
    file = Path(path).expanduser().absolute()
    if not file.is_file():
        raise RunError(f"there is no {file}", "write it with: dynslam-bench gate init")
    config = validated(GateConfig, read_toml(file, kind=RunError), str(file), RunError)
    return Gate(file, config, data_root)


def spec_of_round(spec: RunSpec, gate: Gate, number: int) -> RunSpec:
    """A case as one round runs it: from a later start frame, and with another seed.

    The start repeats systems that are deterministic, the seed those that are not.

    Args:
        spec: The case.
        gate: Its gate.
        number: Number of the round, from 0.
    """
    update = {"seed": gate.config.seed + number, "offset": spec.offset + number}
    return spec.model_copy(update=update)


def check_sequences(cases: Mapping[str, RunSpec], gate: Gate, rounds: int) -> None:
    """Open every sequence of a gate, before anything is built or run.

    Args:
        cases: What a round runs.
        gate: Its gate.
        rounds: Rounds at most.

    Raises:
        RunError: Some cannot be opened (how many, which, and why the first one cannot), or are too
            short for the start frame of the last round.
    """
    faults: dict[str, DynslamError] = {}
    for name, spec in cases.items():
        try:
            frames = open_frames(
                spec.sequence, spec.data_root, spec.camera, spec.frames, spec.stride
            )
        except DynslamError as error:
            faults[name] = error
            continue
        needed = spec.offset + rounds - 1 + FEWEST_FRAMES
        if len(frames) < needed:
            faults[name] = RunError(
                f"{len(frames)} frames are too few: round {rounds} begins {rounds - 1} frames later, "
                f"so {needed} are needed",
                "name more frames, or fewer rounds",
            )
    if faults:
        first = next(iter(faults.values()))
        raise RunError(
            f"{len(faults)} of {len(cases)} sequences of {gate.path.name} cannot be used "
            f"({', '.join(faults)}): {first.args[0]}",
            first.hint
            or "change sequences or frames there; recordings are looked for in "
            f"{gate.data_root}, or in --data-root",
        )


def _by_name(specs: list[RunSpec]) -> Cases:
    """Cases by the name of the sequence, with the tracker's where there are several, else with the part's."""
    one_tracker = len({spec.tracker for spec in specs}) == 1
    cases: Cases = {}
    for spec in specs:
        if spec in cases.values():
            raise RunError(
                f"the gate runs {spec.tracker} on {spec.sequence} twice in the same way",
                "remove one: the rounds repeat every sequence",
            )
        name = label_text(spec.sequence)
        if not one_tracker:
            name = f"{label_text(spec.tracker)} on {name}"
        if name in cases:
            start, stop = spec.frames or (0, None)
            name += f" {start}:{'' if stop is None else stop}"
        if name in cases:
            name += f" {digest(spec, 6)}"
        cases[name] = spec
    return cases
