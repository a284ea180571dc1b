"""What commands write: tables for people, JSON for scripts, progress only where somebody watches."""

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


_for_scripts = False
"""Whether the command that runs was asked for JSON: then nothing but errors goes to standard error."""


def for_scripts(asked: bool) -> bool:
    """Say whether JSON is asked for; the callback of ``--json``, and taken back where the program ends."""
    global _for_scripts
    _for_scripts = asked
    return asked


def write(text: str = "", *, now: bool = False) -> None:
    """Write a line to standard output; `now` also where nobody watches, ahead of what follows.

    What it names may come from anywhere: a terminal is never handed what it would act upon.
    """
    sys.stdout.write(printable(text) + "\n")
    if now:
        sys.stdout.flush()


def note(text: str) -> None:
    """Write a line for people to standard error, only if they watch and nobody asked for JSON."""
    if sys.stderr.isatty() and not _for_scripts:
        complain(text)


def announce(text: str) -> None:
    """Write a line for people to standard error, a terminal or not; none with ``--json``."""
    if not _for_scripts:
        complain(text)


def complain(text: str) -> None:
    """Write a line to standard error, whoever watches: what was asked for and cannot be had; harmless as in `write`."""
    sys.stderr.write(printable(text) + "\n")


def complain_of(error: DynslamError) -> None:
    """Write an error to standard error: its headline in one line, each cure below it."""
    line = printable(" ".join(f"error: {error.headline}".split()))
    sys.stderr.write(f"\033[31m{line}\033[0m\n" if sys.stderr.isatty() else f"{line}\n")
    for option in error.options:
        sys.stderr.write(f"  - {printable(' '.join(option.split()))}\n")


def can_ask() -> bool:
    """Whether somebody sits at a terminal who can answer a question, and no script reads what is written."""
    return sys.stdin.isatty() and sys.stderr.isatty() and not _for_scripts


def write_json(value: Any) -> None:
    """Write a value as JSON; pydantic models and paths included."""
    sys.stdout.write(json.dumps(value, indent=2, default=_plain) + "\n")


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
    """Write a table as aligned text, on a terminal no wider than that; where the output is none, it is whole.

    Args:
        columns: Headings, each with the cells below it.
        shrink: Columns that are shortened first to fit a terminal, one after the other; then all others.
        spare: Columns that are left out then if it is still too wide, the first one first; a line below names them.
    """
    cells: list[Sequence[str]] = [[_text(name), *_texts(values)] for name, values in columns]
    left_out: list[str] = []
    if sys.stdout.isatty():
        rows_of_text, left_out = fitted(list(zip(*cells, strict=True)), shrink, spare, _terminal_width())
        cells = list(zip(*rows_of_text, strict=True))
    head, separator, body = _under_each_other(cells).partition("\n")
    sys.stdout.write(f"\033[1m{head}\033[0m" if sys.stdout.isatty() else head)
    sys.stdout.write(f"{separator}{body}\n")  # harmless: `_text` has made every cell so
    if left_out:
        write(f"(no room for: {', '.join(left_out)})")


_LEAST = 8
"""Characters that a shortened column keeps."""


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
    table = [list(row) for row in rows]
    droppable = [*(name for name in spare if name in table[0]), *(n for n in table[0][:0:-1] if n not in spare)]
    left_out: list[str] = []
    while True:
        first = [table[0].index(name) for name in shrink if name in table[0]]
        widths = _shrunk([max(map(len, cells)) for cells in zip(*table, strict=True)], first, width)
        if _total(widths) <= width or not droppable:
            break
        left_out.append(droppable.pop(0))
        at = table[0].index(left_out[-1])
        table = [row[:at] + row[at + 1 :] for row in table]
    return [[_cut(cell, room) for cell, room in zip(row, widths, strict=True)] for row in table], left_out


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def _shrunk(widths: list[int], first: Sequence[int], width: int) -> list[int]:
    """Widths that fit, or the least ones: the columns `first` give way before the others, of which the widest does."""
    widths = list(widths)
    for at in first:
        widths[at] = max(widths[at] - max(_total(widths) - width, 0), min(widths[at], _LEAST))
    while _total(widths) > width and max(widths) > _LEAST:
        widths[widths.index(max(widths))] -= 1
    return widths


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
    """Rows of text with their columns under each other."""
    return _under_each_other(list(zip(*rows, strict=True)))


def _under_each_other(columns: Sequence[Sequence[str]]) -> str:
    line = "  ".join(f"%-{max(map(len, column))}s" for column in columns)
    return "\n".join([(line % cells).rstrip() for cells in zip(*columns, strict=True)])


def write_fields(fields: Mapping[str, object]) -> None:
    """Write names and values below each other; empty values are left out."""
    shown = {name: _text(value) for name, value in fields.items() if value not in (None, "", (), [])}
    width = max(map(len, shown), default=0)
    for name, value in shown.items():
        write(f"{name.ljust(width)}  {value}")


HEARTBEAT_S = 10.0
"""Off a terminal something that lasts says so this often, unless JSON was asked for."""


@contextmanager
def heartbeat() -> Iterator[Callable[[str], None]]:
    """A line on standard error every `HEARTBEAT_S` seconds while something lasts; none with ``--json``.

    Yields:
        Call it as often as you like with what is going on; threads may.
    """
    began = told = time.monotonic()

    def beat(text: str) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told >= HEARTBEAT_S and not _for_scripts:
            told = now
            complain(f"{text}, {now - began:.0f} s")
            sys.stderr.flush()

    yield beat


class _Lines:
    """Progress where there is no terminal: a line every `HEARTBEAT_S` seconds, from a thread of its own."""

    def __init__(self, label: str) -> None:
        self.label, self.began, self.text = label, time.monotonic(), ""
        self.ended = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def told(self, done: float, total: float | None, what: str = "") -> None:
        share = "" if not total else f" {done:.{0 if done == int(done) else 1}f} of {total:.0f}"
        spent = time.monotonic() - self.began
        left = f", about {spent * (total - done) / done:.0f} s left" if total and 0 < done < total else ""
        self.text = f"{share}{left}" + (f" ({what})" if what else "")

    def _run(self) -> None:
        while not self.ended.wait(HEARTBEAT_S):
            complain(f"{self.label}{':' * bool(self.text)}{self.text}, {time.monotonic() - self.began:.0f} s so far")
            sys.stderr.flush()


Advance = Callable[..., None]
"""Called with what is done, the total (None if unknown) and, if there is more to say, what is going on."""


@contextmanager
def progress(label: str, *, unit: str = "") -> Iterator[Advance]:
    """A progress bar on standard error where that is a terminal; elsewhere a line every `HEARTBEAT_S` seconds.

    With ``--json`` there is neither: a script that keeps standard error finds nothing but errors there.

    Yields:
        See `Advance`.
    """
    if _for_scripts:
        yield lambda *_: None
        return
    if not sys.stderr.isatty():
        lines = _Lines(label)
        try:
            yield lines.told
        finally:
            lines.ended.set()
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    amount = DownloadColumn() if unit == "bytes" else TextColumn("{task.completed:.0f}/{task.total:.0f}")
    columns = [TextColumn("{task.description}", markup=False), BarColumn(), amount, TimeRemainingColumn()]
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(label), total=1)

        def told(done: float, total: float | None, what: str = "") -> None:
            shown = f"{label}: {what}" if what else label
            total = total if total is not None else done + 1
            bar.update(task, completed=done, total=total, description=printable(shown))

        yield told


@contextmanager
def drawn_download(name: str) -> Iterator[Report]:
    """`progress` of one file's download, for `core.download.show_downloads`."""
    with progress(name, unit="bytes") as advance:
        yield lambda state: advance(state.done, state.total)


def _texts(values: Sequence[object]) -> Sequence[str]:
    """The cells of a column: `_text` of each, a long column of plain words or numbers at once."""
    kinds = set(map(type, values))
    if kinds == {str} and "".join(cast("Sequence[str]", values)).isprintable():
        return cast("Sequence[str]", values)
    if kinds == {float}:
        return [f"{value:.4g}" for value in values]
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
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)
