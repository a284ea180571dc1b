"""What the page of one run shows: its facts, its frames over time, its track beside the true one, its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.frame_row import CSV_FILE

from ..figures.style import significant
from ..model.missing import run_command
from ..model.rows import LoadedRun
from .side_files import packed

Array = NDArray[np.float64]

MOST_FRAMES = 400
"""Frames of a run that its page shows; of longer ones every second, third, ..."""
_LOG_BYTES = 20_000
_COUNTS = ("keypoints", "culled", "matches", "inliers")


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run.

    Attributes:
        table: ``frames.csv``; empty for an imported trajectory.
        share: Share of the pixels that show people ``[N]``, nan where it is not known.
        share_source: Where that comes from, in words; empty where nothing is known.
    """

    table: pd.DataFrame
    share: Array
    share_source: str


def read_frames(run: LoadedRun, exact: Mapping[int, float]) -> RunFrames:
    """The frames of a run with the share of dynamic pixels: the exact one if it is known, else by its own masks.

    Args:
        run: The run.
        exact: Frame in the numbering of the run's part without offset to the exact share.
    """
    path = run.store.folder(run.row.run_id) / CSV_FILE
    table = pd.read_csv(path) if path.is_file() and path.stat().st_size else pd.DataFrame()
    if table.empty or not {"index", "timestamp", "state", "frame_error_trans_m"} <= set(table):
        return RunFrames(pd.DataFrame(), np.zeros(0), "")
    if exact:
        share = np.array([exact.get(int(index) + run.record.offset, np.nan) for index in table["index"]])
        return RunFrames(table, share, "exact masks")
    if "stat_mask_fraction" in table:
        return RunFrames(table, table["stat_mask_fraction"].to_numpy(np.float64), "the tracker's own masks")
    return RunFrames(table, np.full(len(table), np.nan), "")


def exact_share(path: Path, offset: int) -> dict[int, float]:
    """Frame (before the offset) to its exact share of dynamic pixels, of a ``frames.csv`` that knows it; else empty."""
    if not path.is_file():
        return {}
    with path.open() as file:
        if "dynamic_share" not in file.readline().rstrip("\n").split(","):
            return {}
    table = pd.read_csv(path, usecols=["index", "dynamic_share"]).dropna()
    return {int(index) + offset: float(share) for index, share in table.itertuples(index=False)}


def run_content(run: LoadedRun, frames: RunFrames, protocol: Protocol, truth: Trajectory | None) -> dict[str, Any]:
    """Everything that the page of a run shows, as the page's script reads it.

    Args:
        run: The run.
        frames: Its frames.
        protocol: How its errors are computed.
        truth: Ground truth of its part of the sequence.
    """
    row, record = run.row, run.record
    return {
        "id": row.run_id,
        "status": row.status,
        "ending": row.ending,
        "reason": row.reason,
        "facts": _facts(run),
        "settings": {name: _plain(value) for name, value in record.settings.items()},
        "overrides": sorted(record.overrides),
        "stages": [
            [name, *(significant(1000 * value) for value in (time.median_s, time.p95_s, time.mean_s))]
            for name, time in record.timings.items()
        ],
        "protocol": protocol.describe(),
        "started": row.started,
        "machine": row.machine,
        "notes": row.notes,
        "command": run_command(row),
        "asked": row.command,
        "log": _log(run),
        "frames": _series(frames),
        "track": _track(run, protocol, truth),
    }


def _facts(run: LoadedRun) -> list[list[str | float | None]]:
    """Name, number and unit of what is known of a run."""
    row, record = run.row, run.record
    facts: list[tuple[str, float | None, str]] = [
        ("ATE, lost frames held", None if row.score_m is None else 1000 * row.score_m, "mm"),
        ("ATE of the tracked frames", _scaled(row.metrics.get("ate_rmse_m"), 1000), "mm"),
        ("ATE of the final trajectory", _scaled(row.final_ate_m, 1000), "mm"),
        *((f"RPE {key[4:-13].replace('_', ' ')}", 1000 * value, "mm") for key, value in _relative(row.metrics)),
        ("coverage", 100 * row.coverage, "%"),
        ("frame time", row.frame_ms, "ms"),
        ("real time", row.real_time_factor, "×"),
        ("memory", row.peak_memory_mb, "MB"),
        ("keyframes", record.keyframes, ""),
        ("map points", record.map_points, ""),
        ("mask overlap (IoU)", row.mask_iou, ""),
    ]
    return [[name, significant(value), unit] for name, value, unit in facts if value is not None]


def _relative(metrics: Mapping[str, float]) -> list[tuple[str, float]]:
    return [(name, value) for name, value in metrics.items() if name.startswith("rpe_") and name.endswith("trans_rmse_m")]


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | bool) or value is None else str(value)


def _log(run: LoadedRun) -> str:
    path = run.store.folder(run.row.run_id) / "log.txt"
    if not path.is_file():
        return ""
    text = path.read_bytes()
    cut = f"... {len(text) - _LOG_BYTES} bytes before\n" if len(text) > _LOG_BYTES else ""
    return cut + text[-_LOG_BYTES:].decode(errors="replace")


def _series(frames: RunFrames) -> dict[str, Any]:
    """The frames over time, thinned and packed."""
    table = frames.table
    if table.empty:
        return {}
    step = -(-len(table) // MOST_FRAMES)
    thin = table.iloc[::step]
    start = float(table["timestamp"].iloc[0])
    found: dict[str, Any] = {
        "count": len(table),
        "step": step,
        "start": start,
        "t": packed(thin["timestamp"] - start),
        "states": "".join(state[:1] for state in thin["state"]),
        "frame_error_mm": packed(1000 * thin["frame_error_trans_m"]),
        "share_source": frames.share_source,
        "counts": {name: packed(thin[f"stat_{name}"]) for name in _COUNTS if f"stat_{name}" in thin},
    }
    if np.isfinite(frames.share).any():
        found["share"] = packed(100 * frames.share[::step])
    names = [name for name in thin if name.endswith("_s") and not name.startswith("stat_")]
    found["stages"] = {name[:-2]: packed(1000 * thin[name]) for name in names if name not in ("total_s", "read_s")}
    if "total_s" in thin:
        found["total_ms"] = packed(1000 * thin["total_s"])
    return found


def _track(run: LoadedRun, protocol: Protocol, truth: Trajectory | None) -> dict[str, Any]:
    """The aligned track beside the true one; without ground truth the track alone; empty if nothing was tracked."""
    try:
        estimate = run.store.trajectory(run.row.run_id, run.row.trajectory)
        if estimate is None or len(estimate) < 2:
            return {}
        if truth is None or not run.row.metrics:
            thin = estimate.select(slice(None, None, -(-len(estimate) // MOST_FRAMES)))
            return {"t": packed(thin.timestamps - thin.timestamps[0]), "start": float(thin.timestamps[0]), **_poses(thin, thin, "")}
        aligned, true, series = pose_errors(estimate, truth, protocol)
    except DynslamError as error:
        return {"reason": str(error)}
    step = slice(None, None, -(-len(aligned) // MOST_FRAMES))
    aligned, true = aligned.select(step), true.select(step)
    return {
        "t": packed(aligned.timestamps - aligned.timestamps[0]),
        "start": float(aligned.timestamps[0]),
        "alignment": protocol.alignment,
        "error_mm": packed(1000 * series["trans_m"][step]),
        "rotation_deg": packed(series["rot_deg"][step]),
        **_poses(aligned, true, ""),
        **_poses(true, true, "true_"),
    }


def _poses(track: Trajectory, true: Trajectory, prefix: str) -> dict[str, Any]:
    """Positions in metres, and yaw, pitch and roll (about the camera's y, x and z) from the first true pose, degrees."""
    from scipy.spatial.transform import Rotation

    turned = true.T_world_cam[0, :3, :3].T @ track.T_world_cam[:, :3, :3]
    angles = np.degrees(np.unwrap(Rotation.from_matrix(turned).as_euler("YXZ"), axis=0))
    return {
        f"{prefix}xyz": [packed(track.positions[:, axis]) for axis in range(3)],
        f"{prefix}angles": [packed(angles[:, axis]) for axis in range(3)],
    }
