"""Output of commands: tables for people, JSON for scripts, progress on standard error."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import typer

from dynslam_bench.core import DynslamError, call_periodically, printable

if TYPE_CHECKING:
    from dynslam_bench.core.download import Report
    from dynslam_bench.reports.tables.table import Table

SOME_RUNS_FAILED = 3
"""Exit code where a run failed or was lost, could not be made, or was left out of a copy."""
VERIFICATION_FAILED = 4
"""Exit code where something was checked and has a fault, or a gate found a regression."""
HEARTBEAT_S = 10.0
"""Off a terminal, a long operation reports its progress this often, unless JSON was asked for."""
_GAP = "  "
"""Gap between the columns of a table."""
_BAR_WIDTH = 20
"""Characters of a progress bar, so that count, time and some of the step fit into 80 columns."""
_LINE_WIDTH = 120
"""Characters of a wrapped line at most."""

_json_mode = False
"""Whether ``--json`` was given: then nothing but errors goes to standard error."""

_wide = False
"""Whether ``--wide`` was given: then tables have all columns, however wide the terminal is."""


def set_wide(on: bool) -> None:
    """Show all columns of tables, or those for which a terminal has room."""
    global _wide
    _wide = on


def set_json_mode(on: bool) -> bool:
    """Switch between JSON and text; the callback of ``--json``, undone when the program ends."""
    global _json_mode
    _json_mode = on
    return on


def json_mode() -> bool:
    """Whether JSON is written."""
    return _json_mode


def write(text: str = "", *, colours: Mapping[str, int] | None = None) -> None:
    """Write a line to standard output at once, without escape sequences that a terminal would execute.

    Args:
        text: The line, or lines.
        colours: ANSI codes of words that are coloured on a terminal where they fill a cell of a
            table.
    """
    text = printable(text)
    if colours and sys.stdout.isatty() and "NO_COLOR" not in os.environ:
        # a word that fills a cell: the gap of two columns before it, that or the line's end behind
        cell = re.compile(rf"(?<=  )(?:{'|'.join(colours)})(?=  |$)", re.MULTILINE)
        text = cell.sub(lambda word: f"\033[{colours[word[0]]}m{word[0]}\033[0m", text)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def write_prose(text: str) -> None:
    """Write a sentence to standard output: broken at blanks on a terminal, in one line for programs."""
    write(wrapped(text) if sys.stdout.isatty() else text)


def note(text: str) -> None:
    """Write a line to standard error, only on a terminal and without ``--json``."""
    if sys.stderr.isatty():
        announce(text)


def announce(text: str) -> None:
    """Write a line to standard error, on a terminal or not; none with ``--json``."""
    if not _json_mode:
        warn(_broken(text, _terminal_width()) if sys.stderr.isatty() else text)


def warn(text: str) -> None:
    """Write a line to standard error in any case."""
    sys.stderr.write(printable(text) + "\n")


def write_error(error: DynslamError) -> None:
    """Write an error to standard error: its headline in one line, each cure below it, then the file to copy."""
    line = printable(" ".join(f"error: {error.headline}".split()))
    if sys.stderr.isatty():
        line = f"\033[31m{_broken(line, _terminal_width())}\033[0m"
    sys.stderr.write(f"{line}\n")
    for option in error.options:
        warn(f"  - {' '.join(option.split())}")
    for line in error.template.splitlines():
        warn(line)


def is_interactive() -> bool:
    """Whether a user at a terminal can answer a question."""
    return sys.stdin.isatty() and sys.stderr.isatty() and not _json_mode


def present(value: Any, *lines: str, verified: bool = True) -> None:
    """Write a value as JSON with ``--json`` (pydantic models, dataclasses, paths and arrays included), else lines.

    Raises:
        Exit: Something was checked and is not `verified`; the code is 4.
    """
    if _json_mode:
        from pydantic_core import from_json, to_json

        text = to_json(value, inf_nan_mode="null", fallback=_as_json)
        # `json.dumps` escapes what a terminal would execute
        sys.stdout.write(json.dumps(from_json(text), indent=2) + "\n")
    else:
        for line in lines:
            # tables have several lines, and the width of the terminal
            write(line) if "\n" in line else write_prose(line)
    if not verified:
        raise typer.Exit(VERIFICATION_FAILED)


def _as_json(value: Any) -> Any:
    """Convert a value of a type that pydantic does not know for JSON: an array to its numbers, else to its text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Aligned text, the headings first.

    On a terminal it is no wider than that: texts are wrapped at blanks, and then the last columns
    are left out and named. Words, ids and numbers are never cut.

    Args:
        columns: The headings.
        rows: The values below them.
    """
    cells = [[cell_text(value) for value in row] for row in (columns, *rows)]
    full_widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    least_widths = [_least_width(column) for column in zip(*cells, strict=True)]
    widths = _widths_on_terminal(full_widths, least_widths)

    # `zip` ends with the shorter one: columns without a width are left out
    lines = []
    for row in cells:
        wrapped_cells = [_cell_lines(text, width) for text, width in zip(row, widths, strict=False)]
        for parts in zip_longest(*wrapped_cells, fillvalue=""):
            padded = [part.ljust(width) for part, width in zip(parts, widths, strict=True)]
            lines.append(_GAP.join(padded).rstrip())
    left_out = cells[0][len(widths) :]
    if left_out:
        note = f"(no room for: {', '.join(left_out)}; dynslam-bench --wide shows all)"
        lines.append(wrapped(note))
    return "\n".join(lines)


def _widths_on_terminal(full: Sequence[int], least: Sequence[int]) -> list[int]:
    """Widths of the columns that are shown.

    Without a terminal, and with ``--wide``, all columns are shown in full.

    Args:
        full: Characters of each column's longest cell.
        least: Characters that each column needs.
    """
    widths = list(full)
    if _wide or not sys.stdout.isatty():
        return widths
    terminal = _terminal_width()
    # leave out columns from the last one on, until the least widths fit
    while len(widths) > 1 and _line_width(least[: len(widths)]) > terminal:
        widths.pop()
    # then narrow the widest column by a character, again and again
    while _line_width(widths) > terminal:
        can_shrink = [at for at, width in enumerate(widths) if width > least[at]]
        if not can_shrink:
            break
        widths[max(can_shrink, key=widths.__getitem__)] -= 1
    return widths


def _least_width(column: Sequence[str]) -> int:
    """Characters that a column needs: its longest word, or the longest cell that begins with a number."""
    words = [len(word) for cell in column for word in cell.split()]
    numbers = [len(cell) for cell in column if cell and not any(map(str.isalpha, cell.split()[0]))]
    return max([*words, *numbers], default=0)


def _line_width(widths: Sequence[int]) -> int:
    """Characters of a line of the table, the gaps included."""
    return sum(widths) + len(_GAP) * (len(widths) - 1)


def _cell_lines(text: str, width: int) -> list[str]:
    """A cell in lines of a column's width, broken at blanks."""
    if len(text) <= width:
        return [text]
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def fields(facts: Mapping[str, object]) -> str:
    """Names and values below each other; empty values are left out.

    On a terminal long values are broken at blanks, but for a command and a path, which people copy.
    """
    shown = {
        name: cell_text(value)
        for name, value in facts.items()
        if value not in (None, "", (), [], {})
    }
    width = max(map(len, shown), default=0)
    lines = []
    for name, value in shown.items():
        first = f"{name.ljust(width)}  {value}"
        is_whole = name == "command" or " " not in value or not sys.stdout.isatty()
        lines.append(first if is_whole else wrapped(first, indent=width + 2))
    return "\n".join(lines)


def cell_text(value: object) -> str:
    """A value in a table's cell: one line, numbers with four digits."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(cell_text, value))
    return printable(" ".join(str(value).splitlines()))


def report_table(source: Table, names: Sequence[str] = (), most: int | None = None) -> str:
    """A report's table as text.

    Args:
        source: The report's table.
        names: Names of the columns; all in which something is written if there are none.
        most: Rows at most; None for all.
    """
    source = source.displayed()
    titles = [column.name if names else column.key for column in source.columns]
    chosen = [titles.index(name) for name in names or titles if name in titles]
    rows = []
    for row in source.rows[:most]:
        # a cell's value, what stands in small print behind it, and its mark
        parts = [(row[at].text, row[at].small, row[at].tag) for at in chosen]
        rows.append([" ".join(filter(None, texts)) for texts in parts])
    return table([titles[at] for at in chosen], rows)


def wrapped(text: str, indent: int = 0) -> str:
    """Text in lines as wide as the terminal, 120 characters at most; that many where there is none.

    Args:
        text: The text.
        indent: Blanks before all lines but the first.
    """
    width = min(_terminal_width(), _LINE_WIDTH) if sys.stdout.isatty() else _LINE_WIDTH
    return _broken(text, width, indent)


def _broken(text: str, width: int, indent: int = 0) -> str:
    """Text broken at blanks alone: names such as `orb-slam2`, ids and paths stay whole."""
    return textwrap.fill(
        text,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _terminal_width() -> int:
    return shutil.get_terminal_size().columns


Advance = Callable[..., None]
"""Called with the amount done, the total (None if unknown) and, optionally, the current step."""


@contextmanager
def progress(label: str, *, unit: str = "") -> Iterator[Advance]:
    """A progress bar on standard error where that is a terminal; elsewhere a line every `HEARTBEAT_S` seconds.

    With ``--json`` there is neither, so that standard error holds nothing but errors.

    Yields:
        See `Advance`.
    """
    if _json_mode:
        yield lambda *_: None
        return
    if not sys.stderr.isatty():
        with _progress_lines(label) as advance:
            yield advance
        return
    with _progress_bar(label, unit) as advance:
        yield advance


@contextmanager
def _progress_bar(label: str, unit: str) -> Iterator[Advance]:
    """A bar of rich's, with the amount in bytes or as a count; it disappears at its end."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Column

    amount = (
        DownloadColumn() if unit == "bytes" else TextColumn("{task.completed:.0f}/{task.total:.0f}")
    )
    # where there is little room, the step is cut, and nothing else
    step_column = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=_BAR_WIDTH),
        amount,
        TimeRemainingColumn(),
        TextColumn("{task.fields[step]}", markup=False, table_column=step_column),
    ]
    with Progress(*columns, console=Console(stderr=True), transient=True, expand=True) as bar:
        task = bar.add_task(printable(label), total=1, step="")

        def update(done: float, total: float | None, step: str = "") -> None:
            # rich needs a total: an unknown one stays one ahead
            total = done + 1 if total is None else total
            bar.update(task, completed=done, total=total, step=printable(step))

        yield update


@contextmanager
def _progress_lines(label: str) -> Iterator[Advance]:
    """The last progress as a line on standard error, every `HEARTBEAT_S` seconds."""
    began = time.monotonic()
    text = label

    def update(done: float, total: float | None, step: str = "") -> None:
        nonlocal text
        line = label
        if total:
            amount = f"{done:.0f}" if done >= 100 else f"{done:.3g}"
            line += f": {amount} of {total:.0f}"
        if total and 0 < done < total:
            # what is left takes as long for its amount as what is done
            spent_s = time.monotonic() - began
            line += f", about {spent_s * (total - done) / done:.0f} s left"
        if step:
            line += f" ({step})"
        text = line

    def report() -> None:
        warn(f"{text}, {time.monotonic() - began:.0f} s so far")

    with call_periodically(HEARTBEAT_S, report):
        yield update


@contextmanager
def download_bar(name: str) -> Iterator[Report]:
    """`progress` of one file's download, for `core.download.show_downloads`."""
    with progress(name, unit="bytes") as advance:
        yield lambda state: advance(state.done, state.total)
