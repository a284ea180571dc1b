"""The median of any number of the runs that succeeded, by tracker and sequence, and the marks of the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median

from ..model.board import Board
from ..model.cell import Cell
from ..model.row import SEEN, RunRow
from .formats import mm
from .leaderboard import SEEN_NOTE, sequence_columns, skipped_words
from .table import Column, Emphasis, Table, TableCell, emphasise

Value = Callable[[RunRow], float | None]
"""A number of a run; None where it has none."""
DOUBT = "‡"
"""Behind a number that says nothing of its tracker."""


def metric_table(
    board: Board,
    value: Value,
    name: str,
    title: str,
    caption: str,
    *,
    unit: str = "RMSE, mm",
    text: Callable[[float], str] = mm,
    larger_is_better: bool = False,
    trackers: Sequence[str] | None = None,
    doubt: Callable[[Cell], str] = lambda cell: "",
) -> Table | None:
    """Median of any number of the runs that succeeded, by tracker and sequence; None if no run has it.

    Args:
        board: The board.
        value: The number of a run.
        name: Id of the table.
        title: Heading.
        caption: How to read it.
        unit: What the numbers are, in a word or two.
        text: How the number is written; metres become millimetres by default.
        larger_is_better: Which end is bold.
        trackers: Variant keys; the board's by default.
        doubt: Why the number of a cell says nothing, empty if it does; such a cell carries `DOUBT` and is never bold.
    """
    keys = board.trackers if trackers is None else trackers
    at = {(key, name): cell for key in keys for name, cell in board.cells[key].items() if name in board.sequences}
    found = {place: number for place, cell in at.items() if (number := median_of(cell, value)) is not None}
    if not found:
        return None
    doubted = {place: words for place in found if (words := doubt(at[place]))}
    sign = -1.0 if larger_is_better else 1.0
    marks = column_marks(board, {place: sign * number for place, number in found.items() if place not in doubted})
    present = [key for key in keys if any((key, sequence) in found for sequence in board.sequences)]
    rows = []
    for key in present:
        cells = [TableCell(board.labels[key])]
        for place in ((key, sequence) for sequence in board.sequences):
            cell, number, why = at.get(place), found.get(place), doubted.get(place, "")
            if cell is not None and not cell.success:
                cells.append(TableCell(emphasis="failed", tip=cell.ending))
            elif cell is None or number is None:
                cells.append(TableCell())
            else:
                shown, mark = text(number) + DOUBT * bool(why), "muted" if why else marks.get(place, "")
                tip = why or (SEEN_NOTE if cell.seen else cell.ending)
                cells.append(TableCell(shown + SEEN * cell.seen, skipped_words(cell), number, mark, tip=tip))
        rows.append(cells)
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    competing = sum(key in board.ranked for key in present)
    muted = [at for at, key in enumerate(present) if key not in board.ranked]
    separators = {competing} if 0 < competing < len(rows) else set()
    return Table(name, title, caption, columns, rows, muted, separators, f"{title} ({unit})")


def median_of(cell: Cell, value: Value) -> float | None:
    """Median of a number over the runs of a cell that count and succeeded."""
    values = [number for row in cell.kept if not row.failed and (number := value(row)) is not None]
    return median(values) if values else None


def column_marks(board: Board, values: dict[tuple[str, str], float]) -> dict[tuple[str, str], Emphasis]:
    """Best and second best of every column among the ranked trackers whose runs there compete and all succeeded.

    Args:
        board: The board.
        values: ``(variant, sequence)`` to a number, less is better; what has none takes no part.
    """
    marks: dict[tuple[str, str], Emphasis] = {}
    for name in board.sequences:
        cells = {key: board.cells[key][name] for key in board.ranked if name in board.cells[key]}
        keys = [key for key, cell in cells.items() if not cell.failed and board.competes(key, name)]
        found = emphasise([values.get((key, name)) for key in keys])
        marks |= {(key, name): mark for key, mark in zip(keys, found, strict=True)}
    return marks
