"""The run store: one folder a run, which appears whole or not at all."""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError, InfrastructureError, RunError, did_you_mean
from dynslam_bench.core.files import claimed, replace_folder, sweep_temporary, temporary_folder
from dynslam_bench.core.reading import read_lines
from dynslam_bench.core.records import digest, write_atomic
from dynslam_bench.evaluation.protocol import PROTOCOLS, Protocol, get_protocol
from dynslam_bench.geometry.stamps import format_ns
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import format_tum, read_tum
from dynslam_bench.runs.record import MetricRecord, RunRecord
from dynslam_bench.runs.run_index import (
    FINAL,
    ONLINE,
    Stamp,
    add_to_index,
    check_plain,
    index_file,
    input_stamps,
    make_line,
    stamp_if_there,
    stamp_of,
)
from dynslam_bench.runs.scoring import DEFAULT_PROTOCOL, evaluate_run, evaluation_code

if TYPE_CHECKING:
    import pandas as pd


LOGGER = logging.getLogger(__name__)
RUN_FILE = "run.json"
A_RUN = "a run's id"
_RUN_ID = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Unreadable:
    """A folder of the store that holds no valid record."""

    path: Path
    reason: str


class RunStore:
    """Runs, their metrics and the sequences' ground truth below one folder.

    ``runs/<run_id>/`` holds ``run.json``, ``trajectory_online.txt``, ``trajectory_final.txt``, ``frames.csv``,
    ``keyframes.csv``, ``map.ply`` and ``log.txt``; ``metrics/<protocol digest>/<run_id>.json`` the errors under a
    protocol; ``index/`` what lists and reports have said of each run; ``sequences/<part>/`` stamps and ground truth,
    so that a run can be scored again without its data; ``latest`` links the newest run.

    Args:
        root: The folder; it is made when something is written.

    Attributes:
        root: The same, absolute.
        runs: Folder of the runs.
    """

    def __init__(self, root: str | Path = "results") -> None:
        self.root = Path(root).expanduser().absolute()
        self.runs = self.root / "runs"
        self._swept = False
        self._published: dict[str, Stamp] = {}
        """Runs of this process that are in no index yet."""

    def folder(self, run_id: str) -> Path:
        """Folder of one run, whether it exists or not.

        Raises:
            RunError: It is no run's id, which is 16 hexadecimal digits: anything else could lead out of the store.
        """
        return self.runs / _checked(run_id, A_RUN)

    def metric_file(self, run_id: str, protocol_digest: str) -> Path:
        """Where the errors of a run under a protocol lie, whether they exist or not.

        Raises:
            RunError: As `folder`.
        """
        return self.root / "metrics" / protocol_digest / f"{_checked(run_id, A_RUN)}.json"

    def _part(self, part: str) -> Path:
        """Folder of the stamps and the ground truth of a sequence's part."""
        return self.root / "sequences" / _checked(part, "the part of a sequence")

    # -- writing ---------------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Make sure that runs can be stored, and sweep up what killed processes left behind.

        Raises:
            RunError: The folder cannot be written.
        """
        try:
            with temporary_folder(self.runs / "probe"):
                pass
        except DynslamError as error:
            raise RunError(str(error.args[0]), "name another folder with --results") from error
        if not self._swept:
            self._swept = True
            for pattern in ("", "runs", "metrics/*", "sequences/*"):
                sweep_temporary(self.root, pattern)
            for left in self.runs.glob(".*.claim"):
                with claimed(left):  # held by nobody else, it goes
                    pass
            self._unlink_dangling()

    @contextmanager
    def work_folder(self, run_id: str) -> Iterator[Path]:
        """A hidden folder to make a run in; it vanishes unless `publish` moved it into place.

        Raises:
            DynslamError: The store cannot be written.
        """
        with temporary_folder(self.folder(run_id)) as work:
            yield work

    def claim(self, run_id: str) -> AbstractContextManager[bool]:
        """Make a run alone while the block lasts; it is given False where another process or thread is making it.

        Raises:
            DynslamError: The store cannot be written.
        """
        return claimed(self.runs / f".{run_id}.claim")

    def publish(self, work: Path, record: RunRecord) -> RunRecord:
        """Write the record into its work folder and rename that to the run's; replaces an earlier run of the id.

        Returns:
            The record as it is stored, with a note if the earlier run gave another result.

        Raises:
            InfrastructureError: It cannot be written; then nothing has changed.
        """
        target = self.folder(record.run_id)
        record = self._with_alarm(record, work)
        try:
            (work / RUN_FILE).write_text(record.to_json(), encoding="utf-8")
            stamp = stamp_of(work / RUN_FILE)  # which a rename leaves as it is
            self._forget_metrics(record.run_id)  # those of an earlier run of the id
            replace_folder(work, target)
            self._forget_metrics(record.run_id)  # if they were written again between these two lines
        except OSError as error:
            raise InfrastructureError(f"cannot write {target}: {error.strerror}", "check the free space") from error
        self._published[record.run_id] = stamp
        self._link_latest(target)
        return record

    def _with_alarm(self, record: RunRecord, work: Path) -> RunRecord:
        """The record, with a note where an earlier run of its id, which should be equal, gave another trajectory."""
        earlier = self.get(record.run_id)
        if earlier is None or not record.tracker.deterministic or record.realtime:
            return record
        if earlier.status != "ok" or record.status != "ok":
            return record
        if _sha256(work / ONLINE) == _sha256(self.folder(record.run_id) / ONLINE):
            return record
        note = (
            f"an earlier run with this id, started {earlier.started}, gave another trajectory, although tracker "
            f"'{record.tracker.id}' is declared deterministic"
        )
        LOGGER.warning("run %s: %s", record.run_id, note)
        return record.model_copy(update={"notes": [*record.notes, note]})

    def add_sequence(self, part: str, timestamps_ns: NDArray[np.int64], ground_truth: Trajectory | None) -> None:
        """Keep the stamps of a sequence's frames, in nanoseconds, and its ground truth; done once a part."""
        folder = self._part(part)
        if (folder / "timestamps.txt").is_file():
            return
        if ground_truth is not None and len(ground_truth):
            write_atomic(folder / "groundtruth.txt", format_tum(ground_truth))
        write_atomic(folder / "timestamps.txt", "".join(f"{format_ns(ns)}\n" for ns in timestamps_ns.tolist()))

    def relabel(self, record: RunRecord, label: str) -> RunRecord:
        """Give a stored run another name in tables; everything else of it stays.

        Raises:
            DynslamError: It cannot be written.
        """
        return self._rewrite(record, tracker=record.tracker.model_copy(update={"label": label}))

    def leave_study(self, record: RunRecord) -> RunRecord:
        """Make a study's run an ordinary one, since it was asked for without the study; everything else of it stays.

        Raises:
            DynslamError: It cannot be written.
        """
        return self._rewrite(record, study="")

    def _rewrite(self, record: RunRecord, **changes: Any) -> RunRecord:
        changed = (self.get(record.run_id) or record).model_copy(update=changes)
        write_atomic(self.folder(record.run_id) / RUN_FILE, changed.to_json())
        return changed

    def add_metrics(self, metrics: MetricRecord) -> None:
        """Write a run's metrics under a protocol."""
        write_atomic(self.metric_file(metrics.run_id, metrics.protocol_digest), metrics.to_json())

    def remove(self, run_id: str) -> None:
        """Delete a run and its metrics.

        Raises:
            RunError: There is no such run, or it cannot be deleted.
        """
        run_id = self.find(run_id)
        try:
            with self.work_folder(run_id) as gone:
                self._forget_metrics(run_id)
                self.folder(run_id).rename(gone / run_id)
        except OSError as error:
            raise RunError(f"cannot remove run {run_id}: {error.strerror}") from error
        self._unlink_dangling()

    # -- reading ---------------------------------------------------------------------------------------------------

    def ids(self) -> list[str]:
        """Ids of all stored runs, sorted."""
        if not self.runs.is_dir():
            return []
        with os.scandir(self.runs) as entries:
            return sorted(entry.name for entry in entries if _RUN_ID.fullmatch(entry.name) and entry.is_dir())

    def read(self, run_id: str) -> RunRecord:
        """The record of a run.

        Raises:
            RunError: There is no such run.
            DynslamError: Its record is damaged.
        """
        return self.read_whole(self.find(run_id))

    def get(self, run_id: str) -> RunRecord | None:
        """The record of a run by its full id, None if it is not stored or damaged."""
        if not (self.folder(run_id) / RUN_FILE).is_file():
            return None
        try:
            return self.read_whole(run_id)
        except DynslamError:
            return None

    def read_whole(self, run_id: str) -> RunRecord:
        """The record of a run by its full id.

        Raises:
            DynslamError: It is missing or damaged, names itself otherwise, or its folder holds more than plain files.
        """
        path = self.folder(run_id) / RUN_FILE
        check_plain(path.parent, self.root)
        record = RunRecord.read(path)
        if record.run_id != run_id:
            raise RunError(f"{path} names itself {record.run_id}, not as its folder", "it was copied or made by hand")
        return record

    def all(self) -> tuple[list[RunRecord], list[Unreadable]]:
        """All runs from the oldest to the newest, and the folders that hold no valid record, with reasons."""
        records, unreadable = [], []
        for run_id in self.ids():
            try:
                records.append(self.read_whole(run_id))
            except DynslamError as error:
                unreadable.append(Unreadable(self.folder(run_id), str(error)))
        return sorted(records, key=lambda record: (record.started, record.run_id)), unreadable

    def find(self, prefix: str) -> str:
        """The full id of a run from its first digits, or of ``latest``.

        Raises:
            RunError: No run, or more than one, begins so.
        """
        known = self.ids()
        if prefix == "latest" and (self.root / "latest").exists():
            return (self.root / "latest").resolve().name
        matching = [run_id for run_id in known if run_id.startswith(prefix)] if prefix else []
        if len(matching) == 1:
            return matching[0]
        if matching:
            raise RunError(f"{len(matching)} runs begin with '{prefix}'", ", ".join(matching[:5]))
        hint = did_you_mean(prefix, known) if known else f"there are no runs in {self.root}"
        raise RunError(f"there is no run '{prefix}'", hint)

    def metrics(self, record: RunRecord, protocol: Protocol) -> MetricRecord | None:
        """A run's stored metrics under a protocol; None if it was not scored under it, or they are out of date.

        Metrics hold for one version of the evaluation code and one content of the trajectories and the ground truth.
        """
        found = self.stored_metrics(record.run_id, protocol)
        if found is None or (found.code, found.inputs) != (evaluation_code(), self._inputs(record)):
            return None
        return found

    def stored_metrics(self, run_id: str, protocol: Protocol) -> MetricRecord | None:
        """A run's metrics under a protocol as they are stored, maybe out of date; None without valid ones."""
        path = self.metric_file(run_id, protocol.digest())
        if not path.is_file():
            return None
        try:
            found = MetricRecord.read(path)
        except DynslamError as error:
            LOGGER.warning("run %s is scored again: %s", run_id, error)
            return None
        return found if (found.run_id, found.protocol_digest) == (run_id, protocol.digest()) else None

    def _inputs(self, record: RunRecord) -> str:
        """Digest of everything that a run's metrics are computed from."""
        run, part = self.folder(record.run_id), self._part(record.sequence.part)
        files = (run / ONLINE, run / FINAL, part / "groundtruth.txt", part / "timestamps.txt")
        contents = [_sha256(file) for file in files]
        return digest(
            [contents, record.sequence.id, record.tracker.id, record.tracker.sensors, record.stamps_match], 16
        )

    def score(
        self, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
    ) -> MetricRecord:
        """A stored run's metrics under a protocol; see `scoring.score`."""
        protocol = get_protocol(protocol)
        stored = None if again else self.metrics(record, protocol)
        if stored is not None:
            return stored
        inputs = self._inputs(record)  # before they are read: what replaces them meanwhile is scored anew
        part = record.sequence.part
        metrics = evaluate_run(
            record,
            lambda which: self.trajectory(record.run_id, which),
            lambda: self.ground_truth(part),
            lambda: self.timestamps(part),
            protocol,
        )
        if record.kind == "imported":  # it has only one trajectory
            online = (self.folder(record.run_id) / "trajectory_online.txt").is_file()
            metrics = metrics.model_copy(update={"trajectory": "online" if online else "final"})
        metrics = metrics.model_copy(update={"code": evaluation_code(), "inputs": inputs})
        try:
            self.add_metrics(metrics)
        except DynslamError as error:  # a store that can only be read can be scored all the same
            LOGGER.info("the metrics of run %s are not kept: %s", record.run_id, error)
        stamp = self._published.pop(record.run_id, None)
        if stamp is not None:
            scored = stamp_if_there(self.metric_file(record.run_id, metrics.protocol_digest))
            parts = str(self.root / "sequences")
            stamps = (*stamp, *scored, *input_stamps(str(self.runs), parts, record.run_id, record.sequence.part))
            add_to_index(index_file(self.root, protocol), make_line(stamps, record, metrics))
        return metrics

    def frame(self, protocol: Protocol | str = DEFAULT_PROTOCOL, *, trials: bool = False) -> pd.DataFrame:
        """All runs, scored under one protocol, as a pandas frame: one row a run, from the oldest to the newest.

        Args:
            protocol: How to evaluate; SLAM is never run again for it.
            trials: Whether the trials of studies are listed, too: their settings are candidates, no results.

        Returns:
            The columns that `runs_frame` describes.
        """
        from dynslam_bench.runs.run_index import runs_frame

        records, _ = self.all()
        listed = [record for record in records if trials or not record.trial_of]
        return runs_frame([(r, None if r.status == "stopped" else self.score(r, protocol)) for r in listed])

    def trajectory(self, run_id: str, which: str = "online") -> Trajectory | None:
        """The ``online`` or ``final`` trajectory of a run; None if there is none or no frame was tracked."""
        path = self.folder(run_id) / f"trajectory_{which}.txt"
        if not path.is_file() or not any(line.strip() and line[0] != "#" for line in read_lines(path, kind=RunError)):
            return None
        return read_tum(path)

    def ground_truth(self, part: str) -> Trajectory | None:
        """The ground truth of a sequence's part; None if it has none."""
        path = self._part(part) / "groundtruth.txt"
        check_plain(path.parent, self.root)
        return _read_truth(path, path.stat().st_mtime_ns) if path.is_file() else None

    def timestamps(self, part: str) -> NDArray[np.float64]:
        """Stamps in seconds of all input frames of a sequence's part.

        Raises:
            RunError: They are not stored, or damaged.
        """
        path = self._part(part) / "timestamps.txt"
        check_plain(path.parent, self.root)
        try:
            return _read_stamps(path, path.stat().st_mtime_ns)
        except OSError as error:
            raise RunError(f"cannot read {path}: {error.strerror}", "the results folder is incomplete") from error

    def _forget_metrics(self, run_id: str) -> None:
        for metrics in (self.root / "metrics").glob(f"*/{run_id}.json"):
            metrics.unlink(missing_ok=True)

    def _link_latest(self, target: Path) -> None:
        link = self.root / "latest"
        with contextlib.suppress(OSError), temporary_folder(link) as work:  # a file system may have no links
            fresh = work / link.name
            fresh.symlink_to(target.relative_to(self.root))
            fresh.replace(link)

    def _unlink_dangling(self) -> None:
        latest = self.root / "latest"
        if latest.is_symlink() and not latest.exists():
            latest.unlink(missing_ok=True)


def _sha256(file: Path) -> str:
    """SHA-256 of a file; empty where it cannot be read, which the evaluation then says."""
    try:
        return sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    except OSError:
        return ""


def _checked(name: str, what: str) -> str:
    """A name that data gives to a folder of the store, if it is one that this package makes."""
    if not _RUN_ID.fullmatch(name):
        raise RunError(f"{name[:100]!r} is not {what}: expected 16 hexadecimal digits")
    return name


@lru_cache(maxsize=64)
def _read_truth(path: Path, _changed_ns: int) -> Trajectory:
    """A ground truth, which many runs share; nobody may write into it."""
    truth = read_tum(path)
    truth.timestamps.flags.writeable = truth.T_world_cam.flags.writeable = False
    return truth


@lru_cache(maxsize=64)
def _read_stamps(path: Path, _changed_ns: int) -> NDArray[np.float64]:
    """The stamps of a part, likewise shared."""
    try:
        stamps = np.array([float(line) for line in read_lines(path, kind=RunError) if line.strip()], dtype=np.float64)
    except ValueError as error:
        raise RunError(f"cannot read {path}: {error}", "the results folder is incomplete") from error
    stamps.flags.writeable = False
    return stamps


# Scoring stored runs; runs are never made again for it.

__all__ = ["DEFAULT_PROTOCOL", "Rescored", "rescore", "score"]


def score(
    store: RunStore, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
) -> MetricRecord:
    """The metrics of a stored run under a protocol, from its stored trajectories and ground truth.

    Args:
        store: Where the run lies.
        record: The run.
        protocol: A protocol or its id.
        again: Compute them even if they are stored.

    Returns:
        The metrics; evaluations that are not possible are None, with the reason.
    """
    return store.score(record, protocol, again=again)


@dataclass(frozen=True)
class Rescored:
    """What scoring all runs of a store again has changed.

    Attributes:
        protocol: Id of the protocol.
        runs: Runs that were scored.
        changed: Ids of those whose stored metrics had other values.
        unreadable: Folders without a valid record, with reasons.
    """

    protocol: str
    runs: int
    changed: tuple[str, ...]
    unreadable: tuple[str, ...]


def rescore(
    store: RunStore, protocol: Protocol | str | None = None, *, on_progress: Callable[[int, int], None] | None = None
) -> list[Rescored]:
    """Compute the metrics of all stored runs again, whatever is stored.

    Args:
        store: The store.
        protocol: The protocol; None for every known one under which the store has metrics, at least the default one.
        on_progress: Called with how many runs were scored, of how many.

    Returns:
        What has changed, by protocol.
    """
    records, unreadable = store.all()
    ended = [record for record in records if record.status != "stopped"]
    if protocol is None:
        there = {folder.name for folder in (store.root / "metrics").glob("*")}
        chosen = [each for each in PROTOCOLS.values() if each.id == DEFAULT_PROTOCOL or each.digest() in there]
    else:
        chosen = [get_protocol(protocol)]
    outcomes = []
    for position, each in enumerate(chosen):
        changed = []
        for number, record in enumerate(ended):
            before = store.stored_metrics(record.run_id, each)
            after = score(store, record, each, again=True)
            if before is not None and (before.online, before.final) != (after.online, after.final):
                changed.append(record.run_id)
            if on_progress is not None:
                on_progress(position * len(ended) + number + 1, len(chosen) * len(ended))
        reasons = tuple(f"{bad.path}: {bad.reason}" for bad in unreadable)
        outcomes.append(Rescored(each.id, len(ended), tuple(changed), reasons))
    return outcomes
