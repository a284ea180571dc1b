"""Private temporary folders that go with the process that made them, also when that is killed."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from pathlib import Path

from .locks import hold, is_abandoned

_PREFIX = "dynslam-held-"
SHARED_MEMORY = Path("/dev/shm")


class TemporaryFolder:
    """A folder that only this user may enter; removed by `close`, at the latest with the object.

    It is locked while its process lives, so that `sweep` knows those of killed processes.

    Args:
        base: Where; None for the system's folder of temporary files.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, base: Path | None = None) -> None:
        fresh = Path(tempfile.mkdtemp(prefix=f"new-{_PREFIX}", dir=base))
        lock = hold(fresh)
        self.path = fresh.rename(fresh.with_name(fresh.name.removeprefix("new-")))  # from now on `sweep` sees it
        self._remove = weakref.finalize(self, _remove, self.path, lock, os.getpid())

    def close(self) -> None:
        """Remove it with what it holds; may be called more than once."""
        self._remove()


def sweep() -> int:
    """Remove this user's folders whose process is no more; returns how many there were."""
    abandoned = [
        folder
        for base in {Path(tempfile.gettempdir()), SHARED_MEMORY}
        for folder in base.glob(f"{_PREFIX}*")
        if _is_mine(folder) and is_abandoned(folder)
    ]
    for folder in abandoned:
        shutil.rmtree(folder, ignore_errors=True)
    return len(abandoned)


def _is_mine(folder: Path) -> bool:
    try:
        return folder.is_dir() and folder.stat().st_uid == os.getuid()
    except OSError:  # its process has just removed it
        return False


def _remove(path: Path, lock: int, owner: int) -> None:
    if os.getpid() == owner:  # a fork of the owner does not own it
        shutil.rmtree(path, ignore_errors=True)
    os.close(lock)
