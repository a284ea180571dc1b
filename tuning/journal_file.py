"""The journal file of a study: Optuna's, but no kill and no full disk can spoil it."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from optuna.storages.journal import JournalFileBackend

from dynslam_bench.core.errors import StudyError

_BLOCK = 1 << 16


class WholeLines(JournalFileBackend):
    """Appends whole lines or nothing.

    A line that a killed process left unfinished is cut off before the next one is written (Optuna appends to it, and
    can never read the file again); what did not fit on the disk is taken back. The lock lies on the file itself, so
    that it goes with its holder; Optuna's own outlives a killed process by 30 s.

    Args:
        path: The file; begun if it is missing.

    Raises:
        StudyError: It cannot be begun.
    """

    def __init__(self, path: Path) -> None:
        if path.is_symlink():
            raise StudyError(f"{path} is a link: a study is written in its own folder", "put the file in its place")
        with _clear(path):
            super().__init__(str(path))
        self.path = path

    def append_logs(self, logs: Sequence[dict[str, Any]]) -> None:
        """Append entries.

        Raises:
            StudyError: They cannot be written; then the file is as it was.
        """
        text = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs).encode()
        with _clear(self.path), self.path.open("r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            end = end_of_whole_lines(file)
            file.truncate(end)
            _append(file, end, text)


@contextmanager
def _clear(path: Path) -> Iterator[None]:
    """What a file system refuses is one clear error."""
    try:
        yield
    except OSError as error:
        raise StudyError(
            f"cannot write {path}: {error.strerror}",
            "free some space, if that is it; the same command goes on from there",
        ) from error


def end_of_whole_lines(file: IO[bytes]) -> int:
    """Where the last whole line of a file ends; what follows was left unfinished."""
    begin = file.seek(0, os.SEEK_END)
    while begin:
        size = min(_BLOCK, begin)
        begin = file.seek(begin - size)
        found = file.read(size).rfind(b"\n")
        if found >= 0:
            return begin + found + 1
    return 0


def _append(file: IO[bytes], end: int, text: bytes) -> None:
    """Write at the end; takes it back if not all of it can be written."""
    file.seek(end)
    rest = memoryview(text)
    try:
        while rest:
            rest = rest[file.write(rest) :]
        os.fsync(file.fileno())
    except OSError:
        file.truncate(end)
        raise
