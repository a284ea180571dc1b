"""What commands write: tables for people, JSON for scripts, progress only where somebody watches."""

from __future__ import annotations

import json
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from dynslam_bench.core.download_progress import Report
from dynslam_bench.core.harmless import printable

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


def complain(text: str) -> None:
    """Write a line to standard error, whoever watches: what was asked for and cannot be had; harmless as in `write`."""
    sys.stderr.write(printable(text) + "\n")


def write_json(value: Any) -> None:
    """Write a value as JSON; pydantic models and paths included."""
    sys.stdout.write(json.dumps(value, indent=2, default=_plain) + "\n")


def write_table(columns: Sequence[str], rows: Sequence[Sequence[object]], *, shrink: Sequence[str] = ()) -> None:
    """Write a table as aligned text; nothing is cut off, whatever the terminal's width.

    Args:
        columns: Headings.
        rows: Cells.
        shrink: Columns of long text that may be shortened, the first one first, to fit a terminal; where the output
            is none, they are whole.
    """
    cells = [list(columns), *([_text(value) for value in row] for row in rows)]
    if sys.stdout.isatty():
        cells = fitted(cells, [columns.index(name) for name in shrink if name in columns], _terminal_width())
    head, *body = aligned(cells).split("\n")
    sys.stdout.write(f"\033[1m{head}\033[0m\n" if sys.stdout.isatty() else f"{head}\n")
    for line in body:
        write(line)


def fitted(rows: list[list[str]], columns: Sequence[int], width: int, least: int = 12) -> list[list[str]]:
    """Rows with the named columns shortened, one after the other, until a line has at most `width` characters."""
    rows = [list(row) for row in rows]
    for column in columns:
        widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
        over = sum(widths) + 2 * (len(widths) - 1) - width
        if over <= 0:
            break
        room = max(widths[column] - over, least)
        for row in rows:
            if len(row[column]) > room:
                row[column] = row[column][: room - 1] + "…"
    return rows


def _terminal_width() -> int:
    return shutil.get_terminal_size().columns


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text with their columns under each other."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


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
        share = "" if not total else f" {done:.1f} of {total:.0f}"
        spent = time.monotonic() - self.began
        left = f", about {spent * (total - done) / done:.0f} s left" if total and 0 < done < total else ""
        self.text = f"{share}{left}" + (f" ({what})" if what else "")

    def _run(self) -> None:
        while not self.ended.wait(HEARTBEAT_S):
            complain(f"{self.label}:{self.text}, {time.monotonic() - self.began:.0f} s so far")
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


def _text(value: object) -> str:
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
