"""A table, independent of how it is written: HTML, Markdown, CSV and LaTeX are made of the same two frames."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from pandas.api.types import is_float_dtype, is_numeric_dtype

from dynslam_bench.core.harmless import printable

Emphasis = Literal["", "best", "second", "muted", "failed"]
MOST_ROWS = 1000
"""Rows that pages and Markdown show; CSV has all."""


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        name: Heading.
        group: Heading above several neighbouring columns.
        numeric: Whether it holds numbers, aligned to the right.
        meaning: Shown when the pointer rests on the heading.
        full: Name in CSV, where the heading is shortened; empty for the heading itself.
        latex: Whether it stands in LaTeX, where there is little room.
    """

    name: str
    group: str = ""
    numeric: bool = True
    meaning: str = ""
    full: str = ""
    latex: bool = True

    @property
    def key(self) -> str:
        """Name in frames and in CSV: the full one, with its group."""
        return self.full or (f"{self.group}: {self.name}" if self.group else self.name)


def texts(*names: str) -> list[Column]:
    """Columns of text."""
    return [Column(name, numeric=False) for name in names]


def numbers(*names: str, group: str = "") -> list[Column]:
    """Columns of numbers, below one heading."""
    return [Column(name, group) for name in names]


@dataclass(frozen=True)
class TableCell:
    """A cell.

    Attributes:
        text: What is written; empty for nothing.
        small: Written smaller behind it: interval, spread, counts.
        value: The number behind the text, for sorting and CSV.
        emphasis: ``best`` (bold), ``second`` (italic), ``muted``, or ``failed`` (hatched).
        shade: -1 (much better than the reference) to 1 (much worse), None for none.
        tip: Shown when the pointer rests on it.
        tag: A word set as a label, e.g. ``run here``.
        link: Relative path of a file.
    """

    text: str = ""
    small: str = ""
    value: float | None = None
    emphasis: Emphasis = ""
    shade: float | None = None
    tip: str = ""
    tag: str = ""
    link: str = ""


def number(value: float | None, digits: str = "", unit: str = "") -> TableCell:
    """A number, written with a format specification or with all its digits; an empty cell for None."""
    if value is None:
        return TableCell()
    return TableCell((format(value, digits) if digits else repr(value)) + unit, value=value)


class Table:
    """A table with a caption that says how to read it: a frame of what is shown and a frame of what is behind it.

    Attributes:
        id: Short name, also the CSV file's.
        title: Heading.
        caption: Everything a reader needs, including the protocol.
        columns: The columns.
        rows: What is displayed, by row.
        shown: What is displayed: a frame of `TableCell`, one column for each of `columns` under its `Column.key`.
        values: The numbers behind it with all their digits, in the units that the caption and the headings name
            (errors in metres, times in milliseconds, shares from 0 to 1), under the same names. Numeric columns are
            ``Int64`` if all their numbers are whole, else ``Float64``; ``pd.NA`` where the cell has no number. Columns
            of text are ``string``.
        muted_rows: Rows that are shown but do not compete.
        separators: Rows above which a line is drawn.
        brief: Caption where there is little room, without the full stop: what is shown, and its unit.
    """

    def __init__(
        self,
        id: str,
        title: str,
        caption: str,
        columns: Sequence[Column],
        rows: Sequence[Sequence[TableCell]],
        muted_rows: Collection[int] = (),
        separators: Collection[int] = (),
        brief: str = "",
    ) -> None:
        """A table of rows with one cell for every column.

        Raises:
            ValueError: A row has another number of cells than there are columns.
        """
        self.id, self.title, self.caption, self.brief = id, title, caption, brief or title
        self.columns = list(columns)
        self.muted_rows, self.separators = set(muted_rows), set(separators)
        self.rows = [list(row) for row in rows]
        self.shown = pd.DataFrame(self.rows, columns=range(len(self.columns)), dtype=object)
        series = [_values(column, self.shown[at]) for at, column in enumerate(self.columns)]
        self.values = pd.concat(series, axis=1)
        self.shown.columns = self.values.columns = pd.Index([column.key for column in self.columns])

    def frame(self) -> pd.DataFrame:
        """What CSV holds: the numbers with all their digits, and the words of the cells that have none."""
        columns = [
            [
                _words(cell) if value is pd.NA else value
                for value, cell in zip(values.astype(object), shown, strict=True)
            ]
            for (_, values), (_, shown) in zip(self.values.items(), self.shown.items(), strict=True)
        ]
        return pd.DataFrame(list(zip(*columns, strict=True)), columns=self.values.columns, dtype=object)

    def displayed(self) -> Table:
        """The table as pages, Markdown and LaTeX show it; CSV has all.

        Columns in which nothing is written are left out, and rows behind `MOST_ROWS`, which the caption says.
        """
        kept = [at for at in range(len(self.columns)) if not self.rows or any(_words(row[at]) for row in self.rows)]
        if len(kept) == len(self.columns) and len(self.rows) <= MOST_ROWS:
            return self
        columns, rows = [self.columns[at] for at in kept], [[row[at] for at in kept] for row in self.rows[:MOST_ROWS]]
        caption = self.caption
        if len(rows) < len(self.rows):
            caption += f" These are the first {len(rows)} of {len(self.rows)} rows; all stand in csv/{self.id}.csv."
        return Table(self.id, self.title, caption, columns, rows, self.muted_rows, self.separators, self.brief)

    def groups(self) -> list[tuple[str, int]]:
        """Neighbouring columns of one group: name and how many."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.group:
                found[-1] = (column.group, found[-1][1] + 1)
            else:
                found.append((column.group, 1))
        return found


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown with its caption."""
    table = table.displayed()
    names = [f"{column.group}: {column.name}" if column.group else column.name for column in table.columns]
    lines = [
        f"## {prose(table.title)}",
        "",
        "| " + " | ".join(_escape_markdown(name) for name in names) + " |",
        "| " + " | ".join("---:" if column.numeric else "---" for column in table.columns) + " |",
    ]
    for row in table.rows:
        lines.append("| " + " | ".join(_markdown_cell(cell) for cell in row) + " |")
    return "\n".join([*lines, "", prose(table.caption), ""])


def to_csv(table: Table) -> str:
    """The table as CSV; numbers stand with all their digits."""
    return csv_text(table.frame())


def csv_text(frame: pd.DataFrame) -> str:
    """A frame as CSV that a spreadsheet may open, a terminal may show: nothing is a formula or an escape.

    Words that a spreadsheet would take for a formula begin with a quote.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_harmless, frame.columns))
    writer.writerows(zip(*(_written(values) for _, values in frame.items()), strict=True))
    return text.getvalue()


def _written(values: pd.Series) -> list[object]:
    """What CSV says of a column; what cannot be harmful is not looked at one by one: there may be millions of it."""
    if is_float_dtype(values.dtype):
        numbers = values.to_numpy(dtype=np.float64, na_value=np.nan).tolist()
        return [None if number != number else number for number in numbers]
    found = values.astype(object)
    if is_numeric_dtype(values.dtype):
        return list(found.where(values.notna(), None))
    if values.dtype == "string":
        known = {word: _harmless(word) for word in set(found)}
        return [known[word] for word in found]
    return [_harmless(value) for value in found]


def emphasise(values: Sequence[float | None]) -> list[Emphasis]:
    """Best and second best (smallest) of a column; equal values share the mark."""
    present = sorted({value for value in values if value is not None})
    marks: list[Emphasis] = []
    for value in values:
        if value is None or len(present) < 2:
            marks.append("")
        else:
            marks.append("best" if value == present[0] else "second" if value == present[1] else "")
    return marks


def prose(text: str) -> str:
    """A sentence for Markdown: on one line, and without markup of HTML."""
    return printable(" ".join(text.split())).replace("<", "&lt;")


def _escape_markdown(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("|", "\\|")
    return prose(escaped).replace("*", "\\*").replace("_", "\\_").replace("[", "\\[")


def _markdown_cell(cell: TableCell) -> str:
    text = _escape_markdown(cell.text)
    if text and cell.emphasis in ("best", "second"):
        mark = "**" if cell.emphasis == "best" else "*"
        text = f"{mark}{text}{mark}"
    parts = [text, _escape_markdown(cell.small), f"({cell.tag})" if cell.tag else ""]
    return " ".join(part for part in parts if part)


def _values(column: Column, shown: pd.Series) -> pd.Series:
    """The numbers behind the cells of a column, or its words."""
    if not column.numeric and all(cell.value is None for cell in shown):
        return shown.map(_words).astype("string").rename(column.key)
    found = [cell.value for cell in shown]
    present = [value for value in found if value is not None]
    whole = bool(present) and all(isinstance(value, int) for value in present)
    return pd.Series(found, dtype="Int64" if whole else "Float64", name=column.key)


def _words(cell: TableCell) -> str:
    return " ".join(part for part in (cell.text, cell.small, cell.tag) if part)


def _harmless(value: object) -> object:
    if not isinstance(value, str):
        return None if value is pd.NA or value != value else value
    return ("'" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else "") + printable(value)
