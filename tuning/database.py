"""A study's database: its tables are made once, whoever begins at the same time, and a restart of it is waited for."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

import optuna
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError

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
