"""Index of what was computed from the runs of a store, in one SQLite file that may be deleted at any time."""

from __future__ import annotations

import contextlib
import sqlite3
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dynslam_bench.core import RunError
from dynslam_bench.runs.layout import (
    COVARIANCES,
    FINAL,
    INDEX_FILE,
    ONLINE,
    RUN_FILE,
    STAMPS,
    TRUTH,
    check_plain,
    file_stamp,
)

_CREATE_TABLE = (
    "CREATE TABLE IF NOT EXISTS computed "
    "(name TEXT, run_id TEXT, version TEXT, state TEXT, value TEXT, PRIMARY KEY (name, run_id))"
)
_INSERT = (
    "INSERT OR REPLACE INTO computed (name, run_id, version, state, value) VALUES (?, ?, ?, ?, ?)"
)
_SELECT = "SELECT run_id, state, value FROM computed WHERE name = ? AND version = ?"
_LOCKED_S = 10.0
"""Other processes keep the index for milliseconds."""


class RunIndex:
    """Values computed from the runs of a store: metrics, rows of lists and rows of reports, in one SQLite file.

    Each value holds for one version of the code that computed it and for one state (times and
    sizes) of the files that it was computed from. The file may be deleted at any time; values that
    are missing, damaged or out of date are computed again from the run folders.

    An index that another process has locked is waited for once, for `_LOCKED_S`. After that this
    process goes on without it, with a warning: what it holds can be computed.

    Args:
        root: Folder of the store.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.path = root / INDEX_FILE
        self._is_locked = False

    def state(self, run_id: str, part: str, record_stamp: str = "") -> str:
        """The state of the files that a run's values are computed from.

        Args:
            run_id: The run.
            part: Its part of a sequence.
            record_stamp: `file_stamp` of its record before that was read; empty for the present
                one.
        """
        run = f"{self.root}/runs/{run_id}"
        sequence = f"{self.root}/sequences/{part}"
        files = (
            f"{run}/{ONLINE}",
            f"{run}/{FINAL}",
            f"{run}/{COVARIANCES}",
            f"{sequence}/{TRUTH}",
            f"{sequence}/{STAMPS}",
        )
        record_stamp = record_stamp or file_stamp(f"{run}/{RUN_FILE}")
        return " ".join([part, record_stamp, *map(file_stamp, files)])

    def get(self, name: str, version: str, run_id: str) -> str | None:
        """The value of one run, as `read` gives it."""
        for _, state, value in self._query(f"{_SELECT} AND run_id = ?", name, version, run_id):
            if self._is_current(run_id, state, value):
                return str(value)
        return None

    def last(self, name: str, run_id: str) -> str | None:
        """The value of one run that was kept last, whether it is still current or not."""
        rows = self._query("SELECT value FROM computed WHERE name = ? AND run_id = ?", name, run_id)
        return rows[0][0] if rows else None

    def read(
        self, name: str, version: str, run_ids: Iterable[str], *, check_links: bool = False
    ) -> dict[str, str]:
        """The current values, by run.

        Args:
            name: What they are, e.g. ``metrics`` with a protocol's digest.
            version: Digest of the code that computes them.
            run_ids: Runs that are stored.
            check_links: Whether runs whose folders hold links to elsewhere or pipes are left out,
                too.
        """
        stored = set(run_ids)
        values = {}
        for run_id, state, value in self._query(_SELECT, name, version):
            if run_id not in stored or not self._is_current(run_id, state, value):
                continue
            if check_links and not self._is_plain(run_id, state):
                continue
            values[run_id] = value
        return values

    def write(self, name: str, version: str, entries: Iterable[tuple[str, str, str]]) -> None:
        """Keep values; a store that cannot be written stays as it is.

        Args:
            name: What they are.
            version: Digest of the code that computed them.
            entries: Run, its state before it was read, and the value.
        """
        rows = [(name, run_id, version, state, value) for run_id, state, value in entries]
        # a damaged file is deleted, so that the second attempt makes a new one
        for _ in range(2):
            try:
                with self._opened(create=True) as connection, connection:
                    connection.executemany(_INSERT, rows)
                return
            except UnicodeEncodeError:
                return
            except sqlite3.OperationalError as error:  # it cannot be written
                self._note_lock(error)
                return
            except sqlite3.DatabaseError:  # it is damaged, or no database
                with contextlib.suppress(OSError):
                    self.path.unlink()

    def names(self) -> set[str]:
        """Names of the values that are kept."""
        return {str(name) for (name,) in self._query("SELECT DISTINCT name FROM computed")}

    def _query(self, command: str, *arguments: str) -> list[tuple[Any, ...]]:
        """The rows that a command gives; none where the index cannot be read."""
        try:
            with self._opened(create=False) as connection:
                return connection.execute(command, arguments).fetchall()
        except sqlite3.Error as error:
            self._note_lock(error)
            return []

    def _is_current(self, run_id: str, state: Any, value: Any) -> bool:
        """Whether the files that a value was computed from are unchanged; damaged entries are not current."""
        if not isinstance(value, str) or not isinstance(state, str):
            return False
        part = state.partition(" ")[0]
        return state == self.state(run_id, part)

    @contextlib.contextmanager
    def _opened(self, *, create: bool) -> Iterator[sqlite3.Connection]:
        """The database; no link is followed, and no pipe is opened.

        Raises:
            sqlite3.OperationalError: It is not there, cannot be opened, or was locked when it was
                waited for.
        """
        if self._is_locked:
            raise sqlite3.OperationalError(f"{self.path} is left alone")
        is_free = create and not self.path.exists()
        if self.path.is_symlink() or not (is_free or self.path.is_file()):
            raise sqlite3.OperationalError(f"{self.path} is no database")
        with contextlib.closing(sqlite3.connect(self.path, timeout=_LOCKED_S)) as connection:
            # a power cut costs an index, which is made again
            connection.execute("PRAGMA synchronous = OFF")
            if create:
                connection.execute(_CREATE_TABLE)
            yield connection

    def _note_lock(self, error: sqlite3.Error) -> None:
        """Leave the index alone from now on, with a warning, if another process has kept it locked."""
        if self._is_locked or "database is locked" not in str(error):
            return
        self._is_locked = True
        warnings.warn(
            f"{self.path} was locked by another process for {_LOCKED_S:g} s: going on without it, scores are computed "
            f"again (end that process: fuser {self.path}; or delete the file, which is made again)",
            RuntimeWarning,
            stacklevel=2,
        )

    def _is_plain(self, run_id: str, state: str) -> bool:
        """Whether the folders of a run and of its sequence's part hold plain files alone, no links or pipes."""
        part = state.partition(" ")[0]
        try:
            check_plain(self.root / "runs" / run_id, self.root)
            check_plain(self.root / "sequences" / part, self.root)
        except RunError:
            return False
        return True
