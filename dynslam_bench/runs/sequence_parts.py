"""Parts of sequences that a store keeps: stamps and ground truth of each part, by which runs are scored again.

The images are not needed for that.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import RunError, read_lines, translate_errors, write_atomic
from dynslam_bench.geometry import LoadedTrajectory, Trajectory, format_ns, format_tum, load_tum
from dynslam_bench.runs.layout import (
    STAMPS,
    TRUTH,
    check_plain,
    checked_id,
    content_of,
    file_stamp,
    read_errors,
)


class SequenceParts:
    """The folders ``sequences/<part>/`` of a store, each with ``timestamps.txt`` and ``groundtruth.txt``.

    Args:
        root: Folder of the store.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def folder(self, part: str) -> Path:
        """Folder of a part, whether it exists or not.

        Raises:
            RunError: It is no name of a part, which has 16 or 20 hexadecimal digits.
        """
        return self._root / "sequences" / checked_id(part, "the part of a sequence")

    def add(
        self, part: str, timestamps_ns: NDArray[np.int64], ground_truth: Trajectory | None
    ) -> None:
        """Keep the stamps of a part's frames, in nanoseconds, and its ground truth, in place of other ones."""
        folder = self.folder(part)
        texts = {}
        # stamps come last: a part whose stamps are there is complete
        if ground_truth is not None and len(ground_truth):
            texts[TRUTH] = format_tum(ground_truth)
        texts[STAMPS] = "".join(f"{format_ns(ns)}\n" for ns in timestamps_ns.tolist())
        for name, text in texts.items():
            if content_of(folder / name) != text.encode():
                write_atomic(folder / name, text)

    def copy_from(self, other: SequenceParts, part: str) -> None:
        """Copy the ground truth and then the stamps of a part of another store, if its stamps are not here.

        Raises:
            InfrastructureError: They cannot be written.
            RunError: They cannot be read.
        """
        folder = self.folder(part)
        if (folder / STAMPS).is_file():
            return
        for file in sorted(other.folder(part).glob("*.txt")):
            with read_errors(file):
                content = file.read_bytes()
            write_atomic(folder / file.name, content)

    def ground_truth(self, part: str, *, repeats: bool = False) -> Trajectory | None:
        """The ground truth of a part, with `repeats` all poses of a repeated stamp; None if it has none."""
        path = self.folder(part) / TRUTH
        check_plain(path.parent, self._root)
        if not path.is_file():
            return None
        return _read_truth(path, file_stamp(path)).poses(repeats=repeats)

    def timestamps(self, part: str) -> NDArray[np.float64]:
        """Stamps in seconds of all input frames of a part.

        Raises:
            RunError: They are not stored, or damaged.
        """
        path = self.folder(part) / STAMPS
        check_plain(path.parent, self._root)
        return _read_stamps(path, file_stamp(path))


# Many runs share a part: what was read is kept as long as the file's stamp stays the same.


@lru_cache(maxsize=64)
def _read_truth(path: Path, _stamp: str) -> LoadedTrajectory:
    """A ground truth; its arrays are read-only."""
    file = load_tum(path)
    for truth in (file.trajectory, file.poses(repeats=True)):
        truth.timestamps.flags.writeable = False
        truth.T_world_cam.flags.writeable = False
    return file


@lru_cache(maxsize=64)
def _read_stamps(path: Path, _stamp: str) -> NDArray[np.float64]:
    """The stamps of a part in seconds, read-only."""
    with translate_errors(
        RunError, f"cannot read {path}", "the results folder is incomplete", of=ValueError
    ):
        lines = [line for line in read_lines(path, kind=RunError) if line.strip()]
        stamps = np.array([float(line) for line in lines], dtype=np.float64)
    stamps.flags.writeable = False
    return stamps
