"""Errors on the frames that all runs of a sequence tracked, and the runs that stand for a tracker in figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.ape import ate_rmse_m
from dynslam_bench.evaluation.prepare import common_frames
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.load import Crew, Loaded, LoadedRun, unheard_run
from dynslam_bench.runs.store import RunStore

MOST_COMPARED = 100
"""Runs on one sequence of which the common frames are taken, about: of more, as many of every tracker."""


@dataclass(frozen=True)
class Tracked:
    """What of a run is compared on common frames, small enough for a job.

    Attributes:
        store: Folder of its results.
        run_id: Its id.
        part: Its part of a sequence.
        key: Its tracker, see `RunRow.variant_key`.
        ate_m: Its error on all of its own frames.
    """

    store: str
    run_id: str
    part: str
    key: str
    ate_m: float

    @classmethod
    def of(cls, run: LoadedRun) -> Tracked:
        """What of a run is needed."""
        row = run.row
        return cls(str(run.store.root), row.run_id, run.part, row.variant_key, row.metrics["ate_rmse_m"])

    def trajectory(self, which: str) -> Trajectory | None:
        """Its trajectory; None if there is none with a pose, or it is damaged."""
        try:
            return RunStore(self.store).trajectory(self.run_id, which)
        except DynslamError:
            return None


def common_errors(
    board: Board, protocol: Protocol, loaded: Loaded, crew: Crew | None = None
) -> tuple[dict[tuple[str, str], float], dict[str, str]]:
    """Median ATE on the frames that all successful runs tracked, by (variant, sequence), and how many those are.

    Of more than `MOST_COMPARED` runs on a sequence these are the runs of each tracker around its median error.
    """
    runs = {
        name: [Tracked.of(run) for run in around_medians(successful(board, name, loaded))] for name in board.sequences
    }
    if crew is None:
        answers = [common_of(found, protocol) for found in runs.values()]
    else:
        jobs: list[Mapping[str, Any]] = [{"runs": [asdict(run) for run in found]} for found in runs.values()]
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


def common_of(runs: Sequence[Tracked], protocol: Protocol) -> tuple[dict[str, float | None], int | None]:
    """ATE of runs on one sequence on the frames that all of them tracked, by run, and how many those are.

    Returns:
        Of every run with a trajectory its error, None where it cannot be taken; nothing, and None, for the runs of a
        single tracker.
    """
    pairs = [(run, run.trajectory(protocol.trajectory)) for run in runs]
    held = [(run, trajectory) for run, trajectory in pairs if trajectory is not None]
    if len({run.key for run, _ in held}) < 2:
        return {}, None
    reduced = common_frames([trajectory for _, trajectory in held])
    errors: dict[str, float | None] = {}
    for (run, whole), trajectory in zip(held, reduced, strict=True):
        if len(trajectory) == len(whole) and protocol.lost_frames == "exclude":  # it is the error that is known
            errors[run.run_id] = run.ate_m
            continue
        try:
            truth = RunStore(run.store).ground_truth(run.part)
            errors[run.run_id] = None if truth is None else ate_rmse_m(trajectory, truth, protocol)
        except DynslamError:
            errors[run.run_id] = None
    return errors, len(reduced[0])


def representatives(board: Board, sequence: str, loaded: Loaded) -> dict[str, LoadedRun]:
    """Of each tracker the successful run on a sequence whose error is the (lower) median one."""
    by_key = _by_error(successful(board, sequence, loaded))
    return {key: by_key[key][(len(by_key[key]) - 1) // 2] for key in board.trackers if key in by_key}


def around_medians(runs: Sequence[LoadedRun]) -> Sequence[LoadedRun]:
    """All of few runs on a sequence; of many, as many of each tracker: those around its (lower) median error."""
    if len(runs) <= MOST_COMPARED:
        return runs
    by_key = _by_error(runs)
    most = max(MOST_COMPARED // len(by_key), 1)
    starts = {key: max((len(ordered) - most) // 2, 0) for key, ordered in by_key.items()}
    return [run for key, ordered in by_key.items() for run in ordered[starts[key] : starts[key] + most]]


def _by_error(runs: Sequence[LoadedRun]) -> dict[str, list[LoadedRun]]:
    """Runs by tracker, from the smallest to the largest error."""
    by_key: dict[str, list[LoadedRun]] = {}
    for run in sorted(runs, key=lambda run: run.row.metrics["ate_rmse_m"]):
        by_key.setdefault(run.row.variant_key, []).append(run)
    return by_key


def successful(board: Board, sequence: str, loaded: Loaded) -> list[LoadedRun]:
    """The runs on a sequence that ended and could be evaluated, copies left out."""
    rows = [row for cells in board.cells.values() if sequence in cells for row in cells[sequence].kept]
    good = [row.run_id for row in rows if not row.failed and "ate_rmse_m" in row.metrics]
    return [loaded.by_id[run_id] for run_id in good]
