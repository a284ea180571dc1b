"""Where a study is stored: a journal file by default, any SQL database, or Optuna's gRPC proxy."""

from __future__ import annotations

import fcntl
import json
import os
import random
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import optuna
import psutil
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from sqlalchemy.exc import DBAPIError

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.reading import read_json
from dynslam_bench.core.sanitise import HIDDEN, without_passwords
from dynslam_bench.tuning.study_file import StudySpec, make_spec

SCHEMES = ("sqlite", "postgresql", "mysql", "mariadb", "oracle", "mssql", "grpc")
"""SQL databases (also with a driver: ``postgresql+psycopg``) and Optuna's gRPC proxy. They hold data, never code;
Optuna unpickles what Redis holds."""
_ATTEMPTS = 10
_BEING_MADE = ("already exists", "duplicate", "unique constraint", "is locked")
"""What drivers say where another worker makes the tables at the same time."""


def study_folder(results: Path, spec: StudySpec) -> Path:
    """The folder of a study's files."""
    return results / "studies" / spec.name


def open_storage(results: Path, spec: StudySpec) -> BaseStorage:
    """Open, or begin, the storage of a study.

    Raises:
        StudyError: It cannot be reached or written, or is of no kind that is known.
    """
    scheme, separator, address = spec.storage.partition("://")
    if spec.storage and not (separator and scheme.partition("+")[0] in SCHEMES):
        raise StudyError(
            f"the storage {without_passwords(spec.storage)!r} is of no kind that is known",
            f"one of {', '.join(SCHEMES)}",
        )
    folder = study_folder(results, spec)
    try:
        if not spec.storage:
            folder.mkdir(parents=True, exist_ok=True)
            return optuna.storages.JournalStorage(JournalFile(folder / "journal.log"))
        if scheme != "grpc":
            return open_database(spec.storage)
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ValueError("write it as grpc://host:port")
        return optuna.storages.GrpcStorageProxy(host=host, port=int(port))
    except Exception as error:  # each driver raises errors of its own
        line = (str(error).strip() or type(error).__name__).splitlines()[0]
        text = without_password(f"cannot open the storage {spec.storage or folder}: {line}", spec.storage)
        raise StudyError(text, "check the address and the permissions") from None


SPEC_FILE = "study.json"


def read_stored(folder: Path) -> tuple[StudySpec, Path]:
    """The study that lies in a folder, and the results folder that it lies in.

    Raises:
        StudyError: There is none.
    """
    stored = folder / SPEC_FILE
    if not stored.is_file():
        raise StudyError(f"{folder} holds no study: it has no {SPEC_FILE}", "name results/studies/NAME")
    return make_spec(read_json(stored, kind=StudyError), str(stored)), folder.absolute().parents[1]


def load_study(results: Path, spec: StudySpec, **how: Any) -> optuna.Study:
    """Load a stored study.

    Args:
        results: The results folder.
        spec: The study.
        **how: Further arguments of ``optuna.load_study``.

    Raises:
        StudyError: There is none; nothing is made then.
    """
    absent = StudyError(f"there is no study '{spec.name}' in {results}", "dynslam-bench tune run STUDY.toml")
    if not spec.storage and not study_folder(results, spec).is_dir():
        raise absent
    try:
        return optuna.load_study(study_name=spec.name, storage=open_storage(results, spec), **how)
    except KeyError as error:
        raise absent from error


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


def without_password(text: str, address: str) -> str:
    """A text, for example a driver's message, without the password that an address holds."""
    try:
        password = urlsplit(address).password or ""
    except ValueError:
        password = ""
    for secret in {password, unquote(password)} - {""}:
        text = text.replace(secret, HIDDEN)
    return without_passwords(text)


def worker_name() -> str:
    """Names this process: host and process number."""
    return f"{socket.gethostname()}:{os.getpid()}"


def worker_is_dead(name: str) -> bool:
    """Whether a worker on this host no longer runs; workers of other hosts count as alive."""
    host, _, pid = name.rpartition(":")
    if host != socket.gethostname() or not pid.isdigit():
        return False
    try:
        return bool(psutil.Process(int(pid)).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


class JournalFile(JournalFileBackend):
    """Optuna's journal file, to which whole lines are appended or nothing.

    A line that a killed process left unfinished is cut off before the next one is written: Optuna appends to it, and
    can never read the file again. What did not fit on the disk is taken back. The lock is on the file itself and ends
    with its process; Optuna's own outlives a killed process by 30 s.

    Args:
        path: The file; begun if it is missing.

    Raises:
        StudyError: It cannot be begun.
    """

    def __init__(self, path: Path) -> None:
        if path.is_symlink():
            raise StudyError(f"{path} is a link: a study is written in its own folder", "put the file in its place")
        try:
            super().__init__(str(path))
        except OSError as error:
            raise _cannot_write(path, error) from error
        self.path = path

    def append_logs(self, logs: Sequence[dict[str, Any]]) -> None:
        """Append entries.

        Raises:
            StudyError: They cannot be written; then the file is as it was.
        """
        rest = memoryview("".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs).encode())
        try:
            with self.path.open("r+b", buffering=0) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                end = file.readall().rfind(b"\n") + 1
                file.truncate(end)
                file.seek(end)
                try:
                    while rest:
                        rest = rest[file.write(rest) :]
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(end)
                    raise
        except OSError as error:
            raise _cannot_write(self.path, error) from error


def _cannot_write(path: Path, error: OSError) -> StudyError:
    return StudyError(f"cannot write {path}: {error.strerror}", "free some space, or check the folder; then go on")
