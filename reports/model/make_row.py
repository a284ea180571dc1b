"""The row of one stored run: its record, its errors under a protocol, and what follows from its trajectories."""

from __future__ import annotations

from typing import Any

from dynslam_bench.evaluation.evaluate import Evaluation
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.storage.record import LOST_COVERAGE, MetricRecord, RunRecord, Status
from dynslam_bench.runs.storage.run_index import part_words
from dynslam_bench.runs.storage.scoring import score
from dynslam_bench.runs.storage.store import RunStore
from dynslam_bench.segmentation.training_set import seen_in_training

from .row import RunRow, Which
from .row_values import (
    camera_words,
    column_of,
    command_line,
    held_error,
    machine_words,
    never_move_error,
    part_options,
    variant_of,
)


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run."""
    scored = score(store, record, protocol)
    which, status, failed, reason = _judge(record, scored, protocol)
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    alignment = None if evaluation is None else evaluation.alignment
    tracker, sequence = record.tracker, record.sequence
    still = never_move_error(store, record, protocol, evaluation)
    return RunRow(
        run_id=record.run_id,
        kind="run here" if record.kind == "run" else "imported",
        tracker=tracker.id,
        given=tracker.given,
        label=tracker.label or tracker.id,
        variant=variant_of(record),
        program=record.program,
        deterministic=tracker.deterministic and not record.realtime,
        provenance=tracker.provenance,
        ranked=tracker.ranked and record.start_map is None,
        monocular=tracker.sensors == "rgb",
        sequence=sequence.id,
        frames=part_words(record),
        part_options=part_options(record),
        block=column_of(record),
        content=sequence.content,
        camera=camera_words(record),
        map_file="" if record.start_map is None else record.start_map.file,
        place=record.place,
        duration_s=sequence.duration_s,
        tags=sequence.tags,
        split=sequence.split,
        seed=record.seed,
        offset=record.offset,
        noise=sequence.noise,
        status=status,
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
        static_camera_ate_rmse_m=still,
        **_counts(record, scored.final if which == "final" and record.kind == "run" else None),
        epipolar_skipped=record.epipolar_skipped,
        cached=bool(record.identity.get("cache")),
        frame_ms=None if record.frame_time_s is None else 1000 * record.frame_time_s,
        real_time_factor=record.real_time_factor,
        peak_memory_mb=record.peak_memory_mb,
        mask_iou=record.mask_iou,
        segmentation=record.segmentation,
        seen_in_training=seen_in_training(record.segmentation, sequence.id),
        study=record.trial_of,
        started=record.started,
        log=log_of(store, record.run_id),
        command=command_line(record.command),
        machine=machine_words(record),
        **_remarks(record, evaluation, scored.hints),
    )


def _judge(record: RunRecord, scored: MetricRecord, protocol: Protocol) -> tuple[Which, Status, bool, str]:
    """Whose errors a row holds, how the run ended, whether it counts as a failure, and why it is not ``ok``."""
    only_final = record.kind == "imported" and scored.online is None and scored.final is not None
    which: Which = "final" if only_final else protocol.trajectory
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    failed = record.failed or record.status == "lost"
    if record.sequence.ground_truth and evaluation is None and not failed and which == protocol.trajectory:
        return which, record.status, True, record.reason or scored.reasons.get(which, "it cannot be evaluated")
    due = record.n_frames - record.n_dropped
    if record.kind == "run" and which == "final" and not record.failed and evaluation and evaluation.n_tracked:
        if evaluation.n_tracked < LOST_COVERAGE * due:
            return which, "lost", True, f"the final trajectory has poses of {evaluation.n_tracked} of {due} frames"
        if evaluation.n_tracked >= due:  # frames that were lost when they came were found later
            return which, "ok", False, ""
    return which, record.status, failed, record.reason


def _counts(record: RunRecord, final: Evaluation | None) -> dict[str, Any]:
    """A row's numbers of frames; where the final trajectory is scored, those that it has poses of."""
    counts = {name: getattr(record, name) for name in ("n_frames", "n_processed", "n_tracked", "coverage")}
    if final is not None and final.n_tracked is not None and final.coverage is not None:
        counts |= {"n_tracked": final.n_tracked, "coverage": final.coverage}
    return counts


def _remarks(record: RunRecord, evaluation: Evaluation | None, hints: list[str]) -> dict[str, list[str]]:
    """What a reader should know of a run: hints, whose trial it is, its own remarks, those of its evaluation."""
    trial = [f"trial of the study '{record.trial_of}'"] if record.trial_of else []
    lines = [*trial, *record.notes, *(evaluation.diagnostics if evaluation is not None else [])]
    return {"notes": [*(f"hint: {hint}" for hint in hints), *lines], "hints": hints}


def log_of(store: RunStore, run_id: str) -> str:
    """Where the log of a run lies."""
    return str(store.folder(run_id) / "log.txt")
