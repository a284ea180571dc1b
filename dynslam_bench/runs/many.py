"""Many runs: resumable, parallel, here or on any executor; runs as bytes for workers."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import threading
import time
import zipfile
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from dynslam_bench.core.errors import DynslamError, InfrastructureError, RunError, SequenceError, TrajectoryError
from dynslam_bench.core.files import TemporaryFolder
from dynslam_bench.core.records import write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.artifacts import SHEET_FILE, VIDEO_FILE
from dynslam_bench.runs.exchange.recording import RECORDING_FILE
from dynslam_bench.runs.identity import ResolvedRun, resolve
from dynslam_bench.runs.one import OnProgress, run_one
from dynslam_bench.runs.record import FAILED, RunRecord
from dynslam_bench.runs.run_index import RUN_FILE
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, RunStore
from dynslam_bench.slam.map_files import MAP_FILE

T = TypeVar("T")
OnFault = Callable[[RunSpec, DynslamError], None]
"""Called as ``on_fault(spec, error)`` for a run that cannot be made; nothing of it is stored."""
_CLAIM_AGAIN_S = 0.2
EventKind = Literal["reused", "started", "progress", "finished"]


@dataclass(frozen=True)
class RunEvent:
    """Something happened to a run.

    Attributes:
        kind: ``reused`` (it was stored already), ``started``, ``progress`` or ``finished``.
        run_id: The run.
        spec: What was asked for.
        total: How many runs there are.
        record: The outcome, with ``reused`` and ``finished``.
        partial: The partial metrics, with ``progress``.
    """

    kind: EventKind
    run_id: str
    spec: RunSpec
    total: int
    record: RunRecord | None = None
    partial: dict[str, Any] | None = None


def run_many(
    specs: Iterable[RunSpec],
    *,
    results: str | Path | RunStore = "results",
    jobs: int = 1,
    executor: Executor | None = None,
    retry: Collection[str] = (),
    on_plan: Callable[[Collection[ResolvedRun]], None] | None = None,
    on_event: Callable[[RunEvent], None] | None = None,
    on_progress: OnProgress | None = None,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    cancelled: Callable[[], bool] | None = None,
    on_fault: OnFault | None = None,
) -> list[RunRecord]:
    """Make the runs that are not stored yet, and score all of them.

    Everything is looked up before the first run begins. A stored run is made again if a video, a sheet or its map is
    asked for that it lacks; one that is given another label gets that, and one that a study made is an ordinary run
    once it is asked for without the study. A failure is a record and stops nothing; after an interrupt the call goes
    on. A run whose sequence or files cannot be read stops no other, and nothing of it is stored. Several processes may
    share a results folder (without `executor`): each run is made by one of them.

    Args:
        specs: What to run; runs that are the same are made once.
        results: The results folder, or a store.
        jobs: Runs at a time on this machine.
        executor: Where to make them instead, e.g. Dask's ``client.get_executor()``. Its workers return records as bytes
            and need the sequences, not the results folder; partial metrics stay there: `on_progress` is not called.
        retry: Statuses to run again although they are stored; ``failed`` stands for all of `FAILED`.
        on_plan: Called once, before the first run, which runs will be made, if any.
        on_event: Told of everything that happens, from several threads but never two at a time.
        on_progress: Told of partial metrics; returning False stops that run, which is then not stored.
        protocol: Protocol to score under.
        cancelled: Asked many times a second; True ends the runs on this machine at once, as stopped.
        on_fault: Told of every run that cannot be made, by one thread at a time. Without it the first such fault is
            raised when all other runs are stored.

    Returns:
        The records in the order of `specs`, without those of runs that cannot be made.

    Raises:
        DynslamError: A spec names something unknown or unfit, or the results folder cannot be written, and nothing ran;
            or, without `on_fault`, a run could not be made.
    """
    store = results if isinstance(results, RunStore) else RunStore(results)
    protocol = get_protocol(protocol)
    again = _statuses(retry)
    if jobs < 1:
        raise RunError(f"jobs is {jobs}", "give a number >= 1")
    resolved: list[ResolvedRun] = []
    faults: list[tuple[RunSpec, DynslamError]] = []
    for spec in specs:
        try:
            resolved.append(resolve(spec))
        except (SequenceError, TrajectoryError) as error:
            faults.append((spec, error))
    if resolved:
        store.prepare()
    bench = _Bench(store, protocol, len(resolved), jobs, on_event, on_progress, cancelled, on_fault)
    for spec, fault in faults:
        bench.fault(spec, fault)
    todo: dict[str, ResolvedRun] = {}
    done: dict[str, RunRecord] = {}
    for run in resolved:
        if run.run_id in todo or run.run_id in done:
            continue
        stored = store.get(run.run_id)
        if stored is not None and stored.status not in again and not _lacks_pictures(store, run, stored):
            done[run.run_id] = bench.reuse(run, stored)
        else:
            todo[run.run_id] = run
            bench.before[run.run_id] = stored
    if todo and on_plan is not None:
        on_plan(todo.values())
    done |= bench.run_here(todo) if executor is None else bench.run_remotely(todo, executor)
    if bench.faults and on_fault is None:
        raise bench.faults[0]
    return [done[run.run_id] for run in resolved if run.run_id in done]


@dataclass
class _Bench:
    """The runs of one call: here, where each is claimed in the store while it is made, or on an executor."""

    store: RunStore
    protocol: Protocol
    total: int
    jobs: int
    on_event: Callable[[RunEvent], None] | None
    on_progress: OnProgress | None
    cancelled: Callable[[], bool] | None
    on_fault: OnFault | None
    before: dict[str, RunRecord | None] = field(default_factory=dict)
    """The records of the runs that are to be made, when the call began."""
    faults: list[DynslamError] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    aborted: threading.Event = field(default_factory=threading.Event)

    def reuse(self, run: ResolvedRun, record: RunRecord) -> RunRecord:
        if run.spec.label not in ("", record.tracker.label):
            record = self.store.relabel(record, run.spec.label)
        if record.study and not run.spec.study:
            record = self.store.rewrite(record, study="")
        self.store.score(record, self.protocol)
        self._report("reused", run, record=record)
        return record

    def run_here(self, todo: dict[str, ResolvedRun]) -> dict[str, RunRecord]:
        waiting = list(todo.values())
        with ThreadPoolExecutor(self.jobs, thread_name_prefix="dynslam-run") as pool:
            return self._collect([pool.submit(self._next, waiting) for _ in todo])

    def _next(self, waiting: list[ResolvedRun]) -> RunRecord | None:
        """Make the first run that no other process is making, or take what another one has made of it meanwhile.

        While all that are left are claimed elsewhere it waits.
        """
        with ExitStack() as claims:
            while (run := self._claim(waiting, claims)) is None:
                time.sleep(_CLAIM_AGAIN_S)
            stored = self.store.get(run.run_id)
            if stored is not None and stored != self.before[run.run_id]:
                return self.reuse(run, stored)
            return self._attempt(run, self._make)

    def _claim(self, waiting: list[ResolvedRun], claims: ExitStack) -> ResolvedRun | None:
        with self.lock:
            for run in waiting:
                with ExitStack() as attempt:
                    if attempt.enter_context(self.store.claim(run.run_id)) or self._is_cancelled():
                        claims.enter_context(attempt.pop_all())
                        waiting.remove(run)
                        return run
        return None

    def _make(self, run: ResolvedRun) -> RunRecord:
        self._report("started", run)

        def progress(run_id: str, partial: dict[str, Any]) -> bool:
            self._report("progress", run, partial=partial)
            return self.on_progress is None or self.on_progress(run_id, partial)

        record = run_one(
            run,
            self.store,
            on_progress=progress,
            protocol=self.protocol,
            cancelled=self._is_cancelled,
            at_a_time=self.jobs,
        )
        return self._finished(run, record)

    def run_remotely(self, todo: dict[str, ResolvedRun], executor: Executor) -> dict[str, RunRecord]:
        protocol = self.protocol.model_dump_json()
        futures: dict[Future[Any], ResolvedRun] = {}
        for run in todo.values():
            self._report("started", run)
            futures[_asked(executor.submit, run_packed, run.spec.model_dump_json(), protocol)] = run

        def take(future: Future[Any]) -> RunRecord | None:
            return self._attempt(
                futures[future], lambda run: self._finished(run, unpack(_asked(future.result), self.store))
            )

        return self._collect(futures, take)

    def _attempt(self, run: ResolvedRun, make: Callable[[ResolvedRun], RunRecord]) -> RunRecord | None:
        """The run's record; None, once that is reported, if it cannot be made although nothing is broken here."""
        try:
            return make(run)
        except InfrastructureError:
            raise
        except RunError as error:
            self.fault(run.spec, error)
            return None

    def _finished(self, run: ResolvedRun, record: RunRecord) -> RunRecord:
        if record.status != "stopped":
            self.store.score(record, self.protocol)
        self._report("finished", run, record=record)
        return record

    def fault(self, spec: RunSpec, error: DynslamError) -> None:
        with self.lock:
            self.faults.append(error)
            if self.on_fault is not None:
                self.on_fault(spec, error)

    def _collect(
        self,
        futures: Iterable[Future[Any]],
        take: Callable[[Future[Any]], RunRecord | None] = lambda future: future.result(),
    ) -> dict[str, RunRecord]:
        futures = list(futures)
        try:
            records = [take(future) for future in as_completed(futures)]
        except BaseException:
            self.aborted.set()
            for future in futures:
                future.cancel()
            raise
        return {record.run_id: record for record in records if record is not None}

    def _is_cancelled(self) -> bool:
        return self.aborted.is_set() or (self.cancelled is not None and self.cancelled())

    def _report(self, kind: EventKind, run: ResolvedRun, **details: Any) -> None:
        if self.on_event is not None:
            with self.lock:
                self.on_event(RunEvent(kind, run.run_id, run.spec, self.total, **details))


def _asked(ask: Callable[..., T], *arguments: object) -> T:
    """What an executor answers; its own end, as when Dask's scheduler is killed, is no outcome of a run."""
    try:
        return ask(*arguments)
    except DynslamError:
        raise
    except Exception as error:  # each library of executors has errors of its own
        words = " ".join(str(error).split())[:200]
        raise InfrastructureError(
            f"the executor gave up: {type(error).__name__} {words}".rstrip(),
            "what is finished is stored; the same command goes on from there",
        ) from error


def pictures_asked(spec: RunSpec) -> list[str]:
    """The files beside a run that it was asked for."""
    asked = ((VIDEO_FILE, spec.video), (SHEET_FILE, spec.sheet), (RECORDING_FILE, spec.rrd), (MAP_FILE, spec.save_map))
    return [name for name, wanted in asked if wanted]


def _lacks_pictures(store: RunStore, run: ResolvedRun, stored: RunRecord) -> bool:
    """Whether a stored run has to be made again for a video, a sheet, a recording or a map that is asked for now."""
    folder = store.folder(stored.run_id)
    wanted = pictures_asked(run.spec)
    excused = {name for name in wanted for note in stored.notes if note.startswith(f"no {name}")}
    if stored.failed:  # what ends early has no map to draw, and what saw no frame nothing at all
        excused |= {SHEET_FILE, MAP_FILE, RECORDING_FILE} if stored.n_processed else set(wanted)
    return any(not (folder / name).is_file() for name in set(wanted) - excused)


def _statuses(retry: Collection[str]) -> set[str]:
    wanted = {retry} if isinstance(retry, str) else set(retry)
    outcomes = {"ok", "lost", *FAILED}
    unknown = sorted(wanted - outcomes - {"failed"})
    if unknown:
        raise RunError(f"unknown status '{unknown[0]}' to retry", "known: failed, " + ", ".join(sorted(outcomes)))
    return (wanted - {"failed"}) | (set(FAILED) if "failed" in wanted else set())


_ENTRY = re.compile(r"(runs|sequences)/([0-9a-f]{16})/([A-Za-z0-9_]+\.[a-z0-9]+)")
_LARGEST = 2**31
_MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to."""
_SLACK = 1 << 24


def run_packed(spec_json: str, protocol_json: str) -> bytes:
    """Make a run on a worker that does not share the results folder; the function that executors are handed.

    Args:
        spec_json: A `RunSpec` as JSON.
        protocol_json: The protocol of the partial metrics as JSON.

    Returns:
        A zip archive with the run's folder and its sequence's stamps and ground truth, for `unpack`.

    Raises:
        DynslamError: The request names something that this worker does not have.
    """
    with contextlib.closing(TemporaryFolder()) as folder:
        store = RunStore(folder.path)
        store.prepare()
        protocol = Protocol.model_validate_json(protocol_json)
        return pack(store, run_one(RunSpec.model_validate_json(spec_json), store, protocol=protocol))


def pack(store: RunStore, record: RunRecord) -> bytes:
    """A stored run with its sequence's part as a zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for folder in (store.folder(record.run_id), store.root / "sequences" / record.sequence.part):
            for file in sorted(folder.iterdir()):
                archive.write(file, str(file.relative_to(store.root)))
    return buffer.getvalue()


def unpack(data: bytes, store: RunStore) -> RunRecord:
    """Take a packed run into a store; nothing of it is executed, and nothing lands outside the store.

    Raises:
        RunError: The bytes are no packed run, or hold names that do not belong there.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _take(archive, store, min(_LARGEST, _SLACK + _MAX_RATIO * len(data)))
    except DynslamError:
        raise
    except Exception as error:  # zipfile raises almost anything over damaged archives
        raise RunError(f"{len(data)} bytes from a worker are no packed run: {error}") from error


def _take(archive: zipfile.ZipFile, store: RunStore, largest: int) -> RunRecord:
    entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if size > largest:
        raise RunError(f"a packed run holds {size / 1e9:.1f} GB, at most {largest / 1e9:.1f} GB are taken")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise RunError("a packed run is compressed in a way that pack() does not use")
    names = [match.groups() for entry in entries if (match := _ENTRY.fullmatch(entry.filename))]
    runs = {folder for kind, folder, _ in names if kind == "runs"}
    if len(names) != len(entries) or len(runs) != 1:
        raise RunError(f"a packed run holds {len(runs)} runs, and {len(entries) - len(names)} odd names")
    (run_id,) = runs
    with store.work_folder(run_id) as work:
        for kind, folder, name in names:
            if kind == "runs":
                with archive.open(f"{kind}/{folder}/{name}") as source, (work / name).open("wb") as file:
                    shutil.copyfileobj(source, file)
        record = RunRecord.read(work / RUN_FILE)
        if record.run_id != run_id:
            raise RunError(f"a packed run names itself {record.run_id} but lies under {run_id}")
        for kind, folder, name in names:
            target = store.root / kind / folder / name
            if kind == "sequences" and folder == record.sequence.part and not target.is_file():
                write_atomic(target, archive.read(f"{kind}/{folder}/{name}"))
        return store.publish(work, record)
