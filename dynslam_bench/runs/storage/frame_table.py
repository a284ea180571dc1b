"""The frames of a stored run as a pandas frame, one row a frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..frame_row import CSV_FILE, column_names, read_csv
from .record import RunRecord
from .store import RunStore

if TYPE_CHECKING:
    import pandas as pd

_KINDS = {"index": "int64", "timestamp": "float64", "state": "string", "reward_m": "float64"}
"""Columns that are never missing; all others are ``Float64``."""


def load_frames(run: RunRecord | Path | str, results: RunStore | Path | str = "results") -> pd.DataFrame:
    """The frames of a run.

    Args:
        run: A record; the run's id, its first digits or ``latest``; or a path: the run's folder (``results/latest``) or
            a ``frames.csv``.
        results: The results folder, or a store; not looked at if `run` is a path.

    Returns:
        One row a frame, in order. Columns without which no frame is: index (``int64``, in the run's part of the
        sequence), timestamp (``float64``, seconds), state (``string``: ``initialising``, ``ok``, ``lost`` or
        ``dropped``), reward_m (``float64``, metres). ``Float64``, missing (``pd.NA``) where there is no ground truth,
        no mask, or the stage did not run: frame_error_trans_m and frame_error_rot_deg (frame to frame, metres and
        degrees), pose_error_trans_m and pose_error_rot_deg (cumulative), mask_iou (0 to 1), dynamic_share (0 to 1, only
        where the sequence has exact masks), ``<stage>_s`` (seconds of each stage; ``total_s`` is the frame time;
        ``read`` is decoding), ``stat_<name>`` (diagnostics).

    Raises:
        RunError: There is no such run, it has no frames (an imported trajectory), or its table is damaged.
    """
    import pandas as pd

    rows = read_csv(_file(run, results))
    columns = column_names(rows)
    frame = pd.DataFrame([row.cells() for row in rows], columns=columns, dtype=object)
    return frame.astype({name: _KINDS.get(name, "Float64") for name in columns})


def _file(run: RunRecord | Path | str, results: RunStore | Path | str) -> Path:
    store = results if isinstance(results, RunStore) else RunStore(results)
    if isinstance(run, RunRecord):
        return store.folder(run.run_id) / CSV_FILE
    path = Path(run).expanduser()
    if path.is_dir():
        return path / CSV_FILE
    return path if path.is_file() or isinstance(run, Path) else store.folder(store.find(run)) / CSV_FILE
