"""Where a study is kept: a journal file by default, any SQL database, or the gRPC proxy."""

from __future__ import annotations

import fcntl
import json
import os
import random
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote, urlsplit

import optuna
import psutil
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from sqlalchemy.exc import DBAPIError

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.passwords import HIDDEN, without_passwords
from dynslam_bench.tuning.study_file import StudySpec

JOURNAL = "journal.log"
_ATTEMPTS = 10
_BEING_MADE = ("already exists", "duplicate", "unique constraint", "is locked")
"""What drivers say where another worker makes the tables at the same time."""


def study_folder(results: Path, spec: StudySpec) -> Path:
    """Where a study's files lie."""
    return results / "studies" / spec.name


def open_storage(results: Path, spec: StudySpec) -> optuna.storages.BaseStorage:
    """Open, or begin, the storage of a study.

    Raises:
        StudyError: It cannot be reached or written, or is of no kind that is known.
    """
    if spec.storage:
        check_scheme(spec.storage)
    try:
        if not spec.storage:
            folder = study_folder(results, spec)
            folder.mkdir(parents=True, exist_ok=True)
            return optuna.storages.JournalStorage(JournalFile(folder / JOURNAL))
        if spec.storage.startswith("grpc://"):
            return _proxy(spec.storage)
        return open_database(spec.storage)
    except Exception as error:  # drivers raise whatever they like
        where = spec.storage or str(study_folder(results, spec))
        line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        said = without_password(f"cannot open the storage {where}: {line}", spec.storage)
        raise StudyError(said, "check the address and the permissions") from None


def open_database(url: str) -> BaseStorage:
    """Open a database, and make its tables if it is empty.

    Workers may begin at the same time: one whose tables another worker makes meanwhile tries again.

    Raises:
        Exception: What the database's driver raises.
    """
    for attempt in range(_ATTEMPTS):
        try:
            return optuna.storages.get_storage(RDBStorage(url, engine_kwargs={"pool_pre_ping": True}))
        except (DBAPIError, StorageInternalError) as error:
            cause = str(error.__cause__ or error).lower()
            if attempt + 1 == _ATTEMPTS or not any(words in cause for words in _BEING_MADE):
                raise
            time.sleep(random.uniform(0.05, 0.5))
    raise AssertionError("unreachable")


def worker_name() -> str:
    """Names this process: host and process number."""
    return f"{socket.gethostname()}:{os.getpid()}"


def worker_is_dead(name: str) -> bool:
    """Whether a worker on this host no longer runs; workers of other hosts count as alive."""
    host, _, pid = name.rpartition(":")
    if host != socket.gethostname() or not pid.isdigit():
        return False
    try:
        return psutil.Process(int(pid)).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def _proxy(address: str) -> optuna.storages.BaseStorage:
    host, _, port = address.removeprefix("grpc://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("write it as grpc://host:port")
    return optuna.storages.GrpcStorageProxy(host=host, port=int(port))


# The address of a study's storage: which ones are known, and what of it may be written down.

SCHEMES = ("sqlite", "postgresql", "mysql", "mariadb", "oracle", "mssql", "grpc")
"""SQL databases (also with a driver: ``postgresql+psycopg``) and Optuna's gRPC proxy; they hold data, never code."""


def check_scheme(address: str) -> None:
    """Raise `StudyError` unless the storage is of a kind that keeps plain data (Optuna unpickles what Redis holds)."""
    scheme = address.partition("://")[0].partition("+")[0]
    if "://" not in address or scheme not in SCHEMES:
        raise StudyError(
            f"the storage {without_passwords(address)!r} is of no kind that is known", f"one of {', '.join(SCHEMES)}"
        )


def without_password(text: str, address: str) -> str:
    """A text, for example a driver's message, without the password that an address holds."""
    try:
        password = urlsplit(address).password or ""
    except ValueError:
        password = ""
    for secret in {password, unquote(password)} - {""}:
        text = text.replace(secret, HIDDEN)
    return without_passwords(text)


# The journal file of a study: Optuna's, but no kill and no full disk can spoil it.

_BLOCK = 1 << 16


class JournalFile(JournalFileBackend):
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
