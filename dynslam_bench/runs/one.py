"""Making one run and storing it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from datetime import datetime, timezone
from typing import Any

from dynslam_bench.contracts.sequence import exact_stamps, timestamps_ns
from dynslam_bench.core.errors import InfrastructureError, RunError
from dynslam_bench.core.fingerprint import git_revision, this_machine, versions
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import flatten
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.frames import FRAMES_FILE, FrameLog
from dynslam_bench.runs.identity import ResolvedRun, check_unchanged, resolve
from dynslam_bench.runs.process.child import LOG_FILE
from dynslam_bench.runs.process.fork_server import Child, make_job
from dynslam_bench.runs.process.supervisor import LONGEST_LOG, LONGEST_YET, Verdict, bound_log, supervise
from dynslam_bench.runs.record import LOST_COVERAGE, RunRecord, SequenceInfo, Status, TrackerInfo
from dynslam_bench.runs.spec import RunSpec, place_of
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, RunStore
from dynslam_bench.sequences.view import part_of

WORK = "dynslam_bench.runs.loop:run_loop"
"""What the child does."""
PROGRESS_EVERY = 50
CACHED_TIMES = "times of features and masks are those of the stage cache's entries, not of this run"
LOST_AT_END = 10
"""A run whose coverage is below `LOST_COVERAGE`, or that is lost on so many frames at its end, has status ``lost``."""

OnProgress = Callable[[str, dict[str, Any]], bool]
"""Called as ``on_progress(run_id, partial)`` every `PROGRESS_EVERY` frames; returning False stops the run.

`partial` holds ``frames_done``, ``frames``, ``metrics`` (of the frames so far under the protocol), ``frame_time_s`` and
``pose_error_trans_m``.
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

    A tracker that raises, hangs, breaks its contract, takes too much or dies gives a record with that status and the
    reason; only a request that cannot begin at all is an error. A run that `on_progress` stopped is not stored.

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
        DynslamError: The request names something unknown or unfit, something other than the tracker's own code raised
            (an image, a mask or a file that cannot be read), the store cannot be written, or what a run needs broke
            (`InfrastructureError`); nothing is stored then.
    """
    resolved = resolve(run) if isinstance(run, RunSpec) else run
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
        )
        log = work / LOG_FILE
        watched: dict[str, Any] = {"tick": lambda: bound_log(log, LONGEST_YET), "at_a_time": at_a_time}
        child = Child()
        try:
            verdict = supervise(child, job, resolved.spec.limits, report, cancelled, **watched)
        except InfrastructureError:
            if not child.lost:
                raise
            child = Child()  # of a new fork server
            verdict = supervise(child, job, resolved.spec.limits, report, cancelled, **watched)
        if verdict.refused:
            raise RunError(
                f"{resolved.tracker.id} cannot run on {resolved.sequence.id}: {verdict.reason}", "nothing is stored"
            )
        try:
            bound_log(log, LONGEST_LOG)
            frames = FrameLog.read(work / FRAMES_FILE)
            title = f"{resolved.tracker.id} on {resolved.sequence.id}, seed {resolved.spec.seed}, online"
            frames.write(work, title, exact_stamps(resolved.sequence))
            (work / FRAMES_FILE).unlink(missing_ok=True)
        except OSError as error:
            raise InfrastructureError(f"cannot write {work}: {error.strerror}", "the run is not stored") from error
        check_unchanged(resolved.start_map, resolved.settings)
        record = _record(resolved, verdict, frames, started, time.perf_counter() - clock).normalised()
        if record.status != "stopped":
            store.add_sequence(record.sequence.part, timestamps_ns(resolved.sequence), resolved.sequence.ground_truth)
            record = store.publish(work, record)
    return record


def sequence_info(sequence: Any, content: str, part: str, offset: int = 0) -> SequenceInfo:
    """What a record keeps of a sequence that was cut to its part without `offset` leading frames."""
    input_part, stamps = part_of(sequence, offset), sequence.timestamps
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
        tags=sorted(getattr(sequence, "tags", ())),
        split=getattr(sequence, "split", ""),
    )


def part_digest(identity: dict[str, Any]) -> str:
    """Names what of the sequence a run saw: content and frames."""
    return digest({key: identity[key] for key in ("sequence", "content", "frames", "offset", "stride")}, 16)


def _record(resolved: ResolvedRun, verdict: Verdict, frames: FrameLog, started: str, wall_s: float) -> RunRecord:
    spec, identity, final = resolved.spec, resolved.identity, verdict.final
    total = len(resolved.sequence)
    status, reason = _judge(verdict, frames, total)
    if status == "ok" and spec.realtime and (dropped := frames.count("dropped")):
        reason = f"{dropped} of {total} frames dropped while the tracker was busy"
    cached = [CACHED_TIMES] if spec.cache else []
    begun = [] if resolved.start_map is None else [resolved.start_map.describe()]
    return RunRecord(
        run_id=resolved.run_id,
        status=status,
        reason=reason,
        tracker=_tracker_info(resolved),
        overrides=spec.settings,
        settings=flatten(resolved.settings),
        sequence=sequence_info(resolved.sequence, identity["content"], part_digest(identity), spec.offset),
        **{name: getattr(spec, name) for name in _AS_ASKED},
        device=resolved.device,
        degrade=identity["degrade"],
        segmentation=resolved.segmentation,
        **_counts(frames, total),
        **{name: final.get(name) for name in ("keyframes", "map_points", "maps", "finalize_s")},
        start_map=resolved.start_map,
        epipolar_skipped=frames.epipolar_skipped(),
        mask_iou=frames.mask_iou(),
        timings=frames.timings(),
        started=started,
        wall_s=wall_s,
        peak_memory_mb=verdict.peak_memory_mb or None,
        peak_gpu_memory_mb=final.get("gpu_memory_mb"),
        machine=this_machine().model_copy(update={"gpu": final.get("gpu", "")}),
        versions=versions(),
        git=git_revision(),
        command=list(sys.argv),
        identity=identity,
        notes=[*cached, *begun, *final.get("notes", [])],
        place=place_of(spec.sequence),
    )


_AS_ASKED = ("frames", "offset", "stride", "seed", "threads", "realtime", "drop_share", "study")
"""What a record takes from the request as it is."""


def _tracker_info(resolved: ResolvedRun) -> TrackerInfo:
    tracker = resolved.tracker
    same = ("id", "version", "provenance", "ranked", "deterministic", "license", "citation", "remarks", "sensors")
    return TrackerInfo(
        label=resolved.spec.label or tracker.label,
        distribution=resolved.identity["distribution"],
        given="" if resolved.spec.tracker == tracker.id else resolved.spec.tracker,
        **{name: getattr(tracker, name) for name in same},
    )


def _counts(frames: FrameLog, total: int) -> dict[str, Any]:
    """A record's numbers of frames, `total` in all."""
    tracked, dropped = frames.count("ok"), frames.count("dropped")
    return {
        "n_frames": total,
        "n_processed": len(frames.rows) - dropped,
        "n_tracked": tracked,
        "n_lost": frames.count("lost"),
        "n_initialising": frames.count("initialising"),
        "n_dropped": dropped,
        "coverage": tracked / total,
    }


def _judge(verdict: Verdict, frames: FrameLog, total: int) -> tuple[Status, str]:
    """A run that came to its end may still have lost its way."""
    if verdict.status != "ok":
        return verdict.status, verdict.reason
    if frames.damage:
        return "invalid", frames.damage
    return judge_coverage(frames.count("ok"), total - frames.count("dropped"), frames.lost_streak(), total)


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
        return "lost", f"lost from frame {total - lost_at_end} to the end, tracked on {tracked} of {due} frames"
    return "ok", ""
