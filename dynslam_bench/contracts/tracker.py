"""The tracker protocol and the light spec that announces a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry.camera import Camera

from .provenance import Provenance as Provenance
from .result import TrackResult
from .sequence import Frame, MaskSource


@runtime_checkable
class Tracker(Protocol):
    """A SLAM or odometry system that is fed one frame at a time.

    Optional methods, found by name: ``finalize() -> Trajectory`` (as it is after the last optimisation of the map; runs
    ask once, at the end, `SlamEnv.final_trajectory` after any frame, and a tracker that cannot go on then says so),
    ``map_outputs() -> MapOutputs`` (keyframes and map points, for ``keyframes.csv`` and ``map.ply``),
    ``save_map(path, made_by)`` (the map as a file from which a later run may start) and ``close()``.
    """

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence; all randomness must come from `rng`."""
        ...

    def track(self, frame: Frame) -> TrackResult:
        """Process one frame and return its camera-to-world pose, causally: later frames change nothing."""
        ...


@dataclass(frozen=True)
class TrackerContext:
    """What a tracker may be told of where it runs; never the ground-truth poses.

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
        entry_point: ``"module:factory"``; the factory is called as ``factory(settings)`` or, if it has a parameter of
            that name, ``factory(settings, context=TrackerContext(...))``.
        label: Shown in tables, e.g. ``ORB-SLAM2 (our back end)``.
        settings: Class of its settings; the default instance is the default configuration.
        summary: One line.
        sensors: What it looks at: ``rgbd``; or ``rgb``, colour alone: it runs without depth, and the unit of length of
            its poses is its own, so that it is scored under protocols with Sim(3) alignment only.
        deterministic: Same seed, same bits.
        provenance: How closely it follows its source.
        ranked: Whether leaderboards rank it by default.
        presets: Named overrides, dotted name to value.
        version: Of the tracker, part of a run's identity.
        license: SPDX id or remark.
        citation: What to cite.
        assumptions: What was assumed where the source is silent.
        requires: Modules that must be importable, each with the command that installs it.
        reported: Numbers that its authors report: sequence id to metric to value.
        published_as: Names under which the product's own table of published numbers lists it, each with its source.
        remarks: Name collisions and known limits, e.g. "marks nothing as lost".
        parameter: Name of the setting that takes what follows the id in ``id:value`` (``replay:FILE``); empty if the
            tracker takes none.
        bound: Settings fixed by the way it was named, dotted name to value; ``TRACKERS.get("id:value")`` fills it in.
        check: ``"module:function"``; the function returns an install hint if the tracker cannot run here although all
            of `requires` can be imported, else an empty string.
        files: ``"module:function"``; called with the settings, the function returns the files whose content decides
            what the tracker does and that no setting names by itself, for a run's identity; empty if there are none.
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
    bound: Mapping[str, Any] = field(default_factory=dict)
    check: str = ""
    files: str = ""

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
