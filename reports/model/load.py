"""From results folders to rows: which runs count, scored under one protocol."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

from pydantic import TypeAdapter

import dynslam_bench
from dynslam_bench.core.errors import DynslamError, InfrastructureError, ReportError, did_you_mean
from dynslam_bench.core.fingerprint import package_digest
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.protocol import MONOCULAR, Protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports.model.row import RunRow, Which, log_of, make_row
from dynslam_bench.runs.process.fork_server import child_environment
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore

OnProgress = Callable[[float, float | None, str], None]
"""Called as ``on_progress(done, total, what)``; the total is None where it is not known."""


def no_progress(done: float, total: float | None, what: str) -> None:
    """Progress that nobody wants to hear of."""


@dataclass(frozen=True)
class LoadedRun:
    """A row with the place where its trajectory lies.

    Attributes:
        row: The row.
        part: The run's part of a sequence.
        store: Where it lies.
    """

    row: RunRow
    part: str
    store: RunStore

    @cached_property
    def record(self) -> RunRecord:
        """The whole record, many times as large as the row: read when it is first asked for.

        Raises:
            DynslamError: It is damaged, or no longer there.
        """
        return self.store.read_whole(self.row.run_id)

    def as_job(self) -> dict[str, Any]:
        """The run for a helper process, see `reports.worker`."""
        return {"store": str(self.store.root), "part": self.part, "row": self.row.model_dump(mode="json")}

    def trajectory(self, which: Which) -> Trajectory | None:
        """The run's ``online`` or ``final`` trajectory; None if there is none with a pose, or it is damaged."""
        try:
            return self.store.trajectory(self.row.run_id, which)
        except DynslamError:
            return None

    def ground_truth(self) -> Trajectory | None:
        """The ground truth of its part of the sequence; None if there is none, or it is damaged."""
        try:
            return self.store.ground_truth(self.part)
        except DynslamError:
            return None


@dataclass
class Loaded:
    """Everything read from the stores.

    Attributes:
        runs: The newest run of every variant, column and repeat.
        superseded: How many older ones there were.
        stopped: How many runs were left out since they were ended on request.
        without_scale: How many were left out since their scale is unknown and the protocol's alignment finds none.
        trials: How many were left out since they are trials of studies.
        unreadable: Folders without a valid record, with reasons.
        conflicts: Runs that should be equal and are not, in words.
    """

    runs: list[LoadedRun] = field(default_factory=list)
    superseded: int = 0
    stopped: int = 0
    without_scale: int = 0
    trials: int = 0
    unreadable: list[str] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)

    @cached_property
    def by_id(self) -> dict[str, LoadedRun]:
        """The runs by their id."""
        return {run.row.run_id: run for run in self.runs}


def load_runs(
    sources: Sequence[RunStore],
    protocol: Protocol,
    on_progress: OnProgress = no_progress,
    crew: Crew | None = None,
    reference: str | None = None,
    *,
    trials: bool = False,
) -> Loaded:
    """Read all runs of some stores and score them under a protocol; SLAM is never run again for it.

    Args:
        sources: The stores.
        protocol: How to evaluate.
        on_progress: As in `build_report`.
        crew: Helpers that score the runs; None to score them here.
        reference: Id of a tracker of which there must be runs, looked for before anything is scored; None for any.
        trials: Whether trials of studies count like other runs.

    Raises:
        ReportError: There is no run at all, or none of the reference.
    """
    on_progress(0, None, "looking for what has changed")
    opened = [RowCache(store, protocol) for store in sources]
    kept = [rows.read() for rows in opened]
    _look_for(reference, opened, kept)
    taken, unreadable = _take(opened, [unread for _, unread in kept], on_progress, crew)
    everything = [
        (store, each) for store, (known, _), new in zip(sources, kept, taken, strict=True) for each in (*known, *new)
    ]
    ended = [LoadedRun(each.row, each.part, store) for store, each in everything if each.row is not None]
    scaled = [run for run in ended if protocol.finds_scale or not run.row.monocular]
    found = [run for run in scaled if trials or not run.row.study]
    loaded = Loaded(
        stopped=len(everything) - len(ended), without_scale=len(ended) - len(scaled), trials=len(scaled) - len(found),
        unreadable=unreadable,
    )  # fmt: skip
    _join_old_imports(found)
    newest: dict[tuple[object, ...], LoadedRun] = {}
    loaded.conflicts = _two_results(found)
    for run in sorted(found, key=lambda run: (run.row.started, run.row.run_id)):
        newest[run.row.settings_key, run.row.column_id, run.row.repeat_key, run.row.trajectory] = run
    _split_programs([run.row for run in newest.values()])
    loaded.superseded = len(found) - len(newest)
    if not newest and loaded.without_scale:
        raise ReportError(f"all {without_scale_words(loaded.without_scale, protocol)}")
    if not newest and loaded.trials:
        raise ReportError(f"all {trial_words(loaded.trials)}")
    if not newest:
        places = ", ".join(str(store.root) for store in sources)
        raise ReportError(
            f"there are no runs in {places}", loaded.unreadable[0] if loaded.unreadable else "make some with 'run'"
        )
    loaded.runs = list(newest.values())
    return loaded


def without_scale_words(count: int, protocol: Protocol) -> str:
    """Why runs of monocular trackers are in no table, and what shows them."""
    return (
        f"{count} runs of monocular trackers: their scale is unknown and {protocol.id} aligns without scale; "
        f"--protocol {MONOCULAR} shows them"
    )


def trial_words(count: int) -> str:
    """Why trials of studies are in no table, and which option shows them."""
    return (
        f"{count} runs that studies made with settings of their own, by which such settings are chosen; "
        "'report --trials' shows them"
    )


def _take(
    opened: Sequence[RowCache], unread: Sequence[Sequence[str]], on_progress: OnProgress, crew: Crew | None
) -> tuple[list[list[CachedRow]], list[str]]:
    """The rows of the runs that are to be read, by store, and the folders without a valid record, with reasons."""
    pieces = [(at, ids[first : first + JOB]) for at, ids in enumerate(unread) for first in range(0, len(ids), JOB)]
    total, done = sum(map(len, unread)), 0

    def heard(count: int, what: str) -> None:
        nonlocal done
        on_progress(done, total, what)
        done += count

    if crew is None:
        answers = [opened[at].take_all(ids, lambda what: heard(1, what)) for at, ids in pieces]
    else:
        jobs = [{"store": str(opened[at].store.root), "runs": ids} for at, ids in pieces]
        answers = crew.work("rows", jobs, heard, lambda answer: ([*map(CachedRow.answered, answer[0])], answer[1]))
    taken: list[list[CachedRow]] = [[] for _ in opened]
    for (at, _), (rows, _) in zip(pieces, answers, strict=True):
        taken[at] += rows
    return taken, [reason for _, unreadable in answers for reason in unreadable]


def _look_for(
    reference: str | None, opened: Sequence[RowCache], kept: Sequence[tuple[list[CachedRow], list[str]]]
) -> None:
    """Refuse a reference of which there is no run, before any run is scored.

    Raises:
        ReportError: As `check_reference`.
    """
    trackers = {each.row.tracker for known, _ in kept for each in known if each.row is not None}
    for rows, (_, unread) in zip(opened, kept, strict=True):
        for run_id in unread:
            if reference is None or reference in trackers:
                return
            record = rows.store.get(run_id)
            trackers |= set() if record is None or record.status == "stopped" else {record.tracker.id}
    if trackers:
        check_reference(reference, sorted(trackers))


def _split_programs(rows: Sequence[RunRow]) -> None:
    """Make the runs of each program a row of their own, where several made the runs of one tracker and its settings.

    Runs by an older program are not ranked, nor are those whose identity is not verified, which are always marked.
    """
    groups: dict[str, list[RunRow]] = {}
    for row in rows:
        groups.setdefault(row.settings_key, []).append(row)
    for group in groups.values():
        values: dict[str, set[str]] = {}
        for row in group:
            for name, value in row.program.items():
                values.setdefault(name, set()).add(value)
        varying = {name for name, found in values.items() if len(found) > 1 or name == "identity"}
        for row in group:
            row.split_by = {name: value for name, value in row.program.items() if name in varying}
        last = max(group, key=lambda row: ("identity" not in row.split_by, row.started)).split_by
        for row in group:
            row.is_current = row.split_by == last and "identity" not in row.split_by


def _two_results(runs: Sequence[LoadedRun]) -> list[str]:
    """Which runs of one id from several stores have different results although they should be equal, in words."""
    conflicts = []
    by_id: dict[str, list[RunRow]] = {}
    for run in runs:
        by_id.setdefault(run.row.run_id, []).append(run.row)
    for rows in by_id.values():
        errors = sorted({row.metrics["ate_rmse_m"] for row in rows if "ate_rmse_m" in row.metrics})
        if len(errors) > 1 and rows[0].deterministic:
            found = ", ".join(f"{1000 * error:.3f}" for error in errors)
            conflicts.append(f"{rows[0].label} on {rows[0].sequence} (run {rows[0].run_id}): ATE {found} mm")
    return conflicts


def _join_old_imports(runs: Sequence[LoadedRun]) -> None:
    """Imports of older versions name no camera: they belong to the one column of the same frames, if there is one."""
    columns: dict[str, set[str]] = {}
    for run in runs:
        if not run.row.imported:
            columns.setdefault(run.part, set()).add(run.row.column_id)
    for run in runs:
        part = run.part
        if run.row.imported and run.row.block == part and len(columns.get(part, ())) == 1:
            (run.row.block,) = columns[part]


def check_reference(reference: str | None, trackers: Sequence[str]) -> None:
    """Refuse a reference that none of some runs' trackers is; None is none.

    Raises:
        ReportError: Names the reference, and the tracker that may have been meant.
    """
    known = sorted(set(trackers))
    if reference is not None and reference not in known:
        raise ReportError(f"there is no run of the reference '{reference}'", did_you_mean(reference, known))


def check_one_protocol(rows: Sequence[RunRow]) -> None:
    """Refuse rows whose numbers were taken under different protocols.

    Raises:
        ReportError: Names the protocols and how many rows each has.
    """
    counts: dict[tuple[str, str], int] = {}
    for row in rows:
        key = (row.protocol_id, row.protocol_digest)
        counts[key] = counts.get(key, 0) + 1
    if len(counts) > 1:
        named = " and ".join(f"{name} [{digest}] ({count} rows)" for (name, digest), count in sorted(counts.items()))
        raise ReportError(
            f"one table cannot mix {len(counts)} protocols: {named}", "score all runs under one protocol first"
        )


def open_stores(runs: Sequence[Path] | Sequence[str] | RunStore | Path | str) -> list[RunStore]:
    """Stores of results folders.

    Raises:
        ReportError: A folder does not exist or holds no store.
    """
    if isinstance(runs, RunStore):
        return [runs]
    paths = [Path(runs)] if isinstance(runs, str | Path) else [Path(path) for path in runs]
    if not paths:
        raise ReportError("no results folder was given", "for example results")
    stores = []
    for path in paths:
        folder = path.expanduser()
        if not folder.is_dir():
            raise ReportError(f"there is no results folder {folder}", "make runs first, or name their folder")
        if folder.name == "runs" and not (folder / "runs").is_dir():
            folder = folder.parent
        if not (folder / "runs").is_dir():
            raise ReportError(f"{folder} holds no runs: it has no folder 'runs'", "name the folder given as --results")
        stores.append(RunStore(folder))
    return stores


# Rows that a report has taken before, kept in the store's index: an unchanged run is not read again.

_CODE = ("evaluation", "geometry", "reports/model", "runs")
_ROW: TypeAdapter[RunRow | None] = TypeAdapter(RunRow | None)


@dataclass(frozen=True)
class CachedRow:
    """A run as a report takes it.

    Attributes:
        run_id: Its id.
        state: Of its files, see `RunIndex.state`; the run's part of a sequence comes first.
        row: Its row; None for a run that was stopped on request, which no report shows.
    """

    run_id: str
    state: str
    row: RunRow | None

    @property
    def part(self) -> str:
        """The run's part of a sequence."""
        return self.state.partition(" ")[0]

    def answer(self) -> list[Any]:
        """The same as a helper's answer."""
        return [self.run_id, self.state, None if self.row is None else self.row.model_dump(mode="json")]

    @classmethod
    def answered(cls, answer: Sequence[Any]) -> CachedRow:
        """What a helper has answered."""
        return cls(answer[0], answer[1], None if answer[2] is None else RunRow.model_validate(answer[2]))


class RowCache:
    """The rows of a store's runs under a protocol.

    Args:
        store: The store.
        protocol: How errors are computed.

    Attributes:
        store: The store.
    """

    def __init__(self, store: RunStore, protocol: Protocol) -> None:
        self.store, self._protocol = store, protocol
        self._name = f"report {protocol.digest()}"
        self._version = digest([dynslam_bench.__version__, package_digest(_CODE)])

    def read(self) -> tuple[list[CachedRow], list[str]]:
        """All that hold, and the ids of the runs of which none does."""
        stored = self.store.ids()
        rows = []
        for run_id, text in self.store.index.read(self._name, self._version, stored, check_links=True).items():
            with suppress(ValueError):
                state, value = json.loads(text)
                row = _ROW.validate_python(value)
                if row is None or (row.run_id, row.protocol_digest) == (run_id, self._protocol.digest()):
                    rows.append(CachedRow(run_id, str(state), row))
        for cached in rows:
            if cached.row is not None:
                cached.row.log = log_of(self.store, cached.run_id)
        there = {cached.run_id for cached in rows}
        return rows, [run_id for run_id in stored if run_id not in there]

    def take_all(self, run_ids: Iterable[str], told: Callable[[str], None]) -> tuple[list[CachedRow], list[str]]:
        """Read some runs, score them, and keep their rows for later reports, as far as the store can be written.

        Args:
            run_ids: Their ids.
            told: Called with what was done, once a run.

        Returns:
            The rows, and the folders without a valid record, with reasons.
        """
        taken: list[CachedRow] = []
        unreadable: list[str] = []
        for run_id in run_ids:
            try:
                record, state = self.store.read_with_state(run_id)
                row = None if record.status == "stopped" else make_row(self.store, record, self._protocol)
                taken.append(CachedRow(run_id, state, row))
                told("" if row is None else f"scoring {row.tracker} on {row.sequence}")
            except DynslamError as error:
                unreadable.append(f"{self.store.folder(run_id)}: {error}")
                told("")
        entries = []
        for cached in taken:
            value = None if cached.row is None else cached.row.model_dump(mode="json", exclude={"log"})
            entries.append((cached.run_id, cached.state, json.dumps([cached.state, value])))
        self.store.index.write(self._name, self._version, entries)
        return taken, unreadable


# Helper processes of a report: thousands of runs are read, scored and drawn on all cores.

MODULE = "dynslam_bench.reports.worker"
MANY = 250
"""Runs from which on helpers save more time than they need to start."""
MOST = 8
JOB = 40
"""Runs of one job, at most."""

Heard = Callable[[int, str], None]
"""Called as ``heard(runs that were done, what was done)``, by one thread at a time."""


def unheard_run(done: int, what: str) -> None:
    """Progress that nobody wants to hear of."""


def helpers_for(runs: int) -> int:
    """How many helpers so many runs are worth on this machine; 0 for none."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST) if runs >= MANY and cores > 1 else 0


class Crew:
    """Some helpers, who go with the block that they were hired for.

    Args:
        count: How many.
        setup: What all of them have to know, see `reports.worker`.

    Raises:
        InfrastructureError: They cannot be started.
    """

    def __init__(self, count: int, setup: Mapping[str, Any]) -> None:
        self._helpers: list[subprocess.Popen[str]] = []
        try:
            for _ in range(count):
                self._helpers.append(
                    subprocess.Popen(
                        [sys.executable, "-m", MODULE],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        text=True,
                        encoding="utf-8",
                        env=child_environment(),
                        start_new_session=True,  # Ctrl-C is for us; they end when their input does
                    )
                )
                _send(self._helpers[-1], dict(setup))
        except OSError as error:
            self.__exit__(None, None, None)
            raise InfrastructureError(f"cannot start {sys.executable}: {error.strerror}") from error

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for helper in self._helpers:
            helper.kill()
        for helper in self._helpers:
            with suppress(OSError):  # what was not sent yet goes nowhere
                helper.communicate()

    def work(
        self,
        kind: str,
        jobs: Sequence[Mapping[str, Any]],
        heard: Heard,
        understood: Callable[[Any], Any] = lambda answer: answer,
    ) -> list[Any]:
        """Share jobs out among the helpers, the next job to whoever is free.

        Args:
            kind: A function of `reports.worker`.
            jobs: What each is called with.
            heard: Told of every run that is done.
            understood: Makes of an answer, as soon as it is there, what is kept of it.

        Returns:
            The answers in the order of the jobs.

        Raises:
            ReportError: A job cannot be done.
            InfrastructureError: A helper has died.
        """
        open_jobs: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(len(jobs)):
            open_jobs.put(number)
        answers: list[Any] = [None] * len(jobs)
        faults: list[Exception] = []
        lock = threading.Lock()

        def tell(done: int, what: str) -> None:
            with lock:
                heard(done, what)

        def serve(helper: subprocess.Popen[str]) -> None:
            with suppress(queue.Empty):
                while not faults:
                    number = open_jobs.get_nowait()
                    try:
                        answers[number] = understood(_asked(helper, kind, jobs[number], tell))
                    except Exception as error:  # raised again below, by the thread that asked
                        faults.append(error)

        threads = [threading.Thread(target=serve, args=(helper,), daemon=True) for helper in self._helpers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if faults:
            raise faults[0]
        return answers


def _send(helper: subprocess.Popen[str], message: Mapping[str, Any]) -> None:
    assert helper.stdin is not None
    helper.stdin.write(json.dumps(message) + "\n")
    helper.stdin.flush()


def _asked(helper: subprocess.Popen[str], kind: str, job: Mapping[str, Any], tell: Heard) -> Any:
    """The answer of one helper to one job."""
    assert helper.stdout is not None
    with suppress(BrokenPipeError):  # it is gone: there is no answer either
        _send(helper, {"kind": kind, "job": job})
        for line in helper.stdout:
            said = json.loads(line)
            if "answer" in said:
                return said["answer"]
            if "fault" in said:
                raise ReportError(*said["fault"])
            tell(said["done"], said["what"])
    raise InfrastructureError(f"a helper process of the report ended early (exit status {helper.wait()})")
