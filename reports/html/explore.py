"""The exploring part of a report: a page for every run, the pictures of frames, and the table that leads to them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.files import write_atomic
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.figures import COLOURS, significant
from dynslam_bench.reports.html.page import render_run_page, write_side
from dynslam_bench.reports.html.run_page import MOST_FRAMES, PictureBook, exact_shares, read_frames, run_content
from dynslam_bench.reports.model.board import Board, Cell
from dynslam_bench.reports.model.load import JOB, run_jobs
from dynslam_bench.reports.model.row import SEEN, RunRow
from dynslam_bench.reports.tables.leaderboard import middle, rank_cell, timed

Array = NDArray[np.float64]

RUN_PAGE = "run.html"
PICTURE_SECONDS = 12.0
"""Time that drawing pictures may take of the making of one report; the next one goes on there."""
MOST_PAGES = 5000
"""Runs of which all have a page of their own unless something else is asked for."""
FEWER_PAGES = 2000
"""Pages of a report of more runs than that: those of the median run of every cell, and others up to this number."""
SHARE_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0)
"""Bins of the share of dynamic pixels."""
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""
FEWEST_FRAMES = 5
"""Frames below which a bin shows nothing."""


@dataclass
class Pages:
    """What was written of some runs, and what the exploring table needs of their frames.

    Attributes:
        pages: Ids of the runs that have a page.
        pictured: Ids of the runs of which pictures are shown.
        missing: Why some frames have none, with their number.
        notes: Which runs have no page, and why some frames have no picture, in words.
        quartiles_mm: Run id to the 5, 25, 50, 75 and 95 % quantiles of its frame-to-frame errors.
        shares: Variant key to the share of dynamic pixels of its successful runs' frames, where exact masks tell it.
        errors_m: Variant key to the frame-to-frame translational errors of these frames.
    """

    pages: set[str] = field(default_factory=set)
    pictured: set[str] = field(default_factory=set)
    missing: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    quartiles_mm: dict[str, list[float | None]] = field(default_factory=dict)
    shares: dict[str, list[float]] = field(default_factory=dict)
    errors_m: dict[str, list[float]] = field(default_factory=dict)

    def add_frames(self, row: RunRow, errors_m: Array, share: Array, exact: bool) -> None:
        """Take the frames of one run.

        Args:
            row: The run.
            errors_m: Frame-to-frame translational errors ``[N]``, nan where there is none.
            share: Share of dynamic pixels ``[N]``.
            exact: Whether that is known from exact masks.
        """
        finite = np.isfinite(errors_m)
        if finite.any():
            quartiles_mm = 1000 * np.percentile(errors_m[finite], [5, 25, 50, 75, 95])
            self.quartiles_mm[row.run_id] = [significant(value, 4) for value in quartiles_mm.tolist()]
        both = finite & np.isfinite(share)
        if exact and not row.failed and both.any():
            self.shares.setdefault(row.variant_key, []).extend(share[both].tolist())
            self.errors_m.setdefault(row.variant_key, []).extend(errors_m[both].tolist())

    def add(self, other: Pages) -> None:
        """Take what was written of other runs."""
        self.pages |= other.pages
        self.pictured |= other.pictured
        self.missing += other.missing
        self.quartiles_mm |= other.quartiles_mm
        for mine, theirs in ((self.shares, other.shares), (self.errors_m, other.errors_m)):
            for key, values in theirs.items():
                mine.setdefault(key, []).extend(values)

    def by_share(self, key: str) -> list[list[float | None]]:
        """RMSE in mm and number of frames of each bin between `SHARE_EDGES`, of one tracker; empty for none.

        Not the median: a tracker that follows people errs grossly on few frames, and best of all on most.
        """
        if key not in self.shares:
            return []
        share, error = np.array(self.shares[key]), np.array(self.errors_m[key])
        at = np.clip(np.searchsorted(SHARE_EDGES, share, side="right") - 1, 0, len(SHARE_EDGES) - 2)
        bins: list[list[float | None]] = []
        for number in range(len(SHARE_EDGES) - 1):
            inside = error[at == number]
            rmse_mm = 1000 * float(np.sqrt(np.mean(inside**2))) if len(inside) >= FEWEST_FRAMES else None
            bins.append([significant(rmse_mm, 4), len(inside)])
        return bins


def write_explore(
    board: Board,
    protocol: Protocol,
    output: Path,
    *,
    title: str,
    picture_seconds: float = PICTURE_SECONDS,
    most_frames: int = MOST_FRAMES,
    most_pages: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    pool: Executor | None = None,
) -> Pages:
    """Write ``run.html``, ``data/`` and ``frames/`` of a report.

    Pictures are shown for the run with the median error of every cell, and for every run that failed.

    Args:
        board: The board.
        protocol: How errors are computed.
        output: Folder of the report.
        title: Title of the report.
        picture_seconds: Time that opening sequences and drawing pictures may take, in each process.
        most_frames: Frames of a run that its page shows; of longer ones every second, third, ...
        most_pages: Runs that have a page, those with the median error of their cell first; None for `pages_for`.
        progress: Called with the runs that are done, and all.
        pool: Workers that write the pages; None to write them here.

    Raises:
        DynslamError: The folder cannot be written, or a run's files are damaged.
    """
    typical = {row.run_id for name in board.sequences for row in board.typical_runs(name).values()}
    paged = _paged(board, typical, most_pages)
    failed = {row.run_id for row in paged if row.failed}
    shown = (typical | failed) & {row.run_id for row in paged}
    pieces = _pieces(paged, shown)
    book = str(output), picture_seconds, time.time_ns()  # a book of each process and report
    jobs = [
        (piece, shown & {row.run_id for row in piece}, share, protocol, book, most_frames)
        for piece, share in zip(pieces, _shares(pieces), strict=True)
    ]
    done = 0

    def on_answer(pages: Pages) -> None:
        nonlocal done
        done += len(pages.pages)
        progress(done, len(paged))

    total = Pages()
    for pages in run_jobs(pool, write_pages, jobs, on_answer):
        total.add(pages)
    pageless = _pageless(len(paged), len(board.rows))
    reasons = "; ".join(f"{count} frames: {reason}" for reason, count in total.missing.items())
    pictureless = f"Frames without a picture: {reasons}." if reasons else ""
    total.notes = [note for note in (pageless, pictureless) if note]
    write_side(output, "explore", explore_content(board, protocol, total, pageless))
    write_atomic(output / RUN_PAGE, render_run_page(title))
    return total


def pages_for(runs: int, typical: int) -> int:
    """How many pages a report has where nobody asks for another number: of very many runs most are never opened.

    Args:
        runs: Runs of the report.
        typical: Those of them with the median error of their cell.
    """
    return runs if runs <= MOST_PAGES else min(max(FEWER_PAGES, typical), MOST_PAGES)


def _paged(board: Board, typical: Set[str], most: int | None) -> list[RunRow]:
    """The runs that have a page: the typical one of every cell, then its first, its second, ... repeat."""
    most = pages_for(len(board.rows), len(typical)) if most is None else most
    if len(board.rows) <= most:
        return board.rows
    cells = [cell.rows for cells in board.cells.values() for cell in cells.values()]
    turn = {row.run_id: at for rows in cells for at, row in enumerate(rows)} | dict.fromkeys(typical, -1)
    return sorted(board.rows, key=lambda row: turn[row.run_id])[:most]


def _pageless(pages: int, runs: int) -> str:
    """Which runs have no page, in words; empty if all have one."""
    if pages == runs:
        return ""
    return (
        f"{runs - pages} of {runs} runs have no page of their own, and their frames stand in no figure: pages are made "
        f"of {pages}, those with the median error of their cell first (`report --most-pages {runs}` makes all). "
        "Every number of the tables counts all runs."
    )


def _pieces(rows: Sequence[RunRow], shown: Collection[str]) -> list[list[RunRow]]:
    """The runs in pieces of one column each, those with pictures and those without apart."""

    def kind(row: RunRow) -> tuple[bool, str]:
        return row.run_id not in shown, row.column_id

    groups = [list(group) for _, group in groupby(sorted(rows, key=kind), kind)]
    return [group[at : at + JOB] for group in groups for at in range(0, len(group), JOB)]


def write_pages(
    rows: Sequence[RunRow],
    shown: Collection[str],
    share: Mapping[int, float],
    protocol: Protocol,
    book: tuple[str, float, int],
    most_frames: int,
) -> Pages:
    """Write the pages of some runs of one column.

    Args:
        rows: The runs.
        shown: Ids of runs of which pictures are shown.
        share: Exact share of dynamic pixels of the column's frames, without offset.
        protocol: How errors are computed.
        book: Folder of the report, seconds for pictures, and a number of the report.
        most_frames: As in `write_explore`.
    """
    pages, drawn = Pages(), _picture_book(*book)
    for row in rows:
        record, frames = row.store.read_whole(row.run_id), read_frames(row, share)
        content = run_content(row, record, frames, protocol, most_frames)
        write_side(drawn.output, f"run-{row.run_id}", content)
        if len(frames):
            pages.add_frames(row, frames.errors_m, frames.share, frames.share_source == "exact masks")
        if row.run_id in shown and drawn.add(row, record, frames, pages.missing):
            pages.pictured.add(row.run_id)
        pages.pages.add(row.run_id)
    return pages


@lru_cache(maxsize=1)
def _picture_book(output: str, seconds: float, report: int) -> PictureBook:
    return PictureBook(Path(output), seconds)


def _shares(pieces: Sequence[Sequence[RunRow]]) -> list[dict[int, float]]:
    """For each piece the exact share of dynamic pixels of its column's frames, as far as a run has recorded it."""
    by_column: dict[str, list[RunRow]] = {}
    newest = sorted((row for piece in pieces for row in piece), key=lambda row: row.started, reverse=True)
    for row in sorted(newest, key=lambda row: row.offset):
        by_column.setdefault(row.column_id, []).append(row)
    shares = {column: exact_shares(rows) for column, rows in by_column.items()}
    return [shares[piece[0].column_id] for piece in pieces]


def explore_content(board: Board, protocol: Protocol, pages: Pages, pageless: str = "") -> dict[str, Any]:
    """What ``data/explore.js`` holds.

    Args:
        board: The board.
        protocol: How errors were computed.
        pages: The pages of runs, and what their frames say.
        pageless: Which runs have no page, in words.
    """
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    names = [*board.sequences, *board.unscored]
    column = {name: at for at, name in enumerate(names)}
    metrics = _metrics(protocol)
    listed = _listed(board, pages.pages)
    kept = {row.run_id for cells in board.cells.values() for cell in cells.values() for row in cell.kept}
    runs = []
    for row in sorted(listed, key=lambda r: (place[r.variant_key], column[board.sequence(r)], r.repeat_key)):
        values = [significant(_value(row, metric), 5) for metric in metrics]
        flags = (row.run_id in kept) + 2 * (row.run_id in pages.pictured) + 4 * (row.run_id not in pages.pages)
        five = pages.quartiles_mm.get(row.run_id)
        where = [row.run_id, place[row.variant_key], column[board.sequence(row)], row.repeat]
        runs.append([*where, row.ending, flags, values, five or []])
    tags: dict[str, set[str]] = {}
    for row in board.rows:
        tags.setdefault(board.sequence(row), set()).update(row.sequence.tags)
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": None if board.reference is None else place[board.reference],
        "referenceName": board.reference_name,
        "metrics": metrics,
        "trackers": [_tracker(board, key, at) for at, key in enumerate(keys)],
        "sequences": [
            {"name": n, "short": board.short.get(n, n), "group": board.groups[n], "tags": sorted(tags[n])}
            for n in names
        ],
        "static": [significant(board.static_camera.get(name), 5) for name in names],
        "cells": [
            [at, column[name], *_cell(cell, metrics, board.rank_seen)]
            for key, at in place.items()
            for name, cell in board.cells[key].items()
        ],
        "runs": runs,
        "unlisted": len(board.rows) - len(listed),
        "shareEdges": SHARE_EDGES,
        "byShare": {place[key]: bins for key in keys if (bins := pages.by_share(key))},
    }


def _listed(board: Board, paged: Collection[str]) -> list[RunRow]:
    """The rows that are listed one by one: a page of a hundred thousand would open slowly, and nobody reads them."""
    if len(board.rows) <= MOST_LISTED:
        return board.rows
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    return [row for row in board.rows if row.run_id in paged or row.run_id in first]


def _cell(cell: Cell, metrics: Sequence[Mapping[str, str]], rank_seen: bool) -> list[Any]:
    """How many runs of a cell there are and failed, what speaks against it, and the median of every number."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (cell.in_training and not rank_seen)
    values = [[_value(row, metric) for row in cell.kept] for metric in metrics]
    medians = [middle(value for value in of_runs if value is None or np.isfinite(value)) for of_runs in values]
    return [len(cell.rows), cell.failed, doubt, [significant(value, 5) for value in medians]]


def _tracker(board: Board, key: str, at: int) -> dict[str, Any]:
    runs, first = board.runs(key), board.first(key)
    standing = next((standing for standing in board.standings if standing.key == key), None)
    ended = [row for row in runs if not row.failed]
    counts = Counter(row.failed for row in runs)
    return {
        "label": board.labels[key],
        "id": first.tracker.id,
        "ranked": key in board.ranked,
        "imported": first.imported,
        "provenance": first.tracker.provenance,
        "colour": COLOURS[at % len(COLOURS)],
        "rank": "–" if standing is None else rank_cell(standing).text,
        "ratio": None if standing is None else significant(standing.ratio.value, 4),
        "success": [counts[False], len(runs)],
        "coverage": significant(float(np.mean([row.coverage for row in runs])), 4),
        "speed": significant(middle(row.real_time_factor for row in timed(ended)), 3),
        "memory": significant(middle(row.peak_memory_mb for row in ended), 4),
    }


def _metrics(protocol: Protocol) -> list[dict[str, str]]:
    """The numbers to choose from: of the online and of the final trajectory."""
    numbers = [
        ("ate", "ATE", "m", "ate_rmse_m"),
        *(
            ("rpe", f"RPE over {spec.describe()}", "m/s" if spec.rate else "m", spec.metric("trans"))
            for spec in protocol.rpe
        ),
        *(
            ("rotation", f"RPE over {spec.describe()}, rotation", "deg/s" if spec.rate else "deg", spec.metric("rot"))
            for spec in protocol.rpe
        ),
        ("rotation", "absolute rotation", "deg", "ape_rot_rmse_deg"),
    ]
    return [
        {"kind": kind, "name": name, "unit": unit, "key": key, "which": which}
        for which in ("online", "final")
        for kind, name, unit, key in numbers
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] != row.trajectory:
        return None if row.failed else row.final_metrics.get(metric["key"])
    if metric["kind"] == "ate":
        return row.score_m
    return None if row.failed else row.metrics.get(metric["key"])
