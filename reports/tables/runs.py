"""Tables about the runs themselves: failures, repeatability, machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from statistics import median

from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.reports.model.statistics import FLOOR_M
from dynslam_bench.reports.tables.table import Column, Table, TableCell, number, texts


def run_link(row: RunRow) -> str:
    """Where the page of a run lies, seen from the report's."""
    return f"run.html#{row.run_id}"


def failures(board: Board) -> Table | None:
    """Every run that failed, with its reason and its page; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None
    columns = [*texts("tracker", "sequence", "repeat", "ended"), Column("coverage"), *texts("reason", "run")]
    rows = [
        [
            TableCell(board.labels[row.variant_key]),
            TableCell(board.sequence(row)),
            TableCell(row.repeat),
            TableCell(row.ending),
            TableCell(f"{100 * row.coverage:.1f} %", value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=run_link(row)),
        ]
        for row in _ordered(board, failed)
    ]
    caption = "Runs that crashed, took too long or too much, broke their contract, were lost, or cannot be evaluated."
    return Table("failures", "Failures", caption, columns, rows)


def repeatability(board: Board) -> Table | None:
    """Spread of the runs of a cell; None if no cell has several."""
    columns = [
        Column("tracker", numeric=False),
        Column("cells", meaning="sequences with several runs that differ"),
        Column("deterministic", meaning="sequences on which several seeds gave one result to the last digit"),
        Column("runs a cell"),
        Column("worst / best", meaning="median over cells of the largest over the smallest ATE"),
        Column("largest worst / best"),
        Column("where", numeric=False, latex=False),
    ]
    rows = [cells for key in board.trackers if (cells := _spread_cells(board, key))]
    if not rows:
        return None
    caption = (
        "How far the runs of one tracker on one sequence lie apart when only seed, start offset or sensor noise "
        "differ. Differences between trackers that are smaller than this are noise. Copies (several seeds, one result "
        "to the last digit) are no repeats: they are counted as deterministic and take no part. Neither do failures."
    )
    return Table("repeatability", "Repeatability", caption, columns, rows)


def _spread_cells(board: Board, key: str) -> list[TableCell]:
    """How far the runs of a tracker lie apart; empty if it has no cell with several."""
    cells = {name: board.cells[key][name] for name in board.sequences if name in board.cells[key]}
    found = {name: [row.score_m or 0.0 for row in cell.succeeded] for name, cell in cells.items()}
    several = {name: scores for name, scores in found.items() if len(scores) > 1}
    copies = sum(cell.deterministic and cell.success > 1 for cell in cells.values())
    counts = [TableCell(board.labels[key]), number(len(several)), number(copies)]
    if not several:
        return [*counts, *[TableCell()] * 4] if copies else []
    spreads = {name: max(scores) / max(min(scores), FLOOR_M) for name, scores in several.items()}
    where, worst = max(spreads.items(), key=lambda item: (item[1], item[0]))
    size = f"{median(len(scores) for scores in several.values()):g}"
    middle = median(spreads.values())
    return [*counts, TableCell(size), number(middle, ".2f"), number(worst, ".2f"), TableCell(where)]


def machines(board: Board) -> Table:
    """Computers and versions behind the runs."""
    counts = Counter(row.machine_words or "not recorded" for row in board.rows)
    columns = [Column("runs"), Column("machine and versions", numeric=False)]
    rows = [[number(count), TableCell(name)] for name, count in counts.most_common()]
    caption = "Times of different machines are not comparable."
    return Table("machines", "Machines and versions", caption, columns, rows)


def _ordered(board: Board, rows: Iterable[RunRow]) -> list[RunRow]:
    return sorted(rows, key=lambda row: (board.labels[row.variant_key], board.sequence(row), row.repeat_key))
