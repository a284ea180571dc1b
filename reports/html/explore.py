"""The exploring part of a report: a page for every run, the pictures of frames, and the table that leads to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.frame_row import CSV_FILE

from ..model.board import Board
from ..model.common import representatives
from ..model.rows import Loaded
from .explore_data import FrameSums, explore_content
from .page import render_run_page
from .pictures import PictureBook
from .run_data import exact_share, read_frames, run_content
from .side_files import write_side

RUN_PAGE = "run.html"
PICTURE_SECONDS = 12.0
"""Time that drawing pictures may take of the making of one report; the next one goes on there."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Explored:
    """What was written.

    Attributes:
        pages: Runs that have a page.
        pictured: Runs of which pictures are shown.
        note: Why some frames have none, in words; empty if all have them.
    """

    pages: int
    pictured: int
    note: str


def write_explore(
    board: Board,
    loaded: Loaded,
    protocol: Protocol,
    output: Path,
    *,
    title: str,
    picture_seconds: float = PICTURE_SECONDS,
    progress: Progress | None = None,
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
        progress: Told of the runs that are done, and of all.

    Raises:
        DynslamError: The folder cannot be written, or a run's files are damaged.
    """
    book, sums = PictureBook(output, picture_seconds), FrameSums()
    shown = {run.row.run_id for name in board.sequences for run in representatives(board, name, loaded).values()}
    shown |= {row.run_id for row in board.rows if row.failed}
    shares = _shares(loaded)
    for done, run in enumerate(sorted(loaded.runs, key=lambda run: run.row.run_id not in shown)):
        frames = read_frames(run, shares.get(run.row.column_id, {}))
        write_side(output, f"run-{run.row.run_id}", run_content(run, frames, protocol, run.ground_truth()))
        if len(frames):
            sums.add(run.row, frames.errors_m, frames.share, frames.share_source == "exact masks")
        if run.row.run_id in shown:
            book.add(run, frames)
        if progress is not None:
            progress(done + 1, len(loaded.runs))
    write_side(output, "explore", explore_content(board, protocol, sums, book.runs))
    write_atomic(output / RUN_PAGE, render_run_page(title))
    return Explored(len(loaded.runs), len(book.runs), book.note())


def _shares(loaded: Loaded) -> dict[str, dict[int, float]]:
    """The exact share of dynamic pixels of every frame, by column, from whichever run has recorded it."""
    found: dict[str, dict[int, float]] = {}
    for run in sorted(loaded.runs, key=lambda run: run.record.offset):
        if run.row.column_id not in found:
            known = exact_share(run.store.folder(run.row.run_id) / CSV_FILE, run.record.offset)
            if known:
                found[run.row.column_id] = known
    return found
