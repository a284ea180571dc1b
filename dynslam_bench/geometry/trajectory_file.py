"""Trajectory files of either format: TUM's, which carry their stamps, and KITTI's, whose stamps lie in another file."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.core.reading import read_lines

from .kitti_file import read_kitti
from .stamps import to_seconds
from .tum_file import FileNotes, TumFile, load_tum, read_stamps

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
    ns = read_stamps(Path(timestamps))
    seconds = to_seconds(ns)
    trajectory = read_kitti(path, seconds, described=str(timestamps))
    trajectory = trajectory.with_exact(dict(zip(seconds.tolist(), ns.tolist(), strict=True)))
    return TumFile(trajectory, FileNotes(lines=len(trajectory)))


def _values(path: Path) -> int:
    """Values in the first line that holds any."""
    for line in read_lines(path, kind=TrajectoryError):
        parts = line.partition("#")[0].replace(",", " ").split()
        if parts:
            return len(parts)
    return 0
