"""Tables that show what the ranking owes to coverage and to the rule for failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..model.board import Board, rank
from ..model.common import MOST_COMPARED
from ..model.row import SEEN, RunRow
from .formats import mm
from .leaderboard import interval_cell, rank_cell, sequence_columns, skipped_words
from .table import Column, Emphasis, Table, TableCell, emphasise


def common_frames_table(
    board: Board, common: Mapping[tuple[str, str], float], frames: Mapping[str, str]
) -> Table | None:
    """ATE on the frames that all evaluated runs of a sequence tracked.

    Args:
        board: The board.
        common: ``(variant, sequence)`` to the median ATE there.
        frames: Sequence to how many frames are common, in words.
    """
    if not common:
        return None
    marks: dict[tuple[str, str], Emphasis] = {}
    for sequence in board.sequences:
        found = [key for key in board.ranked if (key, sequence) in common and board.competes(key, sequence)]
        values = [common[key, sequence] for key in found]
        marks |= {(key, sequence): mark for key, mark in zip(found, emphasise(values), strict=True)}
    rows, muted = [], set()
    for position, key in enumerate(board.trackers):
        if key not in board.ranked:
            muted.add(position)
        cells = [TableCell(board.labels[key])]
        for sequence in board.sequences:
            number = common.get((key, sequence))
            mark = marks.get((key, sequence), "")
            if number is None:
                cells.append(TableCell())
                continue
            cell = board.cells[key][sequence]
            cells.append(TableCell(mm(number) + SEEN * cell.seen, skipped_words(cell), number, mark))
        rows.append(cells)
    separators = {len(rows)}
    muted.add(len(rows))
    rows.append([TableCell("common frames"), *(TableCell(frames.get(sequence, "")) for sequence in board.sequences)])
    caption = (
        "Median ATE (RMSE, millimetres) on those frames only that every successful run of the sequence tracked: a "
        "tracker gains nothing here by losing the hard frames. Failed runs take no part."
    )
    if any(
        sum(len(cells[name].kept) for cells in board.cells.values() if name in cells) > MOST_COMPARED
        for name in board.sequences
    ):
        caption += (
            f" Of more than {MOST_COMPARED} runs on a sequence, these are the runs of every tracker around its median "
            "error, as many of each."
        )
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    brief = "Absolute trajectory error on the common frames (RMSE, mm)"
    return Table("common_frames", "Error on the common frames", caption, columns, rows, muted, separators, brief)


def failure_rule_table(board: Board) -> Table | None:
    """How much the ranking depends on how failures and lost frames are counted; None if nothing was lost."""
    if not board.ranked or all(row.coverage >= 1 and not row.failed for row in board.rows):
        return None
    rules: list[tuple[str, Callable[[RunRow], float | None] | None]] = [
        ("lost frames held", None),
        ("lost frames left out", _excluded),
        ("failures left out too", lambda row: None if row.failed else _excluded(row)),
    ]
    by_rule = [{s.key: s for s in rank(board, board.ranked, board.ranked, rule)} for _, rule in rules]
    columns = [Column("tracker", numeric=False)]
    for name, _ in rules:
        columns += [Column("#", name), Column("ATE ratio", name)]
    rows = []
    for key in board.ranked_order():
        cells = [TableCell(board.labels[key])]
        for found in by_rule:
            standing = found.get(key)
            cells += (
                [TableCell(), TableCell()]
                if standing is None
                else [rank_cell(standing), interval_cell(standing.ratio, ".2f")]
            )
        rows.append(cells)
    caption = (
        "The same runs under three rules. Lost frames held: the report's rule, a lost frame counts as not having moved "
        "since the last tracked one. Lost frames left out: the error of the tracked frames only, which is what most "
        "papers print; a tracker gains by losing the hard frames. Failures left out too: survivors only, which also "
        "flatters trackers that fail; in the first two they count as a static camera, or worse. A ranking "
        "that changes between the rules is decided by the rule."
    )
    return Table("failure_rules", "Sensitivity to the rule for lost frames and failures", caption, columns, rows)


def _excluded(row: RunRow) -> float | None:
    """The ATE of the tracked frames only; a failure counts as the report's rule says."""
    return row.score_m if row.failed else row.metrics.get("ate_rmse_m")
