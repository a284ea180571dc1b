"""Tables about the runs themselves: failures, repeatability, machines."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from statistics import median

from ..model.board import Board
from ..model.row import RunRow
from .table import Column, Table, TableCell


def failures(board: Board, output: Path) -> Table | None:
    """Every run that failed, with its reason and log; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None
    columns = [
        Column("tracker", numeric=False), Column("sequence", numeric=False), Column("repeat", numeric=False),
        Column("ended", numeric=False), Column("coverage"), Column("reason", numeric=False),
        Column("log", numeric=False),
    ]  # fmt: skip
    rows = [
        [
            TableCell(board.labels[row.variant_key]),
            TableCell(board.sequence(row)),
            TableCell(row.repeat),
            TableCell(row.ending),
            TableCell(f"{100 * row.coverage:.1f} %", value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=_relative(row.log, output)),
        ]
        for row in _ordered(board, failed)
    ]
    caption = "Runs that crashed, took too long or too much, broke their contract, were lost, or cannot be evaluated."
    return Table("failures", "Failures", caption, columns, rows)


def repeatability(board: Board) -> Table | None:
    """Spread of the runs of a cell; None if no cell has several."""
    columns = [
        Column("tracker", numeric=False), Column("cells", meaning="sequences with several runs that differ"),
        Column("deterministic", meaning="sequences on which several seeds gave one result to the last digit"),
        Column("runs a cell"),
        Column("worst / best", meaning="median over cells of the largest over the smallest ATE"),
        Column("largest worst / best"), Column("where", numeric=False),
    ]  # fmt: skip
    rows = []
    for key in board.trackers:
        spreads = []
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            if cell and len(cell.scores) > 1:
                spreads.append((max(cell.scores) / max(min(cell.scores), 1e-6), sequence, len(cell.scores)))
        copies = sum(board.cells[key][name].deterministic for name in board.sequences if name in board.cells[key])
        if copies and not spreads:
            rows.append([TableCell(board.labels[key]), TableCell("0", value=0), TableCell(str(copies), value=copies),
                         *[TableCell()] * 4])  # fmt: skip
        if not spreads:
            continue
        worst = max(spreads)
        middle = median(spread for spread, _, _ in spreads)
        rows.append(
            [
                TableCell(board.labels[key]),
                TableCell(str(len(spreads)), value=len(spreads)),
                TableCell(str(copies), value=copies),
                TableCell(f"{median(n for _, _, n in spreads):g}"),
                TableCell(f"{middle:.2f}", value=middle),
                TableCell(f"{worst[0]:.2f}", value=worst[0]),
                TableCell(worst[1]),
            ]
        )
    if not rows:
        return None
    caption = (
        "How far the runs of one tracker on one sequence lie apart when only seed, start offset or sensor noise "
        "differ. Differences between trackers that are smaller than this are noise. Copies (several seeds, one result "
        "to the last digit) are no repeats: they are counted as deterministic and take no part."
    )
    return Table("repeatability", "Repeatability", caption, columns, rows)


def machines(board: Board) -> Table:
    """Computers and versions behind the runs."""
    counts = Counter(row.machine or "not recorded" for row in board.rows)
    columns = [Column("runs"), Column("machine and versions", numeric=False)]
    rows = [[TableCell(str(count), value=count), TableCell(name)] for name, count in counts.most_common()]
    caption = "Times of different machines are not comparable."
    return Table("machines", "Machines and versions", caption, columns, rows)


def _ordered(board: Board, rows: Iterable[RunRow]) -> list[RunRow]:
    return sorted(rows, key=lambda row: (board.labels[row.variant_key], board.sequence(row), row.repeat_key))


def _relative(path: str, output: Path) -> str:
    return Path(os.path.relpath(path, output)).as_posix() if path else ""
