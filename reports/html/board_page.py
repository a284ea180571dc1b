"""The first page of a report: the ranking by category, and what the pages of errors, runs and comparisons read."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from dynslam_bench.core import setting_text
from dynslam_bench.evaluation import Protocol
from dynslam_bench.reports.figures import significant
from dynslam_bench.reports.model.board import OVERALL, Board, Cell, compare_pairs
from dynslam_bench.reports.model.row import SEEN, RunRow, grouped
from dynslam_bench.reports.model.statistics import FLOOR_M, Interval, Standing, Verdict
from dynslam_bench.reports.tables.leaderboard import (
    frame_time_cell,
    leaderboard_cells,
    median_of,
    rank_cell,
    run_link,
)
from dynslam_bench.reports.tables.table import TableCell

_OPPOSITE: dict[Verdict, Verdict] = {
    "better": "worse",
    "worse": "better",
    "cannot tell": "cannot tell",
}
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""


MEANINGS = {
    "static": "nothing moves",
    "low dynamic": "people sit",
    "high dynamic": "people walk",
    "unknown objects": "objects of no class",
    "fixed camera": "the camera stands still",
}
"""Categories in everyday words."""


def entries_of(
    board: Board, whole: Board, boards: Mapping[str, Board], paged: Collection[str] = ()
) -> list[dict[str, Any]]:
    """The rows of one category, cells by the names that `board.html.j2` calls them by.

    ``at`` numbers the tracker on all pages; ``group`` is 0 for ranked trackers, 1 for others, 2 for
    controls (bounds). The name leads to the tracker's run with the median error on the first
    sequence where that has a page, and the successes lead to its first failure.

    Args:
        board: Of the category.
        whole: Of all sequences: the numbers of trackers.
        boards: Of all categories, for the column that shows them side by side.
        paged: Ids of the runs that have a page.
    """
    keys = [*whole.trackers, *whole.final_only]
    limits = _limits([s.ratio for s in board.standings])
    entries = []
    for key in board.trackers:
        standing = board.standing_by_key.get(key)
        cells = leaderboard_cells(board, key)
        runs = board.cells[key]
        first = board.first(key)
        typical = [runs[name].typical for name in board.sequences if name in runs] or [first]
        start = next((run for run in typical if run.run_id in paged), typical[0])
        ended = [run for run in board.runs(key) if not run.failed]
        marks = cells["tracker"].text.removeprefix(board.labels[key])
        failure = next((run for run in board.runs(key) if run.failed), None)
        if failure is not None:
            tip = f"{board.sequence(failure)}: {failure.ending}"
            cells["success"] = replace(cells["success"], link=run_link(failure), tip=tip)
        entries.append(
            {
                "at": keys.index(key),
                "group": 2
                if first.tracker.provenance == "control"
                else int(key not in board.ranked),
                "name": replace(
                    cells["tracker"], text=board.names[key] + marks, link=run_link(start)
                ),
                "kind": TableCell("imported") if first.imported else cells["provenance"],
                "remark": first.program_remark,
                "rank": TableCell("–") if standing is None else rank_cell(standing),
                "ratio": cells["ATE ratio"]
                if standing is None
                else _ratio_cell(board, standing, cells["ATE ratio"]),
                "bar": {} if standing is None else _bar(standing.ratio, limits),
                "verdict": TableCell("not ranked", why)
                if (why := board.unranked_why(key))
                else cells["better?"],
                "success": cells["success"],
                "coverage": cells["coverage"],
                "time": frame_time_cell(board, ended),
                "memory": cells["MB"],
                "by_category": _by_category(key, boards),
            }
        )
    return sorted(entries, key=itemgetter("group"))


def _ratio_cell(board: Board, standing: Standing, cell: TableCell) -> TableCell:
    """The leaderboard's cell with the interval, which is drawn beside it, as a tip."""
    if cell.emphasis == "failed":
        return cell
    low = standing.ratio.low
    high = standing.ratio.high
    some = standing.sequences < len(board.common)
    tip = f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low) else ""
    small = f"{standing.sequences} of {len(board.common)} sequences" if some else ""
    return replace(cell, small=small, emphasis="", tip=tip)


def _limits(ratios: Sequence[Interval]) -> tuple[float, float]:
    """Ends of the axis of interval bars, in logarithms; 1 lies between them."""
    ends = [
        end
        for ratio in ratios
        for end in (ratio.value, ratio.low, ratio.high)
        if math.isfinite(end) and end > 0
    ]
    return math.log(max(min([0.8, *ends]), 0.02)), math.log(min(max([1.25, *ends]), 20.0))


def _bar(ratio: Interval, limits: tuple[float, float]) -> dict[str, float]:
    """Places of a ratio, of the ends of its interval and of 1 on a logarithmic axis, in pixels; none of what is nan."""
    values = {"at": ratio.value, "low": ratio.low, "high": ratio.high, "one": 1.0}
    shares = {
        name: (math.log(max(value, FLOOR_M)) - limits[0]) / (limits[1] - limits[0])
        for name, value in values.items()
        if math.isfinite(value)
    }
    return {name: 4 + 112 * min(max(share, 0.0), 1.0) for name, share in shares.items()}


def _by_category(key: str, boards: Mapping[str, Board]) -> list[tuple[str, float, float]]:
    """A dot a category: its name, the ratio there, and the height of a ratio from 1/8 to 8 in pixels from above."""
    ratios = {
        name: board.standing_by_key[key].ratio.value
        for name, board in boards.items()
        if key in board.standing_by_key
    }
    return [
        (name, ratio, 12 - 8 * min(max(math.log(max(ratio, FLOOR_M)) / math.log(8), -1.0), 1.0))
        for name, ratio in ratios.items()
        if math.isfinite(ratio) and name != OVERALL
    ]


# -- what the pages of errors, runs and comparisons read


def side_content(
    board: Board,
    boards: Mapping[str, Board],
    protocol: Protocol,
    paged: set[str],
    pictured: set[str],
    pageless: str,
) -> dict[str, Any]:
    """What ``data/board.js`` holds: trackers, sequences, cells and runs.

    Args:
        board: The board.
        boards: Of its categories.
        protocol: How errors were computed.
        paged: Ids of the runs that have a page.
        pictured: Ids of those whose pictures lie beside it.
        pageless: Which runs have no page, in words.
    """
    keys = [*board.trackers, *board.final_only]
    names = [*board.sequences, *board.unscored]
    place, column = ({name: at for at, name in enumerate(items)} for items in (keys, names))
    metrics = _metrics(protocol)
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    all_listed = len(board.rows) <= MOST_LISTED  # a page of a hundred thousand would open slowly
    listed = [row for row in board.rows if all_listed or row.run_id in paged or row.run_id in first]
    ordered = sorted(
        listed,
        key=lambda row: (place[row.variant_key], column[board.sequence(row)], row.repeat_key),
    )
    tags = {
        name: {tag for row in rows for tag in row.sequence.tags}
        for name, rows in grouped(board.rows, board.sequence).items()
    }
    categories = {
        category: {column[name] for name in some.sequences}
        for category, some in list(boards.items())[1:]
    }
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": board.reference_name,
        "referenceAt": None if board.reference is None else place[board.reference],
        "metrics": metrics,
        "trackers": [
            {
                "label": board.names[key],
                "ranked": key in board.ranked,
                "settings": settings_content(board.first(key)),
            }
            for key in keys
        ],
        "sequences": [
            {
                "name": name,
                "short": board.short.get(name, name),
                "tags": sorted(tags[name]),
                "static": significant(board.static_camera.get(name)),
            }
            for name in names
        ],
        "categories": {category: sorted(members) for category, members in categories.items()},
        "cells": [
            cell_content(cell, place[key], column[name], metrics, rank_seen=board.rank_seen)
            for key in keys
            for name, cell in board.cells[key].items()
        ],
        "runs": [
            [
                row.run_id,
                place[row.variant_key],
                column[board.sequence(row)],
                row.repeat,
                row.ending,
                (row.run_id in paged) + 2 * (row.run_id in pictured),
            ]
            for row in ordered
        ],
        "unlisted": len(board.rows) - len(listed),
    }


def ratios_content(board: Board) -> list[list[Any]]:
    """What ``data/ratios.js`` holds of every two trackers: their numbers, and the second against the first."""
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    verdicts = {standing.key: standing.verdict for standing in board.standings}
    ratios = []
    for pair in compare_pairs(board, keys[::-1]):  # of the later one over the earlier one
        verdict = pair.verdict
        if pair.other == board.reference:  # as on the board, which asks it of fewer pairs
            verdict = verdicts.get(pair.one, "")
        elif pair.one == board.reference:
            verdict = _OPPOSITE.get(verdicts.get(pair.other, ""), verdict)
        ratios.append(
            [
                place[pair.other],
                place[pair.one],
                *ratio_numbers(pair.ratio),
                pair.sequences,
                verdict,
            ]
        )
    return ratios


def ratio_numbers(ratio: Interval) -> list[float | None]:
    """A ratio and the ends of its interval."""
    return [significant(value) for value in (ratio.value, ratio.low, ratio.high)]


def cell_content(
    cell: Cell,
    tracker: int,
    sequence: int,
    metrics: Sequence[Mapping[str, str]],
    *,
    rank_seen: bool,
) -> list[Any]:
    """Place, runs, failures, what speaks against it, the median of every number, typical run, the error's quartiles."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (
        cell.in_training and not rank_seen
    )
    medians = [
        significant(median_of(_value(row, metric) for row in cell.kept)) for metric in metrics
    ]
    quartiles = np.percentile(cell.scores, [25, 75]).tolist() if len(cell.scores) > 1 else []
    place = [tracker, sequence, len(cell.rows), cell.failed, doubt]
    return [*place, medians, cell.typical.run_id, [significant(value) for value in quartiles]]


def settings_content(row: RunRow) -> dict[str, str]:
    """What sets a run's tracker apart from other variants of it."""
    return {name: setting_text(value) for name, value in row.variant.items()}


def _metrics(protocol: Protocol) -> list[dict[str, str]]:
    """The numbers to choose from, the one that ranks first."""
    parts = (("", "m", "trans"), (", rotation", "deg", "rot"))
    numbers = [
        ("ATE", "m", "ate_rmse_m"),
        *(
            (f"RPE over {spec.describe()}{words}", f"{unit}{'/s' * spec.rate}", spec.metric(part))
            for words, unit, part in parts
            for spec in protocol.rpe
        ),
        ("absolute rotation", "deg", "ape_rot_rmse_deg"),
    ]
    return [
        {"name": name, "unit": unit, "key": key, "which": which}
        for which in dict.fromkeys([protocol.trajectory, "final"])
        for name, unit, key in numbers
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] != row.trajectory:
        return (
            None
            if row.failed or metric["which"] == "online"
            else row.final_metrics.get(metric["key"])
        )
    if metric["key"] == "ate_rmse_m":
        return row.score_m
    return None if row.failed else row.metrics.get(metric["key"])
