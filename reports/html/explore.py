"""The exploring part of a report: a page for every run, the pictures of frames, and the table that leads to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import astuple, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol

from ..model.board import Board
from ..model.common import representatives
from ..model.crew import JOB, Crew, Heard
from ..model.rows import Loaded, LoadedRun
from .explore_data import FrameSummary, FrameSums, explore_content, summarise
from .page import render_run_page
from .pictures import PictureBook
from .run_data import MOST_FRAMES, run_content
from .run_frames import exact_shares, read_frames
from .side_files import write_side

RUN_PAGE = "run.html"
PICTURE_SECONDS = 12.0
"""Time that drawing pictures may take of the making of one report; the next one goes on there."""

MOST_PAGES = 5000
"""Runs of which all have a page of their own unless something else is asked for."""
FEWER_PAGES = 2000
"""Pages of a report of more runs than that: those of the median run of every cell, and others up to this number."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Explored:
    """What was written.

    Attributes:
        pages: Runs that have a page.
        pictured: Runs of which pictures are shown.
        notes: Which runs have no page, and why some frames have no picture, in words.
    """

    pages: int
    pictured: int
    notes: list[str]


@dataclass
class Pages:
    """What was written of some runs.

    Attributes:
        frames: Of each run what the exploring table needs of its frames.
        pictured: Ids of the runs of which pictures are shown.
        missing: Why some frames have none, with their number.
    """

    frames: list[FrameSummary] = field(default_factory=list)
    pictured: set[str] = field(default_factory=set)
    missing: Counter[str] = field(default_factory=Counter)

    def answer(self) -> list[Any]:
        """The same as a helper's answer."""
        return [[astuple(each) for each in self.frames], sorted(self.pictured), self.missing]

    @classmethod
    def of(cls, answer: Sequence[Any]) -> Pages:
        """What a helper has answered."""
        frames, pictured, missing = answer
        return cls([FrameSummary(*each) for each in frames], set(pictured), Counter(missing))

    def note(self) -> str:
        """Why some frames have no picture, in words; empty if all have them."""
        reasons = "; ".join(f"{count} frames: {reason}" for reason, count in self.missing.items())
        return f"Frames without a picture: {reasons}." if reasons else ""


def write_explore(
    board: Board,
    loaded: Loaded,
    protocol: Protocol,
    output: Path,
    *,
    title: str,
    picture_seconds: float = PICTURE_SECONDS,
    most_frames: int = MOST_FRAMES,
    most_pages: int | None = None,
    progress: Progress | None = None,
    crew: Crew | None = None,
) -> Explored:
    """Write ``run.html``, ``data/`` and ``frames/`` of a report.

    Pictures are shown for the run with the median error of every cell, and for every run that failed.

    Args:
        board: The board.
        loaded: The runs.
        protocol: How errors are computed.
        output: Folder of the report.
        title: Title of the report.
        picture_seconds: Time that opening sequences and drawing pictures may take.
        most_frames: Frames of a run that its page shows; of longer ones every second, third, ...
        most_pages: Runs that have a page, those with the median error of their cell first; None for `pages_for`.
        progress: Told of the runs that are done, and of all.
        crew: Helpers that write the pages; None to write them here.

    Raises:
        DynslamError: The folder cannot be written, or a run's files are damaged.
    """
    typical = {run.row.run_id for name in board.sequences for run in representatives(board, name, loaded).values()}
    paged = _paged(board, loaded, typical, most_pages)
    shown = (typical | {row.run_id for row in board.rows if row.failed}) & {run.row.run_id for run in paged}
    runs = sorted(paged, key=lambda run: (run.row.run_id not in shown, run.row.column_id))
    done = 0

    def told(count: int, _what: str) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, len(runs))

    pieces = _pieces(runs, shown)
    known = _shares(pieces)
    if crew is None:
        book = PictureBook(output, picture_seconds)
        written = [
            write_pages(piece, shown, share, protocol, book, most_frames, lambda: told(1, ""))
            for piece, share in zip(pieces, known, strict=True)
        ]
    else:
        written = _written(pieces, shown, known, crew, told)
    sums, total = _summed(pieces, written)
    pageless, with_page = _pageless(len(runs), len(loaded.runs)), {run.row.run_id for run in runs}
    write_side(output, "explore", explore_content(board, protocol, sums, with_page, total.pictured, pageless))
    write_atomic(output / RUN_PAGE, render_run_page(title))
    return Explored(len(runs), len(total.pictured), [note for note in (pageless, total.note()) if note])


def _written(
    pieces: Sequence[Sequence[LoadedRun]],
    shown: Set[str],
    shares: Sequence[Mapping[int, float]],
    crew: Crew,
    told: Heard,
) -> list[Pages]:
    """What the helpers write."""
    jobs = [
        {"runs": [run.as_job() for run in piece], "shown": [*shown & {run.row.run_id for run in piece}], "share": share}
        for piece, share in zip(pieces, shares, strict=True)
    ]
    return [Pages.of(answer) for answer in crew.work("pages", jobs, told)]


def _summed(pieces: Sequence[Sequence[LoadedRun]], written: Sequence[Pages]) -> tuple[FrameSums, Pages]:
    """What all frames say together, and all that was written but the frames."""
    sums, total = FrameSums(), Pages()
    for piece, pages in zip(pieces, written, strict=True):
        for run, frames in zip(piece, pages.frames, strict=True):
            sums.add(run.row, frames)
        total.pictured |= pages.pictured
        total.missing += pages.missing
    return sums, total


def pages_for(runs: int, typical: int) -> int:
    """How many pages a report has where nobody asks for another number: of very many runs most are never opened.

    Args:
        runs: Runs of the report.
        typical: Those of them with the median error of their cell.
    """
    return runs if runs <= MOST_PAGES else min(max(FEWER_PAGES, typical), MOST_PAGES)


def _paged(board: Board, loaded: Loaded, typical: Set[str], most: int | None) -> list[LoadedRun]:
    """The runs that have a page: the typical one of every cell, then its first, its second, ... repeat."""
    most = pages_for(len(loaded.runs), len(typical)) if most is None else most
    if len(loaded.runs) <= most:
        return loaded.runs
    cells = [cell.rows for cells in board.cells.values() for cell in cells.values()]
    turn = {row.run_id: at for rows in cells for at, row in enumerate(rows)} | dict.fromkeys(typical, -1)
    return sorted(loaded.runs, key=lambda run: turn[run.row.run_id])[:most]


def _pageless(pages: int, runs: int) -> str:
    """Which runs have no page, in words; empty if all have one."""
    if pages == runs:
        return ""
    return (
        f"{runs - pages} of {runs} runs have no page of their own, and their frames stand in no figure: pages are made "
        f"of {pages}, those with the median error of their cell first (`report --most-pages {runs}` makes all). "
        "Every number of the tables counts all runs."
    )


def _pieces(runs: Sequence[LoadedRun], shown: Collection[str]) -> list[list[LoadedRun]]:
    """The runs in pieces of one column each, those with pictures and those without apart."""
    by_column = groupby(runs, lambda run: (run.row.run_id in shown, run.row.column_id))
    groups = [list(group) for _, group in by_column]
    return [group[at : at + JOB] for group in groups for at in range(0, len(group), JOB)]


def write_pages(
    runs: Sequence[LoadedRun],
    shown: Collection[str],
    share: Mapping[int, float],
    protocol: Protocol,
    book: PictureBook,
    most_frames: int,
    told: Callable[[], None],
) -> Pages:
    """Write the pages of some runs of one column.

    Args:
        runs: The runs.
        shown: Ids of runs of which pictures are shown.
        share: Exact share of dynamic pixels of the column's frames, without offset.
        protocol: How errors are computed.
        book: Draws the pictures.
        most_frames: As in `write_explore`.
        told: Called after every run.
    """
    pages = Pages()
    runs = [replace(run) for run in runs]  # with records that go when these pages are written
    for run, frames in zip(runs, read_frames(runs, share), strict=True):
        write_side(
            book.output, f"run-{run.row.run_id}", run_content(run, frames, protocol, run.ground_truth(), most_frames)
        )
        exact = frames.share_source == "exact masks"
        known = summarise(run.row, frames.errors_m, frames.share, exact) if len(frames) else FrameSummary([], [], [])
        pages.frames.append(known)
        if run.row.run_id in shown and book.add(run, frames, pages.missing):
            pages.pictured.add(run.row.run_id)
        told()
    return pages


def _shares(pieces: Sequence[Sequence[LoadedRun]]) -> list[dict[int, float]]:
    """For each piece the exact share of dynamic pixels of its column's frames, as far as a run has recorded it."""
    by_column: dict[str, list[LoadedRun]] = {}
    newest = sorted((run for piece in pieces for run in piece), key=lambda run: run.row.started, reverse=True)
    for run in sorted(newest, key=lambda run: run.row.offset):  # older versions recorded no share
        by_column.setdefault(run.row.column_id, []).append(run)
    known = {column: exact_shares(some) for column, some in by_column.items()}
    return [known[piece[0].row.column_id] for piece in pieces]
