"""Rows of a round: the runs that runners have published, their errors, and whether two of them agree."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import RunError
from dynslam_bench.evaluation.comparison import tracked_frames
from dynslam_bench.rounds.files import RoundFolder, Row
from dynslam_bench.runs.make_record import judge_coverage
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.synthetic import open_synthetic

Agreement = Literal["identical", "reproduced", "differs"]
"""Equal to the last bit; errors within the round's tolerance; neither. The first two have one status and coverage."""
_CAME_TO_ITS_END = ("ok", "lost")
"""Statuses that follow from the trajectory; any other is the runner's word."""


@dataclass(frozen=True)
class ScoredRow:
    """A row with its error, computed from the stored trajectory.

    Attributes:
        by: The runner.
        row: Entry, scene and run.
        status: How the run ended: ``ok`` or ``lost`` as the trajectory says, any other as the runner says.
        ate_m: Its error under the round's protocol, metres; None where it has none.
        coverage: Share of the scene's frames with a pose, counted in the trajectory.
    """

    by: str
    row: Row
    status: str
    ate_m: float | None
    coverage: float

    @property
    def key(self) -> tuple[str, str]:
        """Entry and scene."""
        return self.row.entry, self.row.sequence


def scored(opened: RoundFolder, by: str, row: Row) -> ScoredRow:
    """A runner's row with error, coverage and status; all come from the trajectory, whatever is stored of it.

    Raises:
        DynslamError: The run is missing, a file of it is missing, damaged or was changed, or it
            says another coverage or status than its trajectory.
    """
    store = RunStore(opened.bank(by))
    record = store.read_whole(row.run_id)
    store.check(record)
    metrics = store.score(record, opened.round.protocol, again=True).metrics

    # frames of the rendered scene that have a pose
    frames_s = open_synthetic(row.sequence, None).timestamps
    total = len(frames_s)
    has_pose = _frames_with_pose(store, record, frames_s)
    tracked = int(has_pose.sum())
    lost_at_end = int(has_pose[::-1].argmax()) if tracked else total
    stated = round((record.coverage or 0.0) * total)
    if record.status in _CAME_TO_ITS_END and stated != tracked:
        raise RunError(f"it says poses at {stated} of {total} frames, its trajectory has {tracked}")

    # the status of a run that came to its end
    status = record.status
    if status in _CAME_TO_ITS_END:
        status, reason = judge_coverage(tracked, total, lost_at_end, total)
        # a tracker that waits for motion at the end is not lost in its own words
        is_waiting = 0 < lost_at_end <= record.n_initialising
        if status != record.status and not is_waiting:
            raise RunError(
                f"it says {record.status}, its trajectory says {status} {reason}".rstrip()
            )
    return ScoredRow(by, row, status, metrics.get("ate_rmse_m"), tracked / total)


def _frames_with_pose(
    store: RunStore, record: RunRecord, frames_s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether each frame has a pose ``[N]``: in the online trajectory, in the final one of a batch."""
    which = "online" if record.tracker.online else "final"
    trajectory = store.trajectory(record.run_id, which)
    if trajectory is None:
        return np.zeros(len(frames_s), dtype=bool)
    return tracked_frames(trajectory, frames_s)


def agreement(opened: RoundFolder, one: ScoredRow, other: ScoredRow) -> tuple[Agreement, float]:
    """Whether two rows of the same entry and scene agree, and the relative difference of their errors.

    Status and coverage have to be equal. Runs without an error agree then.
    """
    if one.ate_m is None or other.ate_m is None:
        share = 0.0 if one.ate_m is other.ate_m else 1.0
    else:
        share = abs(one.ate_m - other.ate_m) / max(one.ate_m, other.ate_m, 1e-12)
    if one.status != other.status or one.coverage != other.coverage:
        return "differs", share
    if one.ate_m is not None and _same_poses(opened, one, other):
        return "identical", share
    return ("reproduced" if share <= opened.round.tolerance else "differs"), share


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
