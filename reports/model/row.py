"""One row a run: what the report knows of it, whether it was made here, imported or only reported."""

from __future__ import annotations

import json
import shlex
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import write_lines
from dynslam_bench.core.reading import TABLE_BYTES
from dynslam_bench.core.records import Record, digest, schema
from dynslam_bench.evaluation.alignment import RELIABLE_DEG
from dynslam_bench.evaluation.ape import ate_rmse_m, static_camera
from dynslam_bench.evaluation.evaluate import Evaluation
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.record import LOST_COVERAGE, MetricRecord, RunRecord, Status
from dynslam_bench.runs.run_index import part_words
from dynslam_bench.runs.store import RunStore, score
from dynslam_bench.segmentation.networks.checkpoints import seen_in_training

Kind = Literal["run here", "imported"]
Which = Literal["online", "final"]
"""Which of a run's two trajectories."""
SEEN = "§"
"""Behind trackers and numbers whose masks come from a network that was trained on the scene."""
HINTED = "‡"
"""Behind trackers with runs whose trajectories are probably faulty."""


class RunRow(Record):
    """A run as the report shows it.

    Attributes:
        run_id: Its id in the store.
        kind: Made by this toolkit, or a trajectory from elsewhere.
        tracker: Tracker id.
        given: What the tracker was named by where that is not its id, e.g. ``/path/file.py:Attr``.
        label: Tracker's label.
        variant: What sets runs of one tracker apart besides sequence and repeat: overrides, device, threads, mode.
        program: Code, weights and library versions that made it, see `RunRecord.program`.
        split_by: Those of them in which the runs of this tracker and variant differ: each program is a row of its own.
        is_current: Whether its identity is verified, and no newer program has made runs of this tracker and variant.
        deterministic: Whether equal runs should give equal results.
        provenance: How closely the tracker follows its source.
        ranked: Whether its spec lets it be ranked.
        monocular: Whether its scale is unknown: a protocol whose alignment finds none leaves it out.
        sequence: Sequence id.
        frames: Part of the sequence in words, empty for all of it.
        part_options: The same as command-line options.
        block: What one column of a table is: content, camera, frames and stride.
        content: Digest of the content.
        camera: Camera in words.
        map_file: File of the map that it began in, which `variant` names by its digest; empty for none.
        place: Folder of the sequence where it was named by its path.
        duration_s: Time between its first and last frame.
        tags: Tags of the sequence.
        split: ``tune``, ``held-out`` or empty.
        seed: Seed.
        offset: Leading frames that were left out: another repeat.
        noise: Seed of the sensors' noise: another repeat.
        status: Status of the run.
        reason: Why it is not ``ok``.
        failed: Whether it counts as a failure: it did not end, could not track, or cannot be evaluated.
        protocol_id: Id of the protocol of `metrics`.
        protocol_digest: Its digest.
        trajectory: Which trajectory the metrics are of; an import may hold the final one only.
        metrics: Errors of the trajectory that the protocol asks for; empty for a failure without any.
        final_ate_m: ATE of the final trajectory; None if there is none.
        final_metrics: All errors of the final trajectory; empty if there is none, or in reports of older versions.
        rotation_uncertainty_deg: Standard error of the rotation of the trajectory's alignment, see
            `AlignmentRecord.uncertainty_deg`; None where it is not known or does not come from the positions.
        hold_last_pose_ate_m: The ATE with lost frames held at the last tracked pose, which ranks; None without evaluation.
        static_camera_ate_rmse_m: What a static camera scores there; None without ground truth.
        n_frames: Input frames.
        n_processed: Frames that the tracker saw before it ended.
        n_tracked: Frames that were tracked.
        coverage: Share of the input frames that was tracked.
        epipolar_skipped: Share of the tracked frames on which the fundamental matrix was not used; None for systems
            without an epipolar test.
        cached: Whether stage times come from the stage cache and were not taken in this run.
        frame_ms: Median frame time in milliseconds, None if unknown.
        real_time_factor: Frame interval over mean frame time, None if unknown.
        peak_memory_mb: Largest resident memory, None if unknown.
        mask_iou: Overlap of the dynamic mask with the exact one, None if unknown.
        segmentation: Source of the masks.
        seen_in_training: Whether the masks come from a network that was trained on this very scene: a best case, which
            does not rank unless that is asked for.
        study: Study of which the run is a trial, with settings of its own; empty for any other run.
        started: UTC, ISO 8601.
        log: Path of the run's log.
        command: Command line that made it.
        machine: Computer and versions in words.
        notes: Diagnostics of the evaluation and of the run.
        hints: What is probably wrong with the trajectory, see `evaluation.hints`.
    """

    run_id: str
    kind: Kind
    tracker: str
    given: str = ""
    label: str
    variant: dict[str, Any] = Field(default_factory=dict)
    program: dict[str, str] = Field(default_factory=dict)
    split_by: dict[str, str] = Field(default_factory=dict)
    is_current: bool = True
    deterministic: bool = True
    provenance: str = ""
    ranked: bool = True
    monocular: bool = False
    sequence: str
    frames: str = ""
    part_options: list[str] = Field(default_factory=list)
    block: str = ""
    content: str = ""
    camera: str = ""
    map_file: str = ""
    place: str = ""
    duration_s: float = 0.0
    tags: list[str] = Field(default_factory=list)
    split: str = ""
    seed: int = 0
    offset: int = 0
    noise: int | None = None
    status: str = "ok"
    reason: str = ""
    failed: bool = False
    protocol_id: str
    protocol_digest: str
    trajectory: Which = "online"
    metrics: dict[str, float] = Field(default_factory=dict)
    final_ate_m: float | None = None
    final_metrics: dict[str, float] = Field(default_factory=dict)
    rotation_uncertainty_deg: float | None = None
    hold_last_pose_ate_m: float | None = None
    static_camera_ate_rmse_m: float | None = None
    n_frames: int = 0
    n_processed: int = 0
    n_tracked: int = 0
    coverage: float = 0.0
    epipolar_skipped: float | None = None
    cached: bool = False
    frame_ms: float | None = None
    real_time_factor: float | None = None
    peak_memory_mb: float | None = None
    mask_iou: float | None = None
    segmentation: str = ""
    seen_in_training: bool = False
    study: str = ""
    started: str = ""
    log: str = ""
    command: str = ""
    machine: str = ""
    notes: list[str] = Field(default_factory=list)
    hints: list[str] = Field(default_factory=list)

    @property
    def column_id(self) -> str:
        """What one column of a table is; equal for all repeats and for every spelling of the same frames."""
        return self.block or f"{self.sequence} [{self.frames}]"

    @property
    def repeat_key(self) -> tuple[int, int, int, str]:
        """Which repeat of its cell it is; every imported file is one of its own."""
        return self.offset, -1 if self.noise is None else self.noise, self.seed, self.run_id if self.imported else ""

    @property
    def repeat(self) -> str:
        """The same in words, e.g. ``seed 0, offset 2``."""
        if self.imported:
            return f"import {self.run_id[:6]}"
        words = [f"seed {self.seed}"] + [f"offset {self.offset}"] * bool(self.offset)
        return ", ".join(words + ([] if self.noise is None else [f"noise {self.noise}"]))

    @property
    def imported(self) -> bool:
        """Whether the trajectory comes from elsewhere."""
        return self.kind == "imported"

    @cached_property
    def variant_key(self) -> str:
        """Tracker and everything that sets its runs apart besides sequence and repeat."""
        split = json.dumps(self.split_by, sort_keys=True) if self.split_by else ""
        return f"{self.settings_key}|{split}" if split else self.settings_key

    @property
    def settings_key(self) -> str:
        """Tracker and settings, whatever program made the run."""
        return self.tracker + "|" + self.kind + "|" + json.dumps(self.variant, sort_keys=True, default=str)

    @property
    def score_m(self) -> float | None:
        """The ATE that ranks: lost frames held, failures as a static camera or worse; None without ground truth.

        A failure whose held trajectory is even further off than a static camera keeps that error.
        """
        if self.failed:
            static_m = self.static_camera_ate_rmse_m
            return None if static_m is None else max(static_m, self.hold_last_pose_ate_m or 0.0)
        return self.hold_last_pose_ate_m if self.hold_last_pose_ate_m is not None else self.metrics.get("ate_rmse_m")

    @property
    def rotation_reliable(self) -> bool:
        """Whether the metrics ``ape_rot_*`` are errors of the estimate rather than of its alignment."""
        return self.rotation_uncertainty_deg is None or self.rotation_uncertainty_deg <= RELIABLE_DEG

    @property
    def ending(self) -> str:
        """How a failed run ended, e.g. ``crashed at 20/60`` or ``lost, 12/60 tracked``; empty for any other."""
        if not self.failed:
            return ""
        if self.status == "lost":
            return f"lost, {self.n_tracked}/{self.n_frames} tracked"
        return "not evaluated" if self.status == "ok" else f"{self.status} at {self.n_processed}/{self.n_frames}"


# What a report was made of, as it lies beside it: `report.json`.

REPORT_FILE = "report.json"
SCHEMA_VERSION = 1


class ReportData(Record):
    """What a report was made of; `compare` reads it back.

    Attributes:
        schema_version: Of this record.
        title: Title of the report.
        protocol: Description of the protocol.
        reference: Tracker that errors are divided by.
        version: Version of the package.
        rows: One a run.
    """

    most_bytes: ClassVar[int] = TABLE_BYTES

    schema_version: int = schema(SCHEMA_VERSION)
    title: str
    protocol: str
    reference: str
    version: str
    rows: list[RunRow] = Field(default_factory=list)

    def write(self, path: Path) -> None:
        """Write it with a line for every row; it is never one text, since there may be a hundred thousand rows.

        Raises:
            DynslamError: The folder cannot be written.
        """
        head = self.model_copy(update={"rows": []}).to_line().removesuffix("]}")
        last = len(self.rows) - 1
        rows = (row.to_line() + "," * (at < last) for at, row in enumerate(self.rows))
        write_lines(path, chain([head], rows, ["]}"]))


# The row of one stored run: its record, its errors under a protocol, and what follows from its trajectories.


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run."""
    scored = score(store, record, protocol)
    which, status, failed, reason = _judge(record, scored, protocol)
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    alignment = None if evaluation is None else evaluation.alignment
    tracker, sequence = record.tracker, record.sequence
    still = static_camera_error(store, record, protocol, evaluation)
    return RunRow(
        run_id=record.run_id,
        kind="run here" if record.kind == "run" else "imported",
        tracker=tracker.id,
        given=tracker.given,
        label=tracker.label or tracker.id,
        variant=variant_of(record),
        program=record.program,
        deterministic=tracker.deterministic and not record.realtime,
        provenance=tracker.provenance,
        ranked=tracker.ranked and record.start_map is None,
        monocular=tracker.sensors == "rgb",
        sequence=sequence.id,
        frames=part_words(record),
        part_options=part_options(record),
        block=column_of(record),
        content=sequence.content,
        camera=camera_words(record),
        map_file="" if record.start_map is None else record.start_map.file,
        place=record.place,
        duration_s=sequence.duration_s,
        tags=sequence.tags,
        split=sequence.split,
        seed=record.seed,
        offset=record.offset,
        noise=sequence.noise,
        status=status,
        reason=reason,
        failed=failed,
        protocol_id=scored.protocol_id,
        protocol_digest=scored.protocol_digest,
        trajectory=which,
        metrics={} if evaluation is None else dict(evaluation.metrics),
        final_ate_m=None if scored.final is None else scored.final.metrics.get("ate_rmse_m"),
        final_metrics={} if scored.final is None else dict(scored.final.metrics),
        rotation_uncertainty_deg=None if alignment is None else alignment.uncertainty_deg,
        hold_last_pose_ate_m=hold_last_pose_error(store, record, protocol, evaluation, still),
        static_camera_ate_rmse_m=still,
        **_counts(record, scored.final if which == "final" and record.kind == "run" else None),
        epipolar_skipped=record.epipolar_skipped,
        cached=bool(record.identity.get("cache")),
        frame_ms=None if record.frame_time_s is None else 1000 * record.frame_time_s,
        real_time_factor=record.real_time_factor,
        peak_memory_mb=record.peak_memory_mb,
        mask_iou=record.mask_iou,
        segmentation=record.segmentation,
        seen_in_training=seen_in_training(record.segmentation, sequence.id),
        study=record.trial_of,
        started=record.started,
        log=log_of(store, record.run_id),
        command=command_line(record.command),
        machine=machine_words(record),
        **_remarks(record, evaluation, scored.hints),
    )


def _judge(record: RunRecord, scored: MetricRecord, protocol: Protocol) -> tuple[Which, Status, bool, str]:
    """Whose errors a row holds, how the run ended, whether it counts as a failure, and why it is not ``ok``."""
    only_final = record.kind == "imported" and scored.online is None and scored.final is not None
    which: Which = "final" if only_final else protocol.trajectory
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    failed = record.failed or record.status == "lost"
    if record.sequence.ground_truth and evaluation is None and not failed and which == protocol.trajectory:
        return which, record.status, True, record.reason or scored.reasons.get(which, "it cannot be evaluated")
    due = record.n_frames - record.n_dropped
    if record.kind == "run" and which == "final" and not record.failed and evaluation and evaluation.n_tracked:
        if evaluation.n_tracked < LOST_COVERAGE * due:
            return which, "lost", True, f"the final trajectory has poses of {evaluation.n_tracked} of {due} frames"
        if evaluation.n_tracked >= due:  # frames that were lost when they came were found later
            return which, "ok", False, ""
    return which, record.status, failed, record.reason


def _counts(record: RunRecord, final: Evaluation | None) -> dict[str, Any]:
    """A row's numbers of frames; where the final trajectory is scored, those that it has poses of."""
    counts = {name: getattr(record, name) for name in ("n_frames", "n_processed", "n_tracked", "coverage")}
    if final is not None and final.n_tracked is not None and final.coverage is not None:
        counts |= {"n_tracked": final.n_tracked, "coverage": final.coverage}
    return counts


def _remarks(record: RunRecord, evaluation: Evaluation | None, hints: list[str]) -> dict[str, list[str]]:
    """What a reader should know of a run: hints, whose trial it is, its own remarks, those of its evaluation."""
    trial = [f"trial of the study '{record.trial_of}'"] if record.trial_of else []
    lines = [*trial, *record.notes, *(evaluation.diagnostics if evaluation is not None else [])]
    return {"notes": [*(f"hint: {hint}" for hint in hints), *lines], "hints": hints}


def log_of(store: RunStore, run_id: str) -> str:
    """Where the log of a run lies."""
    return str(store.folder(run_id) / "log.txt")


# What a row takes out of a run's record and its stored trajectories.


def column_of(record: RunRecord) -> str:
    """What one column of a table is: content, camera, frames and stride.

    Records of older versions have no block; for them it is content and frames with the camera, if they name one.
    """
    camera = record.identity.get("camera")
    old = record.sequence.part + (f"-{digest(camera, 8)}" if camera else "")
    return record.sequence.block or old


def camera_words(record: RunRecord) -> str:
    """The camera in a few words, empty if the record does not name it."""
    camera = record.identity.get("camera")
    if not isinstance(camera, dict) or not {"width", "height", "fx", "fy"} <= camera.keys():
        return ""
    return "camera {width}x{height}, f {fx} {fy}".format(**{key: _short(value) for key, value in camera.items()})


def _short(value: object) -> str:
    """A number, or whatever else a record of somebody else's holds in its place."""
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def static_camera_error(
    store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None
) -> float | None:
    """What a static camera scores under the protocol's alignment; None without ground truth."""
    if evaluation is not None and "static_camera_ate_rmse_m" in evaluation.metrics:
        return evaluation.metrics["static_camera_ate_rmse_m"]
    try:
        truth = store.ground_truth(record.sequence.part)
        if truth is None:
            return None
        errors = static_camera(truth, store.timestamps(record.sequence.part), protocol.max_dt)
    except DynslamError:
        return None
    return errors["first_rmse_m" if protocol.alignment in ("none", "origin") else "constant_rmse_m"]


def hold_last_pose_error(
    store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None, still: float | None
) -> float | None:
    """The ATE with every lost frame counted as not having moved since the last tracked one; None without evaluation.

    Where the poses cannot be held, since they belong to no input frames, a trajectory with lost frames counts at least
    as a static camera (`still`).
    """
    if evaluation is None:
        return None
    error = evaluation.metrics["ate_rmse_m"]
    if evaluation.coverage == 1.0:
        return error
    unheld = error if record.coverage >= 1.0 else max(error, still or 0.0)
    try:
        trajectory, truth = (
            store.trajectory(record.run_id, protocol.trajectory),
            store.ground_truth(record.sequence.part),
        )
        if trajectory is None or truth is None:
            return unheld
        stamps = store.timestamps(record.sequence.part)
        return ate_rmse_m(trajectory, truth, protocol, held_at=stamps)
    except DynslamError:
        return unheld


def variant_of(record: RunRecord) -> dict[str, Any]:
    """What sets runs of one tracker apart besides sequence and repeat."""
    variant: dict[str, Any] = dict(sorted(record.asked.items()))
    if record.kind == "run":
        variant |= {"device": record.device, "threads": record.threads}
    if record.realtime:
        machine = record.machine
        variant["realtime"] = f"{machine.cpu}, {machine.cores} cores" if machine is not None else True
    if record.drop_share:
        variant["drop_share"] = record.drop_share
    variant |= {f"degrade.{name}": value for name, value in sorted(record.degrade.items())}
    return variant


def part_options(record: RunRecord) -> list[str]:
    """The same as options of the command line."""
    options = []
    if record.frames is not None:
        start, stop = record.frames
        options += ["--frames", f"{start}:{'' if stop is None else stop}"]
    return options + (["--stride", str(record.stride)] if record.stride != 1 else [])


def command_line(command: list[str]) -> str:
    """The command line as one would type it."""
    if not command:
        return ""
    head = Path(command[0]).name
    return shlex.join(["dynslam-bench" if head in ("__main__.py", "dynslam-bench") else command[0], *command[1:]])


def machine_words(record: RunRecord) -> str:
    """Computer and versions in words."""
    parts = []
    if record.machine is not None:
        machine = record.machine
        parts.append(f"{machine.cpu}, {machine.cores} cores, {machine.memory_gb:g} GB, {machine.system}")
        if machine.gpu:
            parts.append(machine.gpu)
    parts += [f"{name} {version}" for name, version in record.versions.items()]
    if record.git is not None:
        parts.append(f"git {record.git.revision[:10]}{' (changed)' if record.git.dirty else ''}")
    return "; ".join(parts)
