"""Rows of a round: the runs that runners have published, their errors, and whether two of them agree."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dynslam_bench.rounds.files import RoundFolder, Row
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore

Agreement = Literal["identical", "reproduced", "differs"]
"""Equal to the last bit; errors within the round's tolerance; neither."""


@dataclass(frozen=True)
class ScoredRow:
    """A row with its error, computed from the stored trajectory.

    Attributes:
        by: The runner.
        row: Entry, scene and run.
        status: How the run ended.
        ate_m: Its error under the round's protocol, metres; None where it has none.
        coverage: Share of the frames with a pose.
    """

    by: str
    row: Row
    status: str
    ate_m: float | None
    coverage: float | None

    @property
    def key(self) -> tuple[str, str]:
        """Entry and scene."""
        return self.row.entry, self.row.sequence


def scored(opened: RoundFolder, by: str, row: Row) -> ScoredRow:
    """A runner's row with its error; it is scored from the trajectory, whatever is stored of it.

    Raises:
        DynslamError: The run is missing, or a file of it is missing, damaged or was changed.
    """
    store = RunStore(opened.bank(by))
    record = store.read_whole(row.run_id)
    store.check(record)
    metrics = store.score(record, opened.round.protocol, again=True).metrics
    return ScoredRow(by, row, record.status, metrics.get("ate_rmse_m"), record.coverage)


def agreement(opened: RoundFolder, one: ScoredRow, other: ScoredRow) -> tuple[Agreement, float]:
    """Whether two rows of the same entry and scene agree, and the relative difference of their errors.

    Runs without an error agree where they ended alike.
    """
    if one.ate_m is None or other.ate_m is None:
        return ("reproduced", 0.0) if one.status == other.status else ("differs", 1.0)
    share = abs(one.ate_m - other.ate_m) / max(one.ate_m, other.ate_m, 1e-12)
    if _same_poses(opened, one, other):
        return "identical", share
    is_within = share <= opened.round.tolerance and one.status == other.status
    return ("reproduced" if is_within else "differs"), share


def _same_poses(opened: RoundFolder, one: ScoredRow, other: ScoredRow) -> bool:
    """Whether the trajectories of two rows are equal to the last bit that the files hold."""
    for which in ("online", "final"):
        first = RunStore(opened.bank(one.by)).trajectory(one.row.run_id, which)
        second = RunStore(opened.bank(other.by)).trajectory(other.row.run_id, which)
        if first is None or second is None:
            if first is not second:
                return False
            continue
        if not np.array_equal(first.timestamps, second.timestamps):
            return False
        if not np.array_equal(first.T_world_cam, second.T_world_cam):
            return False
    return True


def record_of(opened: RoundFolder, by: str, row: Row) -> RunRecord:
    """The record of a runner's row.

    Raises:
        DynslamError: It is missing or damaged.
    """
    return RunStore(opened.bank(by)).read_whole(row.run_id)
