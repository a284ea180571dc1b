"""Trajectory files of either format: TUM's, which carry their stamps, and KITTI's, whose stamps lie in another file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.core.reading import read_lines

from .kitti_file import read_kitti
from .tum_file import FileNotes, TumFile, load_tum

KITTI_VALUES = 12


def load_trajectory(path: str | Path, timestamps: str | Path | None = None) -> TumFile:
    """Read a trajectory with the counts of what was not taken as it stands.

    Args:
        path: Lines of 8 values (TUM) or, where `timestamps` is given, of 12 (KITTI).
        timestamps: A file whose lines begin with a stamp in seconds each: a ``times.txt``, or a list such as
            ``rgb.txt``; used for lines of 12 values only.

    Raises:
        TrajectoryError: A file cannot be read, is malformed, or the stamps do not fit the poses.
    """
    path = Path(path)
    if timestamps is None or _values(path) != KITTI_VALUES:
        return load_tum(path)
    trajectory = read_kitti(path, np.array(_stamps(Path(timestamps))), described=str(timestamps))
    return TumFile(trajectory, FileNotes(lines=len(trajectory)))


def _values(path: Path) -> int:
    """Values in the first line that holds any."""
    for line in read_lines(path, kind=TrajectoryError):
        parts = line.partition("#")[0].replace(",", " ").split()
        if parts:
            return len(parts)
    return 0


def _stamps(path: Path) -> list[float]:
    found = []
    for number, line in enumerate(read_lines(path, kind=TrajectoryError), start=1):
        parts = line.partition("#")[0].replace(",", " ").split()
        if not parts:
            continue
        try:
            found.append(float(parts[0]))
        except ValueError:
            raise TrajectoryError(f"{path} line {number}: '{parts[0][:40]}' is not a stamp in seconds") from None
    return found
