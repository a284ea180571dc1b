"""What the page of one run shows: its facts, its frames over time, its track beside the true one, its log."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol, RPESpec
from dynslam_bench.geometry.trajectory import Trajectory

from ..figures.sequence import broken
from ..figures.style import significant
from ..model.missing import run_command
from ..model.rows import LoadedRun
from ..tables.metric import DOUBT
from .run_frames import COUNTS, RunFrames
from .side_files import packed_rows

Array = NDArray[np.float64]

MOST_FRAMES = 400
"""Frames of a run that its page shows unless something else is asked for."""
_LOG_BYTES = 20_000
_WHOLE = ("total_s", "processor_s", "read_s")
"""Times of a frame that are no stage of it: the figure stacks stages."""


def run_content(
    run: LoadedRun, frames: RunFrames, protocol: Protocol, truth: Trajectory | None, most: int = MOST_FRAMES
) -> dict[str, Any]:
    """Everything that the page of a run shows, as the page's script reads it.

    Args:
        run: The run.
        frames: Its frames.
        protocol: How its errors are computed.
        truth: Ground truth of its part of the sequence.
        most: Frames that are shown; of longer runs every second, third, ...
    """
    row, record = run.row, run.record
    return {
        "id": row.run_id,
        "status": row.status,
        "ending": row.ending,
        "reason": row.reason,
        "facts": _facts(run, protocol.rpe),
        "settings": {name: _plain(value) for name, value in record.settings.items()},
        "overrides": sorted(record.overrides),
        "stages": [
            [name, *(significant(1000 * value) for value in (time.median_s, time.p95_s, time.mean_s))]
            for name, time in record.timings.items()
        ],
        "protocol": protocol.describe(),
        "started": row.started,
        "machine": row.machine,
        "notes": [*row.notes, *filter(None, [frames.fault])],
        "command": run_command(row),
        "asked": row.command,
        "log": _log(run),
        "frames": _series(frames, most),
        "track": _track(run, protocol, truth, most),
    }


def _facts(run: LoadedRun, rpe: Sequence[RPESpec]) -> list[list[str | float | None]]:
    """Name, number and unit of what is known of a run."""
    row, record = run.row, run.record
    facts: list[tuple[str, float | None, str]] = [
        ("ATE, lost frames held", None if row.score_m is None else 1000 * row.score_m, "mm"),
        ("ATE of the tracked frames", _scaled(row.metrics.get("ate_rmse_m"), 1000), "mm"),
        ("ATE of the final trajectory", _scaled(row.final_ate_m, 1000), "mm"),
        *(
            (f"RPE over {s.describe()}", _scaled(row.metrics.get(s.metric("trans")), 1000), "mm/s" if s.rate else "mm")
            for s in rpe
        ),
        ("coverage", 100 * row.coverage, "%"),
        ("frame time", row.frame_ms, "ms"),
        ("real time", row.real_time_factor, "×"),
        ("memory", row.peak_memory_mb, "MB"),
        ("keyframes", record.keyframes, ""),
        ("map points", record.map_points, ""),
        ("mask overlap (IoU)", row.mask_iou, ""),
    ]
    return [[name, significant(value), unit] for name, value, unit in facts if value is not None]


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | bool) or value is None else str(value)


def _log(run: LoadedRun) -> str:
    path = run.store.folder(run.row.run_id) / "log.txt"
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        before = max(file.seek(0, os.SEEK_END) - _LOG_BYTES, 0)
        file.seek(before)
        text = file.read(_LOG_BYTES)
    return (f"... {before} bytes before\n" if before else "") + text.decode(errors="replace")


def _series(frames: RunFrames, most: int) -> dict[str, Any]:
    """The frames over time, thinned and packed."""
    columns = frames.columns
    if not columns:
        return {}
    step = -(-len(frames) // most)
    stamps, start = columns["timestamp"], float(columns["timestamp"][0])
    stages = [name for name in columns if name.endswith("_s") and name not in _WHOLE]
    counts = [name for name in COUNTS if f"stat_{name}" in columns]
    rows = [stamps - start, 1000 * frames.errors_m, 100 * frames.share]
    rows += [columns[f"stat_{name}"] for name in counts] + [1000 * columns[name] for name in stages]
    t, error, share, *others = packed_rows([np.asarray(row, dtype=np.float64)[::step] for row in rows])
    found: dict[str, Any] = {
        "count": len(frames),
        "step": step,
        "start": start,
        "t": t,
        "states": "".join(state[:1] for state in columns["state"][::step].tolist()),
        "frame_error_mm": error,
        "share_source": frames.share_source,
        "counts": dict(zip(counts, others, strict=False)),
        "stages": {name[:-2]: row for name, row in zip(stages, others[len(counts) :], strict=True)},
    }
    return found | {"share": share} if np.isfinite(frames.share).any() else found


def _track(run: LoadedRun, protocol: Protocol, truth: Trajectory | None, most: int) -> dict[str, Any]:
    """The aligned track beside the true one; without ground truth the track alone; empty if nothing was tracked.

    Where the time between two poses exceeds twice the median interval, all series have a gap.
    """
    try:
        estimate = run.trajectory(run.row.trajectory)
        if estimate is None or len(estimate) < 2:
            return {}
        if truth is None or not run.row.metrics:
            return _packed_track(estimate, {"xyz": estimate.positions, "angles": _angles(estimate, estimate)}, most)
        aligned, true, series = pose_errors(estimate, truth, protocol)
    except DynslamError as error:
        return {"reason": str(error)}
    columns = {
        "error_mm": 1000 * series["trans_m"],
        "rotation_deg": series["rot_deg"],
        "xyz": aligned.positions,
        "true_xyz": true.positions,
        "angles": _angles(aligned, true),
        "true_angles": _angles(true, true),
    }
    return _packed_track(aligned, columns, most) | {"alignment": protocol.alignment, "doubt": _rotation_doubt(run)}


def _rotation_doubt(run: LoadedRun) -> str:
    """Why the angles of an aligned track say nothing of the tracker; empty where they do."""
    uncertainty = run.row.rotation_uncertainty_deg
    if run.row.rotation_reliable or uncertainty is None:
        return ""
    return (
        f"{DOUBT} Rotation is unreliable: the path hardly determines the alignment's rotation (standard error "
        f"{uncertainty:.0f}°), which turns all angles shown here. Positions are not affected."
    )


def _packed_track(track: Trajectory, columns: Mapping[str, Array], most: int) -> dict[str, Any]:
    """Series along a track ``[N]`` or ``[N, 3]``, thinned, broken at gaps and packed."""
    start = float(track.timestamps[0])
    widths = [1 if values.ndim == 1 else values.shape[1] for values in columns.values()]
    together = np.column_stack(list(columns.values()))
    stamps, values = broken(track.timestamps - start, together, most)
    t, *rows = packed_rows(np.vstack([stamps, values.T]))
    found: dict[str, Any] = {"start": start, "t": t}
    for name, width in zip(columns, widths, strict=True):
        found[name] = rows[0] if width == 1 else rows[:width]
        rows = rows[width:]
    return found


def _angles(track: Trajectory, true: Trajectory) -> Array:
    """Yaw, pitch and roll (about the camera's y, x and z) from the first true pose, in degrees ``[N, 3]``."""
    turned = true.T_world_cam[0, :3, :3].T @ track.T_world_cam[:, :3, :3]
    yaw = np.arctan2(turned[:, 0, 2], turned[:, 2, 2])
    pitch = np.arcsin(np.clip(-turned[:, 1, 2], -1, 1))
    roll = np.arctan2(turned[:, 1, 0], turned[:, 1, 1])
    return np.asarray(np.degrees(np.unwrap(np.stack([yaw, pitch, roll], axis=1), axis=0)))
