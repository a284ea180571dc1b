"""Errors on the frames that all runs of a sequence tracked, and the runs that stand for a tracker in figures."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from statistics import median

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.ape import ate_rmse_m
from dynslam_bench.evaluation.prepare import common_frames
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.load import run_jobs
from dynslam_bench.reports.model.row import RunRow

MOST_COMPARED = 100
"""Runs on one sequence of which the common frames are taken, about: of more, as many of every tracker."""


def common_errors(
    board: Board, protocol: Protocol, pool: Executor | None = None
) -> tuple[dict[tuple[str, str], float], dict[str, str]]:
    """Median ATE on the frames that all successful runs tracked, by (variant, sequence), and how many those are.

    Of more than `MOST_COMPARED` runs on a sequence these are the runs of each tracker around its median error.
    """
    jobs = [(around_medians(successful(board, sequence)), protocol) for sequence in board.sequences]
    answers = run_jobs(pool, common_of, jobs, lambda _: None)
    errors: dict[tuple[str, str], float] = {}
    frames: dict[str, str] = {}
    for sequence, (rows, _), (of_run, count) in zip(board.sequences, jobs, answers, strict=True):
        if count is None:
            continue
        compared = [row for row in rows if row.run_id in of_run]
        frames[sequence] = f"{count} of {max(row.n_frames for row in compared)}"
        by_key: dict[str, list[float]] = {}
        for row in compared:
            error = of_run[row.run_id]
            if error is not None:
                by_key.setdefault(row.variant_key, []).append(error)
        errors |= {(key, sequence): median(values) for key, values in by_key.items()}
    return errors, frames


def common_of(rows: Sequence[RunRow], protocol: Protocol) -> tuple[dict[str, float | None], int | None]:
    """ATE of runs on one sequence on the frames that all of them tracked, by run, and how many those are.

    Returns:
        Of every run with a trajectory its error, None where it cannot be taken; nothing, and None, for the runs of a
        single tracker.
    """
    pairs = [(row, row.estimate(protocol.trajectory)) for row in rows]
    tracked = [(row, trajectory) for row, trajectory in pairs if trajectory is not None]
    if len({row.variant_key for row, _ in tracked}) < 2:
        return {}, None
    reduced = common_frames([trajectory for _, trajectory in tracked])
    errors: dict[str, float | None] = {}
    for (row, whole), trajectory in zip(tracked, reduced, strict=True):
        if len(trajectory) == len(whole) and protocol.lost_frames == "exclude":  # the error is that of the row
            errors[row.run_id] = row.metrics["ate_rmse_m"]
            continue
        truth = row.ground_truth()
        try:
            errors[row.run_id] = None if truth is None else ate_rmse_m(trajectory, truth, protocol)
        except DynslamError:
            errors[row.run_id] = None
    return errors, len(reduced[0])


def representatives(board: Board, sequence: str) -> dict[str, RunRow]:
    """Of each tracker the successful run on a sequence whose error is the (lower) median one."""
    by_key = _by_error(successful(board, sequence))
    return {key: by_key[key][(len(by_key[key]) - 1) // 2] for key in board.trackers if key in by_key}


def around_medians(rows: Sequence[RunRow]) -> Sequence[RunRow]:
    """All of few runs on a sequence; of many, as many of each tracker: those around its (lower) median error."""
    if len(rows) <= MOST_COMPARED:
        return rows
    by_key = _by_error(rows)
    most = max(MOST_COMPARED // len(by_key), 1)
    starts = {key: max((len(ordered) - most) // 2, 0) for key, ordered in by_key.items()}
    return [row for key, ordered in by_key.items() for row in ordered[starts[key] : starts[key] + most]]


def _by_error(rows: Sequence[RunRow]) -> dict[str, list[RunRow]]:
    """Runs by tracker, from the smallest to the largest error."""
    by_key: dict[str, list[RunRow]] = {}
    for row in sorted(rows, key=lambda row: row.metrics["ate_rmse_m"]):
        by_key.setdefault(row.variant_key, []).append(row)
    return by_key


def successful(board: Board, sequence: str) -> list[RunRow]:
    """The runs on a sequence that ended and could be evaluated, copies left out."""
    rows = [row for cells in board.cells.values() if sequence in cells for row in cells[sequence].kept]
    return [row for row in rows if not row.failed and "ate_rmse_m" in row.metrics]
