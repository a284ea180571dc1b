"""The tracker protocol and the light spec that announces a tracker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Frame, MaskSource
from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera


@runtime_checkable
class Tracker(Protocol):
    """A SLAM or odometry system that is fed one frame at a time.

    Optional methods, found by name: ``finalize() -> Trajectory`` (as it is after the last
    optimisation of the map; runs ask once, at the end, `SlamEnv.final_trajectory` after any frame,
    and a tracker that cannot go on then says so), ``map_outputs() -> MapOutputs`` (keyframes and
    map points, for ``keyframes.csv`` and ``map.ply``), ``save_map(path, made_by)`` (the map as a
    file from which a later run may start) and ``close()``.
    """

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; all randomness must come from `rng`."""

    def track(self, frame: Frame) -> TrackResult:
        """Process one frame and return its camera-to-world pose, causally: later frames change nothing.

        The frame's images cannot be written.
        """


@dataclass(frozen=True)
class TrackerContext:
    """Facts of the run that a tracker may use; never the ground-truth poses.

    Attributes:
        sequence_id: Id of the sequence, for presets and `segmentation.source = auto`.
        masks: Exact masks of the sequence, for oracles only; None where there are none.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads it may use.
        fps: Nominal frame rate of the sequence.
        cache: Folder of the stage cache; None to compute everything.
    """

    sequence_id: str = ""
    masks: MaskSource | None = None
    device: str = "cpu"
    threads: int = 1
    fps: float = 30.0
    cache: str | None = None


@dataclass(frozen=True)
class TrackerSpec:
    """Announces a tracker; importable without torch or OpenCV.

    Attributes:
        id: For example ``orb-slam2``.
        entry_point: ``"module:factory"``; the factory is called as ``factory(settings)`` or, if it
            has a parameter of that name, ``factory(settings, context=TrackerContext(...))``.
        label: Shown in tables, e.g. ``ORB-SLAM2 (our back end)``.
        settings: Class of its settings; the default instance is the default configuration.
        summary: One line.
        sensors: What it looks at: ``rgbd``; or ``rgb``, colour alone: it runs without depth, and
            the unit of length of its poses is its own, so that it is scored under protocols with
            Sim(3) alignment only.
        deterministic: Whether two runs with the same seed give the same poses to the bit.
        provenance: How closely it follows its source.
        ranked: Whether leaderboards rank it by default.
        presets: Named overrides, dotted name to value.
        version: Version of the tracker, part of a run's identity.
        license: SPDX id or remark.
        citation: What to cite.
        assumptions: What was assumed where the source is silent.
        requires: Modules that must be importable, each with the command that installs it.
        reported: Numbers that its authors report: sequence id to metric to value.
        published_as: Names under which the product's own table of published numbers lists it, each
            with its source.
        remarks: Name collisions and known limits, e.g. "marks nothing as lost".
        parameter: Name of the setting that takes what follows the id in ``id:value``
            (``replay:FILE``); empty if the tracker takes none.
        fixed_settings: Settings that its id fixes, dotted name to value; the registry fills it in:
            ``replay:FILE`` fixes the file.
        check: ``"module:function"``; the function returns an install hint if the tracker cannot run
            here although all of `requires` can be imported, else an empty string.
        online: Whether it gives poses frame by frame; of a batch program only the final trajectory
            exists.
        describe: ``"module:function"``; called with the text behind ``id:``, the function returns
            what the file of that name tells of this spec, by field (settings and presets, for
            example); empty if it names no such file, or there is no function.
        files: ``"module:function"``; called with the settings, the function returns the files whose
            content decides what the tracker does and that no setting names by itself, for a run's
            identity; empty if there are none.
    """

    id: str
    entry_point: str
    label: str
    settings: type[Settings] = Settings
    summary: str = ""
    sensors: Literal["rgbd", "rgb"] = "rgbd"
    deterministic: bool = True
    provenance: Provenance = "external"
    ranked: bool = True
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    version: str = "1"
    license: str = ""
    citation: str = ""
    assumptions: tuple[str, ...] = ()
    requires: Mapping[str, str] = field(default_factory=dict)
    reported: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    published_as: tuple[str, ...] = ()
    remarks: str = ""
    parameter: str = ""
    fixed_settings: Mapping[str, Any] = field(default_factory=dict)
    check: str = ""
    files: str = ""
    online: bool = True
    describe: str = ""

    @property
    def metric(self) -> bool:
        """Whether its poses are in metres."""
        return self.sensors == "rgbd"

    def missing(self) -> list[str]:
        """Install hints of what is required but not there; empty if the tracker can run."""
        from importlib.util import find_spec

        hints = [hint for module, hint in self.requires.items() if find_spec(module) is None]
        if hints or not self.check:
            return hints
        hint = load_object(self.check)()
        return [hint] if hint else []


# What tracking one frame gives.

TrackingState = Literal["initialising", "ok", "lost"]
"""A pose that is given with `lost` is a prediction and enters no trajectory."""


@dataclass(frozen=True, eq=False)
class TrackResult:
    """One frame's outcome.

    Attributes:
        T_world_cam: Camera-to-world pose, float64 ``[4, 4]``; None if the tracker has none. A pose
            given while `state` is ``lost`` is a prediction and enters no trajectory.
        state: ``ok`` (tracked), ``lost`` or ``initialising``.
        stats: Diagnostics, plain floats, the same keys on every frame of a tracker. Keys the
            environment knows: ``keypoints``, ``culled``, ``matches``, ``inliers``, ``map_points``,
            ``keyframes``, ``keyframe`` (1 on frames that became keyframes), ``residual_px``,
            ``mask_fraction``.
        timings: Seconds by stage, in the order of the pipeline (``features``, ``segmentation``,
            ``flow``, ...).
        dynamic_mask: bool ``[H, W]``, pixels held for dynamic, or None.
        keypoints_xy: float32 ``[N, 2]``, raw pixels of the features, for rendering; or None.
        keypoints_keep: bool ``[N]``, which of them were kept; or None.
        motion_covariance: Covariance float64 ``[6, 6]`` of the motion ``T_prev_cur`` from the last
            frame with a pose to this one: of the twist (translation in metres, rotation in radians)
            in ``T_true = T_estimated Exp(twist)``; None if the tracker does not know how sure it
            is. It is scored, and changes no pose.
    """

    T_world_cam: NDArray[np.float64] | None
    state: TrackingState
    stats: Mapping[str, float] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    dynamic_mask: NDArray[np.bool_] | None = None
    keypoints_xy: NDArray[np.float32] | None = None
    keypoints_keep: NDArray[np.bool_] | None = None
    motion_covariance: NDArray[np.float64] | None = None


def stage_seconds(timings: Sequence[Mapping[str, float]]) -> dict[str, NDArray[np.float64]]:
    """Seconds ``[N]`` of every stage over N frames, 0 where it did not run."""
    stages = dict.fromkeys(stage for frame in timings for stage in frame)
    return {stage: np.array([frame.get(stage, 0.0) for frame in timings]) for stage in stages}


# How closely a re-implementation follows its source.

Provenance = Literal[
    "own", "faithful-code", "faithful-paper", "inspired", "assumed", "external", "control"
]
"""``faithful-code``: as the authors' code does; ``faithful-paper``: as the paper says; ``inspired``: its idea in
another form; ``assumed``: the source is silent on what matters; ``own``: put together here, no one
paper or program describes the whole; ``external``: another project's program;
``control``: a reference, no system."""


# What a tracker's map looks like from outside.


@dataclass(frozen=True, eq=False)
class KeyframeRecord:
    """One keyframe.

    Attributes:
        id: Number in order of creation.
        frame: Index of its frame; -1 for one of an earlier run, in whose map this one began.
        timestamp: Seconds; NaN for one of an earlier run.
        T_world_cam: Camera-to-world pose ``[4, 4]``.
        features: Features it holds.
        observations: Map points it observes.
        map: 0 for the map that the trajectory is in; another number for one that began after a loss
            and never met it.
    """

    id: int
    frame: int
    timestamp: float
    T_world_cam: NDArray[np.float64]
    features: int
    observations: int
    map: int = 0


@dataclass(frozen=True, eq=False)
class MapOutputs:
    """Keyframes, oldest first, and map points.

    Attributes:
        keyframes: All keyframes.
        ids: int64 ``[M]`` ids of the points; of maps that never met the first one none: where they
            lie is unknown.
        positions: float64 ``[M, 3]`` world coordinates, metres.
        colours: uint8 ``[M, 3]`` red, green, blue.
        observations: int64 ``[M]``, keyframes that observe each point.
    """

    keyframes: tuple[KeyframeRecord, ...]
    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observations: NDArray[np.int64]
