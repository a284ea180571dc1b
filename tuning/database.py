"""A study in an SQL database that may be away for a while, as while it restarts."""

import random
import time
from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar, cast
from urllib.parse import unquote, urlsplit

import optuna
from optuna.distributions import BaseDistribution
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, RDBStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, PendingRollbackError

from dynslam_bench.core import HIDDEN, StudyError, without_passwords

P = ParamSpec("P")
R = TypeVar("R")

MAX_RETRY_S = 60.0
"""For so long a database that does not answer is asked again."""
_OPEN_ATTEMPTS = 10
_BEING_CREATED = ("already exists", "duplicate", "unique constraint", "is locked")
"""Messages of drivers where another worker creates the tables at the same time."""
_NO_ANSWER = (OperationalError, InterfaceError, PendingRollbackError)
"""Errors of a database that is away; the last one where it went within a transaction."""


def open_database(url: str) -> BaseStorage:
    """Open a database, and create its tables if it is empty.

    Workers may begin at the same time: one whose tables another worker creates meanwhile tries
    again.

    Raises:
        Exception: What the database's driver raises.
    """
    attempts = 0
    while True:
        try:
            # a server takes few connections, e.g. 100
            database = RDBStorage(url, engine_kwargs={"pool_pre_ping": True, "pool_size": 1})
            # Optuna's cache of finished trials lies between
            return RetryingStorage(optuna.storages.get_storage(database), url)
        except (DBAPIError, StorageInternalError) as error:
            cause = str(error.__cause__ or error).lower()
            attempts += 1
            if attempts == _OPEN_ATTEMPTS or not any(words in cause for words in _BEING_CREATED):
                raise
        time.sleep(random.uniform(0.05, 0.5))


class RetryingStorage(BaseStorage):
    """Passes every call on to another storage, and repeats it while the database does not answer.

    Args:
        storage: The storage.
        url: The address of its database, for messages.

    Raises:
        StudyError: Raised by every method: the database has not answered for `MAX_RETRY_S`.
    """

    def __init__(self, storage: BaseStorage, url: str) -> None:
        self._storage = storage
        self._url = url

    def _retry(self, method: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call a method of the storage until the database answers."""
        began = time.monotonic()
        has_failed = False
        while True:
            try:
                return method(*args, **kwargs)
            except UpdateFinishedTrialError:
                if not has_failed:
                    raise
                # the call before had arrived, its answer had not
                return cast("R", True)
            except (DBAPIError, StorageInternalError) as error:
                if not _is_without_answer(error):
                    raise
                if time.monotonic() - began > MAX_RETRY_S:
                    raise _no_answer(error, self._url) from error
            has_failed = True
            time.sleep(random.uniform(0.2, 2.0))

    # -- studies -----------------------------------------------------------------------------------

    def create_new_study(
        self, directions: Sequence[StudyDirection], study_name: str | None = None
    ) -> int:
        """See Optuna's `BaseStorage`; so are all methods below."""
        return self._retry(self._storage.create_new_study, directions, study_name)

    def delete_study(self, study_id: int) -> None:  # noqa: D102
        return self._retry(self._storage.delete_study, study_id)

    def set_study_user_attr(self, study_id: int, key: str, value: Any) -> None:  # noqa: D102
        return self._retry(self._storage.set_study_user_attr, study_id, key, value)

    def set_study_system_attr(self, study_id: int, key: str, value: Any) -> None:  # noqa: D102
        return self._retry(self._storage.set_study_system_attr, study_id, key, value)

    def get_study_id_from_name(self, study_name: str) -> int:  # noqa: D102
        return self._retry(self._storage.get_study_id_from_name, study_name)

    def get_study_name_from_id(self, study_id: int) -> str:  # noqa: D102
        return self._retry(self._storage.get_study_name_from_id, study_id)

    def get_study_directions(self, study_id: int) -> list[StudyDirection]:  # noqa: D102
        return self._retry(self._storage.get_study_directions, study_id)

    def get_study_user_attrs(self, study_id: int) -> dict[str, Any]:  # noqa: D102
        return self._retry(self._storage.get_study_user_attrs, study_id)

    def get_study_system_attrs(self, study_id: int) -> dict[str, Any]:  # noqa: D102
        return self._retry(self._storage.get_study_system_attrs, study_id)

    def get_all_studies(self) -> list[Any]:  # noqa: D102 - of FrozenStudy, which Optuna does not export
        return self._retry(self._storage.get_all_studies)

    # -- trials ------------------------------------------------------------------------------------

    def create_new_trial(  # noqa: D102
        self, study_id: int, template_trial: FrozenTrial | None = None
    ) -> int:
        return self._retry(self._storage.create_new_trial, study_id, template_trial)

    def set_trial_param(  # noqa: D102
        self,
        trial_id: int,
        param_name: str,
        param_value_internal: float,
        distribution: BaseDistribution,
    ) -> None:
        return self._retry(
            self._storage.set_trial_param, trial_id, param_name, param_value_internal, distribution
        )

    def get_trial_id_from_study_id_trial_number(  # noqa: D102
        self, study_id: int, trial_number: int
    ) -> int:
        return self._retry(
            self._storage.get_trial_id_from_study_id_trial_number, study_id, trial_number
        )

    def set_trial_state_values(  # noqa: D102
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        return self._retry(self._storage.set_trial_state_values, trial_id, state, values)

    def set_trial_intermediate_value(  # noqa: D102
        self, trial_id: int, step: int, intermediate_value: float
    ) -> None:
        return self._retry(
            self._storage.set_trial_intermediate_value, trial_id, step, intermediate_value
        )

    def set_trial_user_attr(self, trial_id: int, key: str, value: Any) -> None:  # noqa: D102
        return self._retry(self._storage.set_trial_user_attr, trial_id, key, value)

    def set_trial_system_attr(self, trial_id: int, key: str, value: Any) -> None:  # noqa: D102
        return self._retry(self._storage.set_trial_system_attr, trial_id, key, value)

    def get_trial(self, trial_id: int) -> FrozenTrial:  # noqa: D102
        return self._retry(self._storage.get_trial, trial_id)

    def get_all_trials(  # noqa: D102
        self,
        study_id: int,
        deepcopy: bool = True,
        states: Container[TrialState] | None = None,
    ) -> list[FrozenTrial]:
        return self._retry(self._storage.get_all_trials, study_id, deepcopy, states)

    def get_best_trial(self, study_id: int) -> FrozenTrial:  # noqa: D102
        return self._retry(self._storage.get_best_trial, study_id)


def _is_without_answer(error: Exception) -> bool:
    """Whether a database is away, by the error or by the driver's error behind Optuna's own."""
    return isinstance(error, _NO_ANSWER) or isinstance(error.__cause__, _NO_ANSWER)


def _no_answer(error: Exception, url: str) -> StudyError:
    line = str(error.__cause__ or error).splitlines()[0]
    text = without_password(f"the study's database does not answer: {line}", url)
    return StudyError(text, "finished trials are stored; the same command goes on from there")


def without_password(text: str, address: str) -> str:
    """A text, for example a driver's message, without the password that an address holds."""
    with suppress(ValueError):  # no address
        password = urlsplit(address).password or ""
        for secret in {password, unquote(password)} - {""}:
            text = text.replace(secret, HIDDEN)
    return without_passwords(text)
