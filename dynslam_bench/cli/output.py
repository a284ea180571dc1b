"""What commands write: tables for people, JSON for scripts, progress on standard error."""

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
from typing import TYPE_CHECKING, Any

import typer
from pydantic_core import from_json, to_json

from dynslam_bench.core import DynslamError, call_periodically, printable

if TYPE_CHECKING:
    from dynslam_bench.core.download import Report
    from dynslam_bench.reports.tables.table import Table

SOME_RUNS_FAILED = 3
VERIFICATION_FAILED = 4
HEARTBEAT_S = 10.0
"""Off a terminal, a long operation reports its progress this often, unless JSON was asked for."""
_MIN_WIDTH = 12
"""Characters that a shortened column of names keeps, unless more are asked for."""

_json_mode = False
"""Whether ``--json`` was given: then nothing but errors goes to standard error."""


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
        cell = re.compile(rf"(?<=  )(?:{'|'.join(colours)})(?=  |$)", re.MULTILINE)
        text = cell.sub(lambda word: f"\033[{colours[word[0]]}m{word[0]}\033[0m", text)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """Write a line to standard error, only on a terminal and without ``--json``."""
    if sys.stderr.isatty():
        announce(text)


def announce(text: str) -> None:
    """Write a line to standard error, on a terminal or not; none with ``--json``."""
    if not _json_mode:
        warn(text)


def warn(text: str) -> None:
    """Write a line to standard error in any case."""
    sys.stderr.write(printable(text) + "\n")


def write_error(error: DynslamError) -> None:
    """Write an error to standard error: its headline in one line, each cure below it, then the file to copy."""
    line = printable(" ".join(f"error: {error.headline}".split()))
    sys.stderr.write(f"\033[31m{line}\033[0m\n" if sys.stderr.isatty() else f"{line}\n")
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
        text = to_json(value, inf_nan_mode="null", fallback=_plain)
        # escapes what a terminal would execute
        sys.stdout.write(json.dumps(from_json(text), indent=2) + "\n")
    else:
        for line in lines:
            write(line)
    if not verified:
        raise typer.Exit(VERIFICATION_FAILED)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def table(
    columns: Sequence[str], rows: Sequence[Sequence[object]], *, least: int = _MIN_WIDTH
) -> str:
    """Aligned text, the headings first.

    On a terminal it is no wider than that: the last columns are left out and named, then the widest
    names are shortened in the middle. Numbers are never shortened.

    Args:
        columns: The headings.
        rows: The values below them.
        least: Characters that a shortened column of names keeps.
    """
    cells = [[cell_text(value) for value in row] for row in (columns, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    needed = [_least_width(column, least) for column in zip(*cells, strict=True)]
    room = _terminal_width() if sys.stdout.isatty() else sys.maxsize
    while len(widths) > 1 and _line_width(needed[: len(widths)]) > room:
        widths.pop()
    while _line_width(widths) > room and (
        wider := [at for at, width in enumerate(widths) if width > needed[at]]
    ):
        widths[max(wider, key=widths.__getitem__)] -= 1
    lines = ["  ".join(map(_fitted, row, widths)).rstrip() for row in cells]
    left_out = cells[0][len(widths) :]
    return "\n".join([*lines, f"(no room for: {', '.join(left_out)})"] if left_out else lines)


def _least_width(column: Sequence[str], least: int) -> int:
    """Characters that a column needs: `least`, or the longest cell that begins with a number."""
    numbers = (len(cell) for cell in column if cell and not any(map(str.isalpha, cell.split()[0])))
    return max([min(max(map(len, column)), least), *numbers])


def _line_width(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def _fitted(text: str, width: int) -> str:
    if len(text) <= width:
        return text.ljust(width)
    return text[: width // 2] + "…" + text[len(text) - (width - 1) // 2 :]


def fields(facts: Mapping[str, object]) -> str:
    """Names and values below each other; empty values are left out."""
    shown = {
        name: cell_text(value)
        for name, value in facts.items()
        if value not in (None, "", (), [], {})
    }
    width = max(map(len, shown), default=0)
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in shown.items())


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
    """A report's table as text: the columns of these names, or all in which something is written."""
    source = source.displayed()
    titles = [column.name if names else column.key for column in source.columns]
    chosen = [titles.index(name) for name in names or titles if name in titles]
    cells = [
        [" ".join(filter(None, (row[at].text, row[at].small, row[at].tag))) for at in chosen]
        for row in source.rows[:most]
    ]
    return table([titles[at] for at in chosen], cells)


def wrapped(text: str) -> str:
    """Text in lines as wide as the terminal, 120 characters at most; that many where there is none."""
    return textwrap.fill(text, min(_terminal_width(), 120) if sys.stdout.isatty() else 120)


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
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    amount = (
        DownloadColumn() if unit == "bytes" else TextColumn("{task.completed:.0f}/{task.total:.0f}")
    )
    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        amount,
        TimeRemainingColumn(),
    ]
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(label), total=1)

        def update(done: float, total: float | None, step: str = "") -> None:
            text = printable(f"{label}: {step}" if step else label)
            bar.update(
                task, completed=done, total=done + 1 if total is None else total, description=text
            )

        yield update


@contextmanager
def _progress_lines(label: str) -> Iterator[Advance]:
    began = time.monotonic()
    text = label

    def update(done: float, total: float | None, step: str = "") -> None:
        nonlocal text
        share = f": {done:{'.0f' if done >= 100 else '.3g'}} of {total:.0f}" if total else ""
        spent_s = time.monotonic() - began
        left = (
            f", about {spent_s * (total - done) / done:.0f} s left"
            if total and 0 < done < total
            else ""
        )
        text = f"{label}{share}{left}" + (f" ({step})" if step else "")

    with call_periodically(
        HEARTBEAT_S, lambda: warn(f"{text}, {time.monotonic() - began:.0f} s so far")
    ):
        yield update


@contextmanager
def download_bar(name: str) -> Iterator[Report]:
    """`progress` of one file's download, for `core.download.show_downloads`."""
    with progress(name, unit="bytes") as advance:
        yield lambda state: advance(state.done, state.total)
