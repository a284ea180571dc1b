"""What the exploring part of the page knows of all runs: trackers, sequences, every run's numbers, in few bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.evaluation.protocol import Protocol

from ..figures.style import COLOURS, significant
from ..model.board import Board
from ..model.row import SEEN, RunRow
from ..tables.leaderboard import middle, rank_cell, timed

Array = NDArray[np.float64]

SHARE_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0)
"""Bins of the share of dynamic pixels."""
FEWEST_FRAMES = 5
"""Frames below which a bin shows nothing."""


class FrameSums:
    """What the exploring part shows of frames: quartiles of a run's errors, and errors by dynamic share."""

    def __init__(self) -> None:
        self.quartiles: dict[str, list[float | None]] = {}
        self._shares: dict[str, list[Array]] = {}
        self._errors: dict[str, list[Array]] = {}

    def add(self, row: RunRow, errors_m: Array, share: Array, exact: bool) -> None:
        """Take the frames of one run.

        Args:
            row: The run.
            errors_m: Frame-to-frame translational errors ``[N]``, nan where there is none.
            share: Share of dynamic pixels ``[N]``.
            exact: Whether that is known from exact masks; only those are comparable between trackers.
        """
        known = np.isfinite(errors_m)
        if known.any():
            five = np.percentile(errors_m[known], [5, 25, 50, 75, 95])
            self.quartiles[row.run_id] = [significant(1000 * float(value), 4) for value in five]
        both = known & np.isfinite(share)
        if exact and both.any() and not row.failed:
            self._shares.setdefault(row.variant_key, []).append(share[both])
            self._errors.setdefault(row.variant_key, []).append(errors_m[both])

    def by_share(self, key: str) -> list[list[float | None]]:
        """Median error in mm and number of frames of each bin between `SHARE_EDGES`, of one tracker; empty for none."""
        if key not in self._shares:
            return []
        share, error = np.concatenate(self._shares[key]), np.concatenate(self._errors[key])
        at = np.clip(np.searchsorted(SHARE_EDGES, share, side="right") - 1, 0, len(SHARE_EDGES) - 2)
        found: list[list[float | None]] = []
        for number in range(len(SHARE_EDGES) - 1):
            inside = error[at == number]
            middle_mm = 1000 * float(np.median(inside)) if len(inside) >= FEWEST_FRAMES else None
            found.append([significant(middle_mm, 4), len(inside)])
        return found


def explore_content(board: Board, protocol: Protocol, sums: FrameSums, pictured: Collection[str]) -> dict[str, Any]:
    """What ``data/explore.js`` holds.

    Args:
        board: The board.
        protocol: How errors were computed.
        sums: What the frames say.
        pictured: Ids of the runs that have pictures.
    """
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    names = [*board.sequences, *board.unscored]
    column = {name: at for at, name in enumerate(names)}
    metrics = _metrics(protocol)
    kept = {row.run_id for cells in board.cells.values() for cell in cells.values() for row in cell.kept}
    runs = []
    for row in sorted(board.rows, key=lambda r: (place[r.variant_key], column[board.sequence(r)], r.repeat_key)):
        values = [significant(_value(row, metric), 5) for metric in metrics]
        flags = (row.run_id in kept) + 2 * (row.run_id in pictured) + 4 * (not row.rotation_reliable)
        flags += 8 * (row.seen_in_training and not board.rank_seen)
        five = sums.quartiles.get(row.run_id)
        where = [row.run_id, place[row.variant_key], column[board.sequence(row)], row.repeat]
        runs.append([*where, row.ending, flags, values, five or []])
    tags: dict[str, set[str]] = {}
    for row in board.rows:
        tags.setdefault(board.sequence(row), set()).update(row.tags)
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "reference": None if board.reference is None else place[board.reference],
        "referenceName": board.reference_name,
        "metrics": metrics,
        "trackers": [_tracker(board, key, at) for at, key in enumerate(keys)],
        "sequences": [
            {"name": n, "short": board.short.get(n, n), "group": board.groups[n], "tags": sorted(tags[n])}
            for n in names
        ],
        "still": [significant(board.never_move.get(name), 5) for name in names],
        "runs": runs,
        "shareEdges": SHARE_EDGES,
        "byShare": {place[key]: found for key in keys if (found := sums.by_share(key))},
    }


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
