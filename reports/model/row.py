"""One row a run: what the report knows of it, whether it was made here, imported or only reported."""

from __future__ import annotations

import json
from functools import cached_property
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.conditioning import RELIABLE_DEG

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
        held_ate_m: The ATE with lost frames held at the last tracked pose, which ranks; None without evaluation.
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
    held_ate_m: float | None = None
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
            return None if static_m is None else max(static_m, self.held_ate_m or 0.0)
        return self.held_ate_m if self.held_ate_m is not None else self.metrics.get("ate_rmse_m")

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
