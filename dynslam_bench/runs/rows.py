"""Runs as rows of tables: of the list of a store, and of a pandas frame."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from dynslam_bench.core import assignments
from dynslam_bench.runs.record import ON_RECORDING, MetricRecord, RunRecord

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
"""The values of a row by the names of their columns."""

FIELDS = (
    "run_id",
    "tracker",
    "sequence",
    "frames",
    "seed",
    "offset",
    "noise",
    "repeat",
    "settings",
    "status",
    "ate_rmse_m",
    "static_camera_ate_rmse_m",
    "false_motion_max_m",
    "nees_1f_mean",
    "within95_1f",
    "nees_1s_mean",
    "within95_1s",
    "coverage",
    "truth_share",
    "frame_ms",
    "cpu",
    "segmentation",
    "seen_in_training",
    "study",
    "identity",
    "reason",
    "remarks",
    "started",
)
"""Names of the values of a list's row, in order."""


def make_run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """A run's row in a list: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    # loads the catalogue of all sequences
    from dynslam_bench.segmentation.training_scenes import seen_in_training

    # what a part of a run scores says nothing
    scored = None if record.failed else metrics
    errors = {} if scored is None else scored.metrics
    return {
        "run_id": record.run_id,
        "tracker": record.tracker.id,
        "sequence": record.sequence.id,
        "frames": part_words(record),
        "seed": record.seed,
        "offset": record.offset,
        "noise": record.sequence.noise,
        "repeat": record.repeat,
        "settings": "; ".join(assignments(record.requested_settings)),
        "status": record.status,
        "ate_rmse_m": errors.get("ate_rmse_m"),
        "static_camera_ate_rmse_m": errors.get("static_camera_ate_rmse_m"),
        "false_motion_max_m": errors.get("false_motion_max_m"),
        "nees_1f_mean": errors.get("nees_1f_mean"),
        "within95_1f": errors.get("within95_1f"),
        "nees_1s_mean": errors.get("nees_1s_mean"),
        "within95_1s": errors.get("within95_1s"),
        "coverage": _coverage(record, metrics),
        "truth_share": record.truth_share,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "cpu": None if record.machine is None else record.machine.cpu,
        "segmentation": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
        "reason": _reason(record, metrics),
        "remarks": _remarks(record, scored),
        "started": record.started,
    }


def _remarks(record: RunRecord, metrics: MetricRecord | None) -> list[str]:
    """Warnings on the recording, then remarks on the errors, one a line."""
    of_recording = [f"warning: {note}" for note in record.notes if note.startswith(ON_RECORDING)]
    return [*of_recording, *([] if metrics is None else metrics.remarks)]


def _coverage(record: RunRecord, metrics: MetricRecord | None) -> float | None:
    """The share of frames with a pose: of the final trajectory where that is scored, else of the online one."""
    final = metrics.final if metrics is not None and metrics.trajectory == "final" else None
    if final is not None and final.coverage is not None:
        return final.coverage
    return record.coverage


def _reason(record: RunRecord, metrics: MetricRecord | None) -> str:
    """Why a run failed or was lost, or why it has no errors although its sequence has ground truth; else empty."""
    if record.reason or not record.sequence.ground_truth:
        return record.reason
    if metrics is None or (metrics.metrics and not record.failed):
        return ""
    return metrics.reasons.get(metrics.trajectory, "")


def part_words(record: RunRecord) -> str:
    """Part of its sequence that a run was asked for, e.g. ``0:60, every 2nd``; empty for all frames."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        ending = {2: "nd", 3: "rd"}.get(record.stride, "th")
        words.append(f"every {record.stride}{ending}")
    return ", ".join(words)


_TEXT_COLUMNS = (
    "run_id",
    "kind",
    "tracker",
    "label",
    "settings",
    "provenance",
    "sequence",
    "frames",
    "split",
    "repeat",
    "status",
    "reason",
    "study",
    "identity",
    "device",
    "segmentation",
    "protocol_id",
    "protocol_digest",
    "trajectory",
)
_INTEGER_COLUMNS = (
    "seed",
    "offset",
    "noise",
    "stride",
    "threads",
    "n_frames",
    "n_processed",
    "n_tracked",
    "n_lost",
    "keyframes",
    "map_points",
    "maps",
)
_FLOAT_COLUMNS = (
    "coverage",
    "truth_share",
    "frame_ms",
    "real_time_factor",
    "finalize_s",
    "wall_s",
    "peak_memory_mb",
    "mask_iou",
    "epipolar_skipped",
)


def runs_frame(runs: Iterable[tuple[RunRecord, MetricRecord | None]]) -> pd.DataFrame:
    """Runs as a frame.

    Args:
        runs: Records with their metrics; None for a run that was not scored.

    Returns:
        One row a run, in their order. Whatever may be missing is ``pd.NA``, never nan or an empty
        string.

        - ``string``: run_id, kind (``run``, ``imported``), tracker, label (its name in tables), settings (those that
          were asked for, ``name=value; ...``), provenance, sequence, frames (``A:B, every 2nd``,
          missing for all), split, repeat (``seed 0, offset 2``), status, reason (missing for
          ``ok``), study (of which the run is a trial, missing for any other run), identity
          (``unverified`` for runs of an older scheme of ids, else missing), device, segmentation
          (source of the masks), protocol_id, protocol_digest and trajectory (``online``,
          ``final``): what the errors hold under and are of.
        - ``Int64``: seed, offset, noise (missing for the sequence's own), stride, threads, n_frames, n_processed,
          n_tracked, n_lost, keyframes, map_points, maps.
        - ``Float64``: coverage (0 to 1), truth_share (0 to 1, of imports whose frames are not
          known), frame_ms (median, milliseconds, segmentation included, decoding excluded),
          real_time_factor, finalize_s and wall_s (seconds), peak_memory_mb (MB), mask_iou and
          epipolar_skipped (0 to 1), and every metric under its own name with its unit
          (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``, see `Evaluation`); ``ate_rmse_m`` is there even
          if no run has one.
        - ``datetime64[us, UTC]``: started.
    """
    import pandas as pd

    rows: list[Row] = []
    metric_names = {"ate_rmse_m"}
    for record, metrics in runs:
        rows.append(_cells(record, metrics))
        if metrics is not None:
            metric_names.update(metrics.metrics)

    kinds: dict[str, str] = dict.fromkeys(_TEXT_COLUMNS, "string")
    kinds |= dict.fromkeys(_INTEGER_COLUMNS, "Int64")
    kinds |= dict.fromkeys((*_FLOAT_COLUMNS, *sorted(metric_names)), "Float64")
    frame = pd.DataFrame(rows, columns=[*kinds, "started"], dtype=object).astype(kinds)
    started = pd.to_datetime(frame.started, utc=True, format="ISO8601")
    return frame.assign(started=started.astype("datetime64[us, UTC]"))


def _cells(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """The cells of a run in a frame by the names of their columns; None for an empty text."""
    # columns of the same name as a field of the record, then those of the list, then the others
    columns = (*_INTEGER_COLUMNS, *_FLOAT_COLUMNS, *_TEXT_COLUMNS)
    cells = {name: getattr(record, name) for name in columns if hasattr(record, name)}
    cells |= make_run_row(record, metrics)
    cells["label"] = record.tracker.label or record.tracker.id
    cells["provenance"] = record.tracker.provenance
    cells["split"] = record.sequence.split
    cells["reason"] = record.reason
    if metrics is not None:
        cells["protocol_id"] = metrics.protocol_id
        cells["protocol_digest"] = metrics.protocol_digest
        cells["trajectory"] = metrics.trajectory
        cells |= metrics.metrics
    return {name: None if value == "" else value for name, value in cells.items()}
