"""From results folders to rows: which runs count, scored under one protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError, ReportError, did_you_mean
from dynslam_bench.evaluation.protocol import MONOCULAR, Protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.storage.record import MetricRecord, RunRecord
from dynslam_bench.runs.storage.scoring import score
from dynslam_bench.runs.storage.store import RunStore
from dynslam_bench.segmentation.training_set import seen_in_training

from .crew import JOB, Crew
from .row import RunRow, Which
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

OnProgress = Callable[[float, float | None, str], None]
"""Called as ``on_progress(done, total, what)``; the total is None where it is not known."""


def unheard(done: float, total: float | None, what: str) -> None:
    """Progress that nobody wants to hear of."""


@dataclass(frozen=True)
class LoadedRun:
    """A row with the place where its trajectory lies."""

    row: RunRow
    record: RunRecord
    store: RunStore

    def as_job(self) -> dict[str, Any]:
        """The run for a helper process, see `reports.worker`."""
        return {"store": str(self.store.root), "row": self.row.model_dump(mode="json")}

    def trajectory(self, which: Which) -> Trajectory | None:
        """The run's ``online`` or ``final`` trajectory; None if there is none with a pose, or it is damaged."""
        try:
            return self.store.trajectory(self.record.run_id, which)
        except DynslamError:
            return None

    def ground_truth(self) -> Trajectory | None:
        """The ground truth of its part of the sequence; None if there is none, or it is damaged."""
        try:
            return self.store.ground_truth(self.record.sequence.part)
        except DynslamError:
            return None


@dataclass
class Loaded:
    """Everything read from the stores.

    Attributes:
        runs: The newest run of every variant, column and repeat.
        superseded: How many older ones there were.
        stopped: How many runs were left out since they were ended on request.
        without_scale: How many were left out since their scale is unknown and the protocol's alignment finds none.
        unreadable: Folders without a valid record, with reasons.
    """

    runs: list[LoadedRun] = field(default_factory=list)
    superseded: int = 0
    stopped: int = 0
    without_scale: int = 0
    unreadable: list[str] = field(default_factory=list)

    @cached_property
    def by_id(self) -> dict[str, LoadedRun]:
        """The runs by their id."""
        return {run.row.run_id: run for run in self.runs}


def load_runs(
    sources: Sequence[RunStore],
    protocol: Protocol,
    on_progress: OnProgress = unheard,
    crew: Crew | None = None,
    reference: str | None = None,
) -> Loaded:
    """Read all runs of some stores and score them under a protocol; SLAM is never run again for it.

    Args:
        sources: The stores.
        protocol: How to evaluate.
        on_progress: As in `build_report`.
        crew: Helpers that score the runs; None to score them here.
        reference: Id of a tracker of which there must be runs, looked for before anything is scored; None for any.

    Raises:
        ReportError: There is no run at all, or none of the reference.
    """
    loaded = Loaded()
    kept: list[tuple[RunStore, RunRecord]] = []
    for store in sources:
        records, unreadable = store.all()
        loaded.unreadable += [f"{bad.path}: {bad.reason}" for bad in unreadable]
        ended = [record for record in records if record.status != "stopped"]
        scored = [record for record in ended if record.tracker.sensors == "rgbd" or protocol.finds_scale]
        kept += [(store, record) for record in scored]
        loaded.stopped += len(records) - len(ended)
        loaded.without_scale += len(ended) - len(scored)
    if kept:
        check_reference(reference, [record.tracker.id for _, record in kept])
    rows = _rows(kept, protocol, on_progress, crew)
    found = [LoadedRun(row, record, store) for row, (store, record) in zip(rows, kept, strict=True)]
    _join_old_imports(found)
    newest: dict[tuple[object, ...], LoadedRun] = {}
    for run in sorted(found, key=lambda run: run.row.started):
        newest[run.row.variant_key, run.row.column_id, run.row.repeat_key, run.row.trajectory] = run
    loaded.superseded = len(found) - len(newest)
    if not newest and loaded.without_scale:
        raise ReportError(f"all {without_scale_words(loaded.without_scale, protocol)}")
    if not newest:
        places = ", ".join(str(store.root) for store in sources)
        raise ReportError(
            f"there are no runs in {places}", loaded.unreadable[0] if loaded.unreadable else "make some with 'run'"
        )
    loaded.runs = list(newest.values())
    return loaded


def without_scale_words(count: int, protocol: Protocol) -> str:
    """Why runs of monocular trackers are in no table, and what shows them."""
    return (
        f"{count} runs of monocular trackers: their scale is unknown and {protocol.id} aligns without scale; "
        f"--protocol {MONOCULAR} shows them"
    )


def _rows(
    runs: Sequence[tuple[RunStore, RunRecord]], protocol: Protocol, on_progress: OnProgress, crew: Crew | None
) -> list[RunRow]:
    """The rows of some runs, in their order."""
    if crew is None:
        rows = []
        for position, (store, record) in enumerate(runs):
            on_progress(position, len(runs), f"scoring {record.tracker.id} on {record.sequence.id}")
            rows.append(make_row(store, record, protocol))
        return rows
    done = 0

    def heard(count: int, what: str) -> None:
        nonlocal done
        on_progress(done, len(runs), what)
        done += count

    by_part = sorted(range(len(runs)), key=lambda at: runs[at][1].sequence.part)  # a helper reads few ground truths
    pieces = [by_part[at : at + JOB] for at in range(0, len(runs), JOB)]
    jobs = [{"runs": [(str(runs[at][0].root), runs[at][1].run_id) for at in piece]} for piece in pieces]
    found: dict[int, RunRow] = {}
    for piece, answer in zip(pieces, crew.work("rows", jobs, heard), strict=True):
        found |= dict(zip(piece, map(RunRow.model_validate, answer), strict=True))
    return [found[at] for at in range(len(runs))]


def _join_old_imports(runs: Sequence[LoadedRun]) -> None:
    """Imports of older versions name no camera: they belong to the one column of the same frames, if there is one."""
    columns: dict[str, set[str]] = {}
    for run in runs:
        if not run.row.imported:
            columns.setdefault(run.record.sequence.part, set()).add(run.row.column_id)
    for run in runs:
        part = run.record.sequence.part
        if run.row.imported and run.row.block == part and len(columns.get(part, ())) == 1:
            (run.row.block,) = columns[part]


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run."""
    scored = score(store, record, protocol)
    which, failed, reason = _judge(record, scored, protocol)
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    alignment = None if evaluation is None else evaluation.alignment
    tracker, sequence = record.tracker, record.sequence
    still = never_move_error(store, record, protocol, evaluation)
    return RunRow(
        run_id=record.run_id,
        kind="run here" if record.kind == "run" else "imported",
        tracker=tracker.id,
        label=tracker.label or tracker.id,
        variant=variant_of(record),
        provenance=tracker.provenance,
        ranked=tracker.ranked,
        sequence=sequence.id,
        frames=part_words(record),
        part_options=part_options(record),
        block=column_of(record),
        content=sequence.content,
        camera=camera_words(record),
        place=record.place,
        duration_s=sequence.duration_s,
        tags=sequence.tags,
        split=sequence.split,
        seed=record.seed,
        offset=record.offset,
        noise=sequence.noise,
        status=record.status,
        reason=reason,
        failed=failed,
        protocol_id=scored.protocol_id,
        protocol_digest=scored.protocol_digest,
        trajectory=which,
        metrics={} if evaluation is None else dict(evaluation.metrics),
        final_ate_m=None if scored.final is None else scored.final.metrics.get("ate_rmse_m"),
        final_metrics={} if scored.final is None else dict(scored.final.metrics),
        rotation_uncertainty_deg=None if alignment is None else alignment.uncertainty_deg,
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
        seen_in_training=seen_in_training(record.segmentation, sequence.id),
        started=record.started,
        log=str(store.folder(record.run_id) / "log.txt"),
        command=command_line(record.command),
        machine=machine_words(record),
        notes=[*record.notes, *(evaluation.diagnostics if evaluation is not None else [])],
    )


def _judge(record: RunRecord, scored: MetricRecord, protocol: Protocol) -> tuple[Which, bool, str]:
    """Whose errors a row holds, whether it counts as a failure, and why it is not ``ok``."""
    only_final = record.kind == "imported" and scored.online is None and scored.final is not None
    which: Which = "final" if only_final else protocol.trajectory
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    failed = record.failed or record.status == "lost"
    if record.sequence.ground_truth and evaluation is None and not failed and which == protocol.trajectory:
        return which, True, record.reason or scored.reasons.get(which, "it cannot be evaluated")
    return which, failed, record.reason


def check_reference(reference: str | None, trackers: Sequence[str]) -> None:
    """Refuse a reference that none of some runs' trackers is; None is none.

    Raises:
        ReportError: Names the reference, and the tracker that may have been meant.
    """
    known = sorted(set(trackers))
    if reference is not None and reference not in known:
        raise ReportError(f"there is no run of the reference '{reference}'", did_you_mean(reference, known))


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
