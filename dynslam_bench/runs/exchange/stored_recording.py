"""A stored run as a recording: what is kept of it, with the images of its sequence."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.slam.outputs.map_files import read_ply

from ..frame_row import CSV_FILE, read_csv
from ..snapshots import Snapshot, read_snapshots
from ..storage.record import RunRecord
from ..storage.store import RunStore
from ..truth import aligned_truth
from .recording import RecordingWriter

_TOLERANCE_S = 1e-5


def write_stored(
    path: Path, store: RunStore, record: RunRecord, sequence: Sequence, trajectory: Trajectory
) -> list[str]:
    """Write the recording of a stored run.

    Args:
        path: The file.
        store: The run's.
        record: The run.
        sequence: The frames that it saw.
        trajectory: What is drawn as its estimate, and where the camera goes if the run has no online poses.

    Returns:
        What a user should know, one line each.

    Raises:
        RunError: `rerun-sdk` is not installed, or a file of the run is damaged.
        SequenceError: An image cannot be read.
    """
    folder = store.folder(record.run_id)
    (height, width), shots = read_snapshots(folder)
    scale = np.array([sequence.camera.width / max(width, 1), sequence.camera.height / max(height, 1)])
    seen = {shot.index: _scaled(shot, scale) for shot in shots}
    online = store.trajectory(record.run_id, "online") or trajectory
    rows = {row.index: row for row in read_csv(folder / CSV_FILE)} if (folder / CSV_FILE).is_file() else {}
    writer = RecordingWriter(path, sequence.camera, f"{record.tracker.label} on {record.sequence.id}")
    with contextlib.closing(writer):
        for index in range(len(sequence)):
            frame, row = sequence[index], rows.get(index)
            pose = _pose_at(online, frame.timestamp)
            state, error = ("", None) if row is None else (str(row.state), row.pose_error_trans_m)
            writer.add(index, frame.timestamp, frame.rgb, pose, seen.get(index), state=state, error_m=error)
        cloud = read_ply(folder / "map.ply") if (folder / "map.ply").is_file() else None
        truth = aligned_truth(sequence.ground_truth, trajectory)[0]
        positions, colours = (None, None) if cloud is None else (cloud.positions, cloud.colours)
        writer.finish(trajectory, truth, positions, colours)
    notes = [f"features and masks are known of {len(seen)} of {len(sequence)} frames; `run --rrd` records all"]
    return notes if len(seen) < len(sequence) else []


def _scaled(shot: Snapshot, scale: NDArray[np.float64]) -> Snapshot:
    """A snapshot of an image that the tracker's preprocessing had resized, in pixels of the sequence's."""
    if (scale == 1).all():
        return shot
    points = ((shot.points + 0.5) * scale - 0.5).round().astype(np.int16)
    return replace(shot, points=points)


def _pose_at(trajectory: Trajectory, stamp: float) -> NDArray[np.float64] | None:
    near = int(np.searchsorted(trajectory.timestamps, stamp - _TOLERANCE_S))
    if near < len(trajectory) and abs(trajectory.timestamps[near] - stamp) <= _TOLERANCE_S:
        pose: NDArray[np.float64] = trajectory.T_world_cam[near]
        return pose
    return None
