"""From results folders to a frame or a board, in one call."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.storage.store import RunStore

from .board import Board, On, make_board
from .columns import name_columns
from .frame import rows_frame
from .labels import make_labels
from .rows import load_runs, open_stores

if TYPE_CHECKING:
    import pandas as pd


def load_frame(
    results: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    trials: bool = False,
) -> pd.DataFrame:
    """All runs of some results folders, scored under one protocol, one row a run.

    Args:
        results: Results folders, or a store.
        protocol: How to evaluate; SLAM is never run again for it.
        trials: As in `build_report`.

    Returns:
        The frame that `rows_frame` describes.

    Raises:
        ReportError: There are no runs.
    """
    rows = [run.row for run in load_runs(open_stores(results), get_protocol(protocol), trials=trials).runs]
    return rows_frame(rows, name_columns(rows), make_labels(rows))


def load_board(
    results: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    protocol: Protocol | str = "tum-rgbd/v1",
    *,
    reference: str | None = None,
    on: On = "common",
    rank_seen: bool = False,
    trials: bool = False,
) -> Board:
    """The board of some results folders: all runs, ordered and ranked as in a report.

    Args:
        results: Results folders, or a store.
        protocol: How to evaluate; SLAM is never run again for it.
        reference: As in `make_board`.
        on: As in `make_board`.
        rank_seen: As in `make_board`.
        trials: As in `build_report`.

    Raises:
        ReportError: As `make_board`.
    """
    loaded = load_runs(open_stores(results), get_protocol(protocol), reference=reference, trials=trials)
    rows = [run.row for run in loaded.runs]
    return make_board(rows, reference, on, rank_seen=rank_seen)
