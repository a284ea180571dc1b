"""From the child's frame log to `frames.csv`, the online trajectory and the sums of a record."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.tum_file import write_tum

from .record import StageTime

CSV_FILE = "frames.csv"
ONLINE_FILE = "trajectory_online.txt"
_FIXED = (
    "index", "timestamp", "state", "frame_error_trans_m", "frame_error_rot_deg", "pose_error_trans_m",
    "pose_error_rot_deg", "reward_m", "mask_iou",
)  # fmt: skip


@dataclass
class FrameLog:
    """The frames of a run, as far as it came.

    Attributes:
        rows: One mapping a frame, as the child wrote it.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> FrameLog:
        """Read the child's log; a line that a dying process left unfinished is not taken."""
        if not path.is_file():
            return cls()
        lines = path.read_text().split("\n")
        return cls([json.loads(line) for line in lines[:-1]])

    def count(self, state: str) -> int:
        """Frames of a state."""
        return sum(row["state"] == state for row in self.rows)

    def lost_streak(self) -> int:
        """Frames lost in a row at the end."""
        streak = 0
        for row in reversed(self.rows):
            if row["state"] != "lost":
                break
            streak += 1
        return streak

    def trajectory(self) -> Trajectory:
        """The online trajectory."""
        tracked = [row for row in self.rows if row["pose"] is not None]
        values = np.array([row["pose"] for row in tracked], dtype=np.float64).reshape(-1, 7)
        stamps = np.array([row["timestamp"] for row in tracked], dtype=np.float64)
        return Trajectory(stamps, se3.from_quaternion(values[:, :3], values[:, 3:]) if tracked else np.zeros((0, 4, 4)))

    def timings(self) -> dict[str, StageTime]:
        """Median, p95 and mean of every stage over the frames that reached the tracker."""
        frames = [row["timings"] for row in self.rows if row["timings"]]
        found = {}
        for stage in _keys(frames):
            values = np.array([frame.get(stage, 0.0) for frame in frames])
            found[stage] = StageTime(
                median_s=float(np.median(values)), p95_s=float(np.percentile(values, 95)), mean_s=float(values.mean())
            )
        return found

    def mask_iou(self) -> float | None:
        """Mean overlap of the dynamic mask with the exact masks of people over the frames where either has pixels."""
        overlaps = [overlap for overlap in map(_overlap, self.rows) if overlap is not None]
        return float(np.mean(overlaps)) if overlaps else None

    def epipolar_skipped(self) -> float | None:
        """Share of the tracked frames on which no fundamental matrix judged, of those with an image to compare with.

        Asks the stats ``*_f_asked`` and ``*_f_judged`` of the filters; None for systems without such a filter.
        """
        tracked = [row["stats"] for row in self.rows if row["state"] == "ok"]
        asked, judged = (
            sum(any(value for name, value in stats.items() if name.endswith(ending)) for stats in tracked)
            for ending in ("_f_asked", "_f_judged")
        )
        return 1 - judged / asked if asked else None

    def write(self, folder: Path, comment: str) -> None:
        """Write `frames.csv` and `trajectory_online.txt`."""
        write_tum(folder / ONLINE_FILE, self.trajectory(), comment=comment)
        stages, stats = _keys(row["timings"] for row in self.rows), _keys(row["stats"] for row in self.rows)
        with (folder / CSV_FILE).open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow([*_FIXED, *(f"{stage}_s" for stage in stages), *(f"stat_{name}" for name in stats)])
            for row in self.rows:
                errors = row["error"] or [None] * 4
                fixed = [row["index"], f"{row['timestamp']:.6f}", row["state"], *errors, row["reward"], _overlap(row)]
                table.writerow(
                    [*fixed, *(row["timings"].get(key) for key in stages), *(row["stats"].get(key) for key in stats)]
                )


def _overlap(row: dict[str, Any]) -> float | None:
    counts = row.get("mask")
    return counts[0] / sum(counts) if counts is not None and sum(counts) else None


def _keys(mappings: Iterable[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(key for mapping in mappings for key in mapping))
