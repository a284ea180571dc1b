"""Where a study is kept: a journal file by default, any SQL database, or the gRPC proxy."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import optuna

from dynslam_bench.core.errors import StudyError

from .database import open_database
from .journal_file import WholeLines
from .storage_address import check_scheme, without_password
from .study_file import StudySpec

JOURNAL = "journal.log"


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
            return optuna.storages.JournalStorage(WholeLines(folder / JOURNAL))
        if spec.storage.startswith("grpc://"):
            return _proxy(spec.storage)
        return open_database(spec.storage)
    except Exception as error:  # drivers raise whatever they like
        where = spec.storage or str(study_folder(results, spec))
        line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        said = without_password(f"cannot open the storage {where}: {line}", spec.storage)
        raise StudyError(said, "check the address and the permissions") from None


def worker_name() -> str:
    """Names this process: host and process number."""
    return f"{socket.gethostname()}:{os.getpid()}"


def worker_is_dead(name: str) -> bool:
    """Whether a worker on this host no longer runs; workers of other hosts count as alive."""
    host, _, pid = name.rpartition(":")
    if host != socket.gethostname() or not pid.isdigit():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return _is_zombie(int(pid))


def _is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return False


def _proxy(address: str) -> optuna.storages.BaseStorage:
    host, _, port = address.removeprefix("grpc://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("write it as grpc://host:port")
    return optuna.storages.GrpcStorageProxy(host=host, port=int(port))
