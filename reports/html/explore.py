"""The exploring part of a report: a page for every run, the pictures of frames, and the table that leads to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import astuple, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.figures import COLOURS, significant
from dynslam_bench.reports.html.page import render_run_page, write_side
from dynslam_bench.reports.html.pictures import PictureBook
from dynslam_bench.reports.html.run_page import MOST_FRAMES, exact_shares, read_frames, run_content
from dynslam_bench.reports.model.board import Board, Cell
from dynslam_bench.reports.model.common_frames import representatives
from dynslam_bench.reports.model.load import JOB, Crew, Heard, Loaded, LoadedRun
from dynslam_bench.reports.model.row import SEEN, RunRow
from dynslam_bench.reports.tables.leaderboard import middle, rank_cell, timed

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


# What the exploring part of the page knows of all runs: trackers, sequences, every run's numbers, in few bytes.

Array = NDArray[np.float64]

SHARE_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0)
"""Bins of the share of dynamic pixels."""
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""
FEWEST_FRAMES = 5
"""Frames below which a bin shows nothing."""


@dataclass(frozen=True)
class FrameSummary:
    """What the exploring part shows of the frames of one run.

    Attributes:
        quartiles_mm: The 5, 25, 50, 75 and 95 % quantiles of its frame-to-frame errors; empty where there are none.
        shares: Share of dynamic pixels of frames, where exact masks tell it; only those compare trackers.
        errors_m: Their frame-to-frame translational errors.
    """

    quartiles_mm: list[float | None]
    shares: list[float]
    errors_m: list[float]


def summarise(row: RunRow, errors_m: Array, share: Array, exact: bool) -> FrameSummary:
    """The frames of one run.

    Args:
        row: The run.
        errors_m: Frame-to-frame translational errors ``[N]``, nan where there is none.
        share: Share of dynamic pixels ``[N]``.
        exact: Whether that is known from exact masks.
    """
    known = np.isfinite(errors_m)
    if not known.any():
        return FrameSummary([], [], [])
    five = [significant(1000 * value, 4) for value in np.percentile(errors_m[known], [5, 25, 50, 75, 95]).tolist()]
    both = known & np.isfinite(share) & (exact and not row.failed)
    return FrameSummary(five, share[both].tolist(), errors_m[both].tolist())


class FrameSums:
    """What the exploring part shows of all frames: quartiles of the runs' errors, and errors by dynamic share."""

    def __init__(self) -> None:
        self.quartiles: dict[str, list[float | None]] = {}
        self._shares: dict[str, list[float]] = {}
        self._errors: dict[str, list[float]] = {}

    def add(self, row: RunRow, frames: FrameSummary) -> None:
        """Take the frames of one run."""
        if frames.quartiles_mm:
            self.quartiles[row.run_id] = frames.quartiles_mm
        if frames.shares:
            self._shares.setdefault(row.variant_key, []).extend(frames.shares)
            self._errors.setdefault(row.variant_key, []).extend(frames.errors_m)

    def by_share(self, key: str) -> list[list[float | None]]:
        """RMSE in mm and number of frames of each bin between `SHARE_EDGES`, of one tracker; empty for none.

        Not the median: a tracker that follows people errs grossly on few frames, and best of all on most.
        """
        if key not in self._shares:
            return []
        share, error = np.array(self._shares[key]), np.array(self._errors[key])
        at = np.clip(np.searchsorted(SHARE_EDGES, share, side="right") - 1, 0, len(SHARE_EDGES) - 2)
        found: list[list[float | None]] = []
        for number in range(len(SHARE_EDGES) - 1):
            inside = error[at == number]
            rmse_mm = 1000 * float(np.sqrt(np.mean(inside**2))) if len(inside) >= FEWEST_FRAMES else None
            found.append([significant(rmse_mm, 4), len(inside)])
        return found


def explore_content(
    board: Board,
    protocol: Protocol,
    sums: FrameSums,
    paged: Collection[str],
    pictured: Collection[str],
    pageless: str = "",
) -> dict[str, Any]:
    """What ``data/explore.js`` holds.

    Args:
        board: The board.
        protocol: How errors were computed.
        sums: What the frames say.
        paged: Ids of the runs that have a page.
        pictured: Ids of those that have pictures.
        pageless: Which runs have no page, in words.
    """
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    names = [*board.sequences, *board.unscored]
    column = {name: at for at, name in enumerate(names)}
    metrics = _metrics(protocol)
    listed = _listed(board, paged)
    kept = {row.run_id for cells in board.cells.values() for cell in cells.values() for row in cell.kept}
    runs = []
    for row in sorted(listed, key=lambda r: (place[r.variant_key], column[board.sequence(r)], r.repeat_key)):
        values = [significant(_value(row, metric), 5) for metric in metrics]
        flags = (row.run_id in kept) + 2 * (row.run_id in pictured) + 4 * (row.run_id not in paged)
        five = sums.quartiles.get(row.run_id)
        where = [row.run_id, place[row.variant_key], column[board.sequence(row)], row.repeat]
        runs.append([*where, row.ending, flags, values, five or []])
    tags: dict[str, set[str]] = {}
    for row in board.rows:
        tags.setdefault(board.sequence(row), set()).update(row.tags)
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
        "still": [significant(board.static_camera.get(name), 5) for name in names],
        "cells": [
            [at, column[name], *_cell(cell, metrics, board.rank_seen)]
            for key, at in place.items()
            for name, cell in board.cells[key].items()
        ],
        "runs": runs,
        "unlisted": len(board.rows) - len(listed),
        "shareEdges": SHARE_EDGES,
        "byShare": {place[key]: found for key in keys if (found := sums.by_share(key))},
    }


def _listed(board: Board, paged: Collection[str]) -> list[RunRow]:
    """The rows that are listed one by one: a page of a hundred thousand would open slowly, and nobody reads them."""
    if len(board.rows) <= MOST_LISTED:
        return board.rows
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    return [row for row in board.rows if row.run_id in paged or row.run_id in first]


def _cell(cell: Cell, metrics: Sequence[Mapping[str, str]], rank_seen: bool) -> list[Any]:
    """How many runs of a cell there are and failed, what speaks against it, and the median of every number."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (cell.seen and not rank_seen)
    values = [[_value(row, metric) for row in cell.kept] for metric in metrics]
    medians = [middle(value for value in some if value is None or np.isfinite(value)) for some in values]
    return [len(cell.rows), cell.failed, doubt, [significant(value, 5) for value in medians]]


def _tracker(board: Board, key: str, at: int) -> dict[str, Any]:
    runs, first = board.runs(key), board.first(key)
    standing = next((found for found in board.standings if found.key == key), None)
    ended = [row for row in runs if not row.failed]
    counts = Counter(row.failed for row in runs)
    return {
        "label": board.labels[key],
        "id": first.tracker,
        "ranked": key in board.ranked,
        "imported": first.imported,
        "provenance": first.provenance,
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
    found = [
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
        for kind, name, unit, key in found
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] != row.trajectory:
        return None if row.failed else row.final_metrics.get(metric["key"])
    if metric["kind"] == "ate":
        return row.score_m
    return None if row.failed else row.metrics.get(metric["key"])
