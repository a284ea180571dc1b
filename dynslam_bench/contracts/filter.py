"""The contract of all dynamic feature filters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera

Need = Literal[
    "masks", "boxes", "depth", "previous", "flow", "prediction", "keyframes", "map_points"
]
"""An input that a filter asks for; `FilterState` and `FrameBundle` hold it."""


@dataclass(eq=False)
class FrameBundle:
    """Everything known about one frame before it is tracked.

    Attributes:
        index: Index in the sequence.
        timestamp: Seconds.
        rgb: uint8 ``[H, W, 3]``.
        gray: uint8 ``[H, W]``.
        depth: float32 ``[H, W]`` metres, 0 missing.
        keypoints: The frame's features, raw (distorted) pixels.
        xy: float64 ``[N, 2]``, undistorted pixels of the keypoints.
        z: float32 ``[N]``, depth at the keypoints, metres, 0 missing.
        instances: What the segmenter found; None if no segmenter ran.
        mask: bool ``[H, W]``, the pixels held for dynamic because of what they show, dilated; None
            if nobody asked.
    """

    index: int
    timestamp: float
    rgb: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    depth: NDArray[np.float32]
    keypoints: Keypoints
    xy: NDArray[np.float64]
    z: NDArray[np.float32]
    instances: Instances | None = None
    mask: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True, eq=False)
class KeyframeView:
    """The part of a keyframe that a filter may read.

    Attributes:
        T_world_cam: Camera-to-world pose ``[4, 4]``.
        keypoints: Its features (raw pixels).
        xy: float64 ``[N, 2]`` undistorted pixels; of a rolling shutter as the middle row's camera
            would have seen them.
        z: float32 ``[N]`` depth at the keypoints in metres, 0 missing; of a rolling shutter as the
            middle row's camera would have measured it.
        depth: float32 ``[H, W]`` metres, or None where the keyframe no longer keeps its image.
        timestamp: Seconds.
    """

    T_world_cam: NDArray[np.float64]
    keypoints: Keypoints
    xy: NDArray[np.float64]
    z: NDArray[np.float32]
    depth: NDArray[np.float32] | None
    timestamp: float = 0.0


@dataclass(eq=False)
class FilterState:
    """Input of all filters of a pipeline beside the frame itself: poses, the previous frame, flow and the map.

    Attributes:
        camera: Intrinsics (with the raw images' distortion).
        keep: bool ``[N]``, keypoints that earlier filters kept.
        previous: The previous frame, None on the first.
        previous_keep: bool, which keypoints of the previous frame were kept.
        T_world_prev: Pose of the previous frame, None if it was not tracked.
        T_world_pred: Pose predicted for this frame by the motion model; None without one, and while
            the camera is lost.
        motion_covariance: Covariance ``[6, 6]`` of the predicted motion since the previous frame:
            position in the world (m), rotation in the camera's frame (rad); None where the motion
            model knows nothing.
        flow: Flow of this frame's keypoints *to the previous image* (raw pixels); None until the
            flow stage ran.
        keyframes: The latest keyframes of the map that the camera is in, newest first.
        map_points: int64 ``[M]`` ids and float64 ``[M, 3]`` positions of that map's points, or
            None.
        seed: Seed of everything random a filter does on this frame.
    """

    camera: Camera
    keep: NDArray[np.bool_]
    previous: FrameBundle | None = None
    previous_keep: NDArray[np.bool_] | None = None
    T_world_prev: NDArray[np.float64] | None = None
    T_world_pred: NDArray[np.float64] | None = None
    motion_covariance: NDArray[np.float64] | None = None
    flow: FlowResult | None = None
    keyframes: tuple[KeyframeView, ...] = ()
    map_points: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None
    seed: int = 0

    @cached_property
    def flow_xy(self) -> NDArray[np.float64]:
        """Undistorted pixels ``[N, 2]`` in the previous image to which the flow leads; asked when the flow has run."""
        assert self.flow is not None
        return self.camera.undistort_points(self.flow.xy)


@dataclass(frozen=True, eq=False)
class FilterResult:
    """A filter's verdict.

    Attributes:
        keep: bool ``[N]``; False = dynamic. A filter only judges; what earlier filters dropped
            stays dropped.
        weight: float32 ``[N]`` in [0, 1], confidence that the point is static: scales what the
            point tells the pose optimiser, and with it, as in g2o, the error at which it counts as
            an outlier.
        stats: Counts and reasons, e.g. ``{"dropped": 41.0, "degenerate": 0.0}``; the same keys on
            every frame. A filter that tests against a fundamental matrix says with ``f_asked`` (1
            where there was something to test) and ``f_judged`` (1 where the matrix was used) on how
            many frames it did.
        mask: bool ``[H, W]`` of pixels that the filter holds for dynamic, where it has an opinion
            on pixels.
    """

    keep: NDArray[np.bool_]
    weight: NDArray[np.float32]
    stats: Mapping[str, float] = field(default_factory=dict)
    mask: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls,
        keep: NDArray[np.bool_] | np.bool_,
        stats: Mapping[str, float] | None = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> FilterResult:
        """From a keep mask ``[N]``: weights 1 (kept) and 0 (dropped); `stats` gains ``dropped``.

        Args:
            keep: bool ``[N]``.
            stats: Further counts.
            mask: bool ``[H, W]``, see the class.
        """
        kept = np.asarray(keep, dtype=bool)
        counts = {"dropped": float(np.count_nonzero(~kept)), **(stats or {})}
        return cls(kept, kept.astype(np.float32), counts, mask)


@runtime_checkable
class DynamicFilter(Protocol):
    """Judges which keypoints lie on moving things.

    Attributes:
        name: Short name, the prefix of its stats.
        needs: What must be there for it to work; `FilterState` fields that are None make it keep
            all.
        stats_names: Names of the stats that every verdict holds, with the ``dropped`` that
            `FilterResult.of` adds.
    """

    name: str
    needs: frozenset[Need]
    stats_names: tuple[str, ...] = ("dropped",)

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups of a system's settings that it takes: its own, and ``segmentation`` where it looks at objects."""
        own = getattr(self, "group", self.name)
        return (own, "segmentation") if hasattr(self, "segmentation") else (own,)

    def configure(self, settings: Settings) -> None:
        """Put settings of one of its groups into force from the next frame on."""
        of_objects = hasattr(self, "segmentation") and isinstance(settings, type(self.segmentation))
        setattr(self, "segmentation" if of_objects else "settings", settings)

    def reset(self, camera: Camera) -> None:
        """Forget everything: a new sequence begins."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Judge the frame's keypoints; never raises on degenerate input, says so in `stats` instead."""
