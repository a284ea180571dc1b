"""The frame pipeline of a visual SLAM system for dynamic scenes (paper, Figure 2), from top to bottom.

Every published system runs this file; it differs only in its list of filters, its flow and its settings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.checks import check_frame
from dynslam_bench.contracts.features import FeatureExtractor, Keypoints, MaskedExtractor
from dynslam_bench.contracts.filter import DynamicFilter, FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowEstimator, stats_names_of
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import MapOutputs, TrackResult
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.seeding import derive_seed, stream
from dynslam_bench.core.settings import OnlineSettings, Reconfigurable, Settings
from dynslam_bench.culling.ego_motion import refine_prediction
from dynslam_bench.culling.guard import GuardSettings
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.segmentation.postprocess import dynamic_mask
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.slam.backend import BackendResult, RgbdBackend
from dynslam_bench.slam.stages import CachedStage, CullingResult, StageClock, combine_verdicts, flow_to_previous

FILTER_KEYFRAMES = 20
"""Latest keyframes that filters may read (DynaSLAM's window)."""


class MaskStage(Protocol):
    """Gives each frame its instances: by a network, from a file, or carried over from an earlier frame.

    Attributes:
        segmented: Whether the latest frame's instances are fresh, not carried over.
    """

    segmented: bool

    def masks_for(self, frame: Frame, gray: NDArray[np.uint8], *, keyframe: bool) -> Instances:
        """The objects in the frame; `keyframe` says that the previous frame asked for a fresh segmentation."""
        ...


@dataclass(frozen=True, eq=False)
class PreviousFrame:
    """What filters and flow read of the frame before.

    Attributes:
        frame: The frame.
        keep: bool ``[N]``, its static keypoints.
        image: Its image as the flow prepared it; None if no flow ran.
        T_world_cam: Its pose, None if it was not tracked.
    """

    frame: FrameBundle
    keep: NDArray[np.bool_]
    image: Any
    T_world_cam: NDArray[np.float64] | None


class SlamPipeline:
    """A tracker: segmentation, features, culling, flow, tracking and mapping, one frame at a time.

    Args:
        extractor: Extracts the keypoints; a `MaskedExtractor` extracts enough of them outside the dynamic mask.
        masks: Segmentation stage; None for systems without semantics.
        filters: Dynamic feature filters in the order of application.
        flow: Flow of the keypoints that are left to the previous image; run before the first filter that needs it.
        backend: Tracking and mapping.
        settings: The system's complete settings; their group ``guard`` says what the filters must leave.
        cached: Stages that answer from the stage cache, by name (``features``, ``segmentation``); their times are
            reported as they are without it, and ``cached_stages`` in `stats` says how many answered from it.

    Raises:
        TrackerError: A filter needs a flow and there is none.
        SettingsError: No part takes an online setting that has an effect.
    """

    def __init__(
        self,
        *,
        extractor: FeatureExtractor,
        masks: MaskStage | None,
        filters: Sequence[DynamicFilter],
        flow: FlowEstimator | None,
        backend: RgbdBackend,
        settings: Settings,
        cached: Mapping[str, CachedStage] | None = None,
    ) -> None:
        needing = [f.name for f in filters if "flow" in f.needs]
        if needing and flow is None:
            raise TrackerError(f"filter '{needing[0]}' needs an optical flow, the system has none")
        self._extractor = extractor
        self._masks = masks
        self._filters = tuple(filters)
        self._flow = flow
        self._backend = backend
        self._guard: GuardSettings = getattr(settings, "guard", GuardSettings())
        self._segmentation: SegmentationSettings | None = getattr(settings, "segmentation", None)
        self._online = OnlineSettings(settings, self._configurable_parts(settings))
        self._cached = dict(cached or {})
        self._camera: Camera | None = None

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence with the settings that the system was built with."""
        self._online.restore()
        self._camera = camera
        self._seed = derive_seed(rng)
        self._backend.reset(camera, seed=self._seed)
        for part in (*self._filters, self._masks):
            if part is not None and hasattr(part, "reset"):
                part.reset(camera)
        self._previous: PreviousFrame | None = None
        self._keyframe_due = True

    # ------------------------------------------------------------------ one frame

    def track(self, frame: Frame) -> TrackResult:
        """Track one frame.

        Raises:
            TrackerError: `reset` was not called.
            SequenceError: The frame does not fit the camera (see `check_frame`).
        """
        camera = self._require_reset("track")
        check_frame(frame, camera)
        if not self._backend.uses_depth:
            frame = replace(frame, depth=np.zeros((camera.height, camera.width), np.float32))
        clock = StageClock(self._cached)
        self._backend.resume()  # filters read the map as it was before a `finalize`
        gray, depth = _prepare(frame)
        instances, mask = self._segment(frame, gray, depth, clock)
        keypoints = self._extract(gray, mask, clock)
        xy, z = _undistorted(keypoints, depth, camera)
        bundle = FrameBundle(frame.index, frame.timestamp, frame.rgb, gray, depth, keypoints, xy, z, instances, mask)
        state = self._filter_state(bundle, camera)
        static = self._cull(bundle, state, clock)
        result = self._backend.track(bundle, static.keep, static.weight)
        self._remember(bundle, static, result)
        timings = clock.seconds | dict(result.timings)
        stats = self._stats(bundle, state, static, result)
        return TrackResult(
            result.T_world_cam, result.state, stats, timings, static.mask, bundle.keypoints.xy, static.keep
        )

    def _segment(
        self, frame: Frame, gray: NDArray[np.uint8], depth: NDArray[np.float32], clock: StageClock
    ) -> tuple[Instances | None, NDArray[np.bool_] | None]:
        """The objects in the image, and the mask of those that are dynamic because of their class."""
        if self._masks is None:
            return None, None
        with clock("segmentation"):
            instances = self._masks.masks_for(frame, gray, keyframe=self._keyframe_due)
            if self._segmentation is None or not len(instances):
                return instances, None
            return instances, dynamic_mask(instances, self._segmentation, depth)

    def _extract(self, gray: NDArray[np.uint8], mask: NDArray[np.bool_] | None, clock: StageClock) -> Keypoints:
        """Keypoints, enough of them outside the dynamic mask."""
        with clock("features"):
            if mask is None or self._segmentation is None or not isinstance(self._extractor, MaskedExtractor):
                return self._extractor.extract(gray)
            return self._extractor.extract_masked(gray, mask, self._segmentation.outside_share)

    def _filter_state(self, bundle: FrameBundle, camera: Camera) -> FilterState:
        """What filters may read beside the frame: the previous frame, the prediction and the map."""
        previous, backend = self._previous, self._backend
        return FilterState(
            camera=camera,
            keep=np.ones(len(bundle), dtype=bool),
            previous=None if previous is None else previous.frame,
            previous_keep=None if previous is None else previous.keep,
            T_world_prev=None if previous is None else previous.T_world_cam,
            T_world_pred=backend.predict(bundle.timestamp),
            motion_covariance=backend.motion_covariance(bundle.timestamp),
            keyframes=backend.keyframe_views(FILTER_KEYFRAMES),
            map_points=backend.map_points(),
            seed=int(stream(self._seed, "frame", bundle.index).integers(2**63)),
        )

    def _cull(self, bundle: FrameBundle, state: FilterState, clock: StageClock) -> CullingResult:
        """The filters' verdicts in order; the flow runs on what is left when the first filter needs it."""
        image: Any = None
        verdicts = []
        for dynamic_filter in self._filters:
            if "flow" in dynamic_filter.needs and image is None:
                image = self._run_flow(bundle, state, clock)
            with clock(f"culling_{dynamic_filter.name}"):
                verdict = dynamic_filter.apply(bundle, state)
            state.keep = state.keep & verdict.keep
            verdicts.append((dynamic_filter.name, verdict))
        return combine_verdicts(verdicts, len(bundle), image, self._guard)

    def _run_flow(self, bundle: FrameBundle, state: FilterState, clock: StageClock) -> Any:
        """Put the flow to the previous image, and the pose that it predicts, into `state`; the prepared image."""
        assert self._flow is not None  # checked in the constructor
        with clock("flow"):
            image = self._flow.prepare(bundle.gray)
            if (previous := self._previous) is not None:
                other = self._flow.prepare(previous.frame.gray) if previous.image is None else previous.image
                state.flow = flow_to_previous(self._flow, image, other, bundle, state)
        with clock("ego_motion"):
            state.T_world_pred = refine_prediction(bundle, state)
        return image

    def _remember(self, bundle: FrameBundle, static: CullingResult, result: BackendResult) -> None:
        tracked = result.state == "ok"
        in_root_map = tracked and self._backend.state == "ok"  # predictions of a submap are of another world
        pose = result.T_world_cam if in_root_map else None
        self._previous = PreviousFrame(bundle, static.keep, static.image, pose)
        self._keyframe_due = not tracked or result.keyframe

    def _stats(
        self, bundle: FrameBundle, state: FilterState, static: CullingResult, result: BackendResult
    ) -> dict[str, float]:
        """The frame's diagnostics, the same keys on every frame."""
        names = ("matches", "inliers", "map_points", "keyframes", "keyframe", "maps", "loops", "residual_px")
        stats = {
            "keypoints": float(len(bundle)),
            "culled": float(np.count_nonzero(~static.keep)),
            **{name: float(getattr(result, name)) for name in names},
            "mask_fraction": 0.0 if static.mask is None else float(static.mask.mean()),
            "relocalised": float(result.relocalised),
            **static.stats,
            "guard_undone": float(static.undone),
        }
        if self._flow is not None:
            flow_stats = {} if state.flow is None else state.flow.stats
            stats |= {f"flow_{name}": flow_stats.get(name, 0.0) for name in stats_names_of(self._flow)}
        if self._masks is not None:
            stats["segmented"] = float(self._masks.segmented)
        if self._cached:
            stats["cached_stages"] = float(sum(stage.hit for stage in self._cached.values()))
        return stats

    # ------------------------------------------------------------------ outputs and settings

    def finalize(self) -> Trajectory:
        """The trajectory after the last optimisation of the map.

        Raises:
            TrackerError: `reset` was never called.
        """
        self._require_reset("finalize")
        return self._backend.finalize()

    def map_outputs(self) -> MapOutputs:
        """Keyframes and map points, for ``keyframes.csv``, ``map.ply`` and the sheet.

        Raises:
            TrackerError: `reset` was never called.
        """
        self._require_reset("map_outputs")
        return self._backend.outputs()

    def save_map(self, path: Path, made_by: str = "") -> None:
        """Write the map to a file from which a later run may start (setting ``backend.map.file``).

        Args:
            path: The file.
            made_by: Which run made it, in words.

        Raises:
            TrackerError: `reset` was never called, there is no map yet, or it is too large for a file.
            DynslamError: The file cannot be written.
        """
        self._require_reset("save_map")
        self._backend.save_map(path, made_by)

    def configure(self, settings: Settings) -> None:
        """Put other values of online settings into force from the next frame on; `reset` undoes it.

        Args:
            settings: The complete settings, of which only online fields differ from those it was built with.
        """
        self._online.configure(settings)

    def _configurable_parts(self, settings: Settings) -> Iterator[tuple[str, Callable[[Any], None]]]:
        """Each group of the settings with every part that takes it."""
        parts: list[tuple[str, Any]] = [(group, part) for part in self._filters for group in groups_of(part)]
        parts += [
            ("features", self._extractor),
            ("segmentation", self._masks),
            ("flow", self._flow),
            ("backend", self._backend),
        ]
        for group, part in parts:
            if isinstance(part, Reconfigurable) and hasattr(settings, group):
                yield group, part.configure
        if hasattr(settings, "guard"):
            yield "guard", lambda guard: setattr(self, "_guard", guard)
        if self._segmentation is not None:
            yield "segmentation", lambda segmentation: setattr(self, "_segmentation", segmentation)

    def _require_reset(self, method: str) -> Camera:
        if self._camera is None:
            raise TrackerError(f"{method}() was called before reset()")
        return self._camera


def groups_of(dynamic_filter: DynamicFilter) -> tuple[str, ...]:
    """The groups of settings that a filter takes; its name alone where it does not say."""
    return tuple(getattr(dynamic_filter, "groups", (dynamic_filter.name,)))


def _prepare(frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The grey image, and a copy of the depth image in metres, 0 where depth is missing or not finite."""
    gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    depth = np.array(frame.depth, dtype=np.float32)
    if not np.isfinite(depth).all():
        depth[~np.isfinite(depth)] = 0
    return gray, depth


def _undistorted(
    keypoints: Keypoints, depth: NDArray[np.float32], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Undistorted pixels of keypoints, and the depth there."""
    column, row = np.rint(keypoints.xy).astype(np.intp).T
    z = depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].clip(min=0)
    return camera.undistort_points(keypoints.xy), z
