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
from dynslam_bench.reports.model.answers import error_columns
from dynslam_bench.reports.model.board import (
    OVERALL,
    Board,
    TrackerOnSequence,
    compare_pairs,
    more_sequences,
)
from dynslam_bench.reports.model.row import SEEN, RunRow, grouped
from dynslam_bench.reports.model.statistics import Interval, RankingVerdict, Scope, Standing
from dynslam_bench.reports.tables.leaderboard import (
    error_cell,
    frame_time_cell,
    leaderboard_cells,
    lost_words,
    median_of,
    rank_cell,
    run_link,
)
from dynslam_bench.reports.tables.table import TableCell

_OPPOSITE: dict[RankingVerdict, str] = {
    "better": "worse",
    "better, but lost": "worse, but lost fewer",
    "worse": "better",
    "cannot tell": "cannot tell",
}
"""Verdict of one tracker against another to that of the other against the one."""
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""


# Groups of a board's rows, in their order: a line is drawn between two of them.
_RANKED = 0
_NOT_RANKED = 1
_FINAL_ONLY = 2
"""Trackers of which final trajectories alone are known."""
_MONOCULAR = 3
"""Trackers whose scale is that of the truth."""
_BOUND = 4
"""Controls."""


def ranking_entries(
    board: Board,
    whole: Board,
    boards: Mapping[str, Board],
    paged: Collection[str] = (),
    monocular: Mapping[str, Board] | None = None,
) -> list[dict[str, Any]]:
    """The rows of one category, cells by the names that `board.html.j2` calls them by.

    ``at`` numbers the tracker on all pages; ``group`` is 0 for ranked trackers, 1 for
    others, 2 for final trajectories alone, 3 for monocular trackers, 4 for controls. The name leads to the
    tracker's run with the median error on the first sequence where that has a page, and the
    successes lead to its first failure.

    Args:
        board: Board of the category.
        whole: Board of all sequences, which numbers the trackers.
        boards: Boards by category, for the column that shows them side by side.
        paged: Ids of the runs that have a page.
        monocular: Boards of trackers whose scale comes from the truth, by category.
    """
    keys = [*whole.trackers, *whole.final_only]
    limits = _axis_limits([standing.ratio for standing in board.standings])
    columns = error_columns(board)
    entries = []
    for key in [*board.trackers, *board.final_only]:
        entry: dict[str, Any] = {"at": keys.index(key), "group": _entry_group(board, key)}
        cells = leaderboard_cells(board, key)
        entry |= _run_cells(board, key, cells, paged)
        entry |= _standing_cells(board, key, cells, limits)
        entry["by_category"] = _by_category(key, boards)
        entry["errors"] = [error_cell(board, key, names) for names in columns.values()]
        entries.append(entry)

    # monocular trackers are on a board of their own: their protocol is another one
    apart = (monocular or {}).get(board.category)
    if apart is not None:
        for key in [*apart.trackers, *apart.final_only]:
            cells = leaderboard_cells(apart, key)
            entry = {"at": None, "group": _MONOCULAR} | _run_cells(apart, key, cells, paged)
            entry |= {"rank": TableCell("–"), "ratio": TableCell(), "bar": {}, "by_category": []}
            entry["verdict"] = TableCell("not ranked", "monocular: its scale is that of the truth")
            entry["errors"] = [error_cell(apart, key, names) for names in columns.values()]
            entries.append(entry)
    return sorted(entries, key=itemgetter("group"))


def _entry_group(board: Board, key: str) -> int:
    """The group of rows that a tracker is in."""
    if key in board.final_only:
        return _FINAL_ONLY
    if board.first(key).tracker.provenance == "control":
        return _BOUND
    return _RANKED if key in board.ranked else _NOT_RANKED


def _run_cells(
    board: Board, key: str, cells: Mapping[str, TableCell], paged: Collection[str]
) -> dict[str, Any]:
    """Cells that a tracker's runs alone decide: name and origin, success, coverage, time and memory.

    Args:
        board: The board.
        key: Variant key of the tracker.
        cells: Its cells, see `leaderboard_cells`.
        paged: Ids of the runs that have a page.
    """
    runs = board.runs(key)
    first = board.first(key)

    # the name, with its marks, leads to the first typical run that has a page
    of_sequence = board.cells[key]
    typical = [of_sequence[name].typical for name in board.sequences if name in of_sequence]
    typical = typical or [first]
    linked = next((run for run in typical if run.run_id in paged), typical[0])
    marks = cells["tracker"].text.removeprefix(board.labels[key])
    name = replace(cells["tracker"], text=board.names[key] + marks, link=run_link(linked))

    # the successes lead to the first failure, and say how that ended
    success = cells["success"]
    failure = next((run for run in runs if run.failed), None)
    if failure is not None:
        tip = f"{board.sequence(failure)}: {failure.ending}"
        success = replace(success, small=failure.ending, link=run_link(failure), tip=tip)
    return {
        "name": name,
        "kind": TableCell("imported") if first.imported else cells["provenance"],
        "remark": first.program_remark,
        "success": success,
        "coverage": cells["coverage"],
        "time": frame_time_cell(board, [run for run in runs if not run.failed]),
        "memory": cells["MB"],
    }


def _standing_cells(
    board: Board, key: str, cells: Mapping[str, TableCell], limits: tuple[float, float]
) -> dict[str, Any]:
    """Rank, ratio with its bar, and verdict of a tracker, or why it has none.

    Args:
        board: The board.
        key: Variant key of the tracker.
        cells: Its cells, see `leaderboard_cells`.
        limits: Ends of the bars' axis, see `_axis_limits`.
    """
    standing = board.standing_by_key.get(key)
    why_unranked = board.unranked_why(key)
    if key in board.final_only:
        why_unranked = "final trajectory only"
    verdict = TableCell("not ranked", why_unranked)
    if not why_unranked:
        verdict = _verdict_cell(board, standing, cells["better?"])
    if standing is None:
        return {
            "rank": TableCell("–"),
            "ratio": cells["ATE ratio"],
            "bar": {},
            "verdict": verdict,
        }
    return {
        "rank": rank_cell(standing),
        "ratio": _ratio_cell(board, standing, cells["ATE ratio"]),
        "bar": _interval_bar(standing.ratio, limits),
        "verdict": verdict,
    }


def _verdict_cell(board: Board, standing: Standing | None, cell: TableCell) -> TableCell:
    """The verdict with how far it goes, or with the sequences that would settle it; the p value is its tip."""
    if standing is None or not cell.text:
        return cell
    small = lost_words(standing)
    tip = "" if standing.p_value is None else f"p {standing.p_value:.2g}, Holm-corrected"
    if standing.verdict == "cannot tell":
        more = more_sequences(board, standing.key)
        plural = "" if more == 1 else "s"
        settle = f"about {more} more sequence{plural} would settle it" if more else ""
        return replace(cell, small="; ".join(filter(None, [settle, small])), tip=tip)
    text = f"{cell.text} {standing.scope}".strip()
    return replace(cell, text=text, small=small, tip=tip)


def _ratio_cell(board: Board, standing: Standing, cell: TableCell) -> TableCell:
    """The leaderboard's cell with the interval, which is drawn beside it, as a tip."""
    if cell.emphasis == "failed":
        return cell
    low = standing.ratio.low
    high = standing.ratio.high
    tip = f"95 % interval {low:.2f} to {high:.2f}" if math.isfinite(low) else ""
    small = ""
    if standing.sequences < len(board.common):
        small = f"{standing.sequences} of {len(board.common)} sequences"
    return replace(cell, small=small, emphasis="", tip=tip)


def _axis_limits(ratios: Sequence[Interval]) -> tuple[float, float]:
    """Ends of the axis of interval bars, in logarithms; 1 lies between them."""
    ends = []
    for ratio in ratios:
        for end in (ratio.value, ratio.low, ratio.high):
            if math.isfinite(end) and end > 0:
                ends.append(end)
    # at least from 0.8 to 1.25, at most from 0.02 to 20
    lowest = max(min([0.8, *ends]), 0.02)
    highest = min(max([1.25, *ends]), 20.0)
    return math.log(lowest), math.log(highest)


_SMALLEST = 1e-9
"""Ratios below this are drawn as this, so that their logarithm exists."""


def _interval_bar(ratio: Interval, limits: tuple[float, float]) -> dict[str, float]:
    """Places of a ratio, of the ends of its interval and of 1 on a logarithmic axis, in pixels; none of what is nan."""
    values = {"at": ratio.value, "low": ratio.low, "high": ratio.high, "one": 1.0}
    places_px = {}
    for name, value in values.items():
        if math.isfinite(value):
            share = (math.log(max(value, _SMALLEST)) - limits[0]) / (limits[1] - limits[0])
            places_px[name] = 4 + 112 * min(max(share, 0.0), 1.0)
    return places_px


def _by_category(key: str, boards: Mapping[str, Board]) -> list[tuple[str, float, float]]:
    """A dot a category: its name, the ratio there, and the height of a ratio from 1/8 to 8 in pixels from above."""
    dots = []
    for name, board in boards.items():
        standing = board.standing_by_key.get(key)
        if name == OVERALL or standing is None or not math.isfinite(standing.ratio.value):
            continue
        ratio = standing.ratio.value
        # -1 for a ratio of 1/8, 1 for one of 8
        share = min(max(math.log(max(ratio, _SMALLEST)) / math.log(8), -1.0), 1.0)
        dots.append((name, ratio, 12 - 8 * share))
    return dots


# -- what the pages of errors, runs and comparisons read


def board_data(
    board: Board,
    boards: Mapping[str, Board],
    protocol: Protocol,
    paged: set[str],
    pictured: set[str],
    pageless: str,
) -> dict[str, Any]:
    """Content of ``data/board.js``: trackers, sequences, cells and runs.

    Cells and runs name trackers and sequences by their positions in these lists.

    Args:
        board: The board.
        boards: Boards of its categories, by category.
        protocol: How errors were computed.
        paged: Ids of the runs that have a page.
        pictured: Ids of those whose pictures lie beside it.
        pageless: Which runs have no page, in words.
    """
    # positions of trackers and sequences
    keys = [*board.trackers, *board.final_only]
    names = [*board.sequences, *board.unscored]
    tracker_at = {key: at for at, key in enumerate(keys)}
    sequence_at = {name: at for at, name in enumerate(names)}

    metrics = _metrics(protocol)
    cells = [
        cell_data(cell, tracker_at[key], sequence_at[name], metrics, rank_seen=board.rank_seen)
        for key in keys
        for name, cell in board.cells[key].items()
    ]

    # runs, by tracker, sequence and repeat
    listed = _listed_runs(board, paged)
    listed.sort(
        key=lambda row: (
            tracker_at[row.variant_key],
            sequence_at[board.sequence(row)],
            row.repeat_key,
        )
    )
    runs = []
    for row in listed:
        at = (tracker_at[row.variant_key], sequence_at[board.sequence(row)])
        has_page_and_pictures = (row.run_id in paged) + 2 * (row.run_id in pictured)
        runs.append([row.run_id, *at, row.repeat, row.ending, has_page_and_pictures])

    categories = {
        category: sorted({sequence_at[name] for name in part.sequences})
        for category, part in boards.items()
        if part is not board
    }
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": board.reference_name,
        "referenceAt": None if board.reference is None else tracker_at[board.reference],
        "metrics": metrics,
        "trackers": [
            {
                "label": board.names[key],
                "ranked": key in board.ranked,
                "settings": settings_data(board.first(key)),
            }
            for key in keys
        ],
        "sequences": _sequences_data(board, names),
        "categories": categories,
        "cells": cells,
        "runs": runs,
        "unlisted": len(board.rows) - len(listed),
    }


def _listed_runs(board: Board, paged: set[str]) -> list[RunRow]:
    """The runs that are listed one by one; a page of a hundred thousand would open slowly."""
    if len(board.rows) <= MOST_LISTED:
        return list(board.rows)
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    return [row for row in board.rows if row.run_id in paged or row.run_id in first]


def _sequences_data(board: Board, names: Sequence[str]) -> list[dict[str, Any]]:
    """Name, short name, tags and error of a static camera of every sequence."""
    rows_by_sequence = grouped(board.rows, board.sequence)
    return [
        {
            "name": name,
            "short": board.short.get(name, name),
            "tags": sorted({tag for row in rows_by_sequence[name] for tag in row.sequence.tags}),
            "static": significant(board.static_camera.get(name)),
        }
        for name in names
    ]


def ratios_data(board: Board) -> list[list[Any]]:
    """Content of ``data/ratios.js``: for every two trackers their numbers, and the second against the first.

    Two positions of trackers, ratio and ends of its interval, number of sequences, verdict and its scope.
    """
    keys = [*board.trackers, *board.final_only]
    tracker_at = {key: at for at, key in enumerate(keys)}
    verdicts = {standing.key: standing.verdict for standing in board.standings}
    scopes = {standing.key: standing.scope for standing in board.standings}
    ratios = []
    # reversed: of the later tracker over the earlier one
    for pair in compare_pairs(board, keys[::-1]):
        # against the reference the verdict is the board's, which asks it of fewer pairs
        verdict: str = pair.verdict
        scope: Scope = pair.scope
        if pair.other == board.reference:
            verdict = verdicts.get(pair.one, "")
            scope = scopes.get(pair.one, "")
        elif pair.one == board.reference:
            verdict = _OPPOSITE.get(verdicts.get(pair.other, ""), verdict)
            scope = scopes.get(pair.other, "")
        ratios.append(
            [
                tracker_at[pair.other],
                tracker_at[pair.one],
                *ratio_numbers(pair.ratio),
                pair.sequences,
                verdict,
                scope,
            ]
        )
    return ratios


def ratio_numbers(ratio: Interval) -> list[float | None]:
    """A ratio and the ends of its interval."""
    return [significant(value) for value in (ratio.value, ratio.low, ratio.high)]


def cell_data(
    cell: TrackerOnSequence,
    tracker: int,
    sequence: int,
    metrics: Sequence[Mapping[str, str]],
    *,
    rank_seen: bool,
) -> list[Any]:
    """A cell as the scripts of the pages read it.

    Args:
        cell: The cell.
        tracker: Position of its tracker.
        sequence: Position of its sequence.
        metrics: The numbers to choose from, see `_metrics`.
        rank_seen: Whether masks of a network that was trained on the scene are no reservation.

    Returns:
        Positions of tracker and sequence, number of runs, number of failures, reservations (1: the
        rotation is not reliable; 2: seen in training; 3: both), the median of every number, id of
        the typical run, and the quartiles of the error, none for a single run.
    """
    unreliable_rotation = any(not row.rotation_reliable for row in cell.rows)
    reservations = unreliable_rotation + 2 * (cell.in_training and not rank_seen)
    medians = [
        significant(median_of(_value(row, metric) for row in cell.kept)) for metric in metrics
    ]
    quartiles = np.percentile(cell.scores, [25, 75]).tolist() if len(cell.scores) > 1 else []
    return [
        tracker,
        sequence,
        len(cell.rows),
        cell.failed,
        reservations,
        medians,
        cell.typical.run_id,
        [significant(value) for value in quartiles],
    ]


def settings_data(row: RunRow) -> dict[str, str]:
    """Settings that set a run's tracker apart from other variants of it."""
    return {name: setting_text(value) for name, value in row.variant.items()}


def _metrics(protocol: Protocol) -> list[dict[str, str]]:
    """The numbers to choose from, the one that ranks first; all of them of the final trajectory, too."""
    # name, unit and key
    numbers = [("ATE", "m", "ate_rmse_m")]
    for words, unit, part in (("", "m", "trans"), (", rotation", "deg", "rot")):
        for spec in protocol.rpe:
            per_second = "/s" if spec.rate else ""
            name = f"RPE over {spec.describe()}{words}"
            numbers.append((name, unit + per_second, spec.metric(part)))
    numbers.append(("absolute rotation", "deg", "ape_rot_rmse_deg"))
    return [
        {"name": name, "unit": unit, "key": key, "which": which}
        for which in dict.fromkeys([protocol.trajectory, "final"])
        for name, unit, key in numbers
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] == row.trajectory:
        if metric["key"] == "ate_rmse_m":
            return row.score_m
        return None if row.failed else row.metrics.get(metric["key"])
    if row.failed or metric["which"] == "online":
        return None
    return row.final_metrics.get(metric["key"])
