"""Layout of the files of a store, and checks of them."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dynslam_bench.core import RunError, translate_errors

INDEX_FILE = "index.sqlite"
"""Holds what was computed from the runs, see `index.RunIndex`."""
RUN_FILE = "run.json"
"""Holds the record of a run."""
ONLINE = "trajectory_online.txt"
"""Holds the pose of each tracked frame as it was when the frame came."""
FINAL = "trajectory_final.txt"
"""Holds the poses after the final optimisation."""
COVARIANCES = "motion_covariances.txt"
"""Holds the covariance of the motion to each tracked frame, of trackers that give them."""
STAMPS = "timestamps.txt"
"""Holds the stamps of the input frames of a sequence's part."""
TRUTH = "groundtruth.txt"
"""Holds the ground truth of a sequence's part."""
REMOVED_HINT = "if it was removed meanwhile, repeat the command"
TrajectoryKind = Literal["online", "final"]
"""One of the two trajectories of a run."""

_ID = re.compile(r"[0-9a-f]{16}([0-9a-f]{4})?")


@dataclass(frozen=True)
class Unreadable:
    """A folder of the store that holds no valid record."""

    path: Path
    reason: str


def is_id(name: str) -> bool:
    """Whether a name is that of a run's folder: 20 hexadecimal digits, or 16 of older runs."""
    return _ID.fullmatch(name) is not None


def checked_id(name: str, what: str) -> str:
    """A name that data gives to a folder of the store, if it is one that this package makes.

    Any other name could lead out of the store.

    Raises:
        RunError: It is none; `what` says of what it should be the name.
    """
    if not is_id(name):
        raise RunError(
            f"{name[:100]!r} is not {what}: expected 20 hexadecimal digits, or 16 of older runs"
        )
    return name


def file_stamp(file: str | Path) -> str:
    """Times of content and inode (nanoseconds) and size (bytes) of a file; ``-`` where there is none."""
    try:
        status = os.stat(file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    except OSError:
        return "-"
    return f"{status.st_mtime_ns},{status.st_ctime_ns},{status.st_size}"


def check_plain(folder: Path, root: Path) -> None:
    """Check that a folder holds plain files of its store: no link to elsewhere, no pipe that nothing writes.

    Raises:
        RunError: It names the offending entry. A folder that is not there has none.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink() and not Path(entry.path).resolve().is_relative_to(root.resolve()):
                raise RunError(
                    f"{entry.path} is a link that leads out of {root}", "put the file in its place"
                )
            if not entry.is_file() and not entry.is_dir():
                raise RunError(f"{entry.path} is no plain file")


def content_of(file: Path) -> bytes:
    """The content of a file; none where there is no file.

    Raises:
        RunError: It cannot be read.
    """
    if not file.is_file():
        return b""
    with read_errors(file):
        return file.read_bytes()


def have_equal_files(one: Path, other: Path, *names: str) -> bool:
    """Whether files of two folders have the same content; a missing file is an empty one."""
    return all(content_of(one / name) == content_of(other / name) for name in names)


def read_errors(file: str | Path) -> contextlib.AbstractContextManager[None]:
    """Turns errors of the system while a file of a store is read into a `RunError`."""
    return translate_errors(RunError, f"cannot read {file}", REMOVED_HINT)
