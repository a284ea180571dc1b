"""What the exploring part of the page knows of all runs: trackers, sequences, every run's numbers, in few bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.evaluation.protocol import Protocol

from ..figures.style import COLOURS, significant
from ..model.board import Board
from ..model.cell import Cell
from ..model.row import SEEN, RunRow
from ..tables.leaderboard import middle, rank_cell, timed

Array = NDArray[np.float64]

SHARE_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0)
"""Bins of the share of dynamic pixels."""
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""
FEWEST_FRAMES = 5
"""Frames below which a bin shows nothing."""


@dataclass(frozen=True)
class FrameSummary:
    """What the exploring part shows of the frames of one run.

    Attributes:
        quartiles_mm: The 5, 25, 50, 75 and 95 % quantiles of its frame-to-frame errors; empty where there are none.
        shares: Share of dynamic pixels of frames, where exact masks tell it; only those compare trackers.
        errors_m: Their frame-to-frame translational errors.
    """

    quartiles_mm: list[float | None]
    shares: list[float]
    errors_m: list[float]


def summarise(row: RunRow, errors_m: Array, share: Array, exact: bool) -> FrameSummary:
    """The frames of one run.

    Args:
        row: The run.
        errors_m: Frame-to-frame translational errors ``[N]``, nan where there is none.
        share: Share of dynamic pixels ``[N]``.
        exact: Whether that is known from exact masks.
    """
    known = np.isfinite(errors_m)
    if not known.any():
        return FrameSummary([], [], [])
    five = [significant(1000 * value, 4) for value in np.percentile(errors_m[known], [5, 25, 50, 75, 95]).tolist()]
    both = known & np.isfinite(share) & (exact and not row.failed)
    return FrameSummary(five, share[both].tolist(), errors_m[both].tolist())


class FrameSums:
    """What the exploring part shows of all frames: quartiles of the runs' errors, and errors by dynamic share."""

    def __init__(self) -> None:
        self.quartiles: dict[str, list[float | None]] = {}
        self._shares: dict[str, list[float]] = {}
        self._errors: dict[str, list[float]] = {}

    def add(self, row: RunRow, frames: FrameSummary) -> None:
        """Take the frames of one run."""
        if frames.quartiles_mm:
            self.quartiles[row.run_id] = frames.quartiles_mm
        if frames.shares:
            self._shares.setdefault(row.variant_key, []).extend(frames.shares)
            self._errors.setdefault(row.variant_key, []).extend(frames.errors_m)

    def by_share(self, key: str) -> list[list[float | None]]:
        """RMSE in mm and number of frames of each bin between `SHARE_EDGES`, of one tracker; empty for none.

        Not the median: a tracker that follows people errs grossly on few frames, and best of all on most.
        """
        if key not in self._shares:
            return []
        share, error = np.array(self._shares[key]), np.array(self._errors[key])
        at = np.clip(np.searchsorted(SHARE_EDGES, share, side="right") - 1, 0, len(SHARE_EDGES) - 2)
        found: list[list[float | None]] = []
        for number in range(len(SHARE_EDGES) - 1):
            inside = error[at == number]
            rmse_mm = 1000 * float(np.sqrt(np.mean(inside**2))) if len(inside) >= FEWEST_FRAMES else None
            found.append([significant(rmse_mm, 4), len(inside)])
        return found


def explore_content(
    board: Board,
    protocol: Protocol,
    sums: FrameSums,
    paged: Collection[str],
    pictured: Collection[str],
    pageless: str = "",
) -> dict[str, Any]:
    """What ``data/explore.js`` holds.

    Args:
        board: The board.
        protocol: How errors were computed.
        sums: What the frames say.
        paged: Ids of the runs that have a page.
        pictured: Ids of those that have pictures.
        pageless: Which runs have no page, in words.
    """
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    names = [*board.sequences, *board.unscored]
    column = {name: at for at, name in enumerate(names)}
    metrics = _metrics(protocol)
    listed = _listed(board, paged)
    kept = {row.run_id for cells in board.cells.values() for cell in cells.values() for row in cell.kept}
    runs = []
    for row in sorted(listed, key=lambda r: (place[r.variant_key], column[board.sequence(r)], r.repeat_key)):
        values = [significant(_value(row, metric), 5) for metric in metrics]
        flags = (row.run_id in kept) + 2 * (row.run_id in pictured) + 4 * (row.run_id not in paged)
        five = sums.quartiles.get(row.run_id)
        where = [row.run_id, place[row.variant_key], column[board.sequence(row)], row.repeat]
        runs.append([*where, row.ending, flags, values, five or []])
    tags: dict[str, set[str]] = {}
    for row in board.rows:
        tags.setdefault(board.sequence(row), set()).update(row.tags)
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": None if board.reference is None else place[board.reference],
        "referenceName": board.reference_name,
        "metrics": metrics,
        "trackers": [_tracker(board, key, at) for at, key in enumerate(keys)],
        "sequences": [
            {"name": n, "short": board.short.get(n, n), "group": board.groups[n], "tags": sorted(tags[n])}
            for n in names
        ],
        "still": [significant(board.never_move.get(name), 5) for name in names],
        "cells": [
            [at, column[name], *_cell(cell, metrics, board.rank_seen)]
            for key, at in place.items()
            for name, cell in board.cells[key].items()
        ],
        "runs": runs,
        "unlisted": len(board.rows) - len(listed),
        "shareEdges": SHARE_EDGES,
        "byShare": {place[key]: found for key in keys if (found := sums.by_share(key))},
    }


def _listed(board: Board, paged: Collection[str]) -> list[RunRow]:
    """The rows that are listed one by one: a page of a hundred thousand would open slowly, and nobody reads them."""
    if len(board.rows) <= MOST_LISTED:
        return board.rows
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    return [row for row in board.rows if row.run_id in paged or row.run_id in first]


def _cell(cell: Cell, metrics: Sequence[Mapping[str, str]], rank_seen: bool) -> list[Any]:
    """How many runs of a cell there are and failed, what speaks against it, and the median of every number."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (cell.seen and not rank_seen)
    values = [[_value(row, metric) for row in cell.kept] for metric in metrics]
    medians = [middle(value for value in some if value is None or np.isfinite(value)) for some in values]
    return [len(cell.rows), cell.failed, doubt, [significant(value, 5) for value in medians]]


def _tracker(board: Board, key: str, at: int) -> dict[str, Any]:
    runs, first = board.runs(key), board.first(key)
    standing = next((found for found in board.standings if found.key == key), None)
    ended = [row for row in runs if not row.failed]
    counts = Counter(row.failed for row in runs)
    return {
        "label": board.labels[key],
        "id": first.tracker,
        "ranked": key in board.ranked,
        "imported": first.imported,
        "provenance": first.provenance,
        "colour": COLOURS[at % len(COLOURS)],
        "rank": "–" if standing is None else rank_cell(standing).text,
        "ratio": None if standing is None else significant(standing.ratio.value, 4),
        "success": [counts[False], len(runs)],
        "coverage": significant(float(np.mean([row.coverage for row in runs])), 4),
        "speed": significant(middle(row.real_time_factor for row in timed(ended)), 3),
        "memory": significant(middle(row.peak_memory_mb for row in ended), 4),
    }


def _metrics(protocol: Protocol) -> list[dict[str, str]]:
    """The numbers to choose from: of the online and of the final trajectory."""
    found = [
        ("ate", "ATE", "m", "ate_rmse_m"),
        *(
            ("rpe", f"RPE over {spec.describe()}", "m/s" if spec.rate else "m", spec.metric("trans"))
            for spec in protocol.rpe
        ),
        *(
            ("rotation", f"RPE over {spec.describe()}, rotation", "deg/s" if spec.rate else "deg", spec.metric("rot"))
            for spec in protocol.rpe
        ),
        ("rotation", "absolute rotation", "deg", "ape_rot_rmse_deg"),
    ]
    return [
        {"kind": kind, "name": name, "unit": unit, "key": key, "which": which}
        for which in ("online", "final")
        for kind, name, unit, key in found
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] != row.trajectory:
        return None if row.failed else row.final_metrics.get(metric["key"])
    if metric["kind"] == "ate":
        return row.score_m
    return None if row.failed else row.metrics.get(metric["key"])
