"""Files and folders written under another name, then renamed: no half of one is ever seen under its own name.

What is written has the permissions that the user's umask gives.
"""

import ctypes
import errno
import fcntl
import os
import re
import secrets
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dynslam_bench.core.errors import InfrastructureError, translate_errors

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")
"""Names that `_reserve` gives."""
_POLL_S = 0.1
"""Pause before a lock that another process holds is asked for again."""
_CURE = "check the permissions and the free space"
"""Hint of errors about files that cannot be written."""
_AT_FDCWD = -100
"""Stands for the working folder, from which relative paths are resolved (renameat2(2))."""
_RENAME_EXCHANGE = 2
"""Flag of renameat2(2): both names exist, and each gets what the other one was."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that becomes `path` when the block ends without an error.

    The parent folder is made if need be. If the block raises, `path` is as it was and nothing is
    left beside it; what a killed process leaves is removed by `sweep_temporary`.

    Raises:
        OSError: The folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary, lock = _reserve(path, lambda fresh: fresh.touch(exist_ok=False))
    try:
        yield temporary
        temporary.replace(path)
    finally:
        with suppress(OSError):  # it has become `path`, or the disk takes nothing more
            temporary.unlink()
        os.close(lock)


def write_atomic(path: Path, content: str | bytes | memoryview) -> None:
    """Write a file under a temporary name beside its target, then rename it into place.

    Raises:
        InfrastructureError: The folder cannot be written (full disk, permissions); nothing is left
            behind.
    """
    if isinstance(content, str):
        content = content.encode(errors="backslashreplace")
    with (
        translate_errors(InfrastructureError, f"cannot write {path}", _CURE),
        replacing(path) as temporary,
    ):
        temporary.write_bytes(content)


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines as `write_atomic` does, without holding all of them at once; each gets its newline here.

    Raises:
        InfrastructureError: The folder cannot be written (full disk, permissions); nothing is left
            behind.
    """
    with (
        translate_errors(InfrastructureError, f"cannot write {path}", _CURE),
        replacing(path) as temporary,
        temporary.open("wb") as file,
    ):
        file.writelines(f"{line}\n".encode(errors="backslashreplace") for line in lines)


def replace_folder(work: Path, target: Path) -> None:
    """Rename a finished folder to `target`, on the same file system; what `target` held before is deleted.

    At every moment `target` is what it was or what it is to be, even if others replace it at the
    same time (where the system can exchange two names at once: Linux, on its own file systems;
    elsewhere it is missing for a moment).

    Raises:
        OSError: It cannot be renamed; then `target` is as it was.
    """
    old = work.with_name(f"{work.name}.old")
    while True:
        # where nothing lies at the target a rename is enough
        try:
            work.rename(target)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                with suppress(OSError):  # what was moved aside below, if anything was
                    old.rename(target)
                raise
        # else both exchange their names at once
        if _exchange(work, target):
            old = work
            break
        # where the system cannot do so, the target is moved aside, and the rename tried again
        shutil.rmtree(old, ignore_errors=True)
        with suppress(FileNotFoundError):  # another process has just moved it away
            target.rename(old)
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Give each of two folders the other's name; False if the system cannot do so at once, or one is gone."""
    libc = ctypes.CDLL(None, use_errno=True)
    names = (_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other))
    return hasattr(libc, "renameat2") and libc.renameat2(*names, _RENAME_EXCHANGE) == 0


def _reserve(path: Path, make: Callable[[Path], None]) -> tuple[Path, int]:
    """Make a file or folder of a temporary name beside `path`, and lock it.

    Another process may remove it as abandoned before it is locked; then it is made again.

    Returns:
        Its path, and the descriptor that holds the lock.
    """
    while True:
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
        make(temporary)
        with suppress(FileNotFoundError):
            lock = os.open(temporary, os.O_RDONLY)
            with suppress(OSError):  # the file system knows no locks
                fcntl.flock(lock, fcntl.LOCK_EX)  # waits for a process that is looking at it
            if _is_at(lock, temporary):
                return temporary, lock
            os.close(lock)


def is_temporary(path: Path) -> bool:
    """Whether a name is one that this module gives to what is not finished."""
    return _TEMPORARY.fullmatch(path.name) is not None


def sweep_temporary(folder: Path, pattern: str = ".*") -> None:
    """Remove the temporary files and folders that killed processes left in a folder.

    Args:
        folder: Folder to clean; nothing happens if it is missing.
        pattern: Glob pattern below `folder` of the paths to look at, e.g. ``runs/.*``.
    """
    for path in filter(is_temporary, folder.glob(pattern)):
        # it is locked while it is removed: a process that has just made it waits, and makes it again
        with _locked_if_abandoned(path) as is_ours, suppress(OSError):  # it is another user's
            if not is_ours:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """A hidden folder beside `target` that is removed when the block ends, if it still has its name.

    Raises:
        InfrastructureError: The parent folder cannot be written.
    """
    with translate_errors(
        InfrastructureError, f"cannot write into {target.parent}", "name another folder"
    ):
        target.parent.mkdir(parents=True, exist_ok=True)
        work, lock = _reserve(target, Path.mkdir)
    try:
        yield work
    finally:
        os.close(lock)
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A temporary folder beside `target` that becomes `target` when the block ends without an error.

    An existing target is replaced. If the block raises, or the process dies, `target` is as it was;
    what a killed process left is swept up by the next one.

    Raises:
        InfrastructureError: The parent folder cannot be written, or was removed meanwhile.
    """
    sweep_temporary(target.parent)
    with temporary_folder(target) as work:
        yield work
        with translate_errors(
            InfrastructureError, f"cannot write {target}", "check the permissions"
        ):
            replace_folder(work, target)


# -- locks, which the system releases when their holder dies ---------------------------------------


@contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """Take a lock for as long as the block lasts, if no other process holds it; its file is removed afterwards.

    Args:
        path: The lock's file; its folder exists.

    Yields:
        Whether this process holds the lock; always true where the file system knows no locks.

    Raises:
        InfrastructureError: The file cannot be made.
    """
    with translate_errors(
        InfrastructureError, f"cannot write {path}", "check the permissions and the disk"
    ):
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        # a locked file without its name is one that the last holder has just removed
        is_held = _lock(handle) is not False and _is_at(handle, path)
        try:
            yield is_held
        finally:
            if is_held:  # while it is locked, so that no process locks a file that is being removed
                with suppress(OSError):  # a file that stays does no damage
                    path.unlink()
    finally:
        os.close(handle)


@contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """Take a lock for as long as the block lasts, and wait while another process holds it (see `try_lock`)."""
    while True:
        with try_lock(path) as is_held:
            if is_held:
                yield
                return
        time.sleep(_POLL_S)


def is_abandoned(path: Path) -> bool:
    """Whether a file or folder is there and no process holds it; False where there are no locks."""
    with _locked_if_abandoned(path) as is_ours:
        return is_ours


@contextmanager
def _locked_if_abandoned(path: Path) -> Iterator[bool]:
    """Lock a file or folder while the block lasts, if it is there and no other process holds it.

    Yields:
        Whether it is locked; False where the file system knows no locks.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        yield False
        return
    try:
        yield _lock(handle) is True
    finally:
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    """Whether an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False


def _lock(handle: int) -> bool | None:
    """Whether the lock was free and is ours now; None where the file system knows none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


# -- private temporary folders, which are removed with the process that made them, also when that is killed ---

_PRIVATE = "dynslam-private"
"""In the names of `TemporaryFolder`s."""
SHARED_MEMORY = Path("/dev/shm")
"""Linux's file system in main memory."""


class TemporaryFolder:
    """A folder that only this user may enter; removed by `close`, at the latest with the object.

    It is locked while its process lives, so that `sweep` knows those of killed processes.

    Args:
        base: Folder in which it is made; None for the system's folder of temporary files.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, base: Path | None = None) -> None:
        parent = Path(tempfile.gettempdir()) if base is None else base
        self.path, lock = _reserve(parent / _PRIVATE, lambda fresh: fresh.mkdir(mode=0o700))
        self._remove = weakref.finalize(self, _remove, self.path, lock, os.getpid())

    def close(self) -> None:
        """Remove it with what it holds; may be called more than once."""
        self._remove()


def sweep() -> None:
    """Remove this user's `TemporaryFolder`s whose process is no more."""
    for base in {Path(tempfile.gettempdir()), SHARED_MEMORY}:
        sweep_temporary(base, f".{_PRIVATE}.*")


def _remove(path: Path, lock: int, owner: int) -> None:
    """Remove a folder, if this process made it, and give up its lock."""
    if os.getpid() == owner:  # a fork of the owner does not own it
        shutil.rmtree(path, ignore_errors=True)
    os.close(lock)
