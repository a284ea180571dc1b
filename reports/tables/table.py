"""A table, independent of how it is written: HTML, Markdown, CSV and LaTeX are made of the same cells."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Emphasis = Literal["", "best", "second", "muted", "failed"]


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        name: Heading.
        group: Heading above several neighbouring columns.
        numeric: Whether it holds numbers, aligned to the right.
        meaning: Shown when the pointer rests on the heading.
        full: Name in CSV, where the heading is shortened; empty for the heading itself.
    """

    name: str
    group: str = ""
    numeric: bool = True
    meaning: str = ""
    full: str = ""


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


@dataclass
class Table:
    """A table with a caption that says how to read it.

    Attributes:
        id: Short name, also the CSV file's.
        title: Heading.
        caption: Everything a reader needs, including the protocol.
        columns: The columns.
        rows: One cell for every column.
        muted_rows: Rows that are shown but do not compete.
        separators: Rows above which a line is drawn.
    """

    id: str
    title: str
    caption: str
    columns: list[Column]
    rows: list[list[TableCell]]
    muted_rows: set[int] = field(default_factory=set)
    separators: set[int] = field(default_factory=set)

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
    names = [f"{column.group}: {column.name}" if column.group else column.name for column in table.columns]
    lines = [
        f"## {table.title}",
        "",
        "| " + " | ".join(_escape_markdown(name) for name in names) + " |",
        "| " + " | ".join("---:" if column.numeric else "---" for column in table.columns) + " |",
    ]
    for row in table.rows:
        lines.append("| " + " | ".join(_markdown_cell(cell) for cell in row) + " |")
    return "\n".join([*lines, "", table.caption, ""])


def to_csv(table: Table) -> str:
    """The table as CSV; numbers stand with all their digits."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([_csv_name(column) for column in table.columns])
    for row in table.rows:
        writer.writerow([_csv_cell(cell) for cell in row])
    return out.getvalue()


def to_latex(table: Table) -> str:
    """The table for LaTeX with booktabs; needs nothing else."""
    spec = "".join("r" if column.numeric else "l" for column in table.columns)
    lines = [
        "\\begin{table}[t]",
        "\\centering\\small",
        f"\\caption{{{escape_latex(table.title)}. {escape_latex(table.caption)}}}",
        f"\\label{{tab:{table.id}}}",
        f"\\begin{{tabular}}{{{spec}}}",
        "\\toprule",
    ]
    if any(column.group for column in table.columns):
        lines.append(_latex_groups(table))
    lines.append(" & ".join(escape_latex(column.name) for column in table.columns) + " \\\\")
    lines.append("\\midrule")
    for position, row in enumerate(table.rows):
        if position in table.separators:
            lines.append("\\midrule")
        lines.append(" & ".join(_latex_cell(cell) for cell in row) + " \\\\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", "\\end{table}", ""])


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


def escape_latex(text: str) -> str:
    """Text with LaTeX's special characters made harmless."""
    replaced = {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "·": r"\textperiodcentered{}", "×": r"$\times$",
        "±": r"$\pm$", "≤": r"$\leq$", "≥": r"$\geq$", "—": "---", "<": r"\textless{}", ">": r"\textgreater{}",
        "|": r"\textbar{}", "°": r"$^\circ$", "–": "--", "²": r"$^2$",
    }  # fmt: skip
    return "".join(replaced.get(character, character) for character in text)


def _escape_markdown(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")
    return escaped.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_").replace("[", "\\[")


def _markdown_cell(cell: TableCell) -> str:
    text = _escape_markdown(cell.text)
    if text and cell.emphasis in ("best", "second"):
        mark = "**" if cell.emphasis == "best" else "*"
        text = f"{mark}{text}{mark}"
    parts = [text, _escape_markdown(cell.small), f"({cell.tag})" if cell.tag else ""]
    return " ".join(part for part in parts if part)


def _csv_name(column: Column) -> str:
    return column.full or (f"{column.group}: {column.name}" if column.group else column.name)


def _csv_cell(cell: TableCell) -> str | float:
    if cell.value is not None:
        return cell.value
    return " ".join(part for part in (cell.text, cell.small, cell.tag) if part)


def _latex_cell(cell: TableCell) -> str:
    text = escape_latex(cell.text)
    if text and cell.emphasis == "best":
        text = f"\\textbf{{{text}}}"
    elif text and cell.emphasis == "second":
        text = f"\\textit{{{text}}}"
    small = f"{{\\scriptsize {escape_latex(cell.small)}}}" if cell.small else ""
    tag = f"{{\\scriptsize {escape_latex(cell.tag)}}}" if cell.tag else ""
    return "~".join(part for part in (text, small, tag) if part)


def _latex_groups(table: Table) -> str:
    cells, rules, at = [], [], 1
    for name, width in table.groups():
        cells.append(f"\\multicolumn{{{width}}}{{c}}{{{escape_latex(name)}}}")
        if name:
            rules.append(f"\\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    return " & ".join(cells) + " \\\\ " + " ".join(rules)
