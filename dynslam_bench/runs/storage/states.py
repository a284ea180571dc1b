"""What lies on the disk of a run, as far as names, times and sizes tell: what was taken from a state holds with it."""

from __future__ import annotations

import os
from hashlib import blake2b
from pathlib import Path

from dynslam_bench.core.errors import RunError

Stamp = tuple[int, int]
"""Time (nanoseconds) and size (bytes) of a file."""
NO_FILE: Stamp = (0, 0)


def stamp_of(file: str | Path) -> Stamp:
    """Time and size of a file.

    Raises:
        OSError: It is not there.
    """
    found = os.stat(file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    return found.st_mtime_ns, found.st_size


def stamp_if_there(file: str | Path) -> Stamp:
    """The same; `NO_FILE` where there is none."""
    try:
        return stamp_of(file)
    except OSError:
        return NO_FILE


def check_plain(folder: str | Path, root: Path) -> None:
    """A folder holds plain files of its store: no link to a file elsewhere, no pipe that is never written.

    Raises:
        RunError: It names what is none of it. A folder that is not there has nothing: who reads it, says so.
    """
    folder_state(folder, root)


def folder_state(folder: str | Path, root: Path) -> str:
    """A digest of the names, times and sizes of all that lies in a folder; empty for one that cannot be read.

    Args:
        folder: Of a run, or of the ground truth of a sequence's part.
        root: The store that it belongs to.

    Raises:
        RunError: It holds a link that leads out of the store, or something that is no plain file.
    """
    try:
        with os.scandir(folder) as entries:
            found = sorted((entry.name, *_stamp(entry, root)) for entry in entries)
    except OSError:
        return ""
    return blake2b(repr(found).encode(errors="backslashreplace"), digest_size=8).hexdigest()


def _stamp(entry: os.DirEntry[str], root: Path) -> Stamp:
    if entry.is_symlink() and not Path(entry.path).resolve().is_relative_to(root.resolve()):
        raise RunError(f"{entry.path} is a link that leads out of {root}", "put the file in its place")
    if not entry.is_file():
        if not entry.is_dir():
            raise RunError(f"{entry.path} is no plain file")
        return NO_FILE  # its files are none of the store's
    return stamp_if_there(entry.path)
