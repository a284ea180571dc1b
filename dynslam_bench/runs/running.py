"""Making runs: one in a child process; many, resumable and parallel, here or on any executor; runs as bytes."""

import contextlib
import io
import json
import re
import shutil
import socket
import sys
import threading
import time
import zipfile
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
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from dynslam_bench.contracts import exact_stamps, timestamps_ns
from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    RunError,
    SequenceError,
    TemporaryFolder,
    TrajectoryError,
    reason_of,
    translate_errors,
)
from dynslam_bench.core.fingerprint import git_revision, path_digest, this_machine, versions
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE
from dynslam_bench.core.reads import Reads
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import flatten
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.runs.artifacts import PICTURE, SHEET_FILE, VIDEO_FILE
from dynslam_bench.runs.exchange.recording import RECORDING_FILE
from dynslam_bench.runs.frames import FRAMES_FILE, FrameLog
from dynslam_bench.runs.identity import ResolvedRun, Resolver, check_unchanged, resolve
from dynslam_bench.runs.lookup import LookUp
from dynslam_bench.runs.own_code import is_file, module_of, plugins_of_run
from dynslam_bench.runs.process.fork_server import Child, ForkServer
from dynslam_bench.runs.process.jobs import LOG_FILE, READS_FILE, make_job
from dynslam_bench.runs.process.supervisor import (
    LONGEST_LOG,
    LONGEST_YET,
    ServerDiedError,
    Verdict,
    bound_log,
    supervise,
)
from dynslam_bench.runs.record import (
    FAILED,
    LOST_COVERAGE,
    RunRecord,
    SequenceInfo,
    StageTime,
    Status,
    TrackerInfo,
    run_id_of,
)
from dynslam_bench.runs.spec import RunSpec, place_of
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, Records, RunStore
from dynslam_bench.segmentation.build_segmenter import NetworkNotFetched
from dynslam_bench.sequences.tags import sequence_tags
from dynslam_bench.sequences.view import part_of
from dynslam_bench.slam.map_files import MAP_FILE
from dynslam_bench.trackers.registry import resolve_settings

T = TypeVar("T")
WORK = "dynslam_bench.runs.loop:run_loop"
"""What the child does."""
PROGRESS_EVERY = 50
CACHED_TIMES = "times of features and masks are those of the stage cache's entries, not of this run"
BATCH_NOTE = "a batch program: only the final trajectory exists; a frame's time is the program's over all frames"
LOST_AT_END = 10
"""A run whose coverage is below `LOST_COVERAGE`, or that is lost on so many frames at its end, has status ``lost``."""

OnProgress = Callable[[str, dict[str, Any]], bool]
"""Called as ``on_progress(run_id, partial)`` every `PROGRESS_EVERY` frames; returning False stops the run.

`partial` holds ``frames_done``, ``frames``, ``metrics`` (of the frames so far under the protocol),
``frame_time_s`` and ``pose_error_trans_m``.
"""


def run_one(
    run: RunSpec | ResolvedRun,
    store: RunStore,
    *,
    on_progress: OnProgress | None = None,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    progress_every: int = PROGRESS_EVERY,
    cancelled: Callable[[], bool] = lambda: False,
    at_a_time: int = 1,
) -> RunRecord:
    """Make a run in a child process and store it, whatever becomes of it.

    A tracker that raises, hangs, breaks its contract, takes too much or dies gives a record with
    that status and the reason; only a request that cannot begin at all is an error. A run that
    `on_progress` stopped is not stored.

    Args:
        run: What to run.
        store: Where to keep it; an earlier run of the same id is replaced.
        on_progress: Told of the partial metrics; may stop the run.
        protocol: Protocol of the partial metrics.
        progress_every: Frames between two of them.
        cancelled: Asked many times a second; True ends the run at once, as stopped.
        at_a_time: Runs that share this machine; the default memory limit is divided among them.

    Returns:
        The record.

    Raises:
        DynslamError: The request names something unknown or unfit, something other than the
            tracker's own code raised (an image, a mask or a file that cannot be read), the store
            cannot be written, or what a run needs broke (`InfrastructureError`); nothing is stored
            then.
    """
    resolved = resolve(run) if isinstance(run, RunSpec) else run
    if resolved is run:
        check_unchanged(resolved)
    run_id = resolved.run_id
    started = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    clock = time.perf_counter()

    def report(message: dict[str, Any]) -> bool:
        partial = {key: value for key, value in message.items() if key != "type"}
        return on_progress is None or on_progress(run_id, partial)

    with store.work_folder(run_id) as work:
        job = make_job(
            WORK,
            work,
            spec=resolved.spec.model_dump(mode="json"),
            protocol=get_protocol(protocol).model_dump(mode="json"),
            progress_every=progress_every,
            recorded=recorded_parts(resolved),
        )
        job["environment"][ENVIRONMENT_VARIABLE] = plugins_of_run(
            resolved.spec.tracker, resolved.settings, resolved.segmentation, resolved.spec.sequence
        )
        log = work / LOG_FILE

        def watch(child: Child) -> Verdict:
            tick = partial(bound_log, log, LONGEST_YET)
            return supervise(
                child, job, resolved.spec.limits, report, cancelled, tick=tick, at_a_time=at_a_time
            )

        verdict = _watched(work, watch)
        if not (work / FRAMES_FILE).is_file():
            raise InfrastructureError(
                f"{work} was removed while the run was made",
                "leave the results folder alone; nothing is stored, the same command goes on from there",
            )
        if verdict.refused:
            raise RunError(
                f"{resolved.tracker.id} cannot run on {resolved.sequence.id}: {verdict.reason}",
                "nothing is stored",
            )
        with translate_errors(InfrastructureError, f"cannot write {work}", "the run is not stored"):
            bound_log(log, LONGEST_LOG)
            frames = FrameLog.read(work / FRAMES_FILE)
            title = f"{resolved.tracker.id} on {resolved.sequence.id}, seed {resolved.spec.seed}, online"
            frames.write(work, title, exact_stamps(resolved.sequence))
            (work / FRAMES_FILE).unlink()  # it fails where the folder was removed after all
        check_unchanged(resolved, begun=True)
        reads = read_reads(work) if resolved.foreign else None
        record = _record(
            resolved, verdict, frames, reads, started, time.perf_counter() - clock
        ).normalised()
        if record.status != "stopped":
            store.add_sequence(
                record.sequence.part,
                timestamps_ns(resolved.sequence),
                resolved.sequence.ground_truth,
            )
            record = store.publish(work, record)
    return record


def recorded_parts(run: ResolvedRun) -> dict[str, Any] | None:
    """What the child needs to know to record what plug-ins and programs read; None for a run without such."""
    if not run.foreign:
        return None
    plugin = None if run.anchors.plugin is None else str(run.anchors.plugin)
    return {"plugin": plugin, "work": str(run.anchors.work), "packages": run.plugin_packages}


def read_reads(work: Path) -> Reads | None:
    """What the child has recorded, which is taken out of the run's folder; None where it was killed before."""
    file = work / READS_FILE
    if not file.is_file():
        return None
    reads = Reads.read(file)
    file.unlink()
    return reads


def _watched(work: Path, watch: Callable[[Child], Verdict]) -> Verdict:
    """The verdict on a run; when its fork server dies, the run is repeated with a fork server of its own.

    No other run is there then. If that server dies, too, it is this run that has killed it: the run
    has crashed.

    Args:
        work: Its work folder, which is emptied before each try.
        watch: Has a child make the run, and gives the verdict.

    Raises:
        InfrastructureError: See `supervise`.
    """
    _empty(work)
    with contextlib.suppress(ServerDiedError):
        return watch(Child())
    _empty(work)
    with contextlib.closing(ForkServer()) as own:
        try:
            return watch(Child(own))
        except ServerDiedError as error:
            if not error.where:
                raise
            reason = f"the fork server was killed twice, the second time with this run alone{error.where}"
            return Verdict("crashed", reason)


def _empty(work: Path) -> None:
    """Leave in a work folder an empty log of frames and nothing else."""
    with translate_errors(
        InfrastructureError, f"cannot write {work}", "check the free space; nothing is stored"
    ):
        for path in work.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        (work / FRAMES_FILE).touch()


def sequence_info(sequence: Any, content: str, part: str, offset: int = 0) -> SequenceInfo:
    """What a record keeps of a sequence that was cut to its part without `offset` leading frames."""
    input_part = part_of(sequence, offset)
    stamps = sequence.timestamps
    return SequenceInfo(
        id=sequence.id,
        content=content,
        part=part,
        block=input_part.block,
        noise=input_part.noise,
        frames=len(sequence),
        duration_s=float(stamps[-1] - stamps[0]),
        fps=sequence.fps,
        ground_truth=sequence.ground_truth is not None,
        license=sequence.license,
        citation=sequence.citation,
        tags=sequence_tags(sequence),
        split=getattr(sequence, "split", ""),
    )


def part_digest(identity: dict[str, Any]) -> str:
    """Names what of the sequence a run saw: content and frames."""
    return digest(
        {key: identity[key] for key in ("sequence", "content", "frames", "offset", "stride")}, 16
    )


def _record(
    resolved: ResolvedRun,
    verdict: Verdict,
    frames: FrameLog,
    reads: Reads | None,
    started: str,
    wall_s: float,
) -> RunRecord:
    spec = resolved.spec
    tracker = resolved.tracker
    final = verdict.final
    identity = (
        resolved.stated
        if reads is None
        else resolved.stated | {"reads": reads.model_dump(mode="json")}
    )
    total = len(resolved.sequence)
    states = Counter(row.state for row in frames.rows)
    status = verdict.status
    reason = verdict.reason
    dropped = states["dropped"]
    tracked = states["ok"]
    lost = states["lost"]
    initialising = states["initialising"]
    lost_at_end = frames.lost_streak()
    flat = flatten(resolved.settings)
    default = flatten(resolve_settings(tracker, {}))
    asked = {
        name: value
        for name, value in spec.settings.items()
        if name not in default or flat[name] != default[name]
    }
    timings = frames.timings()
    batch = not tracker.online
    if batch:
        tracked = final.get("tracked", 0)
        lost_at_end = final.get("lost_at_end", total)
        lost = total - dropped - tracked
        initialising = 0
        each_s = final.get("program_s", 0.0) / total
        timings = (
            {"total": StageTime(median_s=each_s, p95_s=each_s, mean_s=each_s)} if each_s else {}
        )
    if status == "ok" and frames.damage:
        status = "invalid"
        reason = frames.damage
    elif status == "ok":  # it may still have lost its way
        status, reason = judge_coverage(tracked, total - dropped, lost_at_end, total)
    if status == "ok" and spec.realtime and dropped:
        reason = f"{dropped} of {total} frames dropped while the tracker was busy"
    notes = [CACHED_TIMES] if spec.cache else []
    notes += [BATCH_NOTE] if batch else []
    notes += [] if resolved.start_map is None else [resolved.start_map.describe()]
    return RunRecord(
        run_id=run_id_of(identity),
        status=status,
        reason=reason,
        tracker=TrackerInfo(
            label=spec.label or tracker.label,
            distribution=resolved.distribution,
            **_where_it_lies(resolved),
            **{name: getattr(tracker, name) for name in _OF_THE_TRACKER},
        ),
        overrides=asked,
        settings=flat,
        sequence=sequence_info(
            resolved.sequence, identity["content"], part_digest(identity), spec.offset
        ),
        **{name: getattr(spec, name) for name in _AS_ASKED},
        device=resolved.device,
        degrade=identity["degrade"],
        segmentation=resolved.segmentation,
        n_frames=total,
        n_processed=len(frames.rows) - dropped,
        n_tracked=tracked,
        n_lost=lost,
        n_initialising=initialising,
        n_dropped=dropped,
        coverage=tracked / total,
        **{name: final.get(name) for name in ("keyframes", "map_points", "maps", "finalize_s")},
        start_map=resolved.start_map,
        epipolar_skipped=frames.epipolar_skipped(),
        mask_iou=frames.mask_iou(),
        timings=timings,
        started=started,
        wall_s=wall_s,
        peak_memory_mb=final.get("program_memory_mb", verdict.peak_memory_mb) or None,
        peak_gpu_memory_mb=final.get("gpu_memory_mb"),
        machine=this_machine().model_copy(update={"gpu": final.get("gpu", "")}),
        versions=versions(),
        git=git_revision(),
        command=list(sys.argv),
        identity=identity,
        notes=[*notes, *final.get("notes", [])],
        place=place_of(spec.sequence),
    )


def _where_it_lies(run: ResolvedRun) -> dict[str, str]:
    """Where a tracker is found that its id alone does not find, see `TrackerInfo`."""
    folder = run.anchors.plugin
    return {
        "given": "" if run.spec.tracker == run.tracker.id else run.spec.tracker,
        "folder": "" if folder is None else str(folder),
    }


_AS_ASKED = ("frames", "offset", "stride", "seed", "threads", "realtime", "drop_share", "study")
"""What a record takes from the request as it is."""
_OF_THE_TRACKER = (
    *(
        "id",
        "version",
        "provenance",
        "ranked",
        "deterministic",
        "license",
        "citation",
        "remarks",
        "sensors",
        "online",
    ),
)
"""What a record takes from the tracker's spec as it is."""


def judge_coverage(tracked: int, due: int, lost_at_end: int, total: int) -> tuple[Status, str]:
    """Whether a trajectory that came to its end is that of a lost camera, with the reason.

    Args:
        tracked: Frames with a pose.
        due: Frames that the tracker was to see.
        lost_at_end: Frames without a pose after the last one with one.
        total: All frames.
    """
    if tracked < LOST_COVERAGE * due:
        return "lost", f"tracked on {tracked} of {due} frames"
    if lost_at_end >= LOST_AT_END:
        return (
            "lost",
            f"lost from frame {total - lost_at_end} to the end, tracked on {tracked} of {due} frames",
        )
    return "ok", ""


# -- many runs -------------------------------------------------------------------------------------

OnFault = Callable[[RunSpec, DynslamError], None]
"""Called as ``on_fault(spec, error)`` for a run that cannot be made; nothing of it is stored."""
_LOOK_AGAIN_S = 0.2
_SENT = 1000
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
class Plan:
    """What is to be made.

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
    on_plan: Callable[[Plan], None] | None = None,
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
    store = results if isinstance(results, RunStore) else RunStore(results)
    again = set(FAILED).union(retry) - {"failed"} if "failed" in retry else set(retry)
    for unknown in sorted(again - {"ok", "lost", *FAILED}):
        raise RunError(
            f"unknown status '{unknown}' to retry",
            f"known: failed, {', '.join(('lost', 'ok', *FAILED))}",
        )
    if jobs < 1:
        raise RunError(f"jobs is {jobs}", "give a number >= 1")
    bench = _Bench(
        store, get_protocol(protocol), jobs, on_plan, on_event, on_progress, cancelled, on_fault
    )
    bench.look_up(specs, again)
    if executor is None:
        bench.make_here()
    else:
        bench.make_remotely(executor)
    if bench.first_fault is not None and on_fault is None:
        raise bench.first_fault
    finished = [bench.done[run_id] for run_id in bench.run_ids if run_id in bench.done]
    return Records(store, finished, bench.not_stored)


@dataclass
class _Bench:
    """The runs of one call: here, where each is claimed in the store while it is made, or on an executor."""

    store: RunStore
    protocol: Protocol
    jobs: int
    on_plan: Callable[[Plan], None] | None
    on_event: Callable[[RunEvent], None] | None
    on_progress: OnProgress | None
    cancelled: Callable[[], bool]
    on_fault: OnFault | None
    run_ids: list[str] = field(default_factory=list)
    """Of the runs that were looked up, in their order, as they were known then."""
    waiting: list[tuple[ResolvedRun, RunRecord | None]] = field(default_factory=list)
    """Runs that are to be made, each with the record that is stored."""
    done: dict[str, str] = field(default_factory=dict)
    """The id of each finished run's record, by the id that was known before."""
    not_stored: dict[str, RunRecord] = field(default_factory=dict)
    first_fault: DynslamError | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)
    aborted: threading.Event = field(default_factory=threading.Event)

    def look_up(self, specs: Iterable[RunSpec], again: Collection[str]) -> None:
        """Look the runs up: take what is stored, let the others wait to be made."""
        resolver = Resolver()
        stored_runs = LookUp(self.store)
        plan = Plan()
        run_ids: set[str] = set()
        for spec in specs:
            try:
                run = resolver(spec)
            except (NetworkNotFetched, InfrastructureError):
                raise
            except DynslamError as error:
                if self.on_fault is None and not isinstance(
                    error, (SequenceError, TrajectoryError)
                ):
                    raise
                self._fault(spec, error)
                continue
            if not run_ids:
                self.store.prepare()
            self.run_ids.append(run.run_id)
            if run.run_id in run_ids:
                continue
            run_ids.add(run.run_id)
            stored = stored_runs.find(run)
            if (
                stored is not None
                and stored.status not in again
                and not _lacks_pictures(self.store, run, stored)
            ):
                fault = self.store.changed(stored)
                # the sequence's files are put back; where the run's differ, it is made again
                if fault:
                    stamps = timestamps_ns(run.sequence)
                    truth = run.sequence.ground_truth
                    self.store.add_sequence(stored.sequence.part, stamps, truth)
                    fault = self.store.changed(stored)
                if not fault:
                    self._reuse(run, stored)
                    continue
            plan.runs += 1
            plan.frames[run.tracker.id] += len(run.sequence)
            self.waiting.append((run, stored))
        if plan.runs and self.on_plan is not None:
            self.on_plan(plan)

    def _reuse(self, run: ResolvedRun, record: RunRecord) -> None:
        if run.spec.label not in ("", record.tracker.label):
            record = self.store.rewrite(
                record, tracker=record.tracker.model_copy(update={"label": run.spec.label})
            )
        if record.study and not run.spec.study:
            record = self.store.rewrite(record, study="")
        place = _where_it_lies(run)
        # the plug-in lies in another folder now
        if place != {name: getattr(record.tracker, name) for name in place}:
            record = self.store.rewrite(record, tracker=record.tracker.model_copy(update=place))
        self._take_in(run, record, "reused")

    def make_here(self) -> None:
        """Make the waiting runs, so many at a time."""
        with ThreadPoolExecutor(self.jobs, thread_name_prefix="dynslam-run") as pool:
            try:
                for maker in as_completed(
                    [pool.submit(self._make_waiting) for _ in range(self.jobs)]
                ):
                    maker.result()
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
                    time.sleep(_LOOK_AGAIN_S)
                    continue
                run, before = claimed
                stored = LookUp(self.store).find(run)  # another process may have made it meanwhile
                if stored is not None and stored != before:
                    self._reuse(run, stored)
                else:
                    self._attempt(run, self._make)

    def _claim(self, claims: ExitStack) -> tuple[ResolvedRun, RunRecord | None] | None:
        with self.lock:
            for at, (run, _) in enumerate(self.waiting):
                with ExitStack() as attempt:
                    if attempt.enter_context(self.store.claim(run.run_id)) or self._is_cancelled():
                        claims.enter_context(attempt.pop_all())
                        return self.waiting.pop(at)
        return None

    def _make(self, run: ResolvedRun) -> RunRecord:
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
                for _ in range(min(_SENT - len(sent), len(self.waiting))):
                    run, _ = self.waiting.pop(0)
                    self._report("started", run)
                    spec = run.spec.model_copy(update={"device": run.device})
                    asked = (spec.model_dump_json(), protocol, json.dumps(_expected(run)))
                    sent[_asked(executor.submit, run_packed, *asked)] = run
                for future in wait(sent, return_when=FIRST_COMPLETED).done:
                    self._attempt(sent.pop(future), partial(self._take, future))
        finally:
            for future in sent:
                future.cancel()

    def _take(self, future: Future[Any], run: ResolvedRun) -> RunRecord:
        return unpack(_asked(future.result), self.store)

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
        self.done[run.run_id] = record.run_id
        if record.status == "stopped":
            self.not_stored[record.run_id] = record
        elif kind == "finished":
            self.store.score(record, self.protocol)
        self._report(kind, run, record=record)

    def _fault(self, spec: RunSpec, error: DynslamError) -> None:
        with self.lock:
            self.first_fault = self.first_fault or error
            if self.on_fault is not None:
                self.on_fault(spec, error)

    def _is_cancelled(self) -> bool:
        return self.aborted.is_set() or self.cancelled()

    def _report(self, kind: EventKind, run: ResolvedRun, **details: Any) -> None:
        if self.on_event is not None:
            with self.lock:
                self.on_event(RunEvent(kind, run.run_id, run.spec, len(self.run_ids), **details))


def _asked(ask: Callable[..., T], *arguments: object) -> T:
    """What an executor answers; its own end, as when Dask's scheduler is killed, is no outcome of a run."""
    try:
        return ask(*arguments)
    except DynslamError:
        raise
    except Exception as error:  # each library of executors has errors of its own
        raise InfrastructureError(
            f"the executor gave up: {type(error).__name__} {reason_of(error)}",
            "what is finished is stored; the same command goes on from there",
        ) from error


def pictures_asked(spec: RunSpec) -> list[str]:
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
    folder = store.folder(stored.run_id)
    wanted = pictures_asked(run.spec)
    excused = {name for name in wanted for note in stored.notes if note.startswith(f"no {name}")}
    if stored.failed:  # what ends early has no map to draw, and what saw no frame nothing at all
        excused |= {SHEET_FILE, MAP_FILE, RECORDING_FILE} if stored.n_processed else set(wanted)
    return any(not (folder / name).is_file() for name in set(wanted) - excused)


_ENTRY = re.compile(r"(runs|sequences)/([0-9a-f]{16}(?:[0-9a-f]{4})?)/([A-Za-z0-9_]+\.[a-z0-9]+)")


def _expected(run: ResolvedRun) -> dict[str, Any]:
    """What a worker has to find where it looks a run up: its identity, and the same files of plug-ins.

    A plug-in's file counts in the identity as it is read, which is after the run.
    """
    parts = [part for part in run.identity["parts"] if is_file(part)]
    files = {part: path_digest(Path(run.anchors.path(module_of(part)))) for part in parts}
    return run.stated | {"plug-ins": files}


def run_packed(
    spec_json: str, protocol_json: str, identity_json: str, *, at_a_time: int = 1
) -> bytes:
    """Make a run on a worker that does not share the results folder; the function that executors are handed.

    Args:
        spec_json: A `RunSpec` as JSON.
        protocol_json: The protocol of the partial metrics as JSON.
        identity_json: The run's identity where it was asked for, as JSON.
        at_a_time: Runs that share this machine.

    Returns:
        A zip archive with the run's folder and its sequence's stamps and ground truth, for
        `unpack`.

    Raises:
        RunError: The request names something that this worker does not have, or its code, packages
            or data are others.
    """
    name = f"worker {socket.gethostname()}"
    try:
        resolved = resolve(RunSpec.model_validate_json(spec_json))
    except DynslamError as error:
        raise RunError(f"{name} cannot make the run: {error.args[0]}", error.hint) from error
    asked = json.loads(identity_json)
    own = _expected(resolved)
    differing = [
        key for key in sorted(asked | own) if asked.get(key) != own.get(key) and key != "machine"
    ]
    if differing:
        raise RunError(
            f"{name} would make another run: {', '.join(differing)} differ",
            "give all workers the same code, packages and data",
        )
    no_space = translate_errors(
        InfrastructureError, f"{name} cannot write its temporary files", "check the free space"
    )
    with no_space, contextlib.closing(TemporaryFolder()) as folder:
        store = RunStore(folder.path)
        store.prepare()
        protocol = Protocol.model_validate_json(protocol_json)
        return pack(store, run_one(resolved, store, protocol=protocol, at_a_time=at_a_time))


def pack(store: RunStore, record: RunRecord) -> bytes:
    """A stored run with its sequence's part as a zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for folder in (
            store.folder(record.run_id),
            store.root / "sequences" / record.sequence.part,
        ):
            for file in sorted(folder.iterdir()):
                archive.write(file, str(file.relative_to(store.root)))
    return buffer.getvalue()


def unpack(data: bytes, store: RunStore) -> RunRecord:
    """Take a packed run into a store; nothing of it is executed, and nothing lands outside the store.

    Raises:
        RunError: The bytes are no packed run, or hold names that do not belong there.
    """
    no_space = translate_errors(
        InfrastructureError, "cannot unpack a run that a worker has made", "check the free space"
    )
    with no_space, contextlib.closing(TemporaryFolder()) as folder:
        sent = RunStore(folder.path)
        with (  # zipfile raises almost anything over damaged archives
            translate_errors(
                RunError, f"{len(data)} bytes from a worker are no packed run", of=Exception
            ),
            translate_errors(
                InfrastructureError, f"cannot write {folder.path}", "check the free space"
            ),
            zipfile.ZipFile(io.BytesIO(data)) as archive,
        ):
            odd = [name for name in archive.namelist() if not _ENTRY.fullmatch(name)]
            archive.extractall(folder.path, set(archive.namelist()).difference(odd))
        runs = sent.ids()
        if odd or len(runs) != 1:
            raise RunError(f"a packed run holds {len(runs)} runs, and {len(odd)} odd names")
        return store.copy_from(sent, sent.read_whole(runs[0]))
