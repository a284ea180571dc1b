"""The frames of a run: lines of the child's log, rows of ``frames.csv``, and a pandas frame."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, field_validator
from pydantic.dataclasses import dataclass as validated

from dynslam_bench.contracts import stage_seconds
from dynslam_bench.core import DynslamError, RunError, read_lines, reason_of, storable
from dynslam_bench.geometry import Trajectory, format_ns, ns_of, se3, write_tum
from dynslam_bench.geometry.motion_covariances import MotionCovariances, write_motion_covariances
from dynslam_bench.runs.layout import COVARIANCES, ONLINE
from dynslam_bench.runs.record import RunRecord, StageTime
from dynslam_bench.runs.store import RunStore

if TYPE_CHECKING:
    import pandas as pd

    from dynslam_bench.envs.episode import FrameOutcome

FRAMES_FILE = "frames.jsonl"
"""The child's log: one line a frame, complete before the next frame begins; gone when the run is stored."""
CSV_FILE = "frames.csv"
"""The stored table: one row a frame."""
FIXED = (
    "index",
    "timestamp",
    "state",
    "frame_error_trans_m",
    "frame_error_rot_deg",
    "pose_error_trans_m",
    "pose_error_rot_deg",
    "reward_m",
    "mask_iou",
)
"""Columns of every ``frames.csv``; after them come ``<stage>_s``, seconds of every stage, and ``stat_<name>``."""
MOST_FRAMES = 1 << 31
"""No run has as many."""
_DYNAMIC_SHARE = "dynamic_share"
"""A column of sequences with exact masks only."""
_STAT_PREFIX = "stat_"
"""Begins the column of a diagnostic of the tracker."""
_TIME_SUFFIX = "_s"
"""Ends the column of a stage's time, in seconds."""


@validated(frozen=True, config=ConfigDict(extra="forbid"))
class FrameRow:
    """One row of a run's table of frames.

    Attributes:
        index: Index of the frame in the run's part of the sequence.
        timestamp: Seconds; ``frames.csv`` holds them to the nanosecond.
        state: ``initialising``, ``ok``, ``lost``, or ``dropped`` if the frame never reached the
            tracker.
        frame_error_trans_m: Frame-to-frame translational error in metres; None without ground truth
            at both frames.
        frame_error_rot_deg: Frame-to-frame rotational error in degrees; None without ground truth
            at both frames.
        pose_error_trans_m: Cumulative translational error in metres, see `OnlineError`; None
            without ground truth.
        pose_error_rot_deg: Cumulative rotational error in degrees; None without ground truth.
        reward_m: What the frame earned.
        mask_iou: Overlap of the dynamic mask with the exact masks of people, 0 to 1; None where
            either is missing or neither has a pixel.
        timings: Seconds by stage; empty for a frame that was dropped.
        stats: The tracker's diagnostics by name.
        pose: Tracked camera-to-world pose ``tx ty tz qx qy qz qw``; None unless the state is
            ``ok``. Not in ``frames.csv``: ``trajectory_online.txt`` holds it.
        dynamic_share: Share of the pixels that show people, by the exact masks, 0 to 1; None
            without such masks.
        motion_covariance: Covariance of the motion to this frame, 36 numbers row by row; None where
            the tracker gave none. Not in ``frames.csv``: ``motion_covariances.txt`` holds it.
    """

    index: Annotated[int, Field(ge=0, lt=MOST_FRAMES)]
    timestamp: Annotated[float, Field(allow_inf_nan=False)]
    state: Literal["initialising", "ok", "lost", "dropped"]
    frame_error_trans_m: float | None = None
    frame_error_rot_deg: float | None = None
    pose_error_trans_m: float | None = None
    pose_error_rot_deg: float | None = None
    reward_m: float = 0.0
    mask_iou: float | None = None
    timings: dict[str, float] = field(default_factory=dict)
    stats: dict[str, float] = field(default_factory=dict)
    pose: list[float] | None = None
    dynamic_share: float | None = None
    motion_covariance: Annotated[list[float], Field(min_length=36, max_length=36)] | None = None

    @field_validator("pose")
    @classmethod
    def _is_pose(cls, pose: list[float] | None) -> list[float] | None:
        if pose is not None and (
            len(pose) != 7 or not np.isfinite(pose).all() or math.hypot(*pose[3:]) < 1e-8
        ):
            raise ValueError("it holds no pose")
        return pose

    @classmethod
    def of(
        cls,
        outcome: FrameOutcome,
        mask_iou: float | None = None,
        dynamic_share: float | None = None,
    ) -> FrameRow:
        """The row of a frame that an environment has tracked."""
        # errors are missing without ground truth, the pose on a lost frame
        error = outcome.error
        pose = outcome.T_world_cam
        covariance = outcome.motion_covariance
        return cls(
            index=outcome.index,
            timestamp=outcome.timestamp,
            state=outcome.state,
            frame_error_trans_m=None if error is None else error.frame_trans_m,
            frame_error_rot_deg=None if error is None else error.frame_rot_deg,
            pose_error_trans_m=None if error is None else error.trans_m,
            pose_error_rot_deg=None if error is None else error.rot_deg,
            reward_m=outcome.reward,
            mask_iou=mask_iou,
            timings=dict(outcome.timings),
            stats=storable(dict(outcome.stats)),
            pose=None if pose is None else np.concatenate(se3.to_quaternion(pose)).tolist(),
            dynamic_share=dynamic_share,
            motion_covariance=None if covariance is None else covariance.ravel().tolist(),
        )

    def cells(self) -> dict[str, Any]:
        """The row by the columns of ``frames.csv``: `FIXED`, the dynamic share, ``<stage>_s`` and ``stat_<name>``."""
        # fixed columns first, then those that a tracker or a sequence adds
        share = {} if self.dynamic_share is None else {_DYNAMIC_SHARE: self.dynamic_share}
        times = {stage + _TIME_SUFFIX: value for stage, value in self.timings.items()}
        stats = {_STAT_PREFIX + name: value for name, value in self.stats.items()}
        return {name: getattr(self, name) for name in FIXED} | share | times | stats

    def to_json(self) -> str:
        """The row as one line of the child's log, with its newline."""
        return json.dumps(vars(self)) + "\n"


_LINE = TypeAdapter(FrameRow)


def column_names(rows: Iterable[FrameRow]) -> list[str]:
    """The columns of a table of frames: `FIXED`, the stages' times, the stats, in the order they appeared in."""
    names = dict.fromkeys(name for row in rows for name in row.cells())
    others = [name for name in names if name not in FIXED]
    return [*FIXED, *sorted(others, key=lambda name: name.startswith(_STAT_PREFIX))]


def write_csv(
    path: Path, rows: Sequence[FrameRow], exact: Mapping[float, int] | None = None
) -> None:
    """Write ``frames.csv``; `exact` gives the nanoseconds of stamps by their seconds."""
    columns = column_names(rows)
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = csv.DictWriter(file, columns)
        table.writeheader()
        for row in rows:
            # a float does not hold the nanoseconds of a Unix time
            stamp = (exact or {}).get(row.timestamp) or ns_of(row.timestamp)
            table.writerow(row.cells() | {"timestamp": format_ns(stamp)})


def read_csv(path: Path) -> list[FrameRow]:
    """Read a ``frames.csv``; columns of another kind are left out.

    Raises:
        RunError: There is no such file, or it holds something else.
    """
    rows: list[FrameRow] = []
    try:
        rows.extend(map(_parse, csv.DictReader(read_lines(path, kind=RunError))))
    except (TypeError, ValueError, csv.Error) as error:
        raise RunError(
            f"{path} is no table of frames: row {len(rows) + 1} is damaged ({reason_of(error)})"
        ) from error
    return rows


def _parse(line: dict[str, str]) -> FrameRow:
    """The row of a line of ``frames.csv``, by its columns.

    Raises:
        ValueError: It does not fit the heading, or a cell holds another kind of value.
    """
    # csv gives None for a missing heading, or for a missing cell
    if None in line or None in line.values():
        raise ValueError("another number of cells than the heading has")
    cells = {name: text for name, text in line.items() if text}
    values: dict[str, Any] = {
        name: cells.pop(name) for name in (*FIXED, _DYNAMIC_SHARE) if name in cells
    }
    # the other columns are told by their prefix or suffix
    stats = {}
    timings = {}
    for name, text in cells.items():
        if name.startswith(_STAT_PREFIX):
            stats[name.removeprefix(_STAT_PREFIX)] = text
        elif name.endswith(_TIME_SUFFIX):
            timings[name.removesuffix(_TIME_SUFFIX)] = text
    return _LINE.validate_python(values | {"stats": stats, "timings": timings})


@dataclass
class FrameLog:
    """The frames of a run, as far as it came.

    Attributes:
        rows: One a frame.
        damage: What is wrong with the row after the last, one line; empty for nothing.
    """

    rows: list[FrameRow] = field(default_factory=list)
    damage: str = ""

    @classmethod
    def read(cls, path: Path) -> FrameLog:
        """Read the child's log up to the first damaged row; no file is no frames.

        A line that a dying process left unfinished is not taken, and no damage.
        """
        rows: list[FrameRow] = []
        lines = read_lines(path, kind=RunError) if path.is_file() else iter(())
        try:
            # rows must go forward in time
            for row in (_LINE.validate_json(line) for line in lines if line.endswith("\n")):
                if rows and row.timestamp <= rows[-1].timestamp:
                    raise ValueError(f"stamp {row.timestamp!r} after {rows[-1].timestamp!r}")
                rows.append(row)
        except (DynslamError, ValueError) as error:
            return cls(rows, f"row {len(rows) + 1} of {path.name} is damaged ({reason_of(error)})")
        return cls(rows)

    def lost_streak(self) -> int:
        """Frames lost in a row at the end."""
        return len(list(takewhile(lambda row: row.state == "lost", reversed(self.rows))))

    def trajectory(self) -> Trajectory:
        """The online trajectory."""
        # poses [N, 7] as position and quaternion
        tracked = [(row.timestamp, row.pose) for row in self.rows if row.pose is not None]
        if not tracked:
            return Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        stamps = np.array([stamp for stamp, _ in tracked], dtype=np.float64)
        poses = np.array([pose for _, pose in tracked], dtype=np.float64)  # position, quaternion
        return Trajectory(stamps, se3.from_quaternion(poses[:, :3], poses[:, 3:]))

    def motion_covariances(self) -> MotionCovariances:
        """The covariances of the motions to tracked frames, as the tracker gave them."""
        rows = [row for row in self.rows if row.motion_covariance is not None]
        stamps = np.array([row.timestamp for row in rows], dtype=np.float64)
        numbers = np.array([row.motion_covariance for row in rows], dtype=np.float64)
        return MotionCovariances(stamps, numbers.reshape(-1, 6, 6))

    def timings(self) -> dict[str, StageTime]:
        """Median, p95 and mean of every stage over the frames that reached the tracker."""
        timings = {}
        # a stage that did not run on a frame counts as 0 there
        seconds = stage_seconds([row.timings for row in self.rows if row.timings])
        for stage, values in seconds.items():  # float64, one a frame
            timings[stage] = StageTime(
                median_s=float(np.median(values)),
                p95_s=float(np.percentile(values, 95)),
                mean_s=float(values.mean()),
            )
        return timings

    def mask_iou(self) -> float | None:
        """Mean overlap of the dynamic mask with the exact masks of people over the frames where either has pixels."""
        overlaps = [row.mask_iou for row in self.rows if row.mask_iou is not None]
        return float(np.mean(overlaps)) if overlaps else None

    def epipolar_skipped(self) -> float | None:
        """Share of the tracked frames on which no fundamental matrix judged, of those with an image to compare with.

        Asks the stats ``*_f_asked`` and ``*_f_judged`` of the filters; None for systems without
        such a filter.
        """
        n_asked = self._tracked_with_stat("_f_asked")
        n_judged = self._tracked_with_stat("_f_judged")
        return 1 - n_judged / n_asked if n_asked else None

    def _tracked_with_stat(self, ending: str) -> int:
        """On how many tracked frames a diagnostic is not 0 whose name ends so."""
        count = 0
        for row in self.rows:
            if row.state == "ok":
                count += any(value for name, value in row.stats.items() if name.endswith(ending))
        return count

    def write(self, folder: Path, comment: str, exact: Mapping[float, int] | None = None) -> None:
        """Write `frames.csv`, `trajectory_online.txt` and, where there are any, `motion_covariances.txt`.

        Args:
            folder: The folder.
            comment: Head of the trajectory.
            exact: The nanoseconds of the frames' stamps by their seconds, where a float does not
                hold them.
        """
        write_tum(folder / ONLINE, self.trajectory().with_exact(exact or {}), comment=comment)
        write_csv(folder / CSV_FILE, self.rows, exact)
        covariances = self.motion_covariances()
        if len(covariances):
            write_motion_covariances(folder / COVARIANCES, covariances)


_COLUMN_TYPES = {"index": "int64", "timestamp": "float64", "state": "string", "reward_m": "float64"}
"""Columns that are never missing; all others are ``Float64``."""


def load_frames(
    run: RunRecord | Path | str, results: RunStore | Path | str = "results"
) -> pd.DataFrame:
    """The frames of a run.

    Args:
        run: A record; the run's id, its first digits or ``latest``; or a path: the run's folder
            (``results/latest``) or a ``frames.csv``.
        results: The results folder, or a store; not looked at if `run` is a path.

    Returns:
        One row a frame, in order. Columns that are always present: index (``int64``, in the run's
        part of the sequence), timestamp (``float64``, seconds), state (``string``:
        ``initialising``, ``ok``, ``lost`` or ``dropped``), reward_m (``float64``, metres).
        ``Float64``, missing (``pd.NA``) where there is no ground truth, no mask, or the stage did
        not run: frame_error_trans_m and frame_error_rot_deg (frame to frame, metres and degrees),
        pose_error_trans_m and pose_error_rot_deg (cumulative), mask_iou (0 to 1), dynamic_share (0
        to 1, only where the sequence has exact masks), ``<stage>_s`` (seconds of each stage;
        ``total_s`` is the frame time; ``read`` is decoding), ``stat_<name>`` (diagnostics).

    Raises:
        RunError: There is no such run, it has no frames (an imported trajectory), or its table is
            damaged.
    """
    import pandas as pd

    # what is missing becomes `pd.NA` in nullable columns
    rows = read_csv(_file(run, results))
    columns = column_names(rows)
    frame = pd.DataFrame([row.cells() for row in rows], columns=columns, dtype=object)
    return frame.astype({name: _COLUMN_TYPES.get(name, "Float64") for name in columns})


def _file(run: RunRecord | Path | str, results: RunStore | Path | str) -> Path:
    """The table of frames of a run, see `load_frames`."""
    path = Path(run.run_id if isinstance(run, RunRecord) else run).expanduser()
    if isinstance(run, RunRecord) or (isinstance(run, str) and not path.exists()):
        store = results if isinstance(results, RunStore) else RunStore(results)
        path = store.folder(store.find(str(path)))
    return path / CSV_FILE if path.is_dir() else path
