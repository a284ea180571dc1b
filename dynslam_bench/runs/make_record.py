"""Makes the record of a run of its frames and of how its process ended."""

import sys
from collections import Counter
from dataclasses import dataclass
from typing import Any

from dynslam_bench.contracts import Sequence
from dynslam_bench.core.fingerprint import git_revision, this_machine, versions
from dynslam_bench.core.reads import Reads
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import flatten
from dynslam_bench.runs.frames import FrameLog
from dynslam_bench.runs.identity import ResolvedRun
from dynslam_bench.runs.process.supervisor import ProcessEnd
from dynslam_bench.runs.record import (
    LOST_COVERAGE,
    ON_RECORDING,
    RunRecord,
    SequenceInfo,
    StageTime,
    Status,
    TrackerInfo,
    run_id_of,
)
from dynslam_bench.runs.spec import place_of
from dynslam_bench.sequences.tags import sequence_tags
from dynslam_bench.sequences.thumbnails import thumbnails
from dynslam_bench.sequences.view import sequence_part_of
from dynslam_bench.trackers.registry import resolve_settings

LOST_AT_END = 10
"""A run whose coverage is below `LOST_COVERAGE`, or that is lost on so many frames at its end, has status ``lost``."""
_CACHED_TIMES_NOTE = (
    "times of features and masks are those of the stage cache's entries, not of this run"
)
_BATCH_NOTE = "a batch program: only the final trajectory exists; a frame's time is the program's over all frames"
_FIELDS_OF_SPEC = (
    "frames",
    "offset",
    "stride",
    "seed",
    "threads",
    "realtime",
    "drop_share",
    "study",
)
"""Fields that a record copies from the request."""
_FIELDS_OF_TRACKER = (
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
)
"""Fields that a record copies from the tracker's spec."""
_FIELDS_OF_LAST_MESSAGE = ("keyframes", "map_points", "maps", "finalize_s")
"""Fields that a record copies from the last message of the run's process; None where the message lacks them."""


@dataclass(frozen=True)
class FrameCounts:
    """Number of frames of a run that were tracked, and that were not.

    Attributes:
        total: All frames of the run's part of the sequence.
        tracked: Frames with a pose.
        lost: Frames on which tracking was lost.
        initialising: Frames before the first pose.
        dropped: Frames that never reached the tracker.
        lost_at_end: Frames without a pose after the last one with one.
    """

    total: int
    tracked: int
    lost: int
    initialising: int
    dropped: int
    lost_at_end: int


def make_record(
    resolved: ResolvedRun,
    end: ProcessEnd,
    frames: FrameLog,
    reads: Reads | None,
    started: str,
    wall_s: float,
) -> RunRecord:
    """The record of a run.

    Args:
        resolved: What was run.
        end: How its process ended.
        frames: Its frames, as far as it came.
        reads: What its plug-ins and programs read; None for a run without such, or where it is not
            known.
        started: When it began, UTC, ISO 8601.
        wall_s: Wall-clock time of the whole run.
    """
    spec = resolved.spec
    tracker = resolved.tracker
    last_message = end.final

    # a run with plug-ins gets its id now that it is known what they read
    identity = resolved.identity
    if reads is not None:
        identity = identity | {"reads": reads.model_dump(mode="json")}

    # poses at every frame, or the whole trajectory at the end
    if tracker.online:
        counts = _counts_of_log(frames, len(resolved.sequence))
        timings = frames.timings()
    else:
        counts = _counts_of_batch(frames, last_message, len(resolved.sequence))
        timings = _timings_of_batch(last_message, counts.total)
    status, reason = _judge(end, frames, counts, is_realtime=spec.realtime)

    # what was asked for, what was used, and what came of it
    settings = flatten(resolved.settings)
    return RunRecord(
        run_id=run_id_of(identity),
        status=status,
        reason=reason,
        tracker=TrackerInfo(
            label=spec.label or tracker.label,
            distribution=resolved.distribution,
            **tracker_location(resolved),
            **{name: getattr(tracker, name) for name in _FIELDS_OF_TRACKER},
        ),
        overrides=_overrides(resolved, settings),
        settings=settings,
        sequence=sequence_info(
            resolved.sequence, identity["content"], sequence_part_digest(identity), spec.offset
        ),
        **{name: getattr(spec, name) for name in _FIELDS_OF_SPEC},
        device=resolved.device,
        degrade=identity["degrade"],
        segmentation=resolved.segmentation,
        n_frames=counts.total,
        n_processed=len(frames.rows) - counts.dropped,
        n_tracked=counts.tracked,
        n_lost=counts.lost,
        n_initialising=counts.initialising,
        n_dropped=counts.dropped,
        coverage=counts.tracked / counts.total,
        **{name: last_message.get(name) for name in _FIELDS_OF_LAST_MESSAGE},
        start_map=resolved.start_map,
        epipolar_skipped=frames.epipolar_skipped(),
        mask_iou=frames.mask_iou(),
        timings=timings,
        started=started,
        wall_s=wall_s,
        peak_memory_mb=last_message.get("program_memory_mb", end.peak_memory_mb) or None,
        peak_gpu_memory_mb=last_message.get("gpu_memory_mb"),
        machine=this_machine().model_copy(update={"gpu": last_message.get("gpu", "")}),
        versions=versions(),
        git=git_revision(),
        command=list(sys.argv),
        identity=identity,
        notes=[*_notes(resolved), *last_message.get("notes", [])],
        place=place_of(spec.sequence),
    )


def _counts_of_log(frames: FrameLog, total: int) -> FrameCounts:
    """The counts of a tracker that gives a pose, or none, at every frame."""
    states = Counter(row.state for row in frames.rows)
    return FrameCounts(
        total=total,
        tracked=states["ok"],
        lost=states["lost"],
        initialising=states["initialising"],
        dropped=states["dropped"],
        lost_at_end=frames.lost_streak(),
    )


def _counts_of_batch(frames: FrameLog, last_message: dict[str, Any], total: int) -> FrameCounts:
    """The counts of a batch program, whose poses are known at the end."""
    dropped = sum(row.state == "dropped" for row in frames.rows)
    tracked = last_message.get("tracked", 0)
    return FrameCounts(
        total=total,
        tracked=tracked,
        lost=total - dropped - tracked,
        initialising=0,
        dropped=dropped,
        lost_at_end=last_message.get("lost_at_end", total),
    )


def _timings_of_batch(last_message: dict[str, Any], total: int) -> dict[str, StageTime]:
    """The time of a batch program, spread over all frames; empty where it is not known."""
    # one time a frame: a program for whole sequences states no more
    frame_s = last_message.get("program_s", 0.0) / total
    if not frame_s:
        return {}
    return {"total": StageTime(median_s=frame_s, p95_s=frame_s, mean_s=frame_s)}


def _judge(
    end: ProcessEnd, frames: FrameLog, counts: FrameCounts, *, is_realtime: bool
) -> tuple[Status, str]:
    """Status of a run, with the reason: one that came to its end may have broken its contract or lost its way."""
    # how the process ended comes first, then damaged results, then coverage
    if end.status != "ok":
        return end.status, end.reason
    if frames.damage:
        return "invalid", frames.damage
    # dropped frames never reached the tracker
    due = counts.total - counts.dropped
    status, reason = judge_coverage(counts.tracked, due, counts.lost_at_end, counts.total)
    if status == "ok" and is_realtime and counts.dropped:
        reason = f"{counts.dropped} of {counts.total} frames dropped while the tracker was busy"
    return status, reason


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


def _overrides(run: ResolvedRun, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that were asked for and differ from the tracker's own, dotted name to value.

    Args:
        run: The run.
        settings: All its settings by dotted name.
    """
    # settings that were asked for at their defaults are none
    defaults = flatten(resolve_settings(run.tracker, {}))
    return {
        name: value
        for name, value in run.spec.settings.items()
        if name not in defaults or settings[name] != defaults[name]
    }


def _notes(run: ResolvedRun) -> list[str]:
    """Notes on a run for readers of its record, one a line."""
    notes = []
    if run.spec.cache:
        notes.append(_CACHED_TIMES_NOTE)
    if not run.tracker.online:
        notes.append(_BATCH_NOTE)
    if run.start_map is not None:
        notes.append(run.start_map.describe())
    return [*notes, *recording_notes(run.sequence)]


def recording_notes(sequence: Sequence) -> list[str]:
    """Notes on a recording, one a line: parts not used, absurd values; see `RecordedSequence.remarks`."""
    return [f"{ON_RECORDING}{remark}" for remark in getattr(sequence, "remarks", ())]


def tracker_location(run: ResolvedRun) -> dict[str, str]:
    """Place of a tracker that its id alone does not find: `given` and `folder` of `TrackerInfo`."""
    folder = run.base_folders.plugin
    return {
        "given": "" if run.spec.tracker == run.tracker.id else run.spec.tracker,
        "folder": "" if folder is None else str(folder),
    }


def sequence_info(sequence: Any, content: str, part: str, offset: int = 0) -> SequenceInfo:
    """Facts that a record keeps of a sequence, cut to its part without `offset` leading frames."""
    input_part = sequence_part_of(sequence, offset)
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
        thumbnails=thumbnails(sequence),
    )


def sequence_part_digest(identity: dict[str, Any]) -> str:
    """Digest of the part of a sequence that a run saw: content and frames."""
    return digest(
        {key: identity[key] for key in ("sequence", "content", "frames", "offset", "stride")}, 16
    )
