"""What commands write: tables for people, JSON for scripts, progress on a terminal."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from dynslam_bench.core.download import Report
from dynslam_bench.core.sanitise import printable

if TYPE_CHECKING:
    from dynslam_bench.core.errors import DynslamError
    from dynslam_bench.reports.tables.table import Table

SOME_RUNS_FAILED = 3
VERIFICATION_FAILED = 4
HEARTBEAT_S = 10.0
"""Off a terminal, a long operation reports its progress this often, unless JSON was asked for."""
_MIN_WIDTH = 8
"""Characters that a shortened column keeps."""

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


def write(text: str = "", *, now: bool = False) -> None:
    """Write a line to standard output, without escape sequences that a terminal would execute; `now` flushes."""
    sys.stdout.write(printable(text) + "\n")
    if now:
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
    """Write an error to standard error: its headline in one line, each cure below it."""
    line = printable(" ".join(f"error: {error.headline}".split()))
    sys.stderr.write(f"\033[31m{line}\033[0m\n" if sys.stderr.isatty() else f"{line}\n")
    for option in error.options:
        sys.stderr.write(f"  - {printable(' '.join(option.split()))}\n")


def is_interactive() -> bool:
    """Whether a user at a terminal can answer a question."""
    return sys.stdin.isatty() and sys.stderr.isatty() and not _json_mode


def present(value: Any, show: Callable[[], None]) -> None:
    """Write a value as JSON (pydantic models, paths and arrays included) with ``--json``; else call `show`."""
    if _json_mode:
        sys.stdout.write(json.dumps(value, indent=2, default=_plain) + "\n")
    else:
        show()


def write_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    *,
    shrink: Sequence[str] = (),
    spare: Sequence[str] = (),
) -> None:
    """Write a table as `write_columns` does.

    Args:
        columns: Headings.
        rows: Cells.
        shrink: As there.
        spare: As there.
    """
    values = zip(*rows, strict=True) if rows else ((),) * len(columns)
    write_columns(list(zip(columns, values, strict=True)), shrink=shrink, spare=spare)


def write_columns(
    columns: Sequence[tuple[str, Sequence[object]]], *, shrink: Sequence[str] = (), spare: Sequence[str] = ()
) -> None:
    """Write a table as aligned text; on a terminal it is no wider than that.

    Args:
        columns: Headings, each with the cells below it.
        shrink: Columns that are shortened first to fit a terminal, in this order; then all others.
        spare: Columns that are left out if the table is still too wide, in this order; a line below names them.
    """
    cells: list[Sequence[str]] = [[_text(name), *_texts(values)] for name, values in columns]
    left_out: list[str] = []
    if sys.stdout.isatty():
        rows, left_out = fitted(list(zip(*cells, strict=True)), shrink, spare, _terminal_width())
        cells = list(zip(*rows, strict=True))
    head, separator, body = _aligned_columns(cells).partition("\n")
    sys.stdout.write(f"\033[1m{head}\033[0m" if sys.stdout.isatty() else head)
    sys.stdout.write(f"{separator}{body}\n")  # `_text` has removed escape sequences from every cell
    if left_out:
        write(f"(no room for: {', '.join(left_out)})")


def fitted(
    rows: Sequence[Sequence[str]], shrink: Sequence[str], spare: Sequence[str], width: int
) -> tuple[list[list[str]], list[str]]:
    """A table made to fit: columns shortened, then left out, until a line has at most `width` characters.

    Args:
        rows: Cells, the headings first.
        shrink: As in `write_columns`.
        spare: As in `write_columns`; the last columns follow where that is not enough, but the first one always stays.
        width: Characters of a line.

    Returns:
        The table, and the headings of the columns that are left out.
    """
    columns = {column[0]: column for column in zip(*rows, strict=True)}
    widths = {name: max(map(len, column)) for name, column in columns.items()}
    droppable = [name for name in spare if name in columns]
    droppable += [name for name in list(columns)[:0:-1] if name not in spare]
    left_out: list[str] = []

    def excess() -> int:
        return sum(widths.values()) + 2 * (len(widths) - 1) - width

    while sum(min(size, _MIN_WIDTH) for size in widths.values()) + 2 * (len(widths) - 1) > width and droppable:
        left_out.append(droppable.pop(0))
        del widths[left_out[-1]]
    for name in shrink:
        if name in widths:
            widths[name] = max(widths[name] - max(excess(), 0), min(widths[name], _MIN_WIDTH))
    while excess() > 0 and max(widths.values()) > _MIN_WIDTH:
        widths[max(widths, key=widths.__getitem__)] -= 1
    shown = [[_cut(cell, size) for cell in columns[name]] for name, size in widths.items()]
    return [list(row) for row in zip(*shown, strict=True)], left_out


def _cut(text: str, room: int) -> str:
    return text if len(text) <= room else text[: max(room - 1, 0)] + "…"


def write_report_table(table: Table) -> None:
    """Write a table of a report: its title, its rows, and its caption in lines as wide as the terminal."""
    write(table.title)
    cells = [[" ".join(filter(None, (cell.text, cell.small, cell.tag))) for cell in row] for row in table.rows]
    write_table([column.key for column in table.columns], cells)
    write()
    write(wrapped(table.caption))


def wrapped(text: str, most: int = 120) -> str:
    """Text in lines as wide as the terminal, `most` characters at most; that many where there is none."""
    return "\n".join(textwrap.wrap(text, min(_terminal_width(), most) if sys.stdout.isatty() else most))


def _terminal_width() -> int:
    return shutil.get_terminal_size().columns


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text with aligned columns."""
    return _aligned_columns(list(zip(*rows, strict=True)))


def _aligned_columns(columns: Sequence[Sequence[str]]) -> str:
    line = "  ".join(f"%-{max(map(len, column))}s" for column in columns)
    return "\n".join([(line % cells).rstrip() for cells in zip(*columns, strict=True)])


def write_fields(fields: Mapping[str, object]) -> None:
    """Write names and values below each other; empty values are left out."""
    shown = {name: _text(value) for name, value in fields.items() if value not in (None, "", (), [])}
    width = max(map(len, shown), default=0)
    for name, value in shown.items():
        write(f"{name.ljust(width)}  {value}")


@contextmanager
def heartbeat() -> Iterator[Callable[[str], None]]:
    """A line on standard error every `HEARTBEAT_S` seconds during a long operation; none with ``--json``.

    Yields:
        Call it with the current step as often as you like; threads may.
    """
    began = last = time.monotonic()

    def beat(text: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= HEARTBEAT_S:
            last = now
            announce(f"{text}, {now - began:.0f} s")

    yield beat


class _Lines:
    """Progress off a terminal: a line every `HEARTBEAT_S` seconds, from a thread."""

    def __init__(self, label: str) -> None:
        self.label, self.began, self.text = label, time.monotonic(), ""
        self.ended = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def update(self, done: float, total: float | None, step: str = "") -> None:
        share = "" if not total else f" {done:.{0 if done == int(done) else 1}f} of {total:.0f}"
        spent = time.monotonic() - self.began
        left = f", about {spent * (total - done) / done:.0f} s left" if total and 0 < done < total else ""
        self.text = f"{share}{left}" + (f" ({step})" if step else "")

    def _run(self) -> None:
        while not self.ended.wait(HEARTBEAT_S):
            warn(f"{self.label}{':' * bool(self.text)}{self.text}, {time.monotonic() - self.began:.0f} s so far")
            sys.stderr.flush()


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
        lines = _Lines(label)
        try:
            yield lines.update
        finally:
            lines.ended.set()
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    amount = DownloadColumn() if unit == "bytes" else TextColumn("{task.completed:.0f}/{task.total:.0f}")
    columns = [TextColumn("{task.description}", markup=False), BarColumn(), amount, TimeRemainingColumn()]
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(label), total=1)

        def update(done: float, total: float | None, step: str = "") -> None:
            text = printable(f"{label}: {step}" if step else label)
            bar.update(task, completed=done, total=done + 1 if total is None else total, description=text)

        yield update


@contextmanager
def download_bar(name: str) -> Iterator[Report]:
    """`progress` of one file's download, for `core.download_progress.show_downloads`."""
    with progress(name, unit="bytes") as advance:
        yield lambda state: advance(state.done, state.total)


def _texts(values: Sequence[object]) -> Sequence[str]:
    """The cells of a column: `_text` of each, with a fast path for long columns of plain words or numbers."""
    kinds = set(map(type, values))
    if kinds == {str} and "".join(cast("Sequence[str]", values)).isprintable():
        return cast("Sequence[str]", values)
    return [_text(value) for value in values]


def _text(value: object) -> str:
    if isinstance(value, str) and value.isprintable():  # nearly every cell of a long table
        return value
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple, set, frozenset)):
        return ", ".join(_text(part) for part in (sorted(value) if isinstance(value, (set, frozenset)) else value))
    return printable(" ".join(str(value).splitlines()))


def _plain(value: Any) -> Any:
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    return value.tolist() if hasattr(value, "tolist") else str(value)
