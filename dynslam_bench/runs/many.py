"""Making many runs: those that are stored are taken, the others made in parallel, here or on an executor."""

import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ThreadPoolExecutor,
    as_completed,
    wait,
)
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from dynslam_bench.contracts import timestamps_ns
from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    RunError,
    SequenceError,
    TrajectoryError,
    reason_of,
)
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.runs.artifacts import PICTURE, SHEET_FILE, VIDEO_FILE
from dynslam_bench.runs.exchange.recording import RECORDING_FILE
from dynslam_bench.runs.identity import ResolvedRun, Resolver
from dynslam_bench.runs.lookup import LookUp
from dynslam_bench.runs.make_record import tracker_location
from dynslam_bench.runs.packing import expected_identity, run_packed, unpack
from dynslam_bench.runs.record import FAILED, RunRecord
from dynslam_bench.runs.running import OnProgress, run_one
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, Records, RunStore
from dynslam_bench.segmentation.build_segmenter import NetworkNotFetched
from dynslam_bench.slam.map_files import MAP_FILE

T = TypeVar("T")
OnFault = Callable[[RunSpec, DynslamError], None]
"""Called as ``on_fault(spec, error)`` for a run that cannot be made; nothing of it is stored."""
_RETRY_CLAIM_S = 0.2
"""Seconds between two attempts to claim a run while other processes are making all that are left."""
_MOST_SENT = 1000
"""Runs that an executor is given at a time."""
EventKind = Literal["reused", "started", "progress", "finished"]


@dataclass(frozen=True)
class RunEvent:
    """Something happened to a run.

    Attributes:
        kind: ``reused`` (it was stored already), ``started``, ``progress`` or ``finished``.
        run_id: The run. One with plug-ins or programs gets its final id, that of `record`, when it
            is finished.
        spec: What was asked for.
        total: How many runs there are, of those looked up so far while some are ``reused``.
        record: The outcome, with ``reused`` and ``finished``.
        partial: The partial metrics, with ``progress``.
    """

    kind: EventKind
    run_id: str
    spec: RunSpec
    total: int
    record: RunRecord | None = None
    partial: dict[str, Any] | None = None


@dataclass
class PlannedRuns:
    """Runs and frames that a call of `run_many` is to make.

    Attributes:
        runs: How many runs.
        frames: Frames of their parts of sequences, by the tracker's id.
    """

    runs: int = 0
    frames: Counter[str] = field(default_factory=Counter)


def run_many(
    specs: Iterable[RunSpec],
    *,
    results: str | Path | RunStore = "results",
    jobs: int = 1,
    executor: Executor | None = None,
    retry: Collection[str] = (),
    on_plan: Callable[[PlannedRuns], None] | None = None,
    on_event: Callable[[RunEvent], None] | None = None,
    on_progress: OnProgress | None = None,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    cancelled: Callable[[], bool] = lambda: False,
    on_fault: OnFault | None = None,
) -> Records:
    """Make the runs that are not stored yet, and score them.

    A stored run is made again if snapshots, a video, a sheet or its map are asked for that it
    lacks. One that is given another label gets that. One that a study made is an ordinary run once
    it is asked for without the study. A failure is a record and stops nothing; after an interrupt
    the call goes on. A run that cannot be made stops no other, and nothing of it is stored. Several
    processes may share a results folder (without `executor`): each run is made by one of them.

    Args:
        specs: What to run; runs that are the same are made once.
        results: The results folder, or a store.
        jobs: Runs at a time on this machine.
        executor: Where to make them instead, e.g. Dask's ``client.get_executor()``. Its workers
            return records as bytes and need the sequences, not the results folder; partial metrics
            stay there: `on_progress` is not called.
        retry: Statuses to run again although they are stored; ``failed`` stands for all of
            `FAILED`.
        on_plan: Called once, when all are looked up, with the runs that are to be made, if any.
        on_event: Told of everything that happens, from several threads but never two at a time.
        on_progress: Told of partial metrics; returning False stops that run, which is then not
            stored.
        protocol: Protocol to score under.
        cancelled: Asked many times a second; True ends the runs on this machine at once, as
            stopped.
        on_fault: Told of every run that cannot be made, by one thread at a time. Without it the
            first such fault is raised when all other runs are stored, and at once where a name or a
            setting is wrong.

    Returns:
        The records in the order of `specs`, without those of runs that cannot be made.

    Raises:
        DynslamError: The results folder cannot be written, what runs need broke, a network has to
            be fetched first, or, without `on_fault`, a run cannot be made.
    """
    # statuses of stored runs that are made again
    store = results if isinstance(results, RunStore) else RunStore(results)
    retried = set(retry)
    if "failed" in retried:
        retried = retried.union(FAILED) - {"failed"}
    for unknown in sorted(retried - {"ok", "lost", *FAILED}):
        raise RunError(
            f"unknown status '{unknown}' to retry",
            f"known: failed, {', '.join(('lost', 'ok', *FAILED))}",
        )
    if jobs < 1:
        raise RunError(f"jobs is {jobs}", "give a number >= 1")

    # take what is stored, and make the others here or on the executor
    runs = _ManyRuns(
        store, get_protocol(protocol), jobs, on_plan, on_event, on_progress, cancelled, on_fault
    )
    runs.look_up(specs, retried)
    if executor is None:
        runs.make_here()
    else:
        runs.make_remotely(executor)

    # faults, then the records in the order of the specs
    if runs.first_fault is not None and on_fault is None:
        raise runs.first_fault
    finished = [runs.done[run_id] for run_id in runs.run_ids if run_id in runs.done]
    return Records(store, finished, runs.not_stored)


@dataclass
class _ManyRuns:
    """The runs of one call: here, where each is claimed in the store while it is made, or on an executor."""

    store: RunStore
    protocol: Protocol
    jobs: int
    on_plan: Callable[[PlannedRuns], None] | None
    on_event: Callable[[RunEvent], None] | None
    on_progress: OnProgress | None
    cancelled: Callable[[], bool]
    on_fault: OnFault | None
    run_ids: list[str] = field(default_factory=list)
    """Ids of the runs that were looked up, in order, as they were known before the runs were made."""
    waiting: list[tuple[ResolvedRun, RunRecord | None]] = field(default_factory=list)
    """Runs that are to be made, each with the record that is stored."""
    done: dict[str, str] = field(default_factory=dict)
    """The id of each finished run's record, by the id that was known before."""
    not_stored: dict[str, RunRecord] = field(default_factory=dict)
    first_fault: DynslamError | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)
    aborted: threading.Event = field(default_factory=threading.Event)

    def look_up(self, specs: Iterable[RunSpec], retried: Collection[str]) -> None:
        """Look the runs up: take what is stored, let the others wait to be made.

        Args:
            specs: The runs.
            retried: Statuses of stored runs that are made again.
        """
        resolver = Resolver()
        stored_runs = LookUp(self.store)
        plan = PlannedRuns()
        looked_up: set[str] = set()
        for spec in specs:
            # the run of a spec; equal ones are made once
            run = self._resolve(resolver, spec)
            if run is None:
                continue
            if not looked_up:
                self.store.prepare()
            self.run_ids.append(run.run_id)
            if run.run_id in looked_up:
                continue
            looked_up.add(run.run_id)
            # taken as it is stored, or to be made
            stored = stored_runs.find(run)
            if stored is not None and self._is_usable(run, stored, retried):
                self._reuse(run, stored)
                continue
            plan.runs += 1
            plan.frames[run.tracker.id] += len(run.sequence)
            self.waiting.append((run, stored))
        if plan.runs and self.on_plan is not None:
            self.on_plan(plan)

    def _resolve(self, resolver: Resolver, spec: RunSpec) -> ResolvedRun | None:
        """Look up what a run names; None for one that cannot be made, which is set aside.

        Raises:
            DynslamError: What runs need broke, a network has to be fetched first, or, without
                `on_fault`, a name or a setting is wrong.
        """
        try:
            return resolver(spec)
        except (NetworkNotFetched, InfrastructureError):
            raise
        except DynslamError as error:
            is_of_data = isinstance(error, (SequenceError, TrajectoryError))
            if self.on_fault is None and not is_of_data:
                raise
            self._fault(spec, error)
            return None

    def _is_usable(self, run: ResolvedRun, stored: RunRecord, retried: Collection[str]) -> bool:
        """Whether a stored run is taken; one whose own files were changed is made again."""
        if stored.status in retried or _lacks_pictures(self.store, run, stored):
            return False
        if not self.store.changed(stored):
            return True
        # it may be the sequence's files that were changed: they are put back
        self.store.add_sequence(
            stored.sequence.part, timestamps_ns(run.sequence), run.sequence.ground_truth
        )
        return not self.store.changed(stored)

    def _reuse(self, run: ResolvedRun, record: RunRecord) -> None:
        """Take a stored run, with the label, the study and the place that it is asked for with now."""
        if run.spec.label not in ("", record.tracker.label):
            tracker = record.tracker.model_copy(update={"label": run.spec.label})
            record = self.store.rewrite(record, tracker=tracker)
        if record.study and not run.spec.study:
            record = self.store.rewrite(record, study="")
        location = tracker_location(run)
        # the plug-in lies in another folder now
        if location != {name: getattr(record.tracker, name) for name in location}:
            tracker = record.tracker.model_copy(update=location)
            record = self.store.rewrite(record, tracker=tracker)
        self._take_in(run, record, "reused")

    def make_here(self) -> None:
        """Make the waiting runs in processes of this machine, `jobs` at a time."""
        with ThreadPoolExecutor(self.jobs, thread_name_prefix="dynslam-run") as pool:
            try:
                workers = [pool.submit(self._make_waiting) for _ in range(self.jobs)]
                for worker in as_completed(workers):
                    worker.result()
            except BaseException:
                self.aborted.set()
                raise

    def _make_waiting(self) -> None:
        """Make waiting runs, or take what another process has made of them meanwhile.

        While all that are left are claimed elsewhere it waits.
        """
        while self.waiting and not self.aborted.is_set():
            with ExitStack() as claims:
                if (claimed := self._claim(claims)) is None:
                    time.sleep(_RETRY_CLAIM_S)
                    continue
                run, before = claimed
                stored = LookUp(self.store).find(run)  # another process may have made it meanwhile
                if stored is not None and stored != before:
                    self._reuse(run, stored)
                else:
                    self._attempt(run, self._make)

    def _claim(self, claims: ExitStack) -> tuple[ResolvedRun, RunRecord | None] | None:
        """The first waiting run that no other process is making, with its record; None where there is none.

        Args:
            claims: Keeps the claim while the run is made.
        """
        with self.lock:
            for position, (run, _) in enumerate(self.waiting):
                with ExitStack() as attempt:
                    is_mine = attempt.enter_context(self.store.claim(run.run_id))
                    # a cancelled run is not made: it needs no claim
                    if is_mine or self._is_cancelled():
                        claims.enter_context(attempt.pop_all())
                        return self.waiting.pop(position)
        return None

    def _make(self, run: ResolvedRun) -> RunRecord:
        """Make a run on this machine."""
        self._report("started", run)

        def progress(run_id: str, partial: dict[str, Any]) -> bool:
            self._report("progress", run, partial=partial)
            return self.on_progress is None or self.on_progress(run_id, partial)

        return run_one(
            run,
            self.store,
            on_progress=progress,
            protocol=self.protocol,
            cancelled=self._is_cancelled,
            at_a_time=self.jobs,
        )

    def make_remotely(self, executor: Executor) -> None:
        """Have an executor make the waiting runs."""
        protocol = self.protocol.model_dump_json()
        # a future holds all bytes of its run, so few are kept
        sent: dict[Future[Any], ResolvedRun] = {}
        try:
            while sent or self.waiting:
                for _ in range(min(_MOST_SENT - len(sent), len(self.waiting))):
                    run, _ = self.waiting.pop(0)
                    self._report("started", run)
                    spec = run.spec.model_copy(update={"device": run.device}).model_dump_json()
                    identity = json.dumps(expected_identity(run))
                    future = _answer_of(executor.submit, run_packed, spec, protocol, identity)
                    sent[future] = run
                for future in wait(sent, return_when=FIRST_COMPLETED).done:
                    self._attempt(sent.pop(future), partial(self._receive, future))
        finally:
            for future in sent:
                future.cancel()

    def _receive(self, future: Future[Any], run: ResolvedRun) -> RunRecord:
        """Take a run that an executor has made into the store."""
        return unpack(_answer_of(future.result), self.store)

    def _attempt(self, run: ResolvedRun, make: Callable[[ResolvedRun], RunRecord]) -> None:
        """Make a run; one that cannot be made although nothing is broken here is set aside."""
        try:
            record = make(run)
        except InfrastructureError:
            raise
        except RunError as error:
            self._fault(run.spec, error)
        else:
            self._take_in(run, record, "finished")

    def _take_in(self, run: ResolvedRun, record: RunRecord, kind: EventKind) -> None:
        """Note the record of a run, score a new one, and report it."""
        self.done[run.run_id] = record.run_id
        if record.status == "stopped":
            self.not_stored[record.run_id] = record
        elif kind == "finished":
            self.store.score(record, self.protocol)
        self._report(kind, run, record=record)

    def _fault(self, spec: RunSpec, error: DynslamError) -> None:
        """Set a run aside that cannot be made."""
        with self.lock:
            self.first_fault = self.first_fault or error
            if self.on_fault is not None:
                self.on_fault(spec, error)

    def _is_cancelled(self) -> bool:
        return self.aborted.is_set() or self.cancelled()

    def _report(self, kind: EventKind, run: ResolvedRun, **details: Any) -> None:
        """Report an event, one thread at a time."""
        if self.on_event is not None:
            with self.lock:
                self.on_event(RunEvent(kind, run.run_id, run.spec, len(self.run_ids), **details))


def _answer_of(ask: Callable[..., T], *arguments: object) -> T:
    """Call an executor; its own end, as when Dask's scheduler is killed, is no outcome of a run."""
    try:
        return ask(*arguments)
    except DynslamError:
        raise
    except Exception as error:  # each library of executors has errors of its own
        raise InfrastructureError(
            f"the executor gave up: {type(error).__name__} {reason_of(error)}",
            "what is finished is stored; the same command goes on from there",
        ) from error


def requested_files(spec: RunSpec) -> list[str]:
    """The files beside a run that it was asked for."""
    asked = {
        PICTURE.format(0): spec.snapshots,
        VIDEO_FILE: spec.video,
        SHEET_FILE: spec.sheet,
        RECORDING_FILE: spec.rrd,
        MAP_FILE: spec.save_map,
    }
    return [name for name, wanted in asked.items() if wanted]


def _lacks_pictures(store: RunStore, run: ResolvedRun, stored: RunRecord) -> bool:
    """Whether a stored run has to be made again for a video, a sheet, a recording or a map that is asked for now."""
    wanted = requested_files(run.spec)
    if not wanted:
        return False
    folder = store.folder(stored.run_id)
    # a note says why the run could not give a file
    excused = {name for name in wanted for note in stored.notes if note.startswith(f"no {name}")}
    # what ends early has no map to draw, and what saw no frame nothing at all
    if stored.failed and stored.n_processed:
        excused |= {SHEET_FILE, MAP_FILE, RECORDING_FILE}
    elif stored.failed:
        excused |= set(wanted)
    return any(not (folder / name).is_file() for name in set(wanted) - excused)
