"""From the child's frame log to `frames.csv`, the online trajectory and the sums of a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.tum_file import write_tum

from ..frame_row import CSV_FILE, FrameRow, read_log, write_csv
from .record import StageTime

ONLINE_FILE = "trajectory_online.txt"


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
        """Read the child's log; a line that a dying process left unfinished is not taken."""
        return cls(*read_log(path))

    def count(self, state: str) -> int:
        """Frames of a state."""
        return sum(row.state == state for row in self.rows)

    def lost_streak(self) -> int:
        """Frames lost in a row at the end."""
        streak = 0
        for row in reversed(self.rows):
            if row.state != "lost":
                break
            streak += 1
        return streak

    def trajectory(self) -> Trajectory:
        """The online trajectory."""
        tracked = [(row.timestamp, row.pose) for row in self.rows if row.pose is not None]
        stamps = np.array([stamp for stamp, _ in tracked], dtype=np.float64)
        poses = np.array([pose for _, pose in tracked], dtype=np.float64).reshape(-1, 7)
        return Trajectory(stamps, se3.from_quaternion(poses[:, :3], poses[:, 3:]) if tracked else np.zeros((0, 4, 4)))

    def timings(self) -> dict[str, StageTime]:
        """Median, p95 and mean of every stage over the frames that reached the tracker."""
        frames = [row.timings for row in self.rows if row.timings]
        found = {}
        for stage in dict.fromkeys(stage for frame in frames for stage in frame):
            values = np.array([frame.get(stage, 0.0) for frame in frames])
            found[stage] = StageTime(
                median_s=float(np.median(values)), p95_s=float(np.percentile(values, 95)), mean_s=float(values.mean())
            )
        return found

    def mask_iou(self) -> float | None:
        """Mean overlap of the dynamic mask with the exact masks of people over the frames where either has pixels."""
        overlaps = [row.mask_iou for row in self.rows if row.mask_iou is not None]
        return float(np.mean(overlaps)) if overlaps else None

    def epipolar_skipped(self) -> float | None:
        """Share of the tracked frames on which no fundamental matrix judged, of those with an image to compare with.

        Asks the stats ``*_f_asked`` and ``*_f_judged`` of the filters; None for systems without such a filter.
        """
        tracked = [row.stats for row in self.rows if row.state == "ok"]
        asked, judged = (
            sum(any(value for name, value in stats.items() if name.endswith(ending)) for stats in tracked)
            for ending in ("_f_asked", "_f_judged")
        )
        return 1 - judged / asked if asked else None

    def write(self, folder: Path, comment: str, exact: Mapping[float, int] | None = None) -> None:
        """Write `frames.csv` and `trajectory_online.txt`.

        Args:
            folder: Where.
            comment: Head of the trajectory.
            exact: The nanoseconds of the frames' stamps by their seconds, where a float does not hold them.
        """
        write_tum(folder / ONLINE_FILE, self.trajectory().with_exact(exact or {}), comment=comment)
        write_csv(folder / CSV_FILE, self.rows, exact)
