"""Files and folders written under another name, then renamed: no half of one is ever seen under its own name."""

from __future__ import annotations

import os
import shutil
import tempfile
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
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
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
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        reason = f"cannot write {path}: {error.strerror}"
        raise DynslamError(reason, "check the permissions and the free space") from error


def replace_folder(work: Path, target: Path) -> None:
    """Rename a finished folder to `target`, beside which it lies; an earlier `target` is deleted.

    Raises:
        OSError: It cannot be renamed; then `target` is as it was.
    """
    work.chmod(0o755)
    if not target.exists():
        work.replace(target)
        return
    stale = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
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

    An existing target is replaced. If the block raises, or the process dies, `target` is as it was.

    Raises:
        DynslamError: The parent folder cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise DynslamError(f"cannot write into {target.parent}: {error.strerror}", "name another folder") from error
    try:
        yield work
        replace_folder(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
