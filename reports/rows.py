"""One row a run: what the report knows of it, whether it was made here, imported or only reported."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.errors import DynslamError, ReportError
from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate
from dynslam_bench.evaluation.never_move import never_move
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.scoring import score
from dynslam_bench.runs.store import RunStore

Kind = Literal["run here", "imported"]


class RunRow(Record):
    """A run as the report shows it.

    Attributes:
        run_id: Its id in the store.
        kind: Made by this toolkit, or a trajectory from elsewhere.
        tracker: Tracker id.
        label: Tracker's label.
        variant: What sets runs of one tracker apart besides sequence and seed: overrides, device, threads, mode.
        provenance: How closely the tracker follows its source.
        ranked: Whether its spec lets it be ranked.
        sequence: Sequence id.
        frames: Part of the sequence in words, empty for all of it.
        tags: Tags of the sequence.
        split: ``tune``, ``held-out`` or empty.
        seed: Seed.
        status: Status of the run.
        reason: Why it is not ``ok``.
        failed: Whether it counts as a failure: it did not end, could not track, or cannot be evaluated.
        protocol_id: Id of the protocol of `metrics`.
        protocol_digest: Its digest.
        metrics: Errors of the trajectory that the protocol asks for; empty for a failure without any.
        final_ate_m: ATE of the final trajectory (after loop closing); None if there is none.
        held_ate_m: The ATE with lost frames held at the last tracked pose; None if nothing was tracked.
        never_move_m: What a camera that does not move scores there; None without ground truth.
        n_frames: Input frames.
        coverage: Share of them that was tracked.
        frame_ms: Median frame time in milliseconds, None if unknown.
        real_time_factor: Frame interval over mean frame time, None if unknown.
        peak_memory_mb: Largest resident memory, None if unknown.
        mask_iou: Overlap of the dynamic mask with the exact one, None if unknown.
        segmentation: Source of the masks.
        started: UTC, ISO 8601.
        log: Path of the run's log.
        command: Command line that made it.
        machine: Computer and versions in words.
        notes: Diagnostics of the evaluation and of the run.
    """

    run_id: str
    kind: Kind
    tracker: str
    label: str
    variant: dict[str, Any] = Field(default_factory=dict)
    provenance: str = ""
    ranked: bool = True
    sequence: str
    frames: str = ""
    tags: list[str] = Field(default_factory=list)
    split: str = ""
    seed: int = 0
    status: str = "ok"
    reason: str = ""
    failed: bool = False
    protocol_id: str
    protocol_digest: str
    metrics: dict[str, float] = Field(default_factory=dict)
    final_ate_m: float | None = None
    held_ate_m: float | None = None
    never_move_m: float | None = None
    n_frames: int = 0
    coverage: float = 0.0
    frame_ms: float | None = None
    real_time_factor: float | None = None
    peak_memory_mb: float | None = None
    mask_iou: float | None = None
    segmentation: str = ""
    started: str = ""
    log: str = ""
    command: str = ""
    machine: str = ""
    notes: list[str] = Field(default_factory=list)

    @property
    def sequence_key(self) -> str:
        """Sequence and part of it."""
        return f"{self.sequence} [{self.frames}]" if self.frames else self.sequence

    @property
    def variant_key(self) -> str:
        """Tracker and everything that sets its runs apart besides sequence and seed."""
        return self.tracker + "|" + self.kind + "|" + json.dumps(self.variant, sort_keys=True, default=str)

    @property
    def score_m(self) -> float | None:
        """The ATE that aggregates use: a failure counts as a camera that never moves; None without ground truth."""
        return self.never_move_m if self.failed else self.metrics.get("ate_rmse_m")


@dataclass(frozen=True)
class LoadedRun:
    """A row with the place where its trajectory lies."""

    row: RunRow
    record: RunRecord
    store: RunStore


@dataclass
class Loaded:
    """Everything read from the stores.

    Attributes:
        runs: The newest run of every (variant, sequence, seed).
        superseded: How many older ones there were.
        stopped: How many runs were left out since they were ended on request.
        unreadable: Folders without a valid record, with reasons.
    """

    runs: list[LoadedRun] = field(default_factory=list)
    superseded: int = 0
    stopped: int = 0
    unreadable: list[str] = field(default_factory=list)


def load_runs(sources: Sequence[RunStore], protocol: Protocol) -> Loaded:
    """Read all runs of some stores and score them under a protocol; SLAM is never run again for it.

    Raises:
        ReportError: There is no run at all.
    """
    loaded = Loaded()
    newest: dict[tuple[str, str, int], LoadedRun] = {}
    for store in sources:
        records, unreadable = store.all()
        loaded.unreadable += [f"{bad.path}: {bad.reason}" for bad in unreadable]
        for record in records:
            if record.status == "stopped":
                loaded.stopped += 1
                continue
            run = LoadedRun(make_row(store, record, protocol), record, store)
            key = (run.row.variant_key, run.row.sequence_key, run.row.seed)
            if key in newest:
                loaded.superseded += 1
                if newest[key].row.started > run.row.started:
                    continue
            newest[key] = run
    if not newest:
        places = ", ".join(str(store.root) for store in sources)
        raise ReportError(
            f"there are no runs in {places}", loaded.unreadable[0] if loaded.unreadable else "make some with 'run'"
        )
    loaded.runs = list(newest.values())
    return loaded


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run."""
    scored = score(store, record, protocol)
    evaluation = scored.primary
    has_truth = record.sequence.ground_truth
    reason = record.reason
    failed = record.failed or record.status == "lost"
    if has_truth and evaluation is None and not failed:
        failed = True
        reason = reason or scored.reasons.get(scored.trajectory, "it cannot be evaluated")
    return RunRow(
        run_id=record.run_id,
        kind="run here" if record.kind == "run" else "imported",
        tracker=record.tracker.id,
        label=record.tracker.label or record.tracker.id,
        variant=_variant(record),
        provenance=record.tracker.provenance,
        ranked=record.tracker.ranked,
        sequence=record.sequence.id,
        frames=_part(record),
        tags=record.sequence.tags,
        split=record.sequence.split,
        seed=record.seed,
        status=record.status,
        reason=reason,
        failed=failed,
        protocol_id=scored.protocol_id,
        protocol_digest=scored.protocol_digest,
        metrics=dict(scored.metrics),
        final_ate_m=None if scored.final is None else scored.final.metrics.get("ate_rmse_m"),
        held_ate_m=_held(store, record, protocol, evaluation),
        never_move_m=_never_move(store, record, protocol, evaluation),
        n_frames=record.n_frames,
        coverage=record.coverage,
        frame_ms=None if record.frame_time_s is None else 1000 * record.frame_time_s,
        real_time_factor=record.real_time_factor,
        peak_memory_mb=record.peak_memory_mb,
        mask_iou=record.mask_iou,
        segmentation=record.segmentation,
        started=record.started,
        log=str(store.folder(record.run_id) / "log.txt"),
        command=_command(record.command),
        machine=_machine(record),
        notes=[*record.notes, *(evaluation.diagnostics if evaluation is not None else [])],
    )


def check_one_protocol(rows: Sequence[RunRow]) -> None:
    """Refuse rows whose numbers were taken under different protocols.

    Raises:
        ReportError: Names the protocols and how many rows each has.
    """
    counts: dict[tuple[str, str], int] = {}
    for row in rows:
        key = (row.protocol_id, row.protocol_digest)
        counts[key] = counts.get(key, 0) + 1
    if len(counts) > 1:
        named = " and ".join(f"{name} [{digest}] ({count} rows)" for (name, digest), count in sorted(counts.items()))
        raise ReportError(
            f"one table cannot mix {len(counts)} protocols: {named}", "score all runs under one protocol first"
        )


def open_stores(runs: Sequence[Path] | Sequence[str] | RunStore | Path | str) -> list[RunStore]:
    """Stores of results folders.

    Raises:
        ReportError: A folder does not exist or holds no store.
    """
    if isinstance(runs, RunStore):
        return [runs]
    paths = [Path(runs)] if isinstance(runs, str | Path) else [Path(path) for path in runs]
    if not paths:
        raise ReportError("no results folder was given", "for example results")
    stores = []
    for path in paths:
        folder = path.expanduser()
        if not folder.is_dir():
            raise ReportError(f"there is no results folder {folder}", "make runs first, or name their folder")
        if folder.name == "runs" and not (folder / "runs").is_dir():
            folder = folder.parent
        if not (folder / "runs").is_dir():
            raise ReportError(f"{folder} holds no runs: it has no folder 'runs'", "name the folder given as --results")
        stores.append(RunStore(folder))
    return stores


def _never_move(store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None) -> float | None:
    if evaluation is not None and "never_move_ate_rmse_m" in evaluation.metrics:
        return evaluation.metrics["never_move_ate_rmse_m"]
    try:
        truth = store.ground_truth(record.sequence.part)
        if truth is None:
            return None
        errors = never_move(truth, store.timestamps(record.sequence.part), protocol.max_dt)
    except DynslamError:
        return None
    return errors["first_rmse_m" if protocol.alignment in ("none", "origin") else "constant_rmse_m"]


def _held(store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None) -> float | None:
    if evaluation is None:
        return None
    if evaluation.coverage == 1.0:
        return evaluation.metrics["ate_rmse_m"]
    trajectory = store.trajectory(record.run_id, protocol.trajectory)
    truth = store.ground_truth(record.sequence.part)
    if trajectory is None or truth is None:
        return None
    held = protocol.model_copy(update={"lost_frames": "hold", "rpe": (), "segments_m": ()})
    try:
        stamps = store.timestamps(record.sequence.part)
        return evaluate(trajectory, truth, held, input_timestamps=stamps).metrics["ate_rmse_m"]
    except DynslamError:
        return None


def _variant(record: RunRecord) -> dict[str, Any]:
    variant: dict[str, Any] = dict(sorted(record.overrides.items()))
    if record.kind == "run":
        variant |= {"device": record.device, "threads": record.threads}
    if record.realtime:
        variant["realtime"] = True
    if record.drop_share:
        variant["drop_share"] = record.drop_share
    variant |= {f"degrade.{name}": value for name, value in sorted(record.degrade.items())}
    return variant


def _part(record: RunRecord) -> str:
    parts = []
    if record.frames is not None:
        start, stop = record.frames
        parts.append(f"{start}:{'' if stop is None else stop}")
    if record.stride != 1:
        parts.append(f"every {record.stride}")
    return ", ".join(parts)


def _command(command: list[str]) -> str:
    import shlex

    if not command:
        return ""
    head = Path(command[0]).name
    return shlex.join(["dynslam-bench" if head in ("__main__.py", "dynslam-bench") else command[0], *command[1:]])


def _machine(record: RunRecord) -> str:
    parts = []
    if record.machine is not None:
        machine = record.machine
        parts.append(f"{machine.cpu}, {machine.cores} cores, {machine.memory_gb:g} GB, {machine.system}")
        if machine.gpu:
            parts.append(machine.gpu)
    parts += [f"{name} {version}" for name, version in record.versions.items()]
    if record.git is not None:
        parts.append(f"git {record.git.revision[:10]}{' (changed)' if record.git.dirty else ''}")
    return "; ".join(parts)
