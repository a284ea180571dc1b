"""Where a study is kept: a journal file by default, any SQL database, or the gRPC proxy."""

from __future__ import annotations

import fcntl
import io
import json
import os
import pickle
import pickletools
import random
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote, urlsplit

import optuna
from optuna.exceptions import StorageInternalError
from optuna.samplers import _cmaes as optuna_cmaes
from optuna.storages import BaseStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.sanitise import HIDDEN, without_passwords
from dynslam_bench.tuning.study_file import StudySpec

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
            return optuna.storages.JournalStorage(JournalFile(folder / JOURNAL))
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


# A study's database: its tables are made once, whoever begins at the same time, and a restart of it is waited for.

RESTART_S = 60.0
"""So long a database may be away in mid-study before its workers give up."""
_ATTEMPTS = 10
_MADE_MEANWHILE = ("already exists", "duplicate", "unique constraint", "is locked")


def open_database(url: str) -> BaseStorage:
    """Open a database, and make its tables if it is empty.

    Raises:
        Exception: It cannot be opened; what its driver raises.
    """
    for attempt in range(_ATTEMPTS):
        try:
            return optuna.storages.get_storage(_PatientStorage(url, engine_kwargs={"pool_pre_ping": True}))
        except (DBAPIError, StorageInternalError) as error:
            cause = str(error.__cause__ or error).lower()
            if attempt + 1 == _ATTEMPTS or not any(words in cause for words in _MADE_MEANWHILE):
                raise
            time.sleep(random.uniform(0.05, 0.5))  # another worker is making the tables
    raise AssertionError("unreachable")


def _patient(method: Callable[..., Any]) -> Callable[..., Any]:
    """The method, done once more if the connection broke in the middle; the new connection waits for the server."""

    @wraps(method)
    def again(*arguments: Any, **named: Any) -> Any:
        try:
            return method(*arguments, **named)
        except (DBAPIError, StorageInternalError) as error:
            cause = error if isinstance(error, DBAPIError) else error.__cause__
            if not (isinstance(cause, DBAPIError) and cause.connection_invalidated):
                raise
            return method(*arguments, **named)

    return again


class _PatientStorage(RDBStorage):
    """Optuna's storage; its connections outlast a restart of the server."""

    def __init__(self, url: str, **options: Any) -> None:
        super().__init__(url, **options)
        event.listen(self.engine, "do_connect", _connect)


for _name in BaseStorage.__abstractmethods__:
    setattr(_PatientStorage, _name, _patient(getattr(RDBStorage, _name)))


def _connect(dialect: Any, _: object, arguments: list[Any], named: dict[str, Any]) -> Any:
    """Connect, again and again while the server does not answer; only the first connection of all fails at once."""
    deadline = time.monotonic() + RESTART_S
    while True:
        try:
            return dialect.connect(*arguments, **named)
        except dialect.loaded_dbapi.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(1.0)


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


# CMA-ES without the run of code: Optuna keeps its state in the study's storage as a pickle.

_NUMPY = ("numpy._core", "numpy.core")
_ALLOWED = {
    ("cmaes._cma", "CMA"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    *((f"{core}.multiarray", name) for core in _NUMPY for name in ("_reconstruct", "scalar")),
    *((f"{core}.numeric", "_frombuffer") for core in _NUMPY),
}


class _State(pickle.Unpickler):
    """Reads a state of CMA-ES and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return super().find_class(module, name)


class _OnlyStates:
    """Stands in for the module ``pickle`` where Optuna's CMA-ES reads its state."""

    dumps = staticmethod(pickle.dumps)

    @staticmethod
    def loads(data: bytes) -> Any:
        try:
            for operation, argument, _ in pickletools.genops(data):
                if operation.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > len(data):
                    raise pickle.UnpicklingError(f"it asks for room for {argument} objects")
            return _State(io.BytesIO(data)).load()
        except Exception as error:  # a pickle that somebody made can raise whatever it likes
            raise StudyError(
                f"the study's storage holds no state of CMA-ES but something else: {str(error)[:200]}",
                "it was tampered with or is damaged; use another sampler, or a storage of your own",
            ) from error


def restrict() -> None:
    """Let Optuna's CMA-ES restore nothing but its own state, in this process.

    Raises:
        StudyError: This Optuna reads its state in another way, which is not known to be safe.
    """
    if not hasattr(optuna_cmaes, "pickle"):
        raise StudyError("sampler 'cmaes' is not known to be safe with this version of Optuna", "use tpe or gp")
    optuna_cmaes.pickle = _OnlyStates
