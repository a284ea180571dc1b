"""Measurements of one side of a gate, and the baseline file that holds them."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from dynslam_bench.core import DynslamError, RunError, read_lines
from dynslam_bench.core.fingerprint import Machine
from dynslam_bench.core.records import Record, schema
from dynslam_bench.gate.config import GateConfig
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore, evaluation_code

BASELINE_FILE = "gate-baseline.json"
"""Lies beside ``gate.toml``, and is committed."""
BASELINE_SCHEMA = 1
"""Version of the fields of `Baseline`."""
Array = NDArray[np.float64]


class Measurement(Record):
    """One run, as a gate keeps it.

    Attributes:
        case: Name of what was run.
        round: From 0.
        run_id: The run.
        status: How it ended, see `RunRecord`.
        reason: One line; empty for ``ok``.
        ate_m: Absolute trajectory error in metres under the gate's protocol; None for a run that was
            lost, failed or cannot be scored.
        coverage: Share of the frames that were tracked.
        frame_time_s: Median time of a frame; None where it is not known.
        memory_mb: Largest memory; None where it is not known.
        trajectories: SHA-256 of the poses by the trajectory, ``online`` and ``final``.
        data: Digest of the sequence's content; empty where it is not known.
        program: Code, weights and libraries that made it, as short texts.
    """

    case: str
    round: int = Field(ge=0)
    run_id: str = ""
    status: str
    reason: str = ""
    ate_m: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    coverage: float | None = Field(default=None, ge=0, le=1)
    frame_time_s: float | None = None
    memory_mb: float | None = None
    trajectories: dict[str, str] = Field(default_factory=dict)
    data: str = ""
    program: dict[str, str] = Field(default_factory=dict)

    @property
    def is_lost(self) -> bool:
        """Whether it has no error that counts."""
        return self.ate_m is None


def measurement_of(
    case: str, number: int, record: RunRecord, store: RunStore, protocol: Any
) -> Measurement:
    """The measurement that a gate keeps of a stored run.

    Args:
        case: Name of what was run.
        number: Number of the round, from 0.
        record: The run.
        store: Store that holds the run.
        protocol: How it is scored.
    """
    metrics = store.score(record, protocol)
    error = metrics.metrics.get("ate_rmse_m")
    reason = record.reason
    if error is None and not reason:
        reason = "; ".join(metrics.reasons.values())
    digests = {
        which: poses_digest(store.folder(record.run_id) / f"trajectory_{which}.txt")
        for which in ("online", "final")
    }
    return Measurement(
        case=case,
        round=number,
        run_id=record.run_id,
        status=record.status,
        reason=reason,
        ate_m=error if record.status == "ok" else None,
        coverage=record.coverage,
        frame_time_s=record.frame_time_s,
        memory_mb=record.peak_memory_mb,
        trajectories={which: text for which, text in digests.items() if text},
        data=record.sequence.content,
        program=record.program,
    )


def poses_digest(file: Path) -> str:
    """SHA-256 of the poses in a TUM file, without its comments; empty where there is no file."""
    if not file.is_file():
        return ""
    lines = read_lines(file, kind=RunError)
    poses = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    return sha256("\n".join(poses).encode()).hexdigest()


class Side:
    """All measurements of one side, by case and round.

    Attributes:
        name: What messages call it.
        by_case: Case to its measurements, in the order of the rounds.
    """

    def __init__(self, name: str, measurements: Iterable[Measurement] = ()) -> None:
        self.name = name
        self.by_case: dict[str, list[Measurement]] = {}
        for measurement in measurements:
            self.add(measurement)

    def add(self, measurement: Measurement) -> None:
        """Take in the next round of a case."""
        self.by_case.setdefault(measurement.case, []).append(measurement)

    def of(self, case: str, rounds: int) -> list[Measurement]:
        """The first rounds of a case."""
        return self.by_case[case][:rounds]

    def all(self, rounds: int) -> list[Measurement]:
        """The first rounds of all cases."""
        return [run for case in self.by_case for run in self.of(case, rounds)]

    def rounds(self) -> int:
        """Rounds that all cases have."""
        return min((len(runs) for runs in self.by_case.values()), default=0)

    def cases_of_copies(self, rounds: int) -> list[str]:
        """Cases whose first rounds are all the same trajectories: they show no scatter."""
        return [case for case in self.by_case if _are_copies(self.of(case, rounds))]

    def errors(self, cases: Iterable[str], rounds: int) -> Array:
        """Errors in metres of cases and rounds ``[S, K]``; nan is a lost run."""
        return _matrix([[run.ate_m for run in self.of(case, rounds)] for case in cases])

    def frame_times(self, cases: Iterable[str], rounds: int) -> Array:
        """Median times of a frame in seconds ``[S, K]``; nan where one is not known."""
        return _matrix([[run.frame_time_s for run in self.of(case, rounds)] for case in cases])

    def memory(self, cases: Iterable[str], rounds: int) -> Array:
        """Largest memory in MB ``[S, K]``; nan where it is not known."""
        return _matrix([[run.memory_mb for run in self.of(case, rounds)] for case in cases])


def _are_copies(runs: list[Measurement]) -> bool:
    """Whether there are several runs, and all have the same trajectories."""
    first = runs[0].trajectories
    return len(runs) > 1 and bool(first) and all(run.trajectories == first for run in runs)


def _matrix(rows: list[list[float | None]]) -> Array:
    return np.array(rows, dtype=np.float64)


class Origin(Record):
    """Origin of the program that one side of a gate runs: name, commit, uncommitted files.

    Attributes:
        name: In words: a revision, ``the working tree``, ``the recorded runs``.
        revision: Commit of the repository that holds the gate; empty where there is none.
        uncommitted: Files with changes that the revision does not hold.
    """

    name: str
    revision: str = ""
    uncommitted: list[str] = Field(default_factory=list)

    def describe(self) -> str:
        """In words, with the commit and what differs from it."""
        words = self.name
        if self.revision and self.revision[:12] not in self.name:
            words += f" at {self.revision[:12]}"
        if self.uncommitted:
            words += f" with uncommitted changes in {', '.join(self.uncommitted)}"
        return words


class Baseline(Record):
    """The baseline file.

    Attributes:
        schema_version: Version of this record's fields.
        question: Digest of the question that it was recorded for.
        asked: The question in full, so that a change of it can be named.
        protocol: Id of the protocol of the errors.
        protocol_digest: Its digest.
        code: Digest of the evaluation code.
        origin: Which program was measured.
        recorded: When, UTC, ISO 8601.
        machine: The computer.
        versions: Versions of Python and the packages that matter.
        runs: The development set.
        confirmation: The confirmation set; empty without one.
        looks: What became known of the confirmation set: one line for each look at it.
        notes: What a reader should know, a line each.
    """

    schema_version: int = schema(BASELINE_SCHEMA)
    question: str
    asked: GateConfig
    protocol: str
    protocol_digest: str
    code: str = Field(default_factory=evaluation_code)
    origin: Origin
    recorded: str
    machine: Machine
    versions: dict[str, str]
    runs: list[Measurement]
    confirmation: list[Measurement] = Field(default_factory=list)
    looks: list[str] = Field(default_factory=list)
    notes: list[str] = Field(default_factory=list)

    @model_validator(mode="after")
    def _rounds_are_in_order(self) -> Baseline:
        for runs in (self.runs, self.confirmation):
            made: dict[str, int] = {}
            for run in runs:
                expected = made.get(run.case, 0)
                if run.round != expected:
                    raise ValueError(
                        f"{run.case} has round {run.round} where {expected} is expected"
                    )
                made[run.case] = expected + 1
        return self

    def changed(self, asked: GateConfig) -> list[str]:
        """Differences of the question from that of the recorded baseline, one a line."""
        before = self.asked.model_dump(mode="json")
        return _differences(before, asked.model_dump(mode="json"))


def _differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> list[str]:
    lines = []
    for name in sorted(before.keys() | now.keys()):
        old = before.get(name)
        new = now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            lines += _differences(old, new, f"{prefix}{name}.")
        elif old != new:
            lines.append(f"{prefix}{name} was {old}, is {new}")
    return lines


def read_baseline(path: Path) -> Baseline:
    """Read a baseline file.

    Raises:
        RunError: There is none, or it is damaged.
    """
    if path.is_dir():
        raise RunError(f"{path} is a folder, no baseline file", "name the file with --baseline")
    if not path.is_file():
        raise RunError(
            f"there is no baseline {path}",
            "record what is good now with: dynslam-bench gate record, and commit the file",
        )
    try:
        return Baseline.read(path)
    except DynslamError as error:
        raise RunError(str(error.args[0]), error.hint or "record it again") from error
