"""A table, independent of how it is written: HTML, Markdown, CSV and LaTeX are made of the same two frames."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from math import ceil
from typing import Literal

import pandas as pd

from dynslam_bench.core import printable
from dynslam_bench.reports.model.names import OUR_BACK_END

Emphasis = Literal["", "best", "second", "muted", "failed"]
"""Emphasis with which a cell is set, see `TableCell`."""
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


@dataclass
class Table:
    """A table with a caption that says how to read it; pages, Markdown, CSV and LaTeX are made of it.

    Attributes:
        id: Short name, also the CSV file's.
        title: Heading.
        caption: Everything a reader needs, including the protocol.
        columns: The columns.
        rows: A cell for every column, by row.
        muted_rows: Rows that are shown but do not compete.
        separators: Rows above which a line is drawn.
        brief: Caption where there is little room, without the full stop: what is shown, and its
            unit.
    """

    id: str
    title: str
    caption: str
    columns: Sequence[Column]
    rows: list[list[TableCell]]
    muted_rows: set[int] = field(default_factory=set)
    separators: set[int] = field(default_factory=set)
    brief: str = ""

    def frame(self) -> pd.DataFrame:
        """The table as CSV holds it, in columns named by `Column.key`.

        Numbers have all their digits, in the units that the caption and the headings name (errors
        in metres, times in milliseconds, shares from 0 to 1); other cells have their words.
        """
        lines = [
            [_words(cell) if cell.value is None else cell.value for cell in row]
            for row in self.rows
        ]
        return pd.DataFrame(lines, columns=[column.key for column in self.columns], dtype=object)

    def displayed(self) -> Table:
        """The table as pages, Markdown and LaTeX show it; CSV has all.

        Columns in which nothing is written are left out, and rows behind `MOST_ROWS`, which the
        caption says.
        """
        kept = []
        for at in range(len(self.columns)):
            if not self.rows or any(_words(row[at]) for row in self.rows):
                kept.append(at)
        caption = self.caption
        if len(self.rows) > MOST_ROWS:
            caption += f" These are the first {MOST_ROWS} of {len(self.rows)} rows; all stand in csv/{self.id}.csv."
        return replace(self, caption=caption, rows=self.rows[:MOST_ROWS])._with_columns(kept)

    def without(self, *names: str) -> Table:
        """The table without the columns of these names."""
        return self._with_columns(
            [at for at, column in enumerate(self.columns) if column.name not in names]
        )

    def _with_columns(self, kept: Sequence[int]) -> Table:
        """The table with the columns at these positions."""
        rows = [[row[at] for at in kept] for row in self.rows]
        return replace(self, columns=[self.columns[at] for at in kept], rows=rows)

    def groups(self) -> list[tuple[str, int]]:
        """Neighbouring columns of one group: name and how many."""
        return [
            (name, len(list(group)))
            for name, group in groupby(self.columns, key=lambda column: column.group)
        ]


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown with its caption."""
    table = table.displayed()
    names = [
        f"{column.group}: {column.name}" if column.group else column.name
        for column in table.columns
    ]
    lines = [
        f"## {prose(table.title)}",
        "",
        "| " + " | ".join(_escape_markdown(name) for name in names) + " |",
        "| " + " | ".join("---:" if column.numeric else "---" for column in table.columns) + " |",
    ]
    lines += ["| " + " | ".join(map(_markdown_cell, row)) + " |" for row in table.rows]
    return "\n".join([*lines, "", prose(table.caption), ""])


def csv_text(frame: pd.DataFrame) -> str:
    """A DataFrame as CSV that is safe in spreadsheets and terminals: no cell is a formula or an escape sequence.

    Words that a spreadsheet would take for a formula begin with a quote.
    """
    # headings, then columns of words; numbers need no escape
    written = frame.rename(columns=_no_formula)
    for name in written.columns:
        if written[name].dtype in ("object", "string"):
            written[name] = written[name].astype(object).map(_no_formula)
    return written.to_csv(index=False, lineterminator="\n")


def emphasise(values: Sequence[float | None]) -> list[Emphasis]:
    """Best and second best (smallest) of a column; equal values share the mark."""
    present = sorted({value for value in values if value is not None})
    marks: dict[float | None, Emphasis] = dict(zip(present, ("best", "second"), strict=False))
    return [marks.get(value, "") if len(present) > 1 else "" for value in values]


def prose(text: str) -> str:
    """A sentence for Markdown: on one line, and without markup of HTML."""
    return printable(" ".join(text.split())).replace("<", "&lt;")


def _escape_markdown(text: str) -> str:
    """Text for a cell of Markdown, without markup."""
    return re.sub(r"[*_\[]", r"\\\g<0>", prose(re.sub(r"[\\|]", r"\\\g<0>", text)))


def _markdown_cell(cell: TableCell) -> str:
    """A cell: bold for the best, italic for the second, with small text and tag."""
    mark = {"best": "**", "second": "*"}.get(cell.emphasis, "") if cell.text else ""
    parts = [
        mark + _escape_markdown(cell.text) + mark,
        _escape_markdown(cell.small),
        f"({cell.tag})" * bool(cell.tag),
    ]
    return " ".join(filter(None, parts))


def _words(cell: TableCell) -> str:
    """Everything that is written in a cell."""
    return " ".join(filter(None, (cell.text, cell.small, cell.tag)))


def _no_formula(value: object) -> object:
    """The value; words that a spreadsheet would take for a formula begin with a quote."""
    if isinstance(value, str):
        return "'" * value.startswith(("=", "+", "-", "@", "\t", "\r")) + printable(value)
    return value


def percent(share: float) -> str:
    """A share as whole percents, but nothing short of all is 100 % and nothing above none 0 %."""
    # 100 % and 0 % are said of whole shares alone
    rounded = round(100 * share)
    is_exact = not (rounded == 100 and share < 1) and not (rounded == 0 and share > 0)
    if is_exact:
        return f"{rounded} %"
    if 0.0005 <= share < 0.9995:
        return f"{100 * share:.1f} %"
    return "< 0.1 %" if share < 0.5 else "> 99.9 %"


# -- LaTeX: columns and rows that do not fit a column of a page stand in further tabulars and floats


COLUMN_PT = 229.0
"""Width of a column of a two-column article; those of the common conference styles are wider."""
MOST_LINES = 48
"""Lines of a table in this size that stand in a column of a page."""
_GAP_PT = 6.0
"""Between two columns: twice LaTeX's ``tabcolsep``."""
_DIGIT_PT = 4.3
"""About the width of a digit in this size."""
_LETTER_PT = 4.6
"""About the width of another character."""
_NAMES_PT = 92.0
"""Width of the column of names at most; longer names are broken into lines."""
_HEADING = 11
"""Characters of a line of a heading at most, unless a word is longer."""
_STAR = r"\rlap{$^*$}"
"""Behind the names of trackers with this project's back end."""
_LATEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    **{
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "|": r"\textbar{}",
        # behind a line's end a bracket would be its optional argument, and LaTeX go on for ever
        "[": "{[}",
    },
    **{
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "·": r"\textperiodcentered{}",
        "—": "---",
        "–": "--",
    },
    **{
        "†": r"$^\dagger$",
        "‡": r"$^\ddagger$",
        "…": r"\ldots{}",
        "’": "'",
        "“": "``",
        "”": "''",
        '"': "''",
    },
    "×": r"$\times$",
    "±": r"$\pm$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "°": r"$^\circ$",
    "²": r"$^2$",
    "§": r"\S{}",
    "¶": r"\P{}",
}
"""Character to what LaTeX writes for it."""


def to_latex(table: Table, protocol: str = "") -> str:
    """The table as one or several LaTeX tables that fit a column; needs the package ``booktabs`` and nothing else.

    Columns that do not fit stand in further blocks below, and rows that do not fit in further
    tables. Captions are short: what is shown, its unit and the protocol's name; everything else is
    in the other formats.

    Args:
        table: The table.
        protocol: Name of the protocol that its numbers were taken under, for the caption.
    """
    table = table.displayed()

    # fill floats with tabulars, a new one where the next tabular would not fit
    floats: list[list[str]] = []
    used = MOST_LINES
    for columns in _blocks(table):
        for text, lines in _tabulars(table, columns):
            if used + lines > MOST_LINES:
                floats.append([])
                used = 0
            floats[-1].append(text)
            used += lines
    return "\n".join(
        _float(table, tabulars, number, protocol) for number, tabulars in enumerate(floats)
    )


_BREAKS = re.compile(r"([./?=]|\\_|\\&)(?=[A-Za-z0-9])")
"""Where a long name may be broken, such as a setting's."""


def escape_latex(text: str) -> str:
    """Text with LaTeX's special characters escaped, on one line.

    Letters of other alphabets than the Latin one and pictures, which ``pdflatex`` has no glyphs
    for, are named by their code point, U+1F600 in brackets.
    """
    return "".join(_character(character) for character in " ".join(text.split()))


def _character(character: str) -> str:
    """A character as LaTeX writes it; without a glyph as its plain letters or its code point."""
    if character in _LATEX or ("\u00c0" <= character <= "\u017e" and character != "÷"):
        return _LATEX.get(character, character)
    if character.isascii():
        return character if character.isprintable() else " "
    # a letter without its accent, where pdflatex has no glyph
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    if not plain:
        return f"{{[}}U+{ord(character):04X}]"
    return "".join(_LATEX.get(letter, letter) for letter in plain)


def _float(table: Table, tabulars: Sequence[str], number: int, protocol: str) -> str:
    """A float with some tabulars below each other; further ones of a table are numbered and say that they continue."""
    # what is shown, under which protocol, and whether it goes on
    words = [table.brief or table.title]
    if protocol:
        words.append(f"protocol {protocol}")
    if number:
        words.append("continued")
    note = " $^*$\\,our back end." if any(_STAR in tabular for tabular in tabulars) else ""
    label = f"{table.id}-{number + 1}" if number else table.id
    return "\n".join(
        [
            "\\begin{table}[htbp]",
            "\\centering\\footnotesize\\setlength{\\tabcolsep}{3pt}",
            f"\\caption{{{escape_latex(', '.join(words))}.{note}}}",
            f"\\label{{tab:{label}}}",
            "\n\\par\\medskip\n".join(tabulars),
            "\\end{table}\n",
        ]
    )


def _blocks(table: Table) -> list[list[int]]:
    """Columns of each block that stand side by side; the names of the rows stand in every block."""
    # the first column of texts holds the names of the rows
    shown = [at for at, column in enumerate(table.columns) if column.latex]
    names = next((at for at in shown if not table.columns[at].numeric), 0)
    widths_pt = {at: _width_pt(table, at) for at in shown}
    available_pt = COLUMN_PT - min(widths_pt.get(names, 0.0), _NAMES_PT)

    # fill blocks from the left, a new one where the next column would not fit
    blocks: list[list[int]] = [[]]
    for at in shown:
        if at == names:
            continue
        needed_pt = 0.0
        for group, members in groupby(
            [*blocks[-1], at], key=lambda other: table.columns[other].group
        ):
            columns_pt = sum(widths_pt[member] + _GAP_PT for member in members)
            needed_pt += max(columns_pt, _text_pt(group) + _GAP_PT)
        if blocks[-1] and needed_pt > available_pt:
            blocks.append([])
        blocks[-1].append(at)
    return [[names, *columns] for columns in blocks]


def _width_pt(table: Table, at: int) -> float:
    """About how wide a column is, in points."""
    cells = [_plain(row[at]) for row in table.rows]
    return max(map(_text_pt, [*cells, *_heading(table.columns[at].name)]))


def _text_pt(text: str) -> float:
    """About how wide a text is, in points."""
    return sum(_DIGIT_PT if character.isdigit() else _LETTER_PT for character in text)


def _heading(name: str) -> list[str]:
    """A heading in lines of about ten characters, broken behind blanks, slashes and the like."""
    lines = [""]
    for word in re.findall(r"[^ /_@?,-]*[ /_@?,-]?", name):
        if lines[-1] and len(lines[-1]) + len(word) > _HEADING:
            lines.append("")
        lines[-1] += word
    return [line.strip() for line in lines if line.strip()] or [""]


def _plain(cell: TableCell) -> str:
    """Text of a cell in LaTeX, unescaped."""
    if cell.emphasis == "failed":
        return "failed"
    text = cell.text.replace(OUR_BACK_END, "*")
    return f"{text} {cell.small}" if cell.small.startswith("[") else text


def _tabulars(table: Table, columns: Sequence[int]) -> list[tuple[str, int]]:
    """Columns as one tabular, or as several where they have too many rows; each with its height in lines."""
    # alignment of the columns; long names are set in lines of a fixed width
    chosen = [table.columns[at] for at in columns]
    wide = _width_pt(table, columns[0]) > _NAMES_PT
    alignment = f"p{{{_NAMES_PT:.0f}pt}}" if wide else "l"
    alignment += "".join("r" if column.numeric else "l" for column in chosen[1:])

    # headings, with those of the groups above them
    groups = replace(table, columns=chosen).groups()
    head = [_groups(groups)] if any(name for name, _ in groups) else []
    head.append(" & ".join(_stacked(column.name) for column in chosen) + " \\\\")
    head_lines = len(head) + max(len(_heading(column.name)) for column in chosen) + 1

    # lines of every row, and how many rows fit a column of a page
    names = [_plain(row[columns[0]]) for row in table.rows]
    lines = [ceil(1.2 * _text_pt(name) / _NAMES_PT) if wide else 1 for name in names]
    fitting = (MOST_LINES - head_lines) // max(lines, default=1)
    parts = []
    for first in range(0, len(table.rows), fitting):
        body: list[str] = []
        for position, row in enumerate(table.rows[first : first + fitting], first):
            if position in table.separators and body:
                body.append("\\midrule")
            name, *others = (_latex_cell(row[at]) for at in columns)
            if wide:
                name = "\\raggedright " + _BREAKS.sub(r"\1\\allowbreak{}", name)
            body.append(" & ".join([name, *others]) + " \\\\")
        height = head_lines + sum(lines[first : first + fitting])
        begin = [f"\\begin{{tabular}}{{@{{}}{alignment}@{{}}}}", "\\toprule", *head, "\\midrule"]
        parts.append(("\n".join([*begin, *body, "\\bottomrule", "\\end{tabular}"]), height))
    return parts


def _stacked(name: str) -> str:
    """A heading whose lines stand above each other."""
    lines = [escape_latex(line) for line in _heading(name)]
    if len(lines) == 1:
        return lines[0]
    return "\\shortstack{" + " \\\\ ".join(lines) + "}"


def _latex_cell(cell: TableCell) -> str:
    """A cell: bold for the best, italic for the second, with its interval in small type."""
    if cell.emphasis == "failed":
        return "failed"
    text = escape_latex(cell.text.replace(OUR_BACK_END, ""))
    # the best in bold, the second in italics; the interval stays plain
    font = {"best": "bf", "second": "it"}.get(cell.emphasis)
    if text and font:
        text = f"\\text{font}{{{text}}}"
    if OUR_BACK_END in cell.text:
        text += _STAR
    if cell.small.startswith("["):
        text += f"~{{\\scriptsize {escape_latex(cell.small)}}}"
    return text


def _groups(groups: Sequence[tuple[str, int]]) -> str:
    """The line of headings above the columns' own, with a rule below each."""
    cells = []
    rules = []
    first = 1
    for name, width in groups:
        # a group's name stands above its columns, with a rule
        if name:
            cells.append(f"\\multicolumn{{{width}}}{{c}}{{{escape_latex(name)}}}")
            rules.append(f"\\cmidrule(lr){{{first}-{first + width - 1}}}")
        else:
            cells.append(" & ".join([""] * width))
        first += width
    return " & ".join(cells) + " \\\\ " + " ".join(rules)
