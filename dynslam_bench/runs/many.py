"""Many runs: resumable, parallel, here or on any executor."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import struct
import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
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
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, RunStore, score
from dynslam_bench.slam.map_files import MAP_FILE

T = TypeVar("T")
OnFault = Callable[[RunSpec, DynslamError], None]
"""Called as ``on_fault(spec, error)`` for a run that cannot be made; nothing of it is stored."""
_LOOK_AGAIN_S = 0.2


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

    kind: Literal["reused", "started", "progress", "finished"]
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
        on_plan: Told once, before the first run, which runs will be made, if any.
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
    resolved, faults = _resolved(specs)
    if resolved:
        store.prepare()
    bench = _Bench(store, protocol, len(resolved), on_event, on_progress, jobs, cancelled, on_fault)
    for spec, error in faults:
        bench.fault(spec, error)
    todo, done = dict[str, ResolvedRun](), dict[str, RunRecord]()
    for run in resolved:
        if run.run_id in todo or run.run_id in done:
            continue
        stored = store.get(run.run_id)
        if stored is not None and stored.status not in again and not _lacks_pictures(store, run, stored):
            done[run.run_id] = bench.reuse(run, stored)
        else:
            todo[run.run_id] = run
    if todo and on_plan is not None:
        on_plan(todo.values())
    done |= bench.run_remotely(todo, executor) if executor is not None else bench.run_here(todo, jobs)
    if bench.faults and on_fault is None:
        raise bench.faults[0]
    return [done[run.run_id] for run in resolved if run.run_id in done]


def _resolved(specs: Iterable[RunSpec]) -> tuple[list[ResolvedRun], list[tuple[RunSpec, DynslamError]]]:
    """The runs whose sequences can be read, and the others with what is wrong with them.

    Raises:
        DynslamError: A spec names something else that is unknown or unfit.
    """
    resolved: list[ResolvedRun] = []
    faults: list[tuple[RunSpec, DynslamError]] = []
    for spec in specs:
        try:
            resolved.append(resolve(spec))
        except (SequenceError, TrajectoryError) as error:
            faults.append((spec, error))
    return resolved, faults


class _Waiting:
    """The runs that are still to be made on this machine.

    Each is claimed in the store while it is made, so that several processes on one results folder share the work.
    """

    def __init__(self, store: RunStore, todo: dict[str, ResolvedRun]) -> None:
        self.store = store
        self.runs = list(todo.values())
        self.before = {run_id: store.get(run_id) for run_id in todo}
        self.lock = threading.Lock()

    @contextmanager
    def next(self, cancelled: Callable[[], bool]) -> Iterator[tuple[ResolvedRun, RunRecord | None]]:
        """The next run, claimed while the block lasts, and its record if another process has just made it.

        With all of them claimed elsewhere it waits.
        """
        with ExitStack() as claims:
            while True:
                run = self._claimed(claims, anyway=cancelled())
                if run is not None:
                    break
                time.sleep(_LOOK_AGAIN_S)
            stored = self.store.get(run.run_id)
            yield run, None if stored == self.before[run.run_id] else stored

    def _claimed(self, claims: ExitStack, *, anyway: bool) -> ResolvedRun | None:
        with self.lock:
            for run in self.runs:
                with ExitStack() as attempt:
                    if attempt.enter_context(self.store.claim(run.run_id)) or anyway:
                        claims.enter_context(attempt.pop_all())
                        self.runs.remove(run)
                        return run
        return None


class _Bench:
    def __init__(
        self,
        store: RunStore,
        protocol: Protocol,
        total: int,
        on_event: Callable[[RunEvent], None] | None,
        on_progress: OnProgress | None,
        jobs: int,
        cancelled: Callable[[], bool] | None,
        on_fault: OnFault | None,
    ) -> None:
        self.jobs = jobs
        self.on_fault = on_fault
        self.faults: list[DynslamError] = []
        self.cancelled_outside = cancelled or (lambda: False)
        self.store, self.protocol, self.total = store, protocol, total
        self.on_event, self.on_progress = on_event, on_progress
        self.lock = threading.Lock()
        self.cancelled = threading.Event()

    def reuse(self, run: ResolvedRun, record: RunRecord) -> RunRecord:
        if run.spec.label not in ("", record.tracker.label):
            record = self.store.relabel(record, run.spec.label)
        if record.study and not run.spec.study:
            record = self.store.rewrite(record, study="")
        score(self.store, record, self.protocol)
        self.tell("reused", run, record=record)
        return record

    def run_here(self, todo: dict[str, ResolvedRun], jobs: int) -> dict[str, RunRecord]:
        waiting = _Waiting(self.store, todo)
        with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-run") as pool:
            futures = {pool.submit(self._next, waiting): run_id for run_id in todo}
            made = self._collect(futures, lambda future, _: future.result()).values()
            return {run_id: record for run_id, record in made if record is not None}

    def _next(self, waiting: _Waiting) -> tuple[str, RunRecord | None]:
        """Make the first run that nobody else is making, or take what another process has made of it meanwhile.

        None stands for a run that cannot be made.
        """
        with waiting.next(self._is_cancelled) as (run, stored):
            return run.run_id, self._attempt(run, self._one) if stored is None else self.reuse(run, stored)

    def run_remotely(self, todo: dict[str, ResolvedRun], executor: Executor) -> dict[str, RunRecord]:
        options = json.dumps({"protocol": self.protocol.model_dump(mode="json")})
        futures: dict[Future[bytes], str] = {}
        for run_id, run in todo.items():
            self.tell("started", run)
            futures[_asked(executor.submit, run_packed, run.spec.model_dump_json(), options)] = run_id

        def take(future: Future[bytes], run_id: str) -> RunRecord | None:
            return self._attempt(todo[run_id], lambda run: self._unpacked(run, _asked(future.result)))

        made = self._collect(futures, take)
        return {run_id: record for run_id, record in made.items() if record is not None}

    def _unpacked(self, run: ResolvedRun, packed: bytes) -> RunRecord:
        record = unpack(packed, self.store)
        score(self.store, record, self.protocol)
        self.tell("finished", run, record=record)
        return record

    def _attempt(self, run: ResolvedRun, make: Callable[[ResolvedRun], RunRecord]) -> RunRecord | None:
        """The run's record; None, once that is told, if it cannot be made although nothing is broken here."""
        try:
            return make(run)
        except InfrastructureError:
            raise
        except RunError as error:
            self.fault(run.spec, error)
            return None

    def fault(self, spec: RunSpec, error: DynslamError) -> None:
        with self.lock:
            self.faults.append(error)
            if self.on_fault is not None:
                self.on_fault(spec, error)

    def _collect(self, futures: Mapping[Future[Any], str], take: Callable[[Future[Any], str], T]) -> dict[str, T]:
        try:
            return {futures[future]: take(future, futures[future]) for future in as_completed(futures)}
        except BaseException:
            self.cancelled.set()
            for future in futures:
                future.cancel()
            raise

    def _one(self, run: ResolvedRun) -> RunRecord:
        self.tell("started", run)

        def progress(run_id: str, partial: dict[str, Any]) -> bool:
            self.tell("progress", run, partial=partial)
            return self.on_progress is None or self.on_progress(run_id, partial)

        watched: dict[str, Any] = {"on_progress": progress, "cancelled": self._is_cancelled}
        record = run_one(run, self.store, protocol=self.protocol, at_a_time=self.jobs, **watched)
        if record.status != "stopped":
            score(self.store, record, self.protocol)
        self.tell("finished", run, record=record)
        return record

    def _is_cancelled(self) -> bool:
        return self.cancelled.is_set() or self.cancelled_outside()

    def tell(
        self,
        kind: Literal["reused", "started", "progress", "finished"],
        run: ResolvedRun,
        *,
        record: RunRecord | None = None,
        partial: dict[str, Any] | None = None,
    ) -> None:
        if self.on_event is not None:
            with self.lock:
                self.on_event(RunEvent(kind, run.run_id, run.spec, self.total, record, partial))


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
        excused |= {SHEET_FILE, MAP_FILE} if stored.n_processed else set(wanted)
    return any(not (folder / name).is_file() for name in set(wanted) - excused)


def _statuses(retry: Collection[str]) -> set[str]:
    wanted = {retry} if isinstance(retry, str) else set(retry)
    known = {"ok", "lost", *FAILED}
    unknown = sorted(wanted - known - {"failed"})
    if unknown:
        raise RunError(f"unknown status '{unknown[0]}' to retry", "known: failed, " + ", ".join(sorted(known)))
    return (wanted - {"failed"}) | (set(FAILED) if "failed" in wanted else set())


# A run as bytes, for workers that do not share the results folder.

_ENTRY = re.compile(r"(runs|sequences)/([0-9a-f]{16})/([A-Za-z0-9_]+\.[a-z0-9]+)")
_LARGEST = 2**31
_MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to."""
_SLACK = 1 << 24
# What Python's zipfile raises over damaged archives.
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError, LookupError,
           ValueError, TypeError, OverflowError)  # fmt: skip


def run_packed(spec_json: str, options_json: str = "{}") -> bytes:
    """Make a run on a worker; the function that executors are handed.

    Args:
        spec_json: A `RunSpec` as JSON.
        options_json: Keyword arguments of `run_one` as JSON, a protocol as its fields.

    Returns:
        A zip archive with the run's folder and its sequence's stamps and ground truth, for `unpack`.

    Raises:
        DynslamError: The request names something that this worker does not have.
    """
    spec = RunSpec.model_validate_json(spec_json)
    options = json.loads(options_json)
    if "protocol" in options:
        options["protocol"] = Protocol.model_validate(options["protocol"])
    with contextlib.closing(TemporaryFolder()) as folder:
        store = RunStore(folder.path)
        store.prepare()
        record = run_one(spec, store, **options)
        return pack(store, record)


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
    except _DAMAGE as error:
        raise RunError(f"{len(data)} bytes from a worker are no packed run: {error}") from error


def _take(archive: zipfile.ZipFile, store: RunStore, largest: int) -> RunRecord:
    entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if size > largest:
        raise RunError(f"a packed run holds {size / 1e9:.1f} GB, at most {largest / 1e9:.1f} GB are taken")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise RunError("a packed run is compressed in a way that pack() does not use")
    matches = {entry.filename: _ENTRY.fullmatch(entry.filename) for entry in entries}
    odd = [name for name, match in matches.items() if match is None]
    runs = {match[2] for match in matches.values() if match is not None and match[1] == "runs"}
    if odd or len(runs) != 1:
        raise RunError(f"a packed run holds {odd[0] if odd else f'{len(runs)} runs'}", "it was not made by pack()")
    run_id = runs.pop()
    with store.work_folder(run_id) as work:
        for name, match in matches.items():
            assert match is not None
            if match[1] == "runs":
                with archive.open(name) as source, (work / match[3]).open("wb") as file:
                    shutil.copyfileobj(source, file)
        record = RunRecord.read(work / RUN_FILE)
        if record.run_id != run_id:
            raise RunError(f"a packed run names itself {record.run_id} but lies under {run_id}")
        for name, match in matches.items():
            if match is not None and match[1] == "sequences" and match[2] == record.sequence.part:
                _write_once(store.root / "sequences" / match[2] / match[3], archive.read(name))
        record = store.publish(work, record)
    return record


def _write_once(path: Path, data: bytes) -> None:
    if not path.is_file():
        write_atomic(path, data)
