"""One row a run: what the report knows of it, whether it was made here, imported or only reported."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.storage.record import RunRecord
from dynslam_bench.runs.storage.scoring import score
from dynslam_bench.runs.storage.store import RunStore

from .row_values import (
    camera_words,
    column_of,
    command_line,
    held_error,
    machine_words,
    never_move_error,
    part_options,
    part_words,
    variant_of,
)

Kind = Literal["run here", "imported"]


class RunRow(Record):
    """A run as the report shows it.

    Attributes:
        run_id: Its id in the store.
        kind: Made by this toolkit, or a trajectory from elsewhere.
        tracker: Tracker id.
        label: Tracker's label.
        variant: What sets runs of one tracker apart besides sequence and repeat: overrides, device, threads, mode.
        provenance: How closely the tracker follows its source.
        ranked: Whether its spec lets it be ranked.
        sequence: Sequence id.
        frames: Part of the sequence in words, empty for all of it.
        part_options: The same as command-line options.
        block: What one column of a table is: content, camera, frames and stride.
        content: Digest of the content.
        camera: Camera in words.
        place: Folder of the sequence where it was named by its path.
        duration_s: Time between its first and last frame.
        tags: Tags of the sequence.
        split: ``tune``, ``held-out`` or empty.
        seed: Seed.
        offset: Leading frames that were left out: another repeat.
        noise: Seed of the sensors' noise: another repeat.
        status: Status of the run.
        reason: Why it is not ``ok``.
        failed: Whether it counts as a failure: it did not end, could not track, or cannot be evaluated.
        protocol_id: Id of the protocol of `metrics`.
        protocol_digest: Its digest.
        trajectory: Which trajectory the metrics are of; an import may hold the final one only.
        metrics: Errors of the trajectory that the protocol asks for; empty for a failure without any.
        final_ate_m: ATE of the final trajectory; None if there is none.
        held_ate_m: The ATE with lost frames held at the last tracked pose, which ranks; None without evaluation.
        never_move_m: What a camera that does not move scores there; None without ground truth.
        n_frames: Input frames.
        n_processed: Frames that the tracker saw before it ended.
        n_tracked: Frames that were tracked.
        coverage: Share of the input frames that was tracked.
        epipolar_skipped: Share of the tracked frames on which the fundamental matrix was not used; None for systems
            without an epipolar test.
        cached: Whether stage times come from the stage cache and were not taken in this run.
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
    part_options: list[str] = Field(default_factory=list)
    block: str = ""
    content: str = ""
    camera: str = ""
    place: str = ""
    duration_s: float = 0.0
    tags: list[str] = Field(default_factory=list)
    split: str = ""
    seed: int = 0
    offset: int = 0
    noise: int | None = None
    status: str = "ok"
    reason: str = ""
    failed: bool = False
    protocol_id: str
    protocol_digest: str
    trajectory: Literal["online", "final"] = "online"
    metrics: dict[str, float] = Field(default_factory=dict)
    final_ate_m: float | None = None
    held_ate_m: float | None = None
    never_move_m: float | None = None
    n_frames: int = 0
    n_processed: int = 0
    n_tracked: int = 0
    coverage: float = 0.0
    epipolar_skipped: float | None = None
    cached: bool = False
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
    def column_id(self) -> str:
        """What one column of a table is; equal for all repeats and for every spelling of the same frames."""
        return self.block or f"{self.sequence} [{self.frames}]"

    @property
    def repeat_key(self) -> tuple[int, int, int, str]:
        """Which repeat of its cell it is; every imported file is one of its own."""
        return self.offset, -1 if self.noise is None else self.noise, self.seed, self.run_id if self.imported else ""

    @property
    def repeat(self) -> str:
        """The same in words, e.g. ``seed 0, offset 2``."""
        if self.imported:
            return f"import {self.run_id[:6]}"
        words = [f"seed {self.seed}"] + [f"offset {self.offset}"] * bool(self.offset)
        return ", ".join(words + ([] if self.noise is None else [f"noise {self.noise}"]))

    @property
    def imported(self) -> bool:
        """Whether the trajectory comes from elsewhere."""
        return self.kind == "imported"

    @property
    def variant_key(self) -> str:
        """Tracker and everything that sets its runs apart besides sequence and repeat."""
        return self.tracker + "|" + self.kind + "|" + json.dumps(self.variant, sort_keys=True, default=str)

    @property
    def score_m(self) -> float | None:
        """The ATE that ranks: lost frames held; a failure counts as never moving or worse; None without ground truth.

        A failure whose held trajectory is even further off than a camera that never moves keeps that error.
        """
        if self.failed:
            return None if self.never_move_m is None else max(self.never_move_m, self.held_ate_m or 0.0)
        return self.held_ate_m if self.held_ate_m is not None else self.metrics.get("ate_rmse_m")

    @property
    def ending(self) -> str:
        """How a failed run ended, e.g. ``crashed at 20/60`` or ``lost, 12/60 tracked``; empty for any other."""
        if not self.failed:
            return ""
        if self.status == "lost":
            return f"lost, {self.n_tracked}/{self.n_frames} tracked"
        return "not evaluated" if self.status == "ok" else f"{self.status} at {self.n_processed}/{self.n_frames}"


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
        runs: The newest run of every variant, column and repeat.
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
    found: list[LoadedRun] = []
    for store in sources:
        records, unreadable = store.all()
        loaded.unreadable += [f"{bad.path}: {bad.reason}" for bad in unreadable]
        found += [LoadedRun(make_row(store, r, protocol), r, store) for r in records if r.status != "stopped"]
        loaded.stopped += sum(record.status == "stopped" for record in records)
    _join_old_imports(found)
    newest: dict[tuple[object, ...], LoadedRun] = {}
    for run in sorted(found, key=lambda run: run.row.started):
        newest[run.row.variant_key, run.row.column_id, run.row.repeat_key, run.row.trajectory] = run
    loaded.superseded = len(found) - len(newest)
    if not newest:
        places = ", ".join(str(store.root) for store in sources)
        raise ReportError(
            f"there are no runs in {places}", loaded.unreadable[0] if loaded.unreadable else "make some with 'run'"
        )
    loaded.runs = list(newest.values())
    return loaded


def _join_old_imports(runs: Sequence[LoadedRun]) -> None:
    """Imports of older versions name no camera: they belong to the one column of the same frames, if there is one."""
    columns: dict[str, set[str]] = {}
    for run in runs:
        columns.setdefault(run.record.sequence.part, set()).add(run.row.column_id)
    for run in runs:
        part = run.record.sequence.part
        others = columns[part] - {part}
        if run.row.imported and run.row.block == part and len(others) == 1:
            run.row.block = next(iter(others))


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run."""
    scored = score(store, record, protocol)
    which = protocol.trajectory
    if record.kind == "imported" and scored.online is None and scored.final is not None:
        which = "final"
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    reason = record.reason
    failed = record.failed or record.status == "lost"
    if record.sequence.ground_truth and evaluation is None and not failed and which == protocol.trajectory:
        failed = True
        reason = reason or scored.reasons.get(which, "it cannot be evaluated")
    still = never_move_error(store, record, protocol, evaluation)
    return RunRow(
        run_id=record.run_id,
        kind="run here" if record.kind == "run" else "imported",
        tracker=record.tracker.id,
        label=record.tracker.label or record.tracker.id,
        variant=variant_of(record),
        provenance=record.tracker.provenance,
        ranked=record.tracker.ranked,
        sequence=record.sequence.id,
        frames=part_words(record),
        part_options=part_options(record),
        block=column_of(record),
        content=record.sequence.content,
        camera=camera_words(record),
        place=record.place,
        duration_s=record.sequence.duration_s,
        tags=record.sequence.tags,
        split=record.sequence.split,
        seed=record.seed,
        offset=record.offset,
        noise=record.sequence.noise,
        status=record.status,
        reason=reason,
        failed=failed,
        protocol_id=scored.protocol_id,
        protocol_digest=scored.protocol_digest,
        trajectory=which,
        metrics={} if evaluation is None else dict(evaluation.metrics),
        final_ate_m=None if scored.final is None else scored.final.metrics.get("ate_rmse_m"),
        held_ate_m=held_error(store, record, protocol, evaluation, still),
        never_move_m=still,
        n_frames=record.n_frames,
        n_processed=record.n_processed,
        n_tracked=record.n_tracked,
        coverage=record.coverage,
        epipolar_skipped=record.epipolar_skipped,
        cached=bool(record.identity.get("cache")),
        frame_ms=None if record.frame_time_s is None else 1000 * record.frame_time_s,
        real_time_factor=record.real_time_factor,
        peak_memory_mb=record.peak_memory_mb,
        mask_iou=record.mask_iou,
        segmentation=record.segmentation,
        started=record.started,
        log=str(store.folder(record.run_id) / "log.txt"),
        command=command_line(record.command),
        machine=machine_words(record),
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
