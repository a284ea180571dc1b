"""Tables that show what the ranking owes to coverage and to the rule for failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from .board import Board, rank
from .rows import RunRow
from .table import Column, Emphasis, Table, TableCell, emphasise
from .tables import interval_cell, rank_cell, sequence_columns


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
        values = [common.get((key, sequence)) for key in board.ranked]
        marks |= {(key, sequence): mark for key, mark in zip(board.ranked, emphasise(values), strict=True)}
    rows, muted = [], set()
    for position, key in enumerate(board.trackers):
        if key not in board.ranked:
            muted.add(position)
        cells = [TableCell(board.labels[key])]
        for sequence in board.sequences:
            number = common.get((key, sequence))
            mark = marks.get((key, sequence), "")
            cells.append(TableCell() if number is None else TableCell(f"{number:.4f}", value=number, emphasis=mark))
        rows.append(cells)
    separators = {len(rows)}
    muted.add(len(rows))
    rows.append([TableCell("common frames"), *(TableCell(frames.get(sequence, "")) for sequence in board.sequences)])
    caption = (
        "Median ATE (RMSE, metres) on those frames only that every successful run of the sequence tracked: a tracker "
        "gains nothing here by losing the hard frames. Failed runs take no part."
    )
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    return Table("common_frames", "Error on the common frames", caption, columns, rows, muted, separators)


def failure_rule_table(board: Board) -> Table | None:
    """How much the ranking depends on how failures and lost frames are counted; None if nothing was lost."""
    if not board.ranked or all(row.coverage >= 1 and not row.failed for row in board.rows):
        return None
    rules: list[tuple[str, Callable[[RunRow], float | None] | None]] = [
        ("failures never move", None),
        ("lost frames held", lambda row: row.held_ate_m if row.held_ate_m is not None else row.never_move_m),
        ("failures left out", lambda row: None if row.failed else row.metrics.get("ate_rmse_m")),
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
        "The same runs under three rules. Failures never move: the report's rule. Lost frames held: every lost frame "
        "counts with the last tracked pose, a run without any pose as never moving. Failures left out: survivors "
        "only, which flatters trackers that fail. A ranking that changes between the rules is decided by the rule."
    )
    return Table("failure_rules", "Sensitivity to the failure rule", caption, columns, rows)
