"""The run store: one folder a run, which appears whole or not at all; its index, scores, and runs as rows of tables."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import sqlite3
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import (
    DynslamError,
    EvaluationError,
    InfrastructureError,
    RunError,
    TemporaryFolder,
    assignments,
    did_you_mean,
    file_sha256,
    read_lines,
    replace_folder,
    sweep_temporary,
    temporary_folder,
    translate_errors,
    try_lock,
    write_atomic,
)
from dynslam_bench.core.errors import hide_folder_in_messages
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, has_imported_plugins
from dynslam_bench.core.reads import remembered
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation import PROTOCOLS, Evaluation, Protocol, evaluate, get_protocol, hints
from dynslam_bench.geometry import Trajectory, TumFile, format_ns, format_tum, load_tum, read_tum
from dynslam_bench.runs.record import MetricRecord, RunRecord, run_id_of

if TYPE_CHECKING:
    import pandas as pd


LOGGER = logging.getLogger(__name__)
DEFAULT_PROTOCOL = "tum-rgbd/v1"
Which = Literal["online", "final"]
_RUN_ID = re.compile(r"[0-9a-f]{16}([0-9a-f]{4})?")
OnProgress = Callable[[int, int], None]
"""Called with how many runs are done, of how many."""


INDEX_FILE = "index.sqlite"
RUN_FILE = "run.json"
ONLINE = "trajectory_online.txt"
FINAL = "trajectory_final.txt"
_TABLE = (
    "CREATE TABLE IF NOT EXISTS computed "
    "(name TEXT, run_id TEXT, version TEXT, state TEXT, value TEXT, PRIMARY KEY (name, run_id))"
)
_KEEP = (
    "INSERT OR REPLACE INTO computed (name, run_id, version, state, value) VALUES (?, ?, ?, ?, ?)"
)
_VALUES = "SELECT run_id, state, value FROM computed WHERE name = ? AND version = ?"
_LOCKED_S = 10.0
"""Other processes keep the index for milliseconds."""
_REMOVED = "if it was removed meanwhile, repeat the command"
Row = dict[str, Any]


class RunIndex:
    """What was computed from the runs of a store: metrics, rows of lists and rows of reports, in one SQLite file.

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
            f"{sequence}/groundtruth.txt",
            f"{sequence}/timestamps.txt",
        )
        return " ".join(
            [part, record_stamp or file_stamp(f"{run}/{RUN_FILE}"), *map(file_stamp, files)]
        )

    def get(self, name: str, version: str, run_id: str) -> str | None:
        """The value of one run, as `read` gives it."""
        rows = self._query(f"{_VALUES} AND run_id = ?", name, version, run_id)
        return next((value for _, state, value in rows if self._holds(run_id, state, value)), None)

    def last(self, name: str, run_id: str) -> str | None:
        """The value of one run that was kept last, whether it still holds or not."""
        rows = self._query("SELECT value FROM computed WHERE name = ? AND run_id = ?", name, run_id)
        return rows[0][0] if rows else None

    def read(
        self, name: str, version: str, run_ids: Iterable[str], *, check_links: bool = False
    ) -> dict[str, str]:
        """The values that hold, by run.

        Args:
            name: What they are, e.g. ``metrics`` with a protocol's digest.
            version: Digest of the code that computes them.
            run_ids: Runs that are stored.
            check_links: Whether runs whose folders hold links to elsewhere or pipes are left out,
                too.
        """
        stored = set(run_ids)
        return {
            run_id: value
            for run_id, state, value in self._query(_VALUES, name, version)
            if run_id in stored and self._holds(run_id, state, value)
            if not check_links or self._is_plain(run_id, state)
        }

    def _query(self, command: str, *arguments: str) -> list[tuple[Any, ...]]:
        try:
            with self._opened(create=False) as connection:
                return connection.execute(command, arguments).fetchall()
        except sqlite3.Error as error:
            self._note_lock(error)
            return []

    def _holds(self, run_id: str, state: Any, value: Any) -> bool:
        return (
            isinstance(value, str)
            and isinstance(state, str)
            and state == self.state(run_id, state.partition(" ")[0])
        )

    def write(self, name: str, version: str, entries: Iterable[tuple[str, str, str]]) -> None:
        """Keep values; a store that cannot be written stays as it is.

        Args:
            name: What they are.
            version: Digest of the code that computed them.
            entries: Run, its state before it was read, and the value.
        """
        rows = [(name, run_id, version, state, value) for run_id, state, value in entries]
        for _ in range(2):
            try:
                with self._opened(create=True) as connection, connection:
                    connection.executemany(_KEEP, rows)
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
                connection.execute(_TABLE)
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
        try:
            check_plain(self.root / "runs" / run_id, self.root)
            check_plain(self.root / "sequences" / state.partition(" ")[0], self.root)
        except RunError:
            return False
        return True


def file_stamp(file: str | Path) -> str:
    """Times of content and inode (nanoseconds) and size (bytes) of a file; ``-`` where there is none."""
    try:
        status = os.stat(file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    except OSError:
        return "-"
    return f"{status.st_mtime_ns},{status.st_ctime_ns},{status.st_size}"


def check_plain(folder: Path, root: Path) -> None:
    """Check that a folder holds plain files of its store: no link to elsewhere, no pipe that nothing writes.

    Raises:
        RunError: It names the offending entry. A folder that is not there has none.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink() and not Path(entry.path).resolve().is_relative_to(root.resolve()):
                raise RunError(
                    f"{entry.path} is a link that leads out of {root}", "put the file in its place"
                )
            if not entry.is_file() and not entry.is_dir():
                raise RunError(f"{entry.path} is no plain file")


@dataclass(frozen=True)
class Unreadable:
    """A folder of the store that holds no valid record."""

    path: Path
    reason: str


class RunStore:
    """Runs and the sequences' ground truth below one folder.

    ``runs/<run_id>/`` holds ``run.json``, ``trajectory_online.txt``, ``trajectory_final.txt``,
    ``frames.csv``, ``keyframes.csv``, ``map.ply`` and ``log.txt``; ``sequences/<part>/`` stamps and
    ground truth, so that a run can be scored again without its data; ``index.sqlite`` metrics and
    rows of tables, which are computed from these; ``latest`` links the newest run.

    Args:
        root: The folder; it is made when something is written.

    Attributes:
        root: The same, absolute.
        source: What messages call it: the same, or the archive that it was unpacked from.
        runs: Folder of the runs.
        index: What was computed from the runs.
    """

    def __init__(self, root: str | Path = "results") -> None:
        self.root = self.source = Path(root).expanduser().absolute()
        self.runs = self.root / "runs"
        self.index = RunIndex(self.root)

    def folder(self, run_id: str) -> Path:
        """Folder of one run, whether it exists or not.

        Raises:
            RunError: It is no run's id, which is 20 hexadecimal digits (16 of older runs): anything
                else could lead out of the store.
        """
        return self.runs / _checked(run_id, "a run's id")

    def place(self, run_id: str) -> Path:
        """The same for messages: below the archive that the store was unpacked from."""
        return self.source / "runs" / run_id

    def _part(self, part: str) -> Path:
        """Folder of the stamps and the ground truth of a sequence's part."""
        return self.root / "sequences" / _checked(part, "the part of a sequence")

    # -- writing -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Make sure that runs can be stored, and remove what killed processes left behind.

        Raises:
            DynslamError: The folder cannot be written.
        """
        with temporary_folder(self.runs / "probe"):
            pass
        for pattern in (".*", "runs/.*", "sequences/*/.*", "studies/*/**/.*"):
            sweep_temporary(self.root, pattern)
        for left in self.runs.glob(".*.claim"):
            with try_lock(left):  # if no process holds it, it is removed
                pass
        self._unlink_dangling()

    def work_folder(self, run_id: str) -> AbstractContextManager[Path]:
        """A hidden folder to make a run in; it vanishes unless `publish` moved it into place.

        Raises:
            DynslamError: The store cannot be written.
        """
        return temporary_folder(self.folder(run_id))

    def claim(self, run_id: str) -> AbstractContextManager[bool]:
        """Make a run alone while the block lasts; it is given False where another process or thread is making it.

        Raises:
            DynslamError: The store cannot be written.
        """
        return try_lock(self.runs / f".{run_id}.claim")

    def publish(self, work: Path, record: RunRecord) -> RunRecord:
        """Write the record, ``run.json``, into its work folder, rename that to the run's; replaces a run of the id.

        Returns:
            The record as it is stored, with a note if the earlier run gave another result.

        Raises:
            InfrastructureError: It cannot be written; then nothing has changed.
        """
        record = self._under_free_id(record)
        target = self.folder(record.run_id)
        record = self._with_alarm(record, work)
        with translate_errors(
            InfrastructureError, f"cannot write {target}", "check the free space"
        ):
            files = record.files or self._files(record.sequence.part, work)
            record = record.model_copy(update={"files": files})
            (work / RUN_FILE).write_text(record.to_json(), encoding="utf-8")
            replace_folder(work, target)
        self.link_latest(record.run_id)
        return record

    def link_latest(self, run_id: str) -> None:
        """Let ``latest`` lead to a run."""
        link = self.root / "latest"
        # a file system may have no links
        with contextlib.suppress(OSError), temporary_folder(link) as folder:
            fresh = folder / link.name
            fresh.symlink_to(self.folder(run_id).relative_to(self.root))
            fresh.replace(link)

    def _under_free_id(self, record: RunRecord) -> RunRecord:
        """The record, under another id where a run of another identity has that one: such a run is not overwritten."""
        earlier = self.get(record.run_id)
        while earlier is not None and earlier.identity != record.identity:
            identity = record.identity | {"id_taken_by": earlier.run_id}
            record = record.model_copy(update={"identity": identity, "run_id": run_id_of(identity)})
            earlier = self.get(record.run_id)
        return record

    def _files(self, part: str, run: Path) -> dict[str, str]:
        """Checksums of the files that a run's values are computed from, by name.

        Raises:
            RunError: One cannot be read.
        """
        paths = [
            run / ONLINE,
            run / FINAL,
            self._part(part) / "groundtruth.txt",
            self._part(part) / "timestamps.txt",
        ]
        checksums = {}
        for path in paths:
            if not path.is_file():
                continue
            with translate_errors(RunError, f"cannot read {path}", _REMOVED):
                # many runs share the files of a sequence: each is read once a process
                checksums[path.name] = remembered("sha256", str(path), partial(file_sha256, path))
        return checksums

    def changed(self, record: RunRecord) -> str:
        """The first file that is not the one with which a run was stored, and what happened to it; empty for none."""
        files = self._files(record.sequence.part, self.folder(record.run_id))
        for name, checksum in record.files.items():
            if files.get(name) != checksum:
                happened = "was changed" if name in files else "is missing"
                return f"{name} {happened} since run {record.run_id} was stored (run it again, or copy the file again)"
        return ""

    def _with_alarm(self, record: RunRecord, work: Path) -> RunRecord:
        """The record, with a note where an earlier run of its id, which should be equal, gave another trajectory."""
        earlier = self.get(record.run_id)
        if (
            earlier is None
            or not record.tracker.deterministic
            or record.realtime
            or not earlier.status == record.status == "ok"
            or _equal(work, self.folder(record.run_id), ONLINE)
        ):
            return record
        note = (
            f"an earlier run with this id, started {earlier.started}, gave another trajectory, although tracker "
            f"'{record.tracker.id}' is declared deterministic"
        )
        LOGGER.warning("run %s: %s", record.run_id, note)
        return record.model_copy(update={"notes": [*record.notes, note]})

    def copy_from(self, other: RunStore, record: RunRecord) -> RunRecord:
        """Copy a run of another store, with its part of a sequence; replaces an earlier run of the id.

        Raises:
            InfrastructureError: It cannot be written.
            RunError: It was removed or changed while it was copied.
        """
        self.copy_part(other, record)
        with self.work_folder(record.run_id) as work:
            with self.copying(other, record):
                shutil.copytree(other.folder(record.run_id), work, dirs_exist_ok=True)
            self.check_copy(work, record)
            return self.publish(work, record)

    @contextlib.contextmanager
    def copying(self, other: RunStore, record: RunRecord) -> Iterator[None]:
        """Turn what fails while a run of another store is copied into an error that says whose fault it is.

        Raises:
            RunError: The run was removed meanwhile.
            InfrastructureError: It cannot be written here.
        """
        source = other.folder(record.run_id)
        try:
            with translate_errors(
                InfrastructureError,
                f"cannot write {self.folder(record.run_id)}",
                "check the free space",
            ):
                yield
        except InfrastructureError as error:
            if (source / RUN_FILE).is_file():
                raise
            raise RunError(
                f"{other.place(record.run_id)} was removed while it was copied"
            ) from error

    def check_copy(self, work: Path, record: RunRecord) -> None:
        """Check that a copied run has the trajectories that it was stored with.

        Raises:
            RunError: One is missing or another one.
        """
        copied = self._files(record.sequence.part, work)
        for name in (ONLINE, FINAL):
            if copied.get(name) != record.files.get(name, copied.get(name)):
                raise RunError(
                    f"{name} of run {record.run_id} was removed or changed while it was copied"
                )

    def copy_part(self, other: RunStore, record: RunRecord) -> None:
        """Copy the ground truth and then the stamps of a run's part of a sequence, if its stamps are not here.

        Raises:
            InfrastructureError: They cannot be written.
            RunError: They cannot be read.
        """
        folder = self._part(record.sequence.part)
        if not (folder / "timestamps.txt").is_file():
            for file in sorted(other._part(record.sequence.part).glob("*.txt")):
                with translate_errors(RunError, f"cannot read {file}", _REMOVED):
                    content = file.read_bytes()
                write_atomic(folder / file.name, content)

    def add_sequence(
        self, part: str, timestamps_ns: NDArray[np.int64], ground_truth: Trajectory | None
    ) -> None:
        """Keep the stamps of a sequence's frames, in nanoseconds, and its ground truth, in place of other ones."""
        folder = self._part(part)
        texts = {"timestamps.txt": "".join(f"{format_ns(ns)}\n" for ns in timestamps_ns.tolist())}
        if ground_truth is not None and len(ground_truth):
            texts = {"groundtruth.txt": format_tum(ground_truth), **texts}
        for name, text in texts.items():
            if _content(folder / name) != text.encode():
                write_atomic(folder / name, text)

    def rewrite(self, record: RunRecord, **changes: Any) -> RunRecord:
        """Change fields of a stored run that are no part of its outcome: its label in tables, the study that made it.

        Raises:
            DynslamError: It cannot be written.
        """
        changed = (self.get(record.run_id) or record).model_copy(update=changes)
        write_atomic(self.folder(record.run_id) / RUN_FILE, changed.to_json())
        return changed

    def remove(self, run_id: str) -> None:
        """Delete a run; its values in the index hold no more.

        Raises:
            RunError: There is no such run, or it cannot be deleted.
        """
        run_id = self.find(run_id)
        with (
            translate_errors(RunError, f"cannot remove run {run_id}"),
            self.work_folder(run_id) as removed,
        ):
            self.folder(run_id).rename(removed / run_id)
        self._unlink_dangling()

    def _unlink_dangling(self) -> None:
        latest = self.root / "latest"
        if latest.is_symlink() and not latest.exists():
            latest.unlink(missing_ok=True)

    # -- reading -----------------------------------------------------------------------------------

    def ids(self) -> list[str]:
        """Ids of all stored runs, sorted."""
        try:
            with os.scandir(self.runs) as entries:
                return sorted(
                    entry.name
                    for entry in entries
                    if _RUN_ID.fullmatch(entry.name) and entry.is_dir()
                )
        except (FileNotFoundError, NotADirectoryError):
            return []

    def ids_of(self, asked: str) -> list[str]:
        """Ids of the stored runs of one request, by its first twelve digits; see `record.asked_digest`."""
        return [run_id for run_id in self.ids() if run_id.startswith(asked)]

    def read(self, run_id: str) -> RunRecord:
        """The record of a run by its id, the id's first digits, or ``latest``.

        Raises:
            RunError: There is no such run.
            DynslamError: Its record is damaged.
        """
        return self.read_whole(self.find(run_id))

    def get(self, run_id: str) -> RunRecord | None:
        """The record of a run by its full id, None if it is not stored or damaged."""
        folder = self.folder(run_id)
        with contextlib.suppress(DynslamError):
            return self.read_whole(folder.name)
        return None

    def read_whole(self, run_id: str) -> RunRecord:
        """The record of a run by its full id.

        Raises:
            DynslamError: It is missing or damaged, names itself otherwise, or its folder holds more
                than plain files.
        """
        path = self.folder(run_id) / RUN_FILE
        check_plain(path.parent, self.root)
        try:
            record = RunRecord.read(path)
        except DynslamError as error:
            if path.parent.is_dir():
                raise
            raise RunError(f"run {run_id} is not in {self.source}", _REMOVED) from error
        if record.run_id != run_id:
            raise RunError(
                f"{path} names itself {record.run_id}, not as its folder",
                "it was copied or made by hand",
            )
        return record

    def read_with_state(self, run_id: str) -> tuple[RunRecord, str]:
        """As `read_whole`, with the state for values that are computed from the record, see `RunIndex.write`."""
        stamp = file_stamp(self.folder(run_id) / RUN_FILE)
        record = self.read_whole(run_id)
        return record, self.index.state(run_id, record.sequence.part, stamp)

    def all(self) -> tuple[Records, list[Unreadable]]:
        """All runs from the oldest to the newest, and the folders that hold no valid record, with reasons."""
        started = []
        unreadable = []
        for run_id in self.ids():
            try:
                started.append((self.read_whole(run_id).started, run_id))
            except DynslamError as error:
                unreadable.append(Unreadable(self.place(run_id), str(error)))
        return Records(self, [run_id for _, run_id in sorted(started)]), unreadable

    def find(self, prefix: str) -> str:
        """The full id of a run from its first digits, or of ``latest``.

        Raises:
            RunError: No run, or more than one, begins so.
        """
        if prefix == "latest" and (self.root / "latest").exists():
            return (self.root / "latest").resolve().name
        run_ids = self.ids()
        matching = [run_id for run_id in run_ids if run_id.startswith(prefix)] if prefix else []
        if len(matching) == 1:
            return matching[0]
        if matching:
            raise RunError(f"{len(matching)} runs begin with '{prefix}'", ", ".join(matching[:5]))
        hint = did_you_mean(prefix, run_ids) or f"there are no runs in {self.source}"
        raise RunError(f"there is no run '{prefix}'", hint)

    def trajectory(self, run_id: str, which: str = "online") -> Trajectory | None:
        """The ``online`` or ``final`` trajectory of a run; None if there is none or no frame was tracked."""
        path = self.folder(run_id) / f"trajectory_{which}.txt"
        if not path.is_file() or not any(
            line.strip() and line[0] != "#" for line in read_lines(path, kind=RunError)
        ):
            return None
        return read_tum(path)

    def ground_truth(self, part: str, *, repeats: bool = False) -> Trajectory | None:
        """The ground truth of a sequence's part, with `repeats` all poses of a repeated stamp; None if it has none."""
        path = self._part(part) / "groundtruth.txt"
        check_plain(path.parent, self.root)
        return (
            _read_truth(path, file_stamp(path)).poses(repeats=repeats) if path.is_file() else None
        )

    def timestamps(self, part: str) -> NDArray[np.float64]:
        """Stamps in seconds of all input frames of a sequence's part.

        Raises:
            RunError: They are not stored, or damaged.
        """
        path = self._part(part) / "timestamps.txt"
        check_plain(path.parent, self.root)
        return _read_stamps(path, file_stamp(path))

    def check(self, record: RunRecord) -> None:
        """Read the trajectories of a run, and the stamps and the ground truth of its part of a sequence.

        Raises:
            DynslamError: One is damaged or was changed, or the stamps are missing.
        """
        self.timestamps(record.sequence.part), self.ground_truth(record.sequence.part)
        self.trajectory(record.run_id, "online"), self.trajectory(record.run_id, "final")
        if fault := self.changed(record):
            raise RunError(fault)

    # -- scores ------------------------------------------------------------------------------------

    def metrics(self, record: RunRecord, protocol: Protocol) -> MetricRecord | None:
        """A run's stored metrics under a protocol; None if it was not scored under it, or they are out of date.

        Metrics hold for one version of the evaluation code and one state of the trajectories and
        the ground truth.
        """
        text = self.index.get(_metrics_of(protocol), evaluation_code(), record.run_id)
        with contextlib.suppress(DynslamError):  # damaged: the run is scored again
            metrics = (
                None
                if text is None
                else MetricRecord.parse(text, f"metrics of run {record.run_id}")
            )
            if metrics and (metrics.run_id, metrics.protocol_digest) == (
                record.run_id,
                protocol.digest(),
            ):
                return metrics
        return None

    def add_metrics(self, record: RunRecord, metrics: MetricRecord, state: str = "") -> None:
        """Keep a run's metrics under a protocol, for its state when they were computed or, without one, the present."""
        entry = (
            record.run_id,
            state or self.index.state(record.run_id, record.sequence.part),
            metrics.to_line(),
        )
        self.index.write(f"metrics {metrics.protocol_digest}", metrics.code, [entry])

    def score(
        self, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
    ) -> MetricRecord:
        """The metrics of a stored run under a protocol, from its stored trajectories and ground truth.

        Args:
            record: The run.
            protocol: A protocol or its id.
            again: Compute them even if they are stored.

        Returns:
            The metrics; evaluations that are not possible are None, with the reason.
        """
        protocol = get_protocol(protocol)
        stored = None if again else self.metrics(record, protocol)
        if stored is not None:
            return stored
        if has_imported_plugins() and not os.environ.get(ISOLATED_VARIABLE):
            from dynslam_bench.runs.scoring import score_apart

            return score_apart(self, record.run_id, protocol, again=again)
        state = self.index.state(record.run_id, record.sequence.part)  # before the files are read
        evaluations: dict[Which, Evaluation | None] = {"online": None, "final": None}
        lines = list[str]()
        reasons = dict[str, str]()
        for which in evaluations:
            try:
                trajectory, truth, stamps = self._inputs(record, protocol, which)
                evaluations[which] = evaluate(trajectory, truth, protocol, input_timestamps=stamps)
            except DynslamError as error:
                reasons[which] = str(error)
                continue
            if which == protocol.trajectory or not evaluations[protocol.trajectory]:
                lines = [str(hint) for hint in hints(trajectory, truth, protocol)]
        asked: Which = protocol.trajectory if record.tracker.online else "final"
        if record.kind == "imported":  # it has only one trajectory
            asked = "online" if (self.folder(record.run_id) / ONLINE).is_file() else "final"
        metrics = MetricRecord(
            run_id=record.run_id,
            protocol_id=protocol.id,
            protocol_digest=protocol.digest(),
            code=evaluation_code(),
            trajectory=asked,
            **evaluations,
            reasons=reasons,
            hints=lines,
        )
        self.add_metrics(record, metrics, state)
        return metrics

    def _inputs(
        self, record: RunRecord, protocol: Protocol, which: Which
    ) -> tuple[Trajectory, Trajectory, NDArray[np.float64] | None]:
        """One of a run's trajectories, the ground truth, and the stamps of the input frames where its own are theirs.

        Raises:
            DynslamError: One is missing, damaged or was changed, or the protocol does not fit the
                sequence or the tracker.
        """
        protocol.check_sequence(record.sequence.id)
        protocol.check_scale(record.tracker.id, record.tracker.sensors)
        check_plain(self._part(record.sequence.part), self.root)
        if fault := self.changed(record):
            raise RunError(fault)
        truth = self.ground_truth(record.sequence.part, repeats=not protocol.one_to_one)
        if truth is None:
            raise EvaluationError(f"sequence '{record.sequence.id}' has no ground truth")
        trajectory = self.trajectory(record.run_id, which)
        if trajectory is None:
            raise EvaluationError("there is no such trajectory, or it holds no tracked frame")
        return (
            trajectory,
            truth,
            self.timestamps(record.sequence.part) if record.stamps_match else None,
        )

    def frame(
        self, protocol: Protocol | str = DEFAULT_PROTOCOL, *, trials: bool = False
    ) -> pd.DataFrame:
        """All runs, scored under one protocol, as a pandas frame: one row a run, from the oldest to the newest.

        Args:
            protocol: How to evaluate; SLAM is never run again for it.
            trials: Whether the trials of studies are listed, too: their settings are candidates, no
                results.

        Returns:
            The columns that `runs_frame` describes.
        """
        records, unreadable = self.all()
        reasons = [f"{entry.path}: {entry.reason}" for entry in unreadable]

        def scored() -> Iterator[tuple[RunRecord, MetricRecord | None]]:
            for run_id in records.run_ids:
                try:
                    record = self.read_whole(run_id)
                    if trials or not record.trial_of:
                        yield (
                            record,
                            None if record.status == "stopped" else self.score(record, protocol),
                        )
                except DynslamError as error:
                    reasons.append(f"{self.place(run_id)}: {error}")

        frame = runs_frame(scored())
        warn_of_unreadable(reasons)
        return frame


def warn_of_unreadable(reasons: Sequence[str]) -> None:
    """Warn of runs that a table leaves out."""
    if reasons:
        warnings.warn(
            f"{len(reasons)} runs cannot be read and are left out, the first: {reasons[0]}",
            RuntimeWarning,
            stacklevel=3,
        )


@dataclass(frozen=True, eq=False)
class Records(Sequence[RunRecord]):
    """The records of many runs; each is read from the store when it is asked for.

    Attributes:
        store: The store.
        run_ids: The runs.
        not_stored: The records of those that are not in the store.
    """

    store: RunStore
    run_ids: list[str]
    not_stored: Mapping[str, RunRecord] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.run_ids)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[at] for at in range(len(self))[index]]
        run_id = self.run_ids[index]
        return self.not_stored.get(run_id) or self.store.read_whole(run_id)


def open_store(results: str | Path) -> RunStore:
    """The store of a results folder that exists, or of an archive of one (``.tar``, ``.tgz``, ``.zip``).

    An archive is unpacked into a temporary folder, which is removed with the store.

    Raises:
        RunError: There are no runs in it.
        SequenceError: The archive is damaged, or holds links or names that lead out of it.
        InfrastructureError: It cannot be unpacked here.
    """
    store = RunStore(results)
    if store.root.is_file():
        from dynslam_bench.sequences.fetch import extract  # loads what fetches sequences

        with translate_errors(
            InfrastructureError, f"cannot unpack {results}", "check the free space"
        ):
            temporary = TemporaryFolder()
            unpacked = hide_folder_in_messages(temporary.path) / store.root.name
            unpacked.mkdir()
            extract(store.root, unpacked)
        roots = [path.parent for path in unpacked.rglob("runs") if path.is_dir()]
        # below it, e.g. a study's own runs
        depth = min((len(root.parts) for root in roots), default=0)
        roots = [root for root in roots if len(root.parts) == depth]
        if len(roots) > 1:
            raise RunError(
                f"{results} holds {len(roots)} results folders",
                "pack each into an archive of its own",
            )
        archive = store.root
        store = RunStore(roots[0] if roots else unpacked)
        store.source = archive
        weakref.finalize(store, temporary.close)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {results}", "name a folder that holds runs")
    return store


def evaluation_code() -> str:
    """Digest of the code that metrics are computed by."""
    parts = [f"{PACKAGE}.evaluation.evaluate", f"{PACKAGE}.evaluation.hints"]
    return module_graph().digest(parts, PLUMBING)[:12]


def _metrics_of(protocol: Protocol) -> str:
    return f"metrics {protocol.digest()}"


def _checked(name: str, what: str) -> str:
    """A name that data gives to a folder of the store, if it is one that this package makes."""
    if not _RUN_ID.fullmatch(name):
        raise RunError(
            f"{name[:100]!r} is not {what}: expected 20 hexadecimal digits, or 16 of older runs"
        )
    return name


@lru_cache(maxsize=64)
def _read_truth(path: Path, _stamp: str) -> TumFile:
    """A ground truth, which many runs share; its arrays are read-only."""
    file = load_tum(path)
    for truth in (file.trajectory, file.poses(repeats=True)):
        truth.timestamps.flags.writeable = truth.T_world_cam.flags.writeable = False
    return file


@lru_cache(maxsize=64)
def _read_stamps(path: Path, _stamp: str) -> NDArray[np.float64]:
    """The stamps of a part, likewise shared."""
    with translate_errors(
        RunError, f"cannot read {path}", "the results folder is incomplete", of=ValueError
    ):
        stamps = np.array(
            [float(line) for line in read_lines(path, kind=RunError) if line.strip()],
            dtype=np.float64,
        )
    stamps.flags.writeable = False
    return stamps


def score(
    store: RunStore,
    record: RunRecord,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    again: bool = False,
) -> MetricRecord:
    """The metrics of a stored run under a protocol, see `RunStore.score`."""
    return store.score(record, protocol, again=again)


@dataclass(frozen=True)
class Merged:
    """What `merge` did.

    Attributes:
        added: Ids of the runs that were copied.
        stored: Ids of the runs that the store had already, with the same result.
        left_out: Folders of the runs that were not copied, with reasons.
    """

    added: list[str]
    stored: list[str]
    left_out: list[Unreadable]


def merge(sources: Iterable[RunStore], store: RunStore, *, trials: bool = True) -> Merged:
    """Copy the runs of stores into one, with or without the trials of studies; nothing that it holds is changed.

    A run is left out if its record is damaged, its stamps are lost or it is removed meanwhile, or
    if the store holds another result under its id, other stamps or another ground truth of its
    sequence. ``latest`` leads to the newest of the others afterwards.

    Raises:
        InfrastructureError: The store cannot be written; the runs that were copied before stay.
    """
    merged = Merged([], [], [])
    newest = ("", "")
    store.prepare()
    for source in sources:
        records, unreadable = source.all()
        merged.left_out.extend(unreadable)
        for run_id in records.run_ids:
            try:
                record = source.read_whole(run_id)
                if record.trial_of and not trials:
                    continue
                if reason := _why_left_out(source, record, store):
                    raise RunError(reason)
                if store.get(run_id) is not None:
                    merged.stored.append(run_id)
                else:
                    store.copy_from(source, record)
                    merged.added.append(run_id)
            except InfrastructureError:
                raise
            except DynslamError as error:
                merged.left_out.append(Unreadable(source.place(run_id), str(error)))
                continue
            newest = max(newest, (record.started, run_id))
    if newest[1]:
        store.link_latest(newest[1])
    return merged


def _why_left_out(source: RunStore, record: RunRecord, store: RunStore) -> str:
    """Why a run of a store may not be copied into another one; empty if it may, or stands there already."""
    part, there = (owner._part(record.sequence.part) for owner in (source, store))
    try:
        check_plain(part, source.root)
    except RunError as error:
        return str(error)
    if not (part / "timestamps.txt").is_file():
        return f"{source.source} has lost the stamps of its sequence"
    if (there / "timestamps.txt").is_file() and not _equal(
        part, there, "timestamps.txt", "groundtruth.txt"
    ):
        return f"{store.source} holds other stamps or truth of its sequence"
    earlier = store.get(record.run_id)
    folders = (source.folder(record.run_id), store.folder(record.run_id))
    if earlier is not None and (
        earlier.status != record.status or not _equal(*folders, ONLINE, FINAL)
    ):
        return f"{store.source} holds another result of this run"
    return source.changed(record)


def _equal(one: Path, other: Path, *names: str) -> bool:
    """Whether files of two folders have the same content; a missing file is an empty one."""
    return all(_content(one / name) == _content(other / name) for name in names)


def _content(file: Path) -> bytes:
    """The content of a file; none where there is no file.

    Raises:
        RunError: It cannot be read.
    """
    if not file.is_file():
        return b""
    with translate_errors(RunError, f"cannot read {file}", _REMOVED):
        return file.read_bytes()


def list_runs(
    store: RunStore,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[list[Row], list[Unreadable]]:
    """Every run as `run_row` gives it, from the oldest to the newest, and the folders that hold no valid record.

    Rows are taken from the store's index while the files of their run are the same; a store that
    cannot be written is read without it.

    Args:
        store: The store.
        protocol: What the errors hold under; runs that were not scored under it are scored now.
        on_progress: Called now and then.
    """
    protocol = get_protocol(protocol)
    name = f"list {protocol.digest()}"
    version = digest([module_graph().digest([__name__], PLUMBING), *FIELDS])
    ids = store.ids()
    rows = {
        run_id: row
        for run_id, text in store.index.read(name, version, ids).items()
        if (row := _row(run_id, text))
    }
    entries: list[tuple[str, str, str]] = []
    unreadable: list[Unreadable] = []
    for position, run_id in enumerate(ids):
        if position % 100 == 0:
            on_progress(position, len(ids))
        if run_id in rows:
            continue
        try:
            record, state = store.read_with_state(run_id)
            rows[run_id] = run_row(
                record, None if record.status == "stopped" else store.score(record, protocol)
            )
            entries.append((run_id, state, json.dumps(list(rows[run_id].values()))))
        except DynslamError as error:
            unreadable.append(Unreadable(store.place(run_id), str(error)))
    store.index.write(name, version, entries)
    return sorted(rows.values(), key=lambda row: (row["started"], row["run_id"])), unreadable


def _row(run_id: str, text: str) -> Row | None:
    """A row of the index, if it is one of that run, and can be sorted."""
    try:
        row = dict(zip(FIELDS, json.loads(text), strict=True))
    except (ValueError, TypeError, RecursionError):
        return None
    return row if row["run_id"] == run_id and isinstance(row["started"], str) else None


@dataclass(frozen=True)
class Rescored:
    """What scoring all runs of a store again has changed.

    Attributes:
        protocol: Id of the protocol.
        runs: Runs that were scored.
        changed: Ids of those whose stored metrics had other values.
        unreadable: Folders without a valid record, or with a damaged trajectory, with reasons; they
            are not scored.
    """

    protocol: str
    runs: int
    changed: tuple[str, ...]
    unreadable: tuple[str, ...]


def rescore(
    store: RunStore,
    protocol: Protocol | str | None = None,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> list[Rescored]:
    """Compute the metrics of all stored runs again, whatever is stored.

    Args:
        store: The store.
        protocol: The protocol; None for every known one under which the store has metrics, at least
            the default one.
        on_progress: Called after every run.

    Returns:
        What has changed, by protocol.
    """
    records, unreadable = store.all()
    readable = []
    for record in records:
        if record.status == "stopped":
            continue
        try:
            store.check(record)
            readable.append(record.run_id)
        except DynslamError as error:
            unreadable.append(Unreadable(store.place(record.run_id), str(error)))
    ended = Records(store, readable)
    reasons = tuple(f"{bad.path}: {bad.reason}" for bad in unreadable)
    names = store.index.names()
    chosen = [
        option
        for option in PROTOCOLS.values()
        if option.id == DEFAULT_PROTOCOL or _metrics_of(option) in names
    ]
    chosen = chosen if protocol is None else [get_protocol(protocol)]
    outcomes: list[Rescored] = []
    for current in chosen:
        changed = []
        for number, record in enumerate(ended, start=1):
            before = store.index.last(_metrics_of(current), record.run_id)
            after = store.score(record, current, again=True)
            if before is not None and _errors(before) != _errors(after.to_line()):
                changed.append(record.run_id)
            on_progress(len(outcomes) * len(ended) + number, len(chosen) * len(ended))
        outcomes.append(Rescored(current.id, len(ended), tuple(changed), reasons))
    return outcomes


def _errors(text: str) -> object:
    """The evaluations of a metrics record; its text where it is damaged."""
    try:
        return [json.loads(text)[name] for name in ("online", "final")]
    except (ValueError, LookupError, TypeError, RecursionError):
        return text


# -- runs as rows of tables ------------------------------------------------------------------------

FIELDS = (
    *(
        "run_id",
        "tracker",
        "sequence",
        "frames",
        "seed",
        "offset",
        "noise",
        "repeat",
        "settings",
        "status",
    ),
    *(
        "ate_rmse_m",
        "static_camera_ate_rmse_m",
        "false_motion_max_m",
        "coverage",
        "frame_ms",
        "segmentation",
    ),
    *("seen_in_training", "study", "identity", "reason", "remarks", "started"),
)
"""Names of the values of a list's row, in order."""


def run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """A run's row in a list: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    # loads the catalogue of all sequences
    from dynslam_bench.segmentation.training_scenes import seen_in_training

    # what a part of a run scores says nothing
    errors = {} if metrics is None or record.failed else metrics.metrics
    not_scored = "" if metrics is None or errors else metrics.reasons.get(metrics.trajectory, "")
    final = metrics.final if metrics is not None and metrics.trajectory == "final" else None
    return {
        "run_id": record.run_id,
        "tracker": record.tracker.id,
        "sequence": record.sequence.id,
        "frames": part_words(record),
        "seed": record.seed,
        "offset": record.offset,
        "noise": record.sequence.noise,
        "repeat": record.repeat,
        "settings": "; ".join(assignments(record.asked)),
        "status": record.status,
        "ate_rmse_m": errors.get("ate_rmse_m"),
        "static_camera_ate_rmse_m": errors.get("static_camera_ate_rmse_m"),
        "false_motion_max_m": errors.get("false_motion_max_m"),
        "coverage": record.coverage if final is None or final.coverage is None else final.coverage,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "segmentation": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
        "reason": record.reason or (not_scored if record.sequence.ground_truth else ""),
        "remarks": [] if metrics is None or record.failed else metrics.remarks,
        "started": record.started,
    }


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run was asked for, e.g. ``0:60, every 2nd``; empty for all of them."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    return ", ".join(words)


_TEXT = (
    *("run_id", "kind", "tracker", "label", "settings", "provenance"),
    *("sequence", "frames", "split", "repeat", "status", "reason", "study", "identity"),
    *("device", "segmentation", "protocol_id", "protocol_digest", "trajectory"),
)
_WHOLE = (
    *(
        "seed",
        "offset",
        "noise",
        "stride",
        "threads",
        "n_frames",
        "n_processed",
        "n_tracked",
        "n_lost",
    ),
    *("keyframes", "map_points", "maps"),
)
_NUMBERS = (
    *("coverage", "frame_ms", "real_time_factor", "finalize_s", "wall_s", "peak_memory_mb"),
    *("mask_iou", "epipolar_skipped"),
)


def runs_frame(runs: Iterable[tuple[RunRecord, MetricRecord | None]]) -> pd.DataFrame:
    """Runs as a frame.

    Args:
        runs: Records with their metrics; None for a run that was not scored.

    Returns:
        One row a run, in their order. Whatever may be missing is ``pd.NA``, never nan or an empty
        string.

        - ``string``: run_id, kind (``run``, ``imported``), tracker, label (its name in tables), settings (those that
          were asked for, ``name=value; ...``), provenance, sequence, frames (``A:B, every 2nd``,
          missing for all), split, repeat (``seed 0, offset 2``), status, reason (missing for
          ``ok``), study (of which the run is a trial, missing for any other run), identity
          (``unverified`` for runs of an older scheme of ids, else missing), device, segmentation
          (source of the masks), protocol_id, protocol_digest and trajectory (``online``,
          ``final``): what the errors hold under and are of.
        - ``Int64``: seed, offset, noise (missing for the sequence's own), stride, threads, n_frames, n_processed,
          n_tracked, n_lost, keyframes, map_points, maps.
        - ``Float64``: coverage (0 to 1), frame_ms (median, milliseconds, segmentation included, decoding excluded),
          real_time_factor, finalize_s and wall_s (seconds), peak_memory_mb (MB), mask_iou and
          epipolar_skipped (0 to 1), and every metric under its own name with its unit
          (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``, see `Evaluation`); ``ate_rmse_m`` is there even
          if no run has one.
        - ``datetime64[us, UTC]``: started.
    """
    import pandas as pd

    rows = list[Row]()
    metrics = {"ate_rmse_m"}
    for record, scored in runs:
        rows.append(_cells(record, scored))
        metrics.update(scored.metrics if scored is not None else ())
    kinds: dict[str, str] = dict.fromkeys(_TEXT, "string") | dict.fromkeys(_WHOLE, "Int64")
    kinds |= dict.fromkeys((*_NUMBERS, *sorted(metrics)), "Float64")
    frame = pd.DataFrame(rows, columns=[*kinds, "started"], dtype=object).astype(kinds)
    started = pd.to_datetime(frame.started, utc=True, format="ISO8601")
    return frame.assign(started=started.astype("datetime64[us, UTC]"))


def _cells(record: RunRecord, metrics: MetricRecord | None) -> Row:
    cells = {
        name: getattr(record, name)
        for name in (*_WHOLE, *_NUMBERS, *_TEXT)
        if hasattr(record, name)
    }
    cells |= run_row(record, metrics)
    cells |= {
        "label": record.tracker.label or record.tracker.id,
        "provenance": record.tracker.provenance,
        "split": record.sequence.split,
        "reason": record.reason,
    }
    if metrics is not None:
        cells |= {
            name: getattr(metrics, name)
            for name in ("protocol_id", "protocol_digest", "trajectory")
        }
        cells |= metrics.metrics
    return {name: None if value == "" else value for name, value in cells.items()}
