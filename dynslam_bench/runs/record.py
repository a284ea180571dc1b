"""Records of runs: `run.json`, which `store` writes, and the metrics, which lie apart in the index."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from dynslam_bench.core.fingerprint import GitRevision, Machine
from dynslam_bench.core.reads import Reads
from dynslam_bench.core.records import Digest, Record, RunId, digest, schema
from dynslam_bench.evaluation import Evaluation

RUN_SCHEMA = 1
"""Version of the fields of `RunRecord`."""
METRIC_SCHEMA = 1
"""Version of the fields of `MetricRecord`."""

ON_RECORDING = "recording: "
"""Begins a run's notes on what of its recording was not used, or what nobody could mean."""

Status = Literal["ok", "lost", "crashed", "timeout", "out-of-memory", "invalid", "stopped"]
"""Status of a run that ended, see `RunRecord`."""
IDENTITY_SCHEME = 2
"""Raised when run ids are made of other things. Stored runs of another scheme are shown as unverified."""
ASKED = (
    "scheme",
    "tracker",
    "settings",
    "sequence",
    "frames",
    "offset",
    "stride",
    "seed",
    "device",
    "threads",
    "cache",
    "realtime",
    "drop_share",
    "degrade",
)
"""Entries of an identity that were asked for; all others were read: code, data, weights, libraries, files."""
_CODE_ENTRIES = ("tracker_version", "source", "requires", "files", "reads")
"""Entries of an identity that tell the code that made the run."""
PROGRAM = ("parts", *_CODE_ENTRIES, "libraries", "weights")
"""Entries of an identity that tell the program that made the run: its code, libraries and weights."""
FAILED: tuple[Status, ...] = ("crashed", "timeout", "out-of-memory", "invalid")
"""Statuses of runs that did not come to their end."""
LOST_COVERAGE = 0.5
"""A trajectory with poses of a smaller share of the frames that were due is that of a camera that was lost."""


ASKED_DIGITS = 12
"""So many digits of a run's id tell what was asked for."""


def digest_of_request(identity: Mapping[str, Any]) -> str:
    """The first twelve digits of a run's id: what was asked for."""
    return digest({name: identity[name] for name in ASKED if name in identity}, ASKED_DIGITS)


def digest_of_reads(identity: Mapping[str, Any]) -> str:
    """The last eight digits of a run's id: what was read for it, which is all that was not asked for."""
    return digest({name: value for name, value in identity.items() if name not in ASKED}, 8)


def run_id_of(identity: Mapping[str, Any]) -> str:
    """The id of a run: twelve digits of what was asked for, eight of what was read for it."""
    return digest_of_request(identity) + digest_of_reads(identity)


def coverage_text(coverage: float | None, truth_share: float | None = None) -> str:
    """The share of tracked frames for people; where the frames are not known, that of the ground truth's time."""
    if coverage is not None:
        return f"{100 * coverage:.1f} %"
    return "unknown" if truth_share is None else f"{100 * truth_share:.0f} % of the truth's time"


def program_of(identity: Mapping[str, Any]) -> dict[str, str]:
    """Code, weights and library versions in a run's identity, by name, as short texts."""
    # a program is told by its code, its libraries and the weights of its networks
    code = digest([identity.get(name) for name in _CODE_ENTRIES], 8)
    libraries = {name: str(value) for name, value in identity.get("libraries", {}).items()}
    weights = {
        f"weights of {name}": str(value)[:8] for name, value in identity.get("weights", {}).items()
    }
    return {"code": code} | libraries | weights


class TrackerInfo(Record):
    """The tracker, as its spec described it; see `TrackerSpec`.

    Beside that `given`: what it was named by where its id alone does not find it,
    ``/path/file.py:Attr`` or ``module:Attr``; empty for an id. `folder` is that of the plug-in's
    file, where it is one.
    """

    id: str
    label: str
    version: str = ""
    distribution: str = ""
    provenance: str = "external"
    ranked: bool = True
    deterministic: bool = True
    license: str = ""
    citation: str = ""
    remarks: str = ""
    sensors: Literal["rgbd", "rgb"] = "rgbd"
    online: bool = True
    given: str = ""
    folder: str = ""


class SequenceInfo(Record):
    """The sequence.

    Attributes:
        id: Its id.
        content: Digest of its content.
        part: Digest of content and frames: names the folder with the stamps and the ground truth.
        block: Digest of what is filmed, camera, frames and stride, without the start offset and the
            noise seed: one column of a table. Empty for imported trajectories whose record does not
            say it.
        noise: Seed of the sensors' noise; None for the sequence's own.
        frames: Frames of the run's part.
        duration_s: Time between its first and last frame.
        fps: Nominal frame rate.
        ground_truth: Whether it has any.
        license: Licence of the data.
        citation: What to cite.
        tags: For example ``high-dynamic``, see `sequences.tags`.
        split: ``tune``, ``held-out`` or empty.
        thumbnails: Small pictures of a recording before a fixed camera, see `sequences.thumbnails`.
    """

    id: str
    content: str = ""
    part: Digest
    block: Annotated[str, Field(pattern=r"^([0-9a-f]{16})?$")] = ""
    noise: int | None = None
    frames: int
    duration_s: float
    fps: float
    ground_truth: bool
    license: str = ""
    citation: str = ""
    tags: list[str] = Field(default_factory=list)
    split: str = ""
    thumbnails: list[str] = Field(default_factory=list)


class StageTime(Record):
    """Wall-clock seconds a frame of one stage, over the tracked frames; frames on which it did not run count as 0."""

    median_s: float
    p95_s: float
    mean_s: float


class StartMap(Record):
    """The map of an earlier run, in which a run began.

    Attributes:
        digest: Digest of the map's content: runs that began in different maps are never repeats of
            each other.
        file: Where it lay.
        made_by: Which run made it, in words.
        keyframes: Keyframes that it brought.
        points: Points that it brought.
        localisation_only: Whether it stayed as it was.
    """

    digest: Digest
    file: str = ""
    made_by: str = ""
    keyframes: int
    points: int
    localisation_only: bool = False

    def describe(self) -> str:
        """One line: which map, of which run, and whether it stayed as it was."""
        size = f"{self.keyframes} keyframes, {self.points} points"
        origin = f" of {self.made_by}" if self.made_by else ""
        mode = ", localisation only" if self.localisation_only else ""
        return f"begun in the map {self.digest[:8]} ({size}){origin}{mode}: {self.file}"


class RunRecord(Record):
    """The outcome of a run.

    Attributes:
        schema_version: Version of this record's fields.
        kind: ``run`` (made here) or ``imported`` (a trajectory from elsewhere).
        run_id: Digest of `identity`.
        status: ``ok``; ``lost``: came to the end without being able to track it (see `reason`);
            ``crashed``, ``timeout``, ``out-of-memory``; ``invalid``: the tracker broke its
            contract; ``stopped``: ended early on request.
        reason: One line, empty for ``ok``.
        tracker: The tracker.
        overrides: The settings that were asked for, dotted name to value.
        settings: All settings, dotted name to value.
        sequence: The sequence.
        frames: Part of it; None for all.
        offset: So many leading frames of that part were left out.
        stride: Every so many frames.
        seed: Seed.
        device: Where it computed.
        threads: Threads it was given.
        realtime: Whether frames were dropped while the tracker was busy.
        drop_share: Share of the frames dropped at random.
        degrade: Degradation of the images.
        segmentation: Where the masks came from: ``oracle``, ``embedded``, ...; empty without a
            semantic stage.
        n_frames: Input frames.
        n_processed: Frames that the tracker saw.
        n_tracked: Frames with state ``ok``.
        n_lost: Frames with state ``lost``.
        n_initialising: Frames with state ``initialising``.
        n_dropped: Frames that never reached the tracker.
        coverage: ``n_tracked / n_frames``; None where the frames are not known, see
            `import_trajectory`.
        truth_share: Share of the ground truth's time that an imported trajectory has poses for,
            where its frames are not known; else None.
        keyframes: Keyframes at the end, None if the tracker does not say.
        map_points: Map points at the end, None if the tracker does not say.
        maps: Maps at the end that never met, those of their own begun after a loss among them; None
            if the tracker does not say.
        start_map: The map that the run began in; None for one that began without.
        epipolar_skipped: Share of the tracked frames on which the fundamental matrix was not used;
            None for systems without an epipolar test.
        mask_iou: Mean over frames of the overlap of the tracker's dynamic mask with the exact masks
            of people; None where either is missing.
        timings: Times of the stages, by stage; ``total`` is the frame time: segmentation included,
            decoding (``read``) excluded; ``processor`` the processor time of the run's own process
            in it; ``detector`` is a network beside it.
        finalize_s: Time of the final optimisation.
        started: UTC, ISO 8601.
        wall_s: Wall-clock time of the whole run.
        peak_memory_mb: Largest resident memory.
        peak_gpu_memory_mb: Largest GPU memory, None without one.
        machine: The computer.
        versions: Versions of Python and the packages that matter.
        git: Revision of the checkout.
        command: The command line of the parent process.
        identity: What `run_id` stands for.
        provenance: For imported trajectories: where it came from.
        place: Folder of the sequence where it was named by its path; empty for an id.
        stamps_match: Whether all poses carry the stamps of input frames; False only for imported
            trajectories.
        study: Study that made it, if it was not asked for without the study; else empty.
        notes: Anything a reader should know, one line each; those on the recording begin with
            `ON_RECORDING`.
        files: SHA-256 of the trajectories, the stamps and the ground truth, by the file's name.
    """

    schema_version: int = schema(RUN_SCHEMA)
    kind: Literal["run", "imported"] = "run"
    run_id: RunId
    status: Status
    reason: str = ""
    tracker: TrackerInfo
    overrides: dict[str, Any] = Field(default_factory=dict)
    settings: dict[str, Any] = Field(default_factory=dict)
    sequence: SequenceInfo
    frames: tuple[int, int | None] | None = None
    offset: int = 0
    stride: int = 1
    seed: int = 0
    device: str = ""
    threads: int = 1
    realtime: bool = False
    drop_share: float = 0.0
    degrade: dict[str, float] = Field(default_factory=dict)
    segmentation: str = ""
    n_frames: int
    n_processed: int = 0
    n_tracked: int = 0
    n_lost: int = 0
    n_initialising: int = 0
    n_dropped: int = 0
    coverage: float | None = Field(default=0.0, ge=0, le=1)
    truth_share: float | None = Field(default=None, ge=0, le=1)
    keyframes: int | None = None
    map_points: int | None = None
    maps: int | None = None
    start_map: StartMap | None = None
    epipolar_skipped: float | None = None
    mask_iou: float | None = None
    timings: dict[str, StageTime] = Field(default_factory=dict)
    finalize_s: float | None = None
    started: str = ""
    wall_s: float = 0.0
    peak_memory_mb: float | None = None
    peak_gpu_memory_mb: float | None = None
    machine: Machine | None = None
    versions: dict[str, str] = Field(default_factory=dict)
    git: GitRevision | None = None
    command: list[str] = Field(default_factory=list)
    identity: dict[str, Any] = Field(default_factory=dict)
    provenance: str = ""
    place: str = ""
    stamps_match: bool = True
    study: str = ""
    notes: list[str] = Field(default_factory=list)
    files: dict[str, str] = Field(default_factory=dict)

    def normalised(self) -> RunRecord:
        """The record as it reads after it was written: tuples inside settings are lists then."""
        return RunRecord.model_validate_json(self.to_json())

    @property
    def reads(self) -> Reads | None:
        """Digests of what the run's plug-ins and programs read; None for a run without such, or if not known."""
        stored = self.identity.get("reads")
        return None if stored is None else Reads.model_validate(stored)

    @property
    def verified(self) -> bool:
        """Whether its id tells content, code, weights and libraries; runs of older identity schemes do not."""
        return self.kind == "imported" or self.identity.get("scheme") == IDENTITY_SCHEME

    @property
    def program(self) -> dict[str, str]:
        """Code, weights and library versions that made the run, by name, as short texts."""
        made = program_of(self.identity) if self.kind == "run" else {}
        return made if self.verified else made | {"identity": "unverified"}

    @property
    def failed(self) -> bool:
        """Whether it did not come to its end."""
        return self.status in FAILED

    @property
    def incomplete(self) -> bool:
        """Whether it is known that frames have no pose."""
        return self.coverage is not None and self.coverage < 1

    @property
    def poses_words(self) -> str:
        """How much of the sequence has a pose: frames of all, or poses and time where the frames are not known."""
        if self.coverage is not None:
            return f"{self.n_tracked} of {self.n_frames} frames"
        share = coverage_text(None, self.truth_share)
        return f"{self.n_tracked} poses, {share}; the number of frames is not known"

    def public(self) -> RunRecord:
        """The record for others: without the command line and the folders of the machine that made it.

        The path of a replayed file and the command of a program are what their trackers are called,
        and stay.
        """
        tracker = self.tracker.model_copy(
            update={"given": Path(self.tracker.given).name, "folder": ""}
        )
        return self.model_copy(update={"command": [], "place": "", "tracker": tracker})

    @property
    def requested_settings(self) -> dict[str, Any]:
        """The settings that were asked for; in place of a map's path the digest of its content, as ``map``.

        Values are those that the run had, however they were spelled: ``"1"`` and ``1.0`` are one.
        """
        # the values that the run had
        asked = {name: self.settings.get(name, value) for name, value in self.overrides.items()}
        if self.start_map is None:
            return asked
        # a map counts by its content, wherever its file lies
        others = {
            name: value for name, value in asked.items() if not name.startswith("backend.map.")
        }
        others["map"] = self.start_map.digest[:8]
        if self.start_map.localisation_only:
            others["backend.map.localisation_only"] = True
        return others

    @property
    def trial_of(self) -> str:
        """The study that made it with settings of its own; empty for its runs with the default settings, and others."""
        return self.study if self.requested_settings else ""

    @property
    def repeat(self) -> str:
        """Name of the repeat of its block that the run is, e.g. ``seed 0, offset 2``."""
        words = [f"seed {self.seed}"]
        if self.offset:
            words.append(f"offset {self.offset}")
        if self.sequence.noise is not None:
            words.append(f"noise {self.sequence.noise}")
        return ", ".join(words)

    @property
    def frame_time_s(self) -> float | None:
        """Median time a frame in seconds, segmentation included, decoding excluded."""
        total = self.timings.get("total")
        return None if total is None else total.median_s

    @property
    def real_time_factor(self) -> float | None:
        """Sensor's frame interval over the mean frame time: above 1 the tracker keeps up."""
        total = self.timings.get("total")
        if total is None or total.mean_s <= 0:
            return None
        return 1.0 / (self.sequence.fps * total.mean_s)

    def describe(self) -> str:
        """One line: tracker, sequence, seed, status, coverage, frame time."""
        parts = [
            f"{self.run_id}  {self.tracker.id} on {self.sequence.id}, {self.repeat}: {self.status}"
        ]
        parts.append(f"coverage {coverage_text(self.coverage, self.truth_share)}")
        if self.frame_time_s is not None:
            parts.append(f"{1000 * self.frame_time_s:.1f} ms a frame")
        return ", ".join(parts) + (f" ({self.reason})" if self.reason else "")


class MetricRecord(Record):
    """The errors of one run under one protocol.

    Attributes:
        schema_version: Version of this record's fields.
        run_id: The run.
        protocol_id: Id of the protocol.
        protocol_digest: Its digest; numbers of different digests are not comparable.
        code: Digest of the evaluation code that computed them.
        trajectory: Which of the two the protocol asks for.
        online: Evaluation of the online trajectory; None if it cannot be evaluated.
        final: Evaluation of the final trajectory; None if there is none or it cannot be evaluated.
        reasons: Why an evaluation is missing, by ``online`` and ``final``.
        hints: What is probably wrong with the trajectory that the protocol asks for, a line each;
            see `hints`.
    """

    schema_version: int = schema(METRIC_SCHEMA)
    run_id: RunId
    protocol_id: str
    protocol_digest: str
    code: str = ""
    trajectory: Literal["online", "final"] = "online"
    online: Evaluation | None = None
    final: Evaluation | None = None
    reasons: dict[str, str] = Field(default_factory=dict)
    hints: list[str] = Field(default_factory=list)

    @property
    def primary(self) -> Evaluation | None:
        """The evaluation of the trajectory that the protocol asks for."""
        return self.online if self.trajectory == "online" else self.final

    @property
    def remarks(self) -> list[str]:
        """Warnings on the primary evaluation, then hints, one a line."""
        warnings = [] if self.primary is None else self.primary.warnings
        return [
            *(f"warning: {line}" for line in warnings),
            *(f"hint: {line}" for line in self.hints),
        ]

    @property
    def metrics(self) -> dict[str, float]:
        """The primary evaluation's metrics; empty if there is none."""
        return {} if self.primary is None else self.primary.metrics
