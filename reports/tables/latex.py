"""Tables for LaTeX: `booktabs`, short captions, and as many floats as it takes to fit one column of a page."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from itertools import groupby
from math import ceil

from .table import Column, Table, TableCell

COLUMN_PT = 229.0
"""Width of a column of a two-column article; those of the common conference styles are wider."""
MOST_LINES = 48
"""Lines of a table in this size that stand in a column of a page."""
_GAP_PT = 6.0
_DIGIT_PT = 4.3
_LETTER_PT = 4.6
_NAMES_PT = 92.0
_HEADING = 11
OUR_BACK_END = " (our back end)"
_STAR = r"\rlap{$^*$}"
_LATEX = {character: f"\\{character}" for character in "&%$#_{}"}
_LATEX |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "|": r"\textbar{}"}
_LATEX |= {"<": r"\textless{}", ">": r"\textgreater{}", "·": r"\textperiodcentered{}", "—": "---", "–": "--"}
_LATEX |= {
    "×": r"$\times$",
    "±": r"$\pm$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "°": r"$^\circ$",
    "²": r"$^2$",
    "§": r"\S{}",
    "¶": r"\P{}",
}
_LATEX |= {"†": r"$^\dagger$", "‡": r"$^\ddagger$", "…": r"\ldots{}", "’": "'", "“": "``", "”": "''", '"': "''"}


def to_latex(table: Table, protocol: str = "") -> str:
    """The table as one or several LaTeX tables that fit a column; needs the package ``booktabs`` and nothing else.

    Columns that do not fit stand in further blocks below, and rows that do not fit in further tables. Captions are
    short: what is shown, its unit and the protocol's name; everything else is in the other formats.

    Args:
        table: The table.
        protocol: Name of the protocol that its numbers were taken under, for the caption.
    """
    table = table.displayed()
    parts = [part for columns in _blocks(table) for part in _parts(table, columns)]
    floats: list[list[str]] = [[]]
    used = 0
    for text, lines in parts:
        if floats[-1] and used + lines > MOST_LINES:
            floats.append([])
            used = 0
        floats[-1].append(text)
        used += lines
    return "\n".join(_float(table, blocks, number, protocol) for number, blocks in enumerate(floats))


def escape_latex(text: str) -> str:
    """Text with LaTeX's special characters made harmless, on one line.

    Letters of other alphabets than the Latin one and pictures, which ``pdflatex`` has no glyphs for, are named by their
    code point: ``[U+1F600]``.
    """
    return "".join(_character(character) for character in " ".join(text.split()))


def _character(character: str) -> str:
    if character in _LATEX:
        return _LATEX[character]
    if character.isascii():
        return character if character.isprintable() else " "
    if "\u00c0" <= character <= "\u017e" and character not in "×÷":
        return character
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return "".join(_LATEX.get(each, each) for each in plain) if plain else f"[U+{ord(character):04X}]"


def _float(table: Table, blocks: Sequence[str], number: int, protocol: str) -> str:
    words = [table.brief] + [f"protocol {protocol}"] * bool(protocol) + ["continued"] * bool(number)
    caption = escape_latex(", ".join(words))
    label = f"tab:{table.id}" + (f"-{number + 1}" if number else "")
    starred = any(_STAR in block for block in blocks)
    note = " $^*$\\,our back end." if starred else ""
    return "\n".join(
        [
            "\\begin{table}[htbp]",
            "\\centering\\footnotesize\\setlength{\\tabcolsep}{3pt}",
            f"\\caption{{{caption}.{note}}}",
            f"\\label{{{label}}}",
            "\n\\par\\medskip\n".join(blocks),
            "\\end{table}",
            "",
        ]
    )


def _blocks(table: Table) -> list[list[int]]:
    """Which columns stand side by side; the names of the rows stand in every block."""
    shown = [at for at, column in enumerate(table.columns) if column.latex]
    names = next((at for at in shown if not table.columns[at].numeric), 0)
    widths = {at: _width_pt(table, at) for at in shown}
    room = COLUMN_PT - min(widths.get(names, 0.0), _NAMES_PT)
    found: list[list[int]] = [[]]
    for at in (at for at in shown if at != names):
        if found[-1] and _together_pt(table, [*found[-1], at], widths) > room:
            found.append([])
        found[-1].append(at)
    return [[names, *columns] for columns in found]


def _together_pt(table: Table, columns: Sequence[int], widths: Mapping[int, float]) -> float:
    """About how wide neighbouring columns are, in points, with the headings above several of them."""
    return sum(
        max(sum(widths[at] + _GAP_PT for at in group), _text_pt(name) + _GAP_PT)
        for name, run in groupby(columns, key=lambda at: table.columns[at].group)
        for group in [list(run)]
    )


def _width_pt(table: Table, at: int) -> float:
    """About how wide a column is, in points."""
    words = [_plain(row[at]) for row in table.rows] + _heading(table.columns[at].name)
    return max(map(_text_pt, words))


def _text_pt(text: str) -> float:
    return sum(_DIGIT_PT if each.isdigit() else _LETTER_PT for each in text)


def _heading(name: str) -> list[str]:
    """A heading in lines of about ten characters, broken behind blanks, slashes and the like."""
    lines = [""]
    for word in re.findall(r"[^ /_@?,-]*[ /_@?,-]?", name):
        if lines[-1] and len(lines[-1]) + len(word) > _HEADING:
            lines.append("")
        lines[-1] += word
    return [line.strip() for line in lines if line.strip()] or [""]


def _plain(cell: TableCell) -> str:
    """What LaTeX shows of a cell, unescaped."""
    if cell.emphasis == "failed":
        return "failed"
    text = cell.text.replace(OUR_BACK_END, "*")
    return f"{text} {cell.small}" if cell.small.startswith("[") else text


def _parts(table: Table, columns: Sequence[int]) -> list[tuple[str, int]]:
    """Columns as one tabular, or as several where they have too many lines; each with its height in lines."""
    chosen = [table.columns[at] for at in columns]
    wide = _width_pt(table, columns[0]) > _NAMES_PT
    kinds = (f"p{{{_NAMES_PT:.0f}pt}}" if wide else "l") + "".join("r" if c.numeric else "l" for c in chosen[1:])
    head = [_groups(chosen)] if any(column.group for column in chosen) else []
    head.append(" & ".join(_stacked(column.name) for column in chosen) + " \\\\")
    top = len(head) + max(len(_heading(column.name)) for column in chosen) + 1
    bodies: list[list[str]] = []
    used = MOST_LINES
    heights: list[int] = []
    for position, row in enumerate(table.rows):
        lines = ceil(1.2 * _text_pt(_plain(row[columns[0]])) / _NAMES_PT) if wide else 1
        if used + lines > MOST_LINES:
            bodies.append([])
            heights.append(top)
            used = top
        if position in table.separators and bodies[-1]:
            bodies[-1].append("\\midrule")
        first, *others = (_cell(row[at]) for at in columns)
        bodies[-1].append(" & ".join([f"\\raggedright {first}" if wide else first, *others]) + " \\\\")
        heights[-1] += lines
        used += lines
    begin = [f"\\begin{{tabular}}{{@{{}}{kinds}@{{}}}}", "\\toprule", *head, "\\midrule"]
    end = ["\\bottomrule", "\\end{tabular}"]
    return [("\n".join([*begin, *body, *end]), height) for body, height in zip(bodies, heights, strict=True)]


def _stacked(name: str) -> str:
    lines = [escape_latex(line) for line in _heading(name)]
    return lines[0] if len(lines) == 1 else "\\shortstack{" + " \\\\ ".join(lines) + "}"


def _cell(cell: TableCell) -> str:
    if cell.emphasis == "failed":
        return "failed"
    text = escape_latex(cell.text.replace(OUR_BACK_END, ""))
    if text and cell.emphasis in ("best", "second"):
        text = f"\\text{'bf' if cell.emphasis == 'best' else 'it'}{{{text}}}"
    text += _STAR if OUR_BACK_END in cell.text else ""
    return f"{text}~{{\\scriptsize {escape_latex(cell.small)}}}" if cell.small.startswith("[") else text


def _groups(columns: Sequence[Column]) -> str:
    """The line of headings above the columns' own, with a rule below each."""
    cells, rules, at = [], [], 1
    for name, group in groupby(columns, key=lambda column: column.group):
        width = len(list(group))
        cells.append(f"\\multicolumn{{{width}}}{{c}}{{{escape_latex(name)}}}" if name else " & ".join([""] * width))
        rules += [f"\\cmidrule(lr){{{at}-{at + width - 1}}}"] if name else []
        at += width
    return " & ".join(cells) + " \\\\ " + " ".join(rules)
