"""Runs as a pandas frame, one row a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from dynslam_bench.core.toml import assignments

from .record import MetricRecord, RunRecord
from .run_index import part_words

if TYPE_CHECKING:
    import pandas as pd

_TEXT = (
    *("run_id", "kind", "tracker", "label", "settings", "provenance"),
    *("sequence", "frames", "split", "repeat", "status", "reason", "study", "identity"),
    *("device", "segmentation", "protocol_id", "protocol_digest", "trajectory"),
)
_WHOLE = ("seed", "offset", "noise", "stride", "threads", "n_frames", "n_processed", "n_tracked", "n_lost")
_MAP = ("keyframes", "map_points", "maps")
_NUMBERS = (
    *("coverage", "frame_ms", "real_time_factor", "finalize_s", "wall_s", "peak_memory_mb"),
    *("mask_iou", "epipolar_skipped"),
)


def runs_frame(runs: Iterable[tuple[RunRecord, MetricRecord | None]]) -> pd.DataFrame:
    """Runs as a frame.

    Args:
        runs: Records with their metrics; None for a run that was not scored.

    Returns:
        One row a run, in their order. Whatever may be missing is ``pd.NA``, never nan or an empty string.

        - ``string``: run_id, kind (``run``, ``imported``), tracker, label (its name in tables), settings (those that
          were asked for, ``name=value; ...``), provenance, sequence, frames (``A:B, every 2nd``, missing for all),
          split, repeat (``seed 0, offset 2``), status, reason (missing for ``ok``), study (of which the run is a trial,
          missing for any other run), identity (``unverified`` for runs of an older scheme of ids, else missing),
          device, segmentation (source of the masks), protocol_id, protocol_digest and trajectory (``online``,
          ``final``): what the errors hold under and are of.
        - ``Int64``: seed, offset, noise (missing for the sequence's own), stride, threads, n_frames, n_processed,
          n_tracked, n_lost, keyframes, map_points, maps.
        - ``Float64``: coverage (0 to 1), frame_ms (median, milliseconds, segmentation included, decoding excluded),
          real_time_factor, finalize_s and wall_s (seconds), peak_memory_mb (MB), mask_iou and epipolar_skipped (0 to
          1), and every metric under its own name with its unit (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``, see
          `Evaluation`); ``ate_rmse_m`` is there even if no run has one.
        - ``datetime64[us, UTC]``: started.
    """
    import pandas as pd

    pairs = list(runs)
    metrics = sorted({name for _, scored in pairs if scored is not None for name in scored.metrics} | {"ate_rmse_m"})
    kinds: dict[str, str] = dict.fromkeys(_TEXT, "string") | dict.fromkeys((*_WHOLE, *_MAP), "Int64")
    kinds |= dict.fromkeys((*_NUMBERS, *metrics), "Float64")
    lines = [_line(record, scored) for record, scored in pairs]
    frame = pd.DataFrame(lines, columns=list(kinds), dtype=object).astype(kinds)
    stamps = pd.Series([record.started or None for record, _ in pairs], dtype=object)
    started = pd.to_datetime(stamps, utc=True, format="ISO8601")
    return frame.assign(started=started.astype("datetime64[us, UTC]"))


def _line(record: RunRecord, scored: MetricRecord | None) -> dict[str, Any]:
    same = {name: getattr(record, name) for name in (*_WHOLE, *_MAP, *_NUMBERS, *_TEXT) if hasattr(record, name)}
    line = same | {
        "tracker": record.tracker.id,
        "label": record.tracker.label or record.tracker.id,
        "provenance": record.tracker.provenance,
        "settings": "; ".join(assignments(record.asked)),
        "sequence": record.sequence.id,
        "split": record.sequence.split,
        "noise": record.sequence.noise,
        "frames": part_words(record),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
    }
    if scored is not None:
        line |= {name: getattr(scored, name) for name in ("protocol_id", "protocol_digest", "trajectory")}
        line |= scored.metrics
    return {name: None if value == "" else value for name, value in line.items()}
