"""One row type from record to page: a run's record with its errors under a protocol and what follows from both."""

import json
import shlex
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import ConfigDict, Field

from dynslam_bench.core import TABLE_BYTES, DynslamError, setting_text, write_lines
from dynslam_bench.core.records import Record, schema
from dynslam_bench.evaluation import Evaluation, Protocol
from dynslam_bench.evaluation.alignment import RELIABLE_DEG
from dynslam_bench.evaluation.ape import ate_rmse_m, static_camera_rmse_m
from dynslam_bench.geometry import Trajectory
from dynslam_bench.runs.layout import TrajectoryKind
from dynslam_bench.runs.record import LOST_COVERAGE, MetricRecord, RunRecord, coverage_text
from dynslam_bench.runs.store import RunStore, score
from dynslam_bench.segmentation.training_scenes import seen_in_training
from dynslam_bench.sequences.tags import FIXED_CAMERA

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")
SEEN = "§"
"""Behind trackers and numbers whose masks come from a network that was trained on the scene."""
HINTED = "‡"
"""Behind trackers with runs whose trajectories are probably faulty."""
REPORT_FILE = "report.json"
"""File of a report's folder that holds `ReportData`."""
SCHEMA_VERSION = 1
"""Version of `ReportData`."""


class RunRow(RunRecord):
    """A run as the report shows it: its record, without the settings nobody asked for, and its errors.

    Status, reason, `n_tracked` and `coverage` are those of the trajectory that is scored.

    Attributes:
        protocol_id: Id of the protocol of `metrics`.
        protocol_digest: Its digest.
        trajectory: Which trajectory the metrics are of; an import may hold the final one only.
        metrics: Errors of the trajectory that the protocol asks for; empty for a failure without
            any.
        final_metrics: All errors of the final trajectory; empty if there is none.
        final_coverage: Share of the input frames with a pose in it; None where it is not known.
        rotation_uncertainty_deg: Standard error of the rotation of the trajectory's alignment, see
            `AlignmentRecord.uncertainty_deg`; None where it is not known or does not come from the
            positions.
        hold_last_pose_ate_m: The ATE with lost frames held at the last tracked pose, which ranks;
            None without evaluation.
        static_camera_ate_rmse_m: What a static camera scores there; None without ground truth.
        not_evaluated: Whether the run ended and cannot be evaluated although there is ground truth.
        seen_in_training: Whether the masks come from a network that was trained on this very scene:
            a best case, which does not rank unless that is asked for.
        hints: What is probably wrong with the trajectory, see `evaluation.hints`.
        split_by: Parts of their programs in which the rows of this tracker and variant differ, by
            name, see `model.programs`.
        is_current: Whether its row ranks: its identity is verified, and of the programs that made
            runs of this tracker and variant its own is the one that is installed or, where none is,
            that of the newest run.
        program_remark: How many programs share its row since their results are equal, or how the
            results differ from those of the row that ranks; empty where there is one program.
        store: Where its files lie; not written.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    protocol_id: str
    protocol_digest: str
    trajectory: TrajectoryKind = "online"
    metrics: dict[str, float] = Field(default_factory=dict)
    final_metrics: dict[str, float] = Field(default_factory=dict)
    final_coverage: float | None = None
    rotation_uncertainty_deg: float | None = None
    hold_last_pose_ate_m: float | None = None
    static_camera_ate_rmse_m: float | None = None
    not_evaluated: bool = False
    seen_in_training: bool = False
    hints: list[str] = Field(default_factory=list)
    split_by: dict[str, str] = Field(default_factory=dict)
    is_current: bool = True
    program_remark: str = ""
    store: RunStore = Field(default_factory=RunStore, exclude=True, repr=False)

    @property
    def folder(self) -> Path:
        """Folder of the run's files."""
        return self.store.folder(self.run_id)

    def estimate(self, which: TrajectoryKind) -> Trajectory | None:
        """The run's ``online`` or ``final`` trajectory; None if there is none with a pose, or it is damaged."""
        try:
            return self.store.trajectory(self.run_id, which)
        except DynslamError:
            return None

    def ground_truth(self) -> Trajectory | None:
        """The ground truth of its part of the sequence; None if there is none, or it is damaged."""
        try:
            return self.store.ground_truth(self.sequence.part)
        except DynslamError:
            return None

    @property
    def label(self) -> str:
        """Label of the tracker."""
        return self.tracker.label or self.tracker.id

    @property
    def imported(self) -> bool:
        """Whether the trajectory comes from elsewhere."""
        return self.kind == "imported"

    @property
    def origin(self) -> str:
        """Whether it was run here or is imported, in words."""
        return "imported" if self.imported else "run here"

    @property
    def ranked(self) -> bool:
        """Whether it may rank: its tracker's spec lets it, and it began without a map."""
        return self.tracker.ranked and self.start_map is None

    @property
    def sequence_key(self) -> str:
        """Content, camera, frames and stride: one column of a table; equal for all repeats and spellings."""
        return self.sequence.block or self.sequence.part

    @property
    def repeat_key(self) -> tuple[int, int, int, str]:
        """Key of the repeat within its cell: offset, noise and seed; every imported file is a repeat of its own."""
        noise = -1 if self.sequence.noise is None else self.sequence.noise
        return self.offset, noise, self.seed, self.run_id if self.imported else ""

    @property
    def repeat(self) -> str:
        """The repeat in words, e.g. ``seed 0, offset 2``.

        Of an import it is the end of its id, which tells files apart.
        """
        return f"import {self.run_id[-6:]}" if self.imported else super().repeat

    @cached_property
    def variant(self) -> dict[str, Any]:
        """Settings, device, threads and mode that set runs of one tracker apart besides sequence and repeat."""
        variant: dict[str, Any] = dict(sorted(self.requested_settings.items()))
        if not self.imported:
            variant |= {"device": self.device, "threads": self.threads}
        if self.realtime:
            machine = self.machine
            variant["realtime"] = f"{machine.cpu}, {machine.cores} cores" if machine else True
        if self.drop_share:
            variant["drop_share"] = self.drop_share
        for name, value in sorted(self.degrade.items()):
            variant[f"degrade.{name}"] = value
        return variant

    @cached_property
    def settings_key(self) -> str:
        """Tracker and settings, whatever program made the run."""
        variant = json.dumps(self.variant, sort_keys=True, default=str)
        return f"{self.tracker.id}|{self.kind}|{variant}"

    @property
    def variant_key(self) -> str:
        """Tracker, settings and program: everything that sets its runs apart besides sequence and repeat.

        It is final only after `programs.choose_runs`, which sets `split_by`.
        """
        if not self.split_by:
            return self.settings_key
        return f"{self.settings_key}|{json.dumps(self.split_by, sort_keys=True)}"

    @property
    def failed(self) -> bool:
        """Whether it counts as a failure: it did not end, could not track, or cannot be evaluated."""
        return super().failed or self.status == "lost" or self.not_evaluated

    @property
    def fixed_camera(self) -> bool:
        """Whether the true camera stands still."""
        return FIXED_CAMERA in self.sequence.tags

    @property
    def final_ate_m(self) -> float | None:
        """ATE of the final trajectory; None if there is none."""
        return self.final_metrics.get("ate_rmse_m")

    @property
    def score_m(self) -> float | None:
        """The ATE that ranks: lost frames held, failures as a static camera or worse; None without ground truth.

        A failure whose held trajectory is even further off than a static camera keeps that error.
        Before a fixed camera a failure has no error: a static camera has none there.
        """
        if not self.failed:
            held_m = self.hold_last_pose_ate_m
            return held_m if held_m is not None else self.metrics.get("ate_rmse_m")
        static_m = None if self.fixed_camera else self.static_camera_ate_rmse_m
        if static_m is None:
            return None
        return max(static_m, self.hold_last_pose_ate_m or 0.0)

    @property
    def frame_ms(self) -> float | None:
        """Median frame time in milliseconds, None if unknown."""
        return None if self.frame_time_s is None else 1000 * self.frame_time_s

    @property
    def cached(self) -> bool:
        """Whether stage times come from the stage cache and were not taken in this run."""
        # controls and external systems have no such stage
        has_stages = self.tracker.provenance not in ("control", "external")
        return bool(self.identity.get("cache")) and has_stages

    @property
    def rotation_reliable(self) -> bool:
        """Whether the metrics ``ape_rot_*`` are errors of the estimate rather than of its alignment."""
        uncertainty_deg = self.rotation_uncertainty_deg
        return uncertainty_deg is None or uncertainty_deg <= RELIABLE_DEG

    @property
    def ending(self) -> str:
        """End of a failed run, e.g. ``crashed at 20/60`` or ``lost, 12/60 tracked``; empty for any other."""
        if not self.failed:
            return ""
        if self.status == "lost" and self.coverage is None:
            return f"lost, {coverage_text(None, self.truth_share)}"
        if self.status == "lost":
            return f"lost, {self.n_tracked}/{self.n_frames} tracked"
        if self.status == "ok":
            return "not evaluated"
        return f"{self.status} at {self.n_processed}/{self.n_frames}"

    @property
    def computer(self) -> str:
        """The machine in words, without its name; empty where it is not recorded."""
        if self.machine is None:
            return ""
        machine = self.machine
        words = [
            machine.cpu,
            f"{machine.cores} cores",
            f"{machine.memory_gb:g} GB",
            machine.system,
            machine.gpu,
        ]
        return ", ".join(filter(None, words))

    @property
    def machine_words(self) -> str:
        """Computer and versions in words."""
        git = self.git
        versions = dict(self.versions)
        # a checkout is older than its code: git's revision holds
        if git is not None and "dynslam-bench" in versions:
            versions["dynslam-bench"] = versions["dynslam-bench"].partition("+")[0]
        parts = [self.computer, *(f"{name} {version}" for name, version in versions.items())]
        if git:
            changed = " (changed)" if git.dirty else ""
            parts.append(f"git {git.revision[:10]}{changed}")
        return "; ".join(filter(None, parts))


def grouped(rows: Iterable[V], key: Callable[[V], K]) -> dict[K, list[V]]:
    """Group rows, or other things, by a key; groups and members stay in their order."""
    groups: dict[K, list[V]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


class ReportData(Record):
    """Rows and protocol of a report, stored beside it; `compare` reads them back.

    Attributes:
        schema_version: Version of this record's fields.
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

        What plug-ins read, file by file, is left out: it is long, and names folders of the machine.

        Raises:
            DynslamError: The folder cannot be written.
        """
        head = self.model_copy(update={"rows": []}).to_line().removesuffix("]}")
        write_lines(path, chain([head], self._row_lines(), ["]}"]))

    def _row_lines(self) -> Iterator[str]:
        """The rows as JSON, one a line, with commas between them."""
        for row in self.rows:
            is_last = row is self.rows[-1]
            yield _without_reads(row).to_line() + ("" if is_last else ",")


def _without_reads(row: RunRow) -> RunRow:
    """A row whose identity does not say what plug-ins read; programs are compared before a report is written."""
    if "reads" not in row.identity:
        return row
    identity = {name: value for name, value in row.identity.items() if name != "reads"}
    return row.model_copy(update={"identity": identity})


def make_row(store: RunStore, record: RunRecord, protocol: Protocol) -> RunRow:
    """The row of one stored run, scored under a protocol."""
    # evaluate the trajectory that the protocol asks for
    scored = score(store, record, protocol)
    evaluation = scored.online if protocol.trajectory == "online" else scored.final
    alignment = None if evaluation is None else evaluation.alignment
    static_m = _static_camera_error(store, record, protocol, evaluation)

    # of the record keep what tables show: not the settings nobody asked for, not the stages' times
    kept: dict[str, Any] = dict(
        settings={
            name: record.settings[name] for name in record.overrides if name in record.settings
        },
        identity={name: value for name, value in record.identity.items() if name != "settings"},
        timings={name: time for name, time in record.timings.items() if name == "total"},
    )
    scores: dict[str, Any] = dict(
        protocol_id=scored.protocol_id,
        protocol_digest=scored.protocol_digest,
        trajectory=protocol.trajectory,
        metrics={} if evaluation is None else evaluation.metrics,
        final_metrics={} if scored.final is None else scored.final.metrics,
        final_coverage=None if scored.final is None else scored.final.coverage,
        rotation_uncertainty_deg=None if alignment is None else alignment.uncertainty_deg,
        hold_last_pose_ate_m=_hold_last_pose_error(store, record, protocol, evaluation, static_m),
        static_camera_ate_rmse_m=static_m,
        seen_in_training=seen_in_training(record.segmentation, record.sequence.id),
        notes=_notes_of(record, scored, evaluation),
        hints=scored.hints,
        store=store,
    )
    outcome = _outcome(record, scored, protocol, evaluation)
    return RunRow(**(dict(record) | kept | scores | outcome))


def _notes_of(record: RunRecord, scored: MetricRecord, evaluation: Evaluation | None) -> list[str]:
    """Hints, warnings, the study that a run is a trial of, the record's notes, and diagnostics."""
    notes = [f"hint: {hint}" for hint in scored.hints]
    if evaluation is not None:
        notes += [f"warning: {line}" for line in evaluation.warnings]
    if record.trial_of:
        notes.append(f"trial of the study '{record.trial_of}'")
    notes += record.notes
    if evaluation is not None:
        notes += evaluation.diagnostics
    return notes


def _outcome(
    record: RunRecord, scored: MetricRecord, protocol: Protocol, evaluation: Evaluation | None
) -> dict[str, Any]:
    """Fields of a row that differ from the record's: which trajectory is scored, how the run ended, its coverage."""
    # imports and batch programs may have a final trajectory only
    may_lack_online = record.kind == "imported" or not record.tracker.online
    has_final_only = scored.online is None and scored.final is not None
    if may_lack_online and has_final_only and not record.failed:
        return {"trajectory": "final"}

    # no evaluation although there is ground truth counts as a failure
    if evaluation is None:
        if record.failed or record.status == "lost" or not record.sequence.ground_truth:
            return {}
        reason = record.reason or scored.reasons.get(protocol.trajectory, "it cannot be evaluated")
        return {"not_evaluated": True, "reason": reason}

    # of the final trajectory of a run here, count the frames with a pose again
    n_tracked = evaluation.n_tracked
    frames_due = record.n_frames - record.n_dropped
    if record.kind == "imported" or protocol.trajectory == "online" or n_tracked is None:
        return {}
    outcome: dict[str, Any] = {"n_tracked": n_tracked, "coverage": evaluation.coverage}
    if not n_tracked or record.failed or LOST_COVERAGE * frames_due <= n_tracked < frames_due:
        return outcome
    # frames that were lost online have a pose in the final trajectory
    if n_tracked >= frames_due:
        return outcome | {"status": "ok", "reason": ""}
    return outcome | {
        "status": "lost",
        "reason": f"the final trajectory has poses of {n_tracked} of {frames_due} frames",
    }


def _static_camera_error(
    store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None
) -> float | None:
    """ATE in metres of a static camera under the protocol's alignment; None without ground truth."""
    if evaluation is not None:
        return evaluation.metrics["static_camera_ate_rmse_m"]
    with suppress(DynslamError):
        truth = store.ground_truth(record.sequence.part)
        if truth is not None:
            return static_camera_rmse_m(truth, store.timestamps(record.sequence.part), protocol)
    return None


def _hold_last_pose_error(
    store: RunStore,
    record: RunRecord,
    protocol: Protocol,
    evaluation: Evaluation | None,
    static_m: float | None,
) -> float | None:
    """The ATE with every lost frame held at the last tracked pose; None without evaluation.

    Poses that belong to no input frames cannot be held: with lost frames, the error is at least a
    static camera's.
    """
    if evaluation is None:
        return None
    error = evaluation.metrics["ate_rmse_m"]
    if evaluation.coverage == 1.0 or record.coverage is None:
        return error
    with suppress(DynslamError):
        trajectory = store.trajectory(record.run_id, protocol.trajectory)
        truth = store.ground_truth(record.sequence.part)
        if trajectory is not None and truth is not None:
            return ate_rmse_m(
                trajectory, truth, protocol, held_at=store.timestamps(record.sequence.part)
            )
    return error if record.coverage >= 1.0 else max(error, static_m or 0.0)


def command_line(command: list[str]) -> str:
    """The command line as one would type it; a results folder named by its absolute path is ``RESULTS``."""
    if not command:
        return ""
    program, *words = command
    results = _option(command, "--results")
    if results and Path(results).is_absolute():
        words = [word.replace(results, "RESULTS") for word in words]
    if Path(program).name in ("__main__.py", "dynslam-bench"):
        program = "dynslam-bench"
    return shlex.join([program, *words])


def run_command(row: RunRow) -> str:
    """The command that makes a run again; empty for an imported trajectory."""
    if row.imported:
        return ""
    words = [row.place or row.sequence.id, *sequence_options(row)]
    if row.seed:
        words += ["--seed", str(row.seed)]
    if row.offset:
        words += ["--offset", str(row.offset)]
    return command_with(row, words)


def command_with(row: RunRow, words: Iterable[str]) -> str:
    """The command ``run`` with the tracker and the settings of a run; `words` name sequences, part and repeats."""
    # options that are no settings; defaults are not named
    options: dict[str, list[str]] = {
        "threads": ["--threads", str(row.threads)] if row.threads != 1 else [],
        "device": ["--device", row.device] if row.device not in ("cpu", "") else [],
        "map": ["--map", row.start_map.file if row.start_map else ""],
        "realtime": ["--realtime"],
        "drop_share": ["--drop", str(row.drop_share)],
    }
    settings: list[str] = []
    for name, value in row.variant.items():
        if name.startswith("degrade."):
            settings += ["--degrade", f"{name.removeprefix('degrade.')}={value}"]
        else:
            settings += options.get(name, ["--set", f"{name}={setting_text(value)}"])
    tracker = row.tracker.given or row.tracker.id
    return shlex.join(["dynslam-bench", "run", tracker, *words, *settings])


def sequence_options(row: RunRow) -> list[str]:
    """Options of the command line for the run's part of the sequence, and for the camera that its command named."""
    words = []
    if row.frames is not None:
        frames = ":".join("" if end is None else str(end) for end in row.frames)
        words += ["--frames", frames]
    camera = _option(row.command, "--camera") if row.place else None
    if camera:
        words += ["--camera", camera]
    if row.stride != 1:
        words += ["--stride", str(row.stride)]
    return words


def _option(command: Sequence[str], name: str) -> str | None:
    """The value of an option in a command line; None where it is not named."""
    for word, following in zip_longest(command, command[1:]):
        if word == name or word.startswith(f"{name}="):
            return following if word == name else word.partition("=")[2]
    return None
