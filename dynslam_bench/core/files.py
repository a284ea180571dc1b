"""Files and folders written under another name, then renamed: no half of one is ever seen under its own name.

What is written has the permissions that the user's umask gives.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import DynslamError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that becomes `path` when the block ends without an error.

    The parent folder is made if need be. If the block raises, `path` is as it was and nothing is left beside it.

    Raises:
        OSError: The folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _beside(path)
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_atomic(path: Path, content: str | bytes | memoryview) -> None:
    """Write a file under a temporary name beside its target, then rename it into place.

    Raises:
        DynslamError: The folder cannot be written (full disk, permissions); nothing is left behind.
    """
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)
    except OSError as error:
        reason = f"cannot write {path}: {error.strerror}"
        raise DynslamError(reason, "check the permissions and the free space") from error


def replace_folder(work: Path, target: Path) -> None:
    """Rename a finished folder to `target`, beside which it lies; an earlier `target` is deleted.

    Raises:
        OSError: It cannot be renamed; then `target` is as it was.
    """
    if not target.exists():
        work.replace(target)
        return
    stale = _beside(target)
    stale.mkdir()
    try:
        target.replace(stale / "old")
        try:
            work.replace(target)
        except OSError:
            (stale / "old").replace(target)
            raise
    finally:
        shutil.rmtree(stale, ignore_errors=True)


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A temporary folder beside `target` that becomes `target` when the block ends without an error.

    An existing target is replaced. If the block raises, or the process dies, `target` is as it was; what a process of
    this machine left when it died is swept up by the next one.

    Raises:
        DynslamError: The parent folder cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target)
        work = _beside(target)
        work.mkdir()
    except OSError as error:
        raise DynslamError(f"cannot write into {target.parent}: {error.strerror}", "name another folder") from error
    try:
        yield work
        replace_folder(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _beside(target: Path) -> Path:
    """A hidden name beside a target that tells whose it is."""
    return target.with_name(f".{target.name}.{socket.gethostname()}.{os.getpid()}.{secrets.token_hex(4)}")


def _sweep(target: Path) -> None:
    """Remove the hidden folders beside a target that belonged to processes of this machine that are no more."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.{re.escape(socket.gethostname())}\.(\d+)\.[0-9a-f]{{8}}")
    for left in target.parent.iterdir():
        match = pattern.fullmatch(left.name)
        if match and not process_exists(int(match[1])):
            shutil.rmtree(left, ignore_errors=True)


def process_exists(pid: int) -> bool:
    """Whether a process of this machine has that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
