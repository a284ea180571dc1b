"""Errors on the frames that all runs of a sequence tracked, and the runs that stand for a tracker in figures."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.ate import ate_rmse_m
from dynslam_bench.evaluation.frames import common_frames
from dynslam_bench.evaluation.protocol import Protocol

from .board import Board
from .crew import Crew, unheard_run
from .rows import Loaded, LoadedRun


def common_errors(
    board: Board, protocol: Protocol, loaded: Loaded, crew: Crew | None = None
) -> tuple[dict[tuple[str, str], float], dict[str, str]]:
    """Median ATE on the frames that all successful runs tracked, by (variant, sequence), and how many those are."""
    runs = {name: successful(board, name, loaded) for name in board.sequences}
    if crew is None:
        answers = [common_of(found, protocol) for found in runs.values()]
    else:
        jobs = [{"runs": [run.as_job() for run in found]} for found in runs.values()]
        answers = crew.work("common", jobs, unheard_run)
    errors: dict[tuple[str, str], float] = {}
    frames: dict[str, str] = {}
    for sequence, (found, count) in zip(runs, answers, strict=True):
        if count is None:
            continue
        frames[sequence] = f"{count} of {max(loaded.by_id[run_id].row.n_frames for run_id in found)}"
        values: dict[str, list[float]] = {}
        for run_id, error in found.items():
            if error is not None:
                values.setdefault(loaded.by_id[run_id].row.variant_key, []).append(error)
        errors |= {(key, sequence): median(some) for key, some in values.items()}
    return errors, frames


def common_of(runs: Sequence[LoadedRun], protocol: Protocol) -> tuple[dict[str, float | None], int | None]:
    """ATE of runs on one sequence on the frames that all of them tracked, by run, and how many those are.

    Returns:
        Of every run with a trajectory its error, None where it cannot be taken; nothing, and None, for the runs of a
        single tracker.
    """
    pairs = [(run, run.trajectory(protocol.trajectory)) for run in runs]
    held = [(run, trajectory) for run, trajectory in pairs if trajectory is not None]
    if len({run.row.variant_key for run, _ in held}) < 2:
        return {}, None
    reduced = common_frames([trajectory for _, trajectory in held])
    errors: dict[str, float | None] = {}
    for (run, whole), trajectory in zip(held, reduced, strict=True):
        if len(trajectory) == len(whole) and protocol.lost_frames == "exclude":  # it is the error that is known
            errors[run.row.run_id] = run.row.metrics["ate_rmse_m"]
            continue
        truth = run.ground_truth()
        try:
            errors[run.row.run_id] = None if truth is None else ate_rmse_m(trajectory, truth, protocol)
        except DynslamError:
            errors[run.row.run_id] = None
    return errors, len(reduced[0])


def representatives(board: Board, sequence: str, loaded: Loaded) -> dict[str, LoadedRun]:
    """Of each tracker the successful run on a sequence whose error is the (lower) median one."""
    runs = successful(board, sequence, loaded)
    by_key: dict[str, list[LoadedRun]] = {key: [] for key in board.trackers}
    for run in sorted(runs, key=lambda run: run.row.metrics["ate_rmse_m"]):
        by_key.get(run.row.variant_key, []).append(run)
    return {key: ordered[(len(ordered) - 1) // 2] for key, ordered in by_key.items() if ordered}


def successful(board: Board, sequence: str, loaded: Loaded) -> list[LoadedRun]:
    """The runs on a sequence that ended and could be evaluated, copies left out."""
    rows = [row for cells in board.cells.values() if sequence in cells for row in cells[sequence].kept]
    good = [row.run_id for row in rows if not row.failed and "ate_rmse_m" in row.metrics]
    return [loaded.by_id[run_id] for run_id in good]
