"""Locks that the system releases when their holder dies, in whatever way.

They tell what is in use from what a killed process left behind. Files and folders can be held; on Linux other machines
that share the file system see it, where that knows locks.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import DynslamError


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Hold a name while the block lasts, if nobody else does; its file is removed afterwards.

    Args:
        path: Of the lock's file; its folder exists.

    Yields:
        Whether it is held; always, where the file system knows no locks.

    Raises:
        DynslamError: The file cannot be made.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        raise DynslamError(f"cannot write {path}: {error.strerror}", "check the permissions and the disk") from error
    try:
        mine = _lock(handle) is not False and _is(handle, path)  # else its last holder has just removed it
        try:
            yield mine
        finally:
            if mine:  # while it is locked, so that nobody locks a file that goes away unseen
                with contextlib.suppress(OSError):  # it is harmless if it stays
                    path.unlink()
    finally:
        os.close(handle)


def hold(path: Path) -> int:
    """Lock a file or folder until the descriptor is closed, or this process and those that it forked have ended.

    Raises:
        OSError: It is not there.
    """
    handle = os.open(path, os.O_RDONLY)
    _lock(handle)
    return handle


def is_abandoned(path: Path) -> bool:
    """Whether a file or folder is there and nobody holds it; False where the file system knows no locks."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        return _lock(handle) is True
    finally:
        os.close(handle)


def _lock(handle: int) -> bool | None:
    """Whether the lock was free and is ours now; None where the file system knows none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is(handle: int, path: Path) -> bool:
    try:
        return os.fstat(handle).st_ino == path.stat().st_ino
    except OSError:
        return False
