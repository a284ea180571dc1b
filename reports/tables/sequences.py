"""Tables with one column for every sequence: absolute and relative errors, and published numbers beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from dynslam_bench.evaluation.protocol import Protocol

from ..model.board import NEVER_MOVE, Board
from ..model.cell import Cell
from ..model.row import RunRow
from .formats import mm, significant_text
from .leaderboard import sequence_columns, skipped_words
from .table import Column, Emphasis, Table, TableCell, emphasise


@dataclass(frozen=True)
class ReportedCell:
    """A published number.

    Attributes:
        system: Its name.
        sequence: Sequence of the board.
        value: ATE in metres.
        source: Where it was read.
        tag: What kind of number it is.
    """

    system: str
    sequence: str
    value: float
    source: str
    tag: str = "reported"


def per_sequence(board: Board, protocol: Protocol, reported: Sequence[ReportedCell] = ()) -> Table:
    """Median ATE of every tracker on every sequence, with spread, number of runs and failures."""
    sizes = Counter(len(cell.rows) for key in board.trackers for cell in board.cells[key].values())
    usual = sizes.most_common(1)[0][0] if sizes else 1
    marks = _marks(board, lambda cell: cell.median)
    rows, muted = [], {at for at, key in enumerate(board.trackers) if key not in board.ranked}
    for key in board.trackers:
        cells = [TableCell(board.labels[key], tag="imported" if board.first(key).imported else "")]
        for name in board.sequences:
            cells.append(_error_cell(board, board.cells[key].get(name), name, marks.get((key, name), ""), usual))
        rows.append(cells)
    separators = board.separators() | {len(rows)}
    rows.append([TableCell(NEVER_MOVE), *(_never_cell(board, name) for name in board.sequences)])
    muted.add(len(rows) - 1)
    if reported:
        separators.add(len(rows))
        for name, tag in dict.fromkeys((cell.system, cell.tag) for cell in reported):
            muted.add(len(rows))
            found = [cell for cell in reported if (cell.system, cell.tag) == (name, tag)]
            rows.append([TableCell(name, tag=tag), *_reported_cells(board, found)])
    caption = (
        f"Median ATE (RMSE, millimetres; metres in the CSV) over the runs of a cell ({usual} unless n says otherwise), "
        "lost frames held at the last tracked pose. Behind it half the interquartile range of the runs that differ, or "
        "'deterministic' where several seeds gave one result to the last digit. A run that failed counts as a camera "
        "that never moves, or worse; a cell with a failure takes no part in bold and green, and is hatched where "
        f"nothing succeeded. Colour: ratio to {board.reference_name}, from green (a quarter or less) to red (four "
        f"times or more). Bold best, italic second among ranked trackers. {_names_note(board)}{protocol.describe()}."
    )
    if reported:
        caption += (
            " Rows marked 'reported' are published numbers, not runs: their protocol is stated by their source only, "
            "and lost frames are left out of most. Rows marked 'claimed by the paper' are the implemented paper's own, "
            "which contradict themselves (see the audit)."
        )
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    return Table("per_sequence", "Absolute trajectory error by sequence", caption, columns, rows, muted, separators)


def relative_errors(board: Board, protocol: Protocol) -> list[Table]:
    """One table for each relative error of the protocol and each of its parts."""
    tables = []
    for spec in protocol.rpe:
        for part, unit, name in (("trans", "m", "translation"), ("rot", "deg", "rotation")):
            metric = f"rpe_{spec.key}_{part}_rmse_{unit}"
            per = {"s": "/s", "f": " per frame"}.get(spec.unit, "") if spec.delta == 1 else ""
            unit_text = ("mm" if unit == "m" else "°") + per
            table = metric_table(
                board,
                lambda row, metric=metric: row.metrics.get(metric),  # type: ignore[misc]
                f"rpe_{spec.key}_{part}",
                f"Relative pose error over {spec.describe()}: {name}",
                f"RMSE in {unit_text}, median over the runs that succeeded, on the frames that they tracked. "
                f"{protocol.describe()}.",
                text=mm if unit == "m" else significant_text,
            )
            if table is not None:
                tables.append(table)
    return tables


def metric_table(
    board: Board,
    value: Callable[[RunRow], float | None],
    name: str,
    title: str,
    caption: str,
    *,
    text: Callable[[float], str] = mm,
    larger_is_better: bool = False,
    trackers: Sequence[str] | None = None,
) -> Table | None:
    """Median of any number of the runs that succeeded, by tracker and sequence; None if no run has it.

    Args:
        board: The board.
        value: The number of a run.
        name: Id of the table.
        title: Heading.
        caption: How to read it.
        text: How the number is written; metres become millimetres by default.
        larger_is_better: Which end is bold.
        trackers: Variant keys; the board's by default.
    """
    keys = board.trackers if trackers is None else trackers
    found = {
        (key, sequence): number
        for key in keys
        for sequence, cell in board.cells[key].items()
        if (number := median_of(cell, value)) is not None
    }
    if not found:
        return None
    sign = -1.0 if larger_is_better else 1.0
    marks = _marks(board, lambda cell: None if (n := median_of(cell, value)) is None else sign * n)
    present = [key for key in keys if any((key, sequence) in found for sequence in board.sequences)]
    rows, muted = [], {at for at, key in enumerate(present) if key not in board.ranked}
    for key in present:
        cells = [TableCell(board.labels[key])]
        for sequence in board.sequences:
            cell, number = board.cells[key].get(sequence), found.get((key, sequence))
            if cell is not None and not cell.success:
                cells.append(TableCell(emphasis="failed", tip=cell.ending))
            elif cell is None or number is None:
                cells.append(TableCell())
            else:
                mark = marks.get((key, sequence), "")
                cells.append(TableCell(text(number), skipped_words(cell), number, mark, tip=cell.ending))
        rows.append(cells)
    columns = [Column("tracker", numeric=False), *sequence_columns(board)]
    competing = sum(key in board.ranked for key in present)
    separators = {competing} if 0 < competing < len(rows) else set()
    return Table(name, title, caption, columns, rows, muted, separators)


def median_of(cell: Cell, value: Callable[[RunRow], float | None]) -> float | None:
    """Median of a number over the runs of a cell that count and succeeded."""
    values = [number for row in cell.kept if not row.failed and (number := value(row)) is not None]
    return median(values) if values else None


def _marks(board: Board, value: Callable[[Cell], float | None]) -> dict[tuple[str, str], Emphasis]:
    """Best and second best of every column among the ranked trackers whose runs there all succeeded."""
    marks: dict[tuple[str, str], Emphasis] = {}
    for name in board.sequences:
        cells = {key: cell for key in board.ranked if (cell := board.cells[key].get(name)) and not cell.failed}
        found = emphasise([value(cell) for cell in cells.values()])
        marks |= {(key, name): mark for key, mark in zip(cells, found, strict=True)}
    return marks


def _error_cell(board: Board, cell: Cell | None, sequence: str, mark: Emphasis, usual: int) -> TableCell:
    if cell is None or cell.median is None:
        return TableCell("–" if cell is None else "", emphasis="muted", tip="not run" if cell is None else "")
    coverage = 100 * float(np.mean([row.coverage for row in cell.rows]))
    if not cell.success:
        tip = f"counts as {mm(cell.median)} mm, coverage {coverage:.1f} %"
        return TableCell(cell.ending, _count(cell, usual), emphasis="failed", tip=tip)
    notes = [_spread(cell), _count(cell, usual), skipped_words(cell)]
    if cell.failed:
        notes.append(f"{cell.success}/{len(cell.rows)} succeeded")
    small = ", ".join(filter(None, notes))
    base = board.reference_median(sequence)
    if base is None:
        return TableCell(mm(cell.median), small, cell.median, mark, tip=f"coverage {coverage:.1f} %")
    ratio = cell.median / max(base, 1e-6)
    colour = max(shade(ratio), 0.0) if cell.failed else shade(ratio)
    tip = f"{ratio:.2f} × the reference, coverage {coverage:.1f} %" + (f"; {cell.ending}" if cell.failed else "")
    return TableCell(mm(cell.median), small, cell.median, mark, colour, tip)


def _spread(cell: Cell) -> str:
    if len(cell.scores) > 1:
        low, high = np.percentile(cell.scores, [25, 75])
        return f"±{significant_text(500.0 * float(high - low), 2)}"
    return "deterministic" if cell.deterministic else ""


def _count(cell: Cell, usual: int) -> str:
    return "" if len(cell.rows) == usual else f"n={len(cell.rows)}"


def _never_cell(board: Board, sequence: str) -> TableCell:
    value, base = board.never_move[sequence], board.reference_median(sequence)
    if base is None:
        return TableCell(mm(value), value=value)
    ratio = value / max(base, 1e-6)
    return TableCell(mm(value), value=value, shade=shade(ratio), tip=f"{ratio:.2f} × the reference")


def _reported_cells(board: Board, reported: Sequence[ReportedCell]) -> list[TableCell]:
    cells = []
    for sequence in board.sequences:
        found = [cell for cell in reported if cell.sequence == sequence]
        cells.append(TableCell(mm(found[0].value), value=found[0].value, tip=found[0].source) if found else TableCell())
    return cells


def shade(ratio: float) -> float:
    """-1 at a quarter of the reference's error or less, 0 at the same, 1 at four times or more."""
    return float(np.clip(np.log(max(ratio, 1e-9)) / np.log(4), -1, 1))


def _names_note(board: Board) -> str:
    """What the shortened headings stand for; empty where they are whole."""
    first = board.sequences[0]
    return "" if board.short[first] == first else f"'{board.short[first]}' stands for {first}, and so on. "
