"""The index page of a bank: its sequences, trackers, protocol and rows, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core import RunError, read_text, write_atomic
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.bank import Bank, check_sound
from dynslam_bench.runs.bank_files import Mark, read_description, read_marks, standing
from dynslam_bench.runs.record import RunRecord, coverage_text

INDEX_PAGE = "README.md"
"""The page; hosts of git repositories show it below the list of files."""
_MADE = "<!-- made by: dynslam-bench bank index -->"
"""The first line of the page: a page without it was written by a person, and stays."""


@dataclass(frozen=True)
class BankRow:
    """A row of a bank.

    Attributes:
        run_id: Its id.
        tracker: Name of its tracker.
        sequence: Id of its sequence.
        repeat: Which repeat it is.
        status: How the run ended.
        standing: ``own``, ``imported`` or ``reproduced by N``.
        ate_m: Its error under the bank's protocol, metres; None where it has none.
        coverage: Share of the frames with a pose; None where it is not known.
        marks: Who has run it again, a line each.
    """

    run_id: str
    tracker: str
    sequence: str
    repeat: str
    status: str
    standing: str
    ate_m: float | None
    coverage: float | None
    marks: list[str]


def bank_rows(bank: str | Path) -> list[BankRow]:
    """The rows of a bank in order of sequences, trackers and repeats, scored under its protocol.

    Raises:
        RunError: It is no bank, or has faults.
    """
    check_sound(bank)
    store = Bank(bank)
    protocol = read_description(store.root).protocol
    marks, _ = read_marks(store.root)
    rows = [_row(store, record, protocol, marks) for record in store.all()[0]]
    return sorted(rows, key=lambda row: (row.sequence, row.tracker, row.repeat, row.run_id))


def _row(store: Bank, record: RunRecord, protocol: str, marks: dict[str, list[Mark]]) -> BankRow:
    """A row of a bank with its error."""
    error = None
    if record.status != "stopped":
        error = store.score(record, protocol).metrics.get("ate_rmse_m")
    return BankRow(
        run_id=record.run_id,
        tracker=record.tracker.label,
        sequence=record.sequence.id,
        repeat=record.repeat,
        status=record.status,
        standing=standing(record, marks),
        ate_m=error,
        coverage=record.coverage,
        marks=[mark.describe() for mark in marks.get(record.run_id, ())],
    )


def write_bank_index(bank: str | Path) -> tuple[Path, list[BankRow]]:
    """Write the index page of a bank; returns the page and the bank's rows.

    Raises:
        RunError: It is no bank, has faults, or has a page that a person wrote.
        DynslamError: It cannot be written.
    """
    rows = bank_rows(bank)
    store = Bank(bank)
    page = store.root / INDEX_PAGE
    if page.is_file() and not read_text(page).startswith(_MADE):
        raise RunError(f"{page} was not made by this command, and stays", "rename it")
    write_atomic(page, _page(store, rows))
    return page, rows


def _page(store: Bank, rows: Sequence[BankRow]) -> str:
    """The page as Markdown."""
    records = list(store.all()[0])
    description = read_description(store.root)
    protocol = get_protocol(description.protocol)
    lines = [_MADE, f"# {store.root.name}", ""]
    lines += [f"{len(rows)} rows. Errors are under `{protocol.id}`.", ""]

    lines += ["## Protocol", ""]
    lines += _table(
        ("protocol", "digest", "meaning"), [(protocol.id, protocol.digest(), protocol.describe())]
    )
    lines += ["## Sequences", ""]
    headings = ["sequence", "rows", "trackers", "split", "licence", "cite"]
    lines += _table(headings, _sequence_rows(records))
    lines += ["## Trackers", ""]
    headings = ["tracker", "id", "rows", "provenance", "licence", "cite"]
    lines += _table(headings, _tracker_rows(records))
    lines += ["## Rows", ""]
    headings = ["sequence", "tracker", "repeat", "status", "ATE (mm)"]
    headings += ["coverage", "row", "standing"]
    cells = [
        (
            row.sequence,
            row.tracker,
            row.repeat,
            row.status,
            "" if row.ate_m is None else f"{1000 * row.ate_m:.3f}",
            coverage_text(row.coverage),
            row.run_id,
            row.standing,
        )
        for row in rows
    ]
    lines += _table(headings, cells)
    marked = [row for row in rows if row.marks]
    if marked:
        lines += ["## Marks", ""]
        lines += _table(
            ("row", "mark"), [(row.run_id, mark) for row in marked for mark in row.marks]
        )
    return "\n".join(lines).rstrip("\n") + "\n"


def _sequence_rows(records: Iterable[RunRecord]) -> list[tuple[str, ...]]:
    """A row for each sequence, in order of their ids."""
    of_sequence: dict[str, list[RunRecord]] = {}
    for record in records:
        of_sequence.setdefault(record.sequence.id, []).append(record)
    rows: list[tuple[str, ...]] = []
    for name, runs in sorted(of_sequence.items()):
        first = runs[0].sequence
        trackers = sorted({run.tracker.label for run in runs})
        rows.append(
            (name, str(len(runs)), ", ".join(trackers), first.split, first.license, first.citation)
        )
    return rows


def _tracker_rows(records: Iterable[RunRecord]) -> list[tuple[str, ...]]:
    """A row for each tracker, in order of their names."""
    of_tracker: dict[str, list[RunRecord]] = {}
    for record in records:
        of_tracker.setdefault(record.tracker.label, []).append(record)
    rows: list[tuple[str, ...]] = []
    for name, runs in sorted(of_tracker.items()):
        first = runs[0].tracker
        rows.append(
            (name, first.id, str(len(runs)), first.provenance, first.license, first.citation)
        )
    return rows


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """A table of Markdown, with an empty line after it."""
    headings = list(columns)
    lines = [f"| {' | '.join(headings)} |", f"| {' | '.join('---' for _ in headings)} |"]
    for row in rows:
        cells = [" ".join(cell.split()).replace("|", "\\|") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]
