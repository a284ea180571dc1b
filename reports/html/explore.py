"""The exploring part of a report: a page for every run, the pictures of frames, and the table that leads to them."""

from __future__ import annotations

import base64
import io
import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.contracts.sequence import Sequence as FrameSequence
from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import TABLE_BYTES, read_bytes
from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol, RPESpec
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports.figures import COLOURS, significant
from dynslam_bench.reports.html.page import packed_rows, render_run_page, write_side
from dynslam_bench.reports.model.board import Board, Cell
from dynslam_bench.reports.model.load import JOB, run_jobs
from dynslam_bench.reports.model.row import SEEN, RunRow, command_line, grouped, run_command
from dynslam_bench.reports.tables.leaderboard import DOUBT, middle, rank_cell, timed
from dynslam_bench.runs.artifacts import Snapshot, read_snapshots, spread
from dynslam_bench.runs.exchange.export import open_stored
from dynslam_bench.runs.frames import CSV_FILE
from dynslam_bench.runs.record import RunRecord

Array = NDArray[np.float64]

RUN_PAGE = "run.html"
PICTURE_SECONDS = 12.0
"""Time in which pictures are drawn of the making of one report; the next one goes on there."""
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
MOST_FRAMES = 400
"""Frames of a run that its page shows unless something else is asked for."""
_LOG_BYTES = 20_000
_WHOLE = ("total_s", "processor_s", "read_s")
"""Times of a frame that are no stage of it: the figure stacks stages."""


@dataclass(frozen=True, eq=False)
class RunPage:
    """What the exploring table needs of a run whose page was written.

    Attributes:
        run_id: The run.
        variant_key: Its tracker and settings.
        pictured: Whether pictures of its frames are shown.
        quantiles_mm: The 5, 25, 50, 75 and 95 % quantiles of its frame-to-frame errors; empty for none.
        share: Share of dynamic pixels ``[N]`` of its frames, of a successful run where exact masks tell it.
        errors_m: Frame-to-frame translational errors ``[N]`` of these frames.
    """

    run_id: str
    variant_key: str
    pictured: bool
    quantiles_mm: list[float | None]
    share: Array
    errors_m: Array


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
) -> list[str]:
    """Write ``run.html``, ``data/`` and ``frames/`` of a report.

    Pictures are shown for the run with the median error of every cell, and for every run that failed.

    Args:
        board: The board.
        protocol: How errors are computed.
        output: Folder of the report.
        title: Title of the report.
        picture_seconds: Time after which no further picture is drawn.
        most_frames: Frames of a run that its page shows; of longer ones every second, third, ...
        most_pages: Runs that have a page, those with the median error of their cell first; None for `pages_for`.
        progress: Called with the runs that are done, and all.
        pool: Workers that write the pages; None to write them here.

    Returns:
        Which runs have no page, and why some frames have no picture, in words.

    Raises:
        DynslamError: The folder cannot be written, or a run's files are damaged.
    """
    typical = {row.run_id for name in board.sequences for row in board.typical_runs(name).values()}
    paged = _paged(board, typical, most_pages)
    shown = {row.run_id for row in paged if row.failed or row.run_id in typical}
    newest = sorted(sorted(paged, key=lambda row: row.started, reverse=True), key=lambda row: row.offset)
    shares = {column: exact_shares(rows) for column, rows in grouped(newest, lambda row: row.column_id).items()}
    ordered = sorted(paged, key=lambda row: (row.run_id not in shown, row.column_id))
    deadline = time.time() + picture_seconds
    jobs = []
    for (_, column), rows in grouped(ordered, lambda row: (row.run_id not in shown, row.column_id)).items():
        for first in range(0, len(rows), JOB):
            jobs.append((rows[first : first + JOB], shown, shares[column], protocol, output, deadline, most_frames))
    pages: list[RunPage] = []
    missing: Counter[str] = Counter()
    for written, undrawn in run_jobs(pool, _write_pages, jobs):
        pages += written
        missing += undrawn
        progress(len(pages), len(paged))
    pageless = _pageless(len(paged), len(board.rows))
    write_side(output, "explore", _explore_content(board, protocol, pages, pageless))
    write_atomic(output / RUN_PAGE, render_run_page(title))
    reasons = "; ".join(f"{count} frames: {reason}" for reason, count in missing.items())
    return [note for note in (pageless, f"Frames without a picture: {reasons}." if reasons else "") if note]


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


def _write_pages(
    rows: Sequence[RunRow],
    shown: Collection[str],
    share: Mapping[int, float],
    protocol: Protocol,
    output: Path,
    deadline: float,
    most_frames: int,
) -> tuple[list[RunPage], Counter[str]]:
    """Write the pages of some runs of one column.

    Args:
        rows: The runs.
        shown: Ids of runs of which pictures are shown.
        share: Exact share of dynamic pixels of the column's frames, without offset.
        protocol: How errors are computed.
        output: Folder of the report.
        deadline: Time after which no further picture is drawn, in seconds since the epoch.
        most_frames: As in `write_explore`.

    Returns:
        The pages, and why some frames have no picture, with their number.
    """
    pages, pictures = [], Pictures(output, deadline)
    for row in rows:
        record, frames = row.store.read_whole(row.run_id), read_frames(row, share)
        write_side(output, f"run-{row.run_id}", run_content(row, record, frames, protocol, most_frames))
        pictured = row.run_id in shown and pictures.add(row, record, frames)
        finite = np.isfinite(frames.errors_m)
        quantiles = 1000 * np.percentile(frames.errors_m[finite], [5, 25, 50, 75, 95]) if finite.any() else np.zeros(0)
        exact = finite & np.isfinite(frames.share) & (frames.share_source == EXACT) & (not row.failed)
        quantiles_mm = [significant(value, 4) for value in quantiles.tolist()]
        pages.append(
            RunPage(row.run_id, row.variant_key, pictured, quantiles_mm, frames.share[exact], frames.errors_m[exact])
        )
    return pages, pictures.missing


def error_by_share(pages: Sequence[RunPage]) -> list[list[float | None]]:
    """RMSE in mm and number of frames of each bin between `SHARE_EDGES`, over some runs; empty for no frame.

    Not the median: a tracker that follows people errs grossly on few frames, and best of all on most.
    """
    share = np.concatenate([np.zeros(0), *(page.share for page in pages)])
    errors_m = np.concatenate([np.zeros(0), *(page.errors_m for page in pages)])
    if not len(share):
        return []
    at = np.clip(np.searchsorted(SHARE_EDGES, share, side="right") - 1, 0, len(SHARE_EDGES) - 2)
    bins: list[list[float | None]] = []
    for number in range(len(SHARE_EDGES) - 1):
        inside = errors_m[at == number]
        rmse_mm = 1000 * float(np.sqrt(np.mean(inside**2))) if len(inside) >= FEWEST_FRAMES else None
        bins.append([significant(rmse_mm, 4), len(inside)])
    return bins


def _explore_content(board: Board, protocol: Protocol, pages: Sequence[RunPage], pageless: str) -> dict[str, Any]:
    """What ``data/explore.js`` holds."""
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    names = [*board.sequences, *board.unscored]
    column = {name: at for at, name in enumerate(names)}
    metrics = _metrics(protocol)
    page_of = {page.run_id: page for page in pages}
    kept = {row.run_id for cells in board.cells.values() for cell in cells.values() for row in cell.kept}
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    all_listed = len(board.rows) <= MOST_LISTED  # a page of a hundred thousand would open slowly
    listed = [row for row in board.rows if all_listed or row.run_id in page_of or row.run_id in first]
    runs = []
    for row in sorted(listed, key=lambda r: (place[r.variant_key], column[board.sequence(r)], r.repeat_key)):
        page = page_of.get(row.run_id)
        values = [significant(_value(row, metric), 5) for metric in metrics]
        flags = (row.run_id in kept) + 2 * (page is not None and page.pictured) + 4 * (page is None)
        cell = place[row.variant_key], column[board.sequence(row)]
        runs.append([row.run_id, *cell, row.repeat, row.ending, flags, values, page.quantiles_mm if page else []])
    tags = {
        name: sorted({tag for row in rows for tag in row.sequence.tags})
        for name, rows in grouped(board.rows, board.sequence).items()
    }
    by_tracker = grouped(pages, lambda page: page.variant_key)
    by_share = {place[key]: error_by_share(by_tracker.get(key, [])) for key in keys}
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": None if board.reference is None else place[board.reference],
        "referenceName": board.reference_name,
        "metrics": metrics,
        "trackers": [_tracker(board, key, at) for at, key in enumerate(keys)],
        "sequences": [
            {"name": n, "short": board.short.get(n, n), "group": board.groups[n], "tags": tags[n]} for n in names
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
        "byShare": {at: bins for at, bins in by_share.items() if bins},
    }


def _cell(cell: Cell, metrics: Sequence[Mapping[str, str]], rank_seen: bool) -> list[Any]:
    """How many runs of a cell there are and failed, what speaks against it, and the median of every number."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (cell.in_training and not rank_seen)
    medians = [middle(_value(row, metric) for row in cell.kept) for metric in metrics]
    return [len(cell.rows), cell.failed, doubt, [significant(value, 5) for value in medians]]


def _tracker(board: Board, key: str, at: int) -> dict[str, Any]:
    runs, first = board.runs(key), board.first(key)
    standing = next((standing for standing in board.standings if standing.key == key), None)
    ended = [row for row in runs if not row.failed]
    return {
        "label": board.labels[key],
        "id": first.tracker.id,
        "ranked": key in board.ranked,
        "imported": first.imported,
        "provenance": first.tracker.provenance,
        "colour": COLOURS[at % len(COLOURS)],
        "rank": "–" if standing is None else rank_cell(standing).text,
        "ratio": None if standing is None else significant(standing.ratio.value, 4),
        "success": [len(ended), len(runs)],
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


# -- the page of a run: its facts, its frames over time, its track beside the true one, its log


def run_content(
    row: RunRow, record: RunRecord, frames: RunFrames, protocol: Protocol, most: int = MOST_FRAMES
) -> dict[str, Any]:
    """Everything that the page of a run shows, as the page's script reads it.

    Args:
        row: The run.
        record: Its whole record.
        frames: Its frames.
        protocol: How its errors are computed.
        most: Frames that are shown; of longer runs every second, third, ...
    """
    return {
        "id": row.run_id,
        "status": row.status,
        "ending": row.ending,
        "reason": row.reason,
        "facts": _facts(row, record, protocol.rpe),
        "settings": {
            name: value if isinstance(value, str | int | bool | None) else str(value)
            for name, value in record.settings.items()
        },
        "overrides": sorted(record.overrides),
        "stages": [
            [name, *(significant(1000 * value) for value in (time.median_s, time.p95_s, time.mean_s))]
            for name, time in record.timings.items()
        ],
        "protocol": protocol.describe(),
        "started": row.started,
        "machine": row.machine_words,
        "notes": [*row.notes, *filter(None, [frames.fault])],
        "command": run_command(row),
        "asked": command_line(row.command),
        "log": _log(row),
        "frames": _series(frames, most),
        "track": _track(row, protocol, most),
    }


def _facts(row: RunRow, record: RunRecord, rpe: Sequence[RPESpec]) -> list[list[str | float | None]]:
    """Name, number and unit of what is known of a run."""
    facts: list[tuple[str, float | None, int, str]] = [
        ("ATE, lost frames held", row.score_m, 1000, "mm"),
        ("ATE of the tracked frames", row.metrics.get("ate_rmse_m"), 1000, "mm"),
        ("ATE of the final trajectory", row.final_ate_m, 1000, "mm"),
        *(
            (f"RPE over {spec.describe()}", row.metrics.get(spec.metric("trans")), 1000, "mm/s" if spec.rate else "mm")
            for spec in rpe
        ),
        ("coverage", row.coverage, 100, "%"),
        ("frame time", row.frame_ms, 1, "ms"),
        ("real time", row.real_time_factor, 1, "×"),
        ("memory", row.peak_memory_mb, 1, "MB"),
        ("keyframes", record.keyframes, 1, ""),
        ("map points", record.map_points, 1, ""),
        ("mask overlap (IoU)", row.mask_iou, 1, ""),
    ]
    return [[name, significant(value * factor), unit] for name, value, factor, unit in facts if value is not None]


def _log(row: RunRow) -> str:
    path = row.folder / "log.txt"
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        skipped = max(file.seek(0, os.SEEK_END) - _LOG_BYTES, 0)
        file.seek(skipped)
        text = file.read(_LOG_BYTES)
    return (f"... {skipped} bytes before\n" if skipped else "") + text.decode(errors="replace")


def _series(frames: RunFrames, most: int) -> dict[str, Any]:
    """The frames over time, thinned and packed."""
    columns = frames.columns
    if not columns:
        return {}
    step = -(-len(frames.share) // most)
    stamps, start = columns["timestamp"], float(columns["timestamp"][0])
    stages = [name for name in columns if name.endswith("_s") and name not in _WHOLE]
    counts = [name for name in COUNTS if f"stat_{name}" in columns]
    rows = [stamps - start, 1000 * frames.errors_m, 100 * frames.share]
    rows += [columns[f"stat_{name}"] for name in counts] + [1000 * columns[name] for name in stages]
    t, error, share, *others = packed_rows([np.asarray(row, dtype=np.float64)[::step] for row in rows])
    series: dict[str, Any] = {
        "count": len(frames.share),
        "step": step,
        "start": start,
        "t": t,
        "states": "".join(state[:1] for state in columns["state"][::step].tolist()),
        "frame_error_mm": error,
        "share_source": frames.share_source,
        "counts": dict(zip(counts, others, strict=False)),
        "stages": {name[:-2]: row for name, row in zip(stages, others[len(counts) :], strict=True)},
    }
    return series | {"share": share} if np.isfinite(frames.share).any() else series


def _track(row: RunRow, protocol: Protocol, most: int) -> dict[str, Any]:
    """The aligned track beside the true one; without ground truth the track alone; empty if nothing was tracked.

    Where the time between two poses exceeds twice the median interval, all series have a gap.
    """
    try:
        estimate, truth = row.estimate(row.trajectory), row.ground_truth()
        if estimate is None or len(estimate) < 2:
            return {}
        if truth is None or not row.metrics:
            return _packed_track(estimate, {"xyz": estimate.positions, "angles": _angles(estimate, estimate)}, most)
        aligned, true, series = pose_errors(estimate, truth, protocol)
    except DynslamError as error:
        return {"reason": str(error)}
    columns = {
        "error_mm": 1000 * series["trans_m"],
        "rotation_deg": series["rot_deg"],
        "xyz": aligned.positions,
        "true_xyz": true.positions,
        "angles": _angles(aligned, true),
        "true_angles": _angles(true, true),
    }
    return _packed_track(aligned, columns, most) | {"alignment": protocol.alignment, "doubt": _rotation_doubt(row)}


def _rotation_doubt(row: RunRow) -> str:
    """Why the angles of an aligned track say nothing of the tracker; empty where they do."""
    if row.rotation_reliable:
        return ""
    return (
        f"{DOUBT} Rotation is unreliable: the path hardly determines the alignment's rotation (standard error "
        f"{row.rotation_uncertainty_deg:.0f}°), which turns all angles shown here. Positions are not affected."
    )


def _packed_track(track: Trajectory, columns: Mapping[str, Array], most: int) -> dict[str, Any]:
    """Series along a track ``[N]`` or ``[N, 3]``, thinned, broken at gaps and packed."""
    start = float(track.timestamps[0])
    widths = [1 if values.ndim == 1 else values.shape[1] for values in columns.values()]
    stamps, values = broken(track.timestamps - start, np.column_stack(list(columns.values())), most)
    t, *rows = packed_rows(np.vstack([stamps, values.T]))
    packed: dict[str, Any] = {"start": start, "t": t}
    for name, width in zip(columns, widths, strict=True):
        packed[name] = rows[0] if width == 1 else rows[:width]
        rows = rows[width:]
    return packed


def broken(stamps: Array, values: Array, most: int) -> tuple[Array, Array]:
    """Thin a series and put NaN where the time between two poses exceeds twice the median interval.

    Args:
        stamps: Seconds ``[N]``.
        values: ``[N, K]``.
        most: About how many points to keep.

    Returns:
        Stamps ``[M]`` and values ``[M, K]`` with NaN rows in the gaps.
    """
    if len(stamps) < 3:
        return stamps, values
    intervals = np.diff(stamps)
    piece = np.concatenate([[0], np.cumsum(intervals > 2 * np.median(intervals))])
    keep = np.arange(len(stamps)) % max(1, -(-len(stamps) // most)) == 0
    edge = np.diff(piece) > 0
    keep |= np.append(edge, True) | np.append(True, edge)  # the ends of every piece stay
    kept = np.flatnonzero(keep)
    breaks = np.flatnonzero(np.diff(piece[kept]) > 0) + 1
    middle = (stamps[kept][breaks - 1] + stamps[kept][breaks]) / 2
    return (
        np.insert(stamps[kept], breaks, middle),
        np.insert(values[kept], breaks, np.nan, axis=0),
    )


def _angles(track: Trajectory, true: Trajectory) -> Array:
    """Yaw, pitch and roll (about the camera's y, x and z) from the first true pose, in degrees ``[N, 3]``."""
    turned = true.T_world_cam[0, :3, :3].T @ track.T_world_cam[:, :3, :3]
    return np.asarray(np.degrees(np.unwrap(Rotation.from_matrix(turned).as_euler("YXZ"), axis=0)))


# -- the frames of a run, from its ``frames.csv``

Columns = dict[str, NDArray[Any]]

COUNTS = ("keypoints", "culled", "matches", "inliers")
_STATS = {f"stat_{name}" for name in (*COUNTS, "mask_fraction")}
_NEEDED = {"index", "timestamp", "state", "frame_error_trans_m"}
EXACT = "exact masks"
_ASKED = 5
"""Runs of a column that are asked for the exact shares of its frames."""


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run.

    Attributes:
        columns: What the page shows of ``frames.csv``, a name to values ``[N]``; empty for an imported trajectory.
        errors_m: Frame-to-frame translational errors ``[N]`` in metres, nan where there is none.
        share: Share of the pixels that show people ``[N]``, nan where it is not known.
        share_source: Where that comes from, in words; empty where nothing is known.
        fault: Why there are no frames though there is a table; empty otherwise.
    """

    columns: Columns
    errors_m: Array
    share: Array
    share_source: str = ""
    fault: str = ""


def read_frames(row: RunRow, exact: Mapping[int, float]) -> RunFrames:
    """The frames of a run with the share of dynamic pixels: the exact one if it is known, else by its own masks.

    Args:
        row: The run.
        exact: Frame in the numbering of the run's part without offset to the exact share.
    """
    try:
        columns = read_table(row.folder / CSV_FILE, _is_shown) or {}
    except RunError as error:
        return RunFrames({}, np.zeros(0), np.zeros(0), fault=str(error))
    if not columns:
        return RunFrames({}, np.zeros(0), np.zeros(0))
    errors_m, own = columns["frame_error_trans_m"], columns.get("stat_mask_fraction")
    if exact:
        return RunFrames(
            columns,
            errors_m,
            np.array([exact.get(index + row.offset, np.nan) for index in columns["index"].tolist()]),
            EXACT,
        )
    if own is not None and own.any():  # else it may have no masks
        return RunFrames(columns, errors_m, own, "the tracker's own masks")
    return RunFrames(columns, errors_m, np.full(len(errors_m), np.nan))


def exact_shares(rows: Sequence[RunRow]) -> dict[int, float]:
    """Frame (before the offset) to its exact share of dynamic pixels, from those of the first runs that know it."""
    shares: dict[int, float] = {}
    for row in rows[:_ASKED]:
        try:
            columns = read_table(row.folder / CSV_FILE, {"index", "dynamic_share"}.__contains__)
        except RunError:  # is named on the page of that run
            continue
        if columns is not None and "dynamic_share" in columns:
            finite = np.isfinite(columns["dynamic_share"])
            indices = (columns["index"][finite] + row.offset).tolist()
            shares |= dict(zip(indices, columns["dynamic_share"][finite].tolist(), strict=True))
    return shares


def read_table(path: Path, wanted: Callable[[str], bool]) -> Columns | None:
    """Columns of a ``frames.csv``, a name to values ``[N]``: numbers, and the state in words; None for no table.

    Raises:
        RunError: It holds no frames, or something else than numbers.
    """
    kinds: dict[str, Any] = defaultdict(lambda: np.float64, index=np.int64, state=str)
    try:
        if not path.is_file() or not path.stat().st_size:
            return None
        table = pd.read_csv(
            io.BytesIO(read_bytes(path, limit=TABLE_BYTES)), usecols=wanted, dtype=kinds, low_memory=False
        )
    except (DynslamError, ValueError, OverflowError, OSError) as error:
        raise RunError(f"{CSV_FILE} is damaged: {error}") from error
    if not isinstance(table.index, pd.RangeIndex):
        raise RunError(f"{CSV_FILE} is damaged: its lines have more cells than its heading")
    if not set(filter(wanted, _NEEDED)) <= set(table) or table.empty:
        raise RunError(f"{CSV_FILE} holds no frames")
    if "timestamp" in table and not np.isfinite(table["timestamp"]).all():
        raise RunError(f"{CSV_FILE} is damaged: not every frame has a stamp")
    return {str(name): table[name].to_numpy() for name in table}


def _is_shown(name: str) -> bool:
    """Whether the page shows a column of ``frames.csv``."""
    return name in _NEEDED or name in _STATS or (name.endswith("_s") and not name.startswith("stat_"))


# -- pictures of frames: drawn from the sequence when the report is made, once a frame

FOLDER = "frames"
EVEN, WORST = 16, 4
"""Frames of a run that are shown evenly spread, and those with the largest frame-to-frame error."""
_WIDTH, _QUALITY = 480, 62
_MASK_WIDTH = 240


@dataclass
class Pictures:
    """Draws the frames that runs show, as long as there is time for it; what is there already is not drawn again.

    Args:
        output: Folder of the report.
        deadline: Time after which no further picture is drawn, in seconds since the epoch.
        missing: Why some frames have no picture, with their number.
    """

    output: Path
    deadline: float
    missing: Counter[str] = field(default_factory=Counter)
    _opened: dict[tuple[str, str], FrameSequence | DynslamError] = field(default_factory=dict)

    def add(self, row: RunRow, record: RunRecord, frames: RunFrames) -> bool:
        """Draw the frames that a run shows and write what its tracker saw on them as ``data/annotations-<run id>.js``.

        Args:
            row: The run.
            record: Its whole record.
            frames: Its frames.

        Returns:
            Whether there is anything to see.
        """
        if not frames.columns:
            return False
        try:
            size, snapshots = read_snapshots(row.folder)
        except DynslamError as error:
            self.missing[str(error)] += 1
            return False
        by_index = {snapshot.index: snapshot for snapshot in snapshots}
        errors_mm = dict(zip(frames.columns["index"].tolist(), (1000 * frames.errors_m).tolist(), strict=True))
        annotated = []
        for index in _chosen(frames, sorted(by_index)):
            frame: dict[str, Any] = {"index": index}
            try:
                frame["image"] = self._image(record, index)
            except DynslamError as error:
                self.missing[str(error)] += 1
            if index in by_index:
                frame |= _annotations(by_index[index], size)
            if frame.get("image") or frame.get("points"):
                annotated.append(frame | {"error_mm": significant(errors_mm.get(index))})
        if annotated:
            write_side(self.output, f"annotations-{row.run_id}", {"frames": annotated, "stored": bool(snapshots)})
        return bool(annotated)

    def _image(self, record: RunRecord, index: int) -> str:
        """Relative path of the picture of a frame; drawn if it is not there yet.

        Raises:
            DynslamError: The sequence cannot be opened, is another one by now, or the time is over.
        """
        number = (record.frames or (0, None))[0] + (index * record.stride) + record.offset
        path = self.output / FOLDER / (record.sequence.block or record.sequence.part) / f"{number}.webp"
        if not path.is_file():
            if time.time() >= self.deadline:
                raise DynslamError("not drawn in the time for pictures", "make the report again: it goes on there")
            bgr = np.ascontiguousarray(self._sequence(record)[index].rgb[:, :, ::-1])
            shrunk = cv2.resize(bgr, _shrunk_size(bgr, _WIDTH), interpolation=cv2.INTER_AREA)
            write_atomic(path, _encoded(".webp", np.asarray(shrunk), cv2.IMWRITE_WEBP_QUALITY, _QUALITY))
        return path.relative_to(self.output).as_posix()

    def _sequence(self, record: RunRecord) -> FrameSequence:
        key = (record.place, record.sequence.part)
        if key not in self._opened:
            try:
                self._opened[key] = open_stored(record)
            except DynslamError as error:
                self._opened[key] = error
        opened = self._opened[key]
        if isinstance(opened, DynslamError):
            raise opened
        return opened


def _chosen(frames: RunFrames, stored: Sequence[int]) -> list[int]:
    """Frames to show: some spread over the run, and the worst; of those that the run has stored, if it has any."""
    indices = frames.columns["index"]
    order = np.argsort(-np.nan_to_num(frames.errors_m, nan=-1.0), kind="stable")
    bad = [int(indices[at]) for at in order if np.isfinite(frames.errors_m[at])]
    if not stored:
        return sorted({int(indices[at]) for at in spread(len(frames.share), EVEN)} | set(bad[:WORST]))
    even = {stored[at] for at in spread(len(stored), EVEN)}
    return sorted(even | set([index for index in bad if index in set(stored)][:WORST]))


def _annotations(snapshot: Snapshot, size: tuple[int, int]) -> dict[str, Any]:
    """Features (two bytes each: x and y in 255ths of the image), which were kept, and the mask as a small image."""
    height, width = size
    places = (
        np.clip(snapshot.points * np.array((255 / width, 255 / height), np.float32), 0, 255).round().astype(np.uint8)
    )
    order = np.argsort(snapshot.kept, kind="stable")  # culled ones first
    annotations: dict[str, Any] = {
        "points": base64.b64encode(places[order].tobytes()).decode(),
        "culled": int((~snapshot.kept).sum()),
        "width": width,
        "height": height,
        "share": None,
    }
    mask = snapshot.mask
    if mask is not None:
        annotations["share"] = significant(100 * np.count_nonzero(mask) / mask.size, 3)
        if mask.any():
            small = cv2.resize(mask.view(np.uint8), _shrunk_size(mask, _MASK_WIDTH), interpolation=cv2.INTER_NEAREST)
            png = base64.b64encode(_encoded(".png", np.asarray(small), cv2.IMWRITE_PNG_BILEVEL, 1)).decode()
            annotations["mask"] = f"data:image/png;base64,{png}"
    return annotations


def _shrunk_size(image: NDArray[Any], width: int) -> tuple[int, int]:
    return width, max(round(image.shape[0] * width / image.shape[1]), 1)


def _encoded(kind: str, image: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DynslamError(f"this OpenCV cannot write {kind} images")
    return bytes(data)
