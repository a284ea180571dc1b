"""The way of one frame through a visual SLAM system for dynamic scenes (paper, Figure 2), top to bottom.

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

KEYFRAMES_SHOWN = 20
"""How many of the latest keyframes filters may look at (DynaSLAM's window)."""


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
    """What the next frame is told of this one.

    Attributes:
        frame: The frame.
        keep: bool ``[N]``, which of its keypoints were kept.
        image: Its image as the flow prepared it; None if no flow ran.
        T_world_cam: Its pose, None if it was not tracked.
    """

    frame: FrameBundle
    keep: NDArray[np.bool_]
    image: Any
    T_world_cam: NDArray[np.float64] | None


class SlamPipeline:
    """A tracker: features, masks, culling, flow, culling, tracking and mapping, one frame at a time.

    Args:
        extractor: Finds the keypoints; a `MaskedExtractor` sees to it that people take no place of the room's.
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
        self._objects: SegmentationSettings | None = getattr(settings, "segmentation", None)
        self._steering = OnlineSettings(settings, self._takers(settings))
        self._cached = dict(cached or {})
        self._camera: Camera | None = None

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence with the settings that the system was built with."""
        self._steering.restore()
        self._camera = camera
        self._seed = derive_seed(rng)
        self._backend.reset(camera, seed=self._seed)
        for each in (*self._filters, self._masks):
            if each is not None and hasattr(each, "reset"):
                each.reset(camera)
        self._previous: PreviousFrame | None = None
        self._keyframe_due = True

    # ------------------------------------------------------------------ one frame

    def track(self, frame: Frame) -> TrackResult:
        """Track one frame.

        Raises:
            TrackerError: `reset` was not called.
            SequenceError: The frame is none of this camera (see `check_frame`).
        """
        camera = self._begun("track")
        check_frame(frame, camera)
        if not self._backend.uses_depth:
            frame = replace(frame, depth=np.zeros((camera.height, camera.width), np.float32))
        clock = StageClock(self._cached)
        self._backend.mapper.resume()  # filters see the map as it was before a `finalize`
        seen = self._see(frame, camera, clock)
        culled = self._cull(seen, self._known(seen, camera), clock)
        pnp_poses = self._backend.track(seen, culled.keep, culled.weight)
        self._remember(seen, culled, pnp_poses)
        return TrackResult(
            pnp_poses.T_world_cam,
            pnp_poses.state,
            self._stats(seen, culled, pnp_poses),
            clock.seconds | dict(pnp_poses.timings),
            culled.mask,
            seen.keypoints.xy,
            culled.keep,
        )

    def _see(self, frame: Frame, camera: Camera, clock: StageClock) -> FrameBundle:
        """The objects in the image, and keypoints with their depth, enough of them outside the objects."""
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        depth = _own_depth(frame.depth)
        instances = mask = None
        if self._masks is not None:
            with clock("segmentation"):
                instances = self._masks.masks_for(frame, gray, keyframe=self._keyframe_due)
                if self._objects is not None and len(instances):
                    mask = dynamic_mask(instances, self._objects, depth)
        with clock("features"):
            keypoints = self._extract(gray, mask)
        column, row = np.rint(keypoints.xy).astype(np.intp).T
        z = depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].clip(min=0)
        xy = camera.undistort_points(keypoints.xy)
        return FrameBundle(frame.index, frame.timestamp, frame.rgb, gray, depth, keypoints, xy, z, instances, mask)

    def _extract(self, gray: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> Keypoints:
        if mask is None or self._objects is None or not isinstance(self._extractor, MaskedExtractor):
            return self._extractor.extract(gray)
        return self._extractor.extract_masked(gray, mask, self._objects.outside_share)

    def _known(self, seen: FrameBundle, camera: Camera) -> FilterState:
        """What the filters may know beside the frame: the past, the prediction and the map."""
        before = self._previous
        return FilterState(
            camera=camera,
            keep=np.ones(len(seen), dtype=bool),
            previous=None if before is None else before.frame,
            previous_keep=None if before is None else before.keep,
            T_world_prev=None if before is None else before.T_world_cam,
            T_world_pred=self._backend.predict(seen.timestamp),
            motion_covariance=self._backend.motion_covariance(seen.timestamp),
            keyframes=self._backend.keyframe_views(KEYFRAMES_SHOWN),
            map_points=self._backend.map_points(),
            seed=int(stream(self._seed, "frame", seen.index).integers(2**63)),
        )

    def _cull(self, seen: FrameBundle, state: FilterState, clock: StageClock) -> CullingResult:
        """The filters' verdicts in order; the flow is found for what is left when the first filter needs it."""
        image: Any = None
        verdicts = []
        for each in self._filters:
            if "flow" in each.needs and image is None:
                image = self._find_flow(seen, state, clock)
            with clock(f"culling_{each.name}"):
                verdict = each.apply(seen, state)
            state.keep = state.keep & verdict.keep
            verdicts.append((each.name, verdict))
        return combine_verdicts(state, verdicts, image, self._guard)

    def _find_flow(self, seen: FrameBundle, state: FilterState, clock: StageClock) -> Any:
        """Put the flow to the previous image, and the pose that it predicts, into `state`; the prepared image."""
        assert self._flow is not None  # the constructor has seen to it
        with clock("flow"):
            image = self._flow.prepare(seen.gray)
            if (before := self._previous) is not None:
                other = self._flow.prepare(before.frame.gray) if before.image is None else before.image
                state.flow = flow_to_previous(self._flow, image, other, seen, state)
        with clock("ego_motion"):
            state.T_world_pred = refine_prediction(seen, state)
        return image

    def _remember(self, seen: FrameBundle, culled: CullingResult, pnp_poses: BackendResult) -> None:
        tracked = pnp_poses.state == "ok"
        known = tracked and self._backend.state == "ok"  # on an submap what is predicted is of another world
        self._previous = PreviousFrame(seen, culled.keep, culled.image, pnp_poses.T_world_cam if known else None)
        self._keyframe_due = not tracked or pnp_poses.keyframe

    def _stats(self, seen: FrameBundle, culled: CullingResult, pnp_poses: BackendResult) -> dict[str, float]:
        """The frame's diagnostics, the same keys on every frame."""
        stats = {
            "keypoints": float(len(seen)),
            "culled": float(np.count_nonzero(~culled.keep)),
            "matches": float(pnp_poses.matches),
            "inliers": float(pnp_poses.inliers),
            "map_points": float(pnp_poses.map_points),
            "keyframes": float(pnp_poses.keyframes),
            "keyframe": float(pnp_poses.keyframe),
            "maps": float(pnp_poses.maps),
            "loops": float(pnp_poses.loops),
            "residual_px": pnp_poses.residual_px,
            "mask_fraction": 0.0 if culled.mask is None else float(culled.mask.mean()),
            "relocalised": float(pnp_poses.relocalised),
            **culled.stats,
            "guard_undone": float(culled.undone),
        }
        if self._flow is not None:
            found = {} if culled.flow is None else culled.flow.stats
            stats |= {f"flow_{name}": found.get(name, 0.0) for name in stats_names_of(self._flow)}
        if self._masks is not None:
            stats["segmented"] = float(self._masks.segmented)
        if self._cached:
            stats["cached_stages"] = float(sum(stage.hit for stage in self._cached.values()))
        return stats

    # ------------------------------------------------------------------ afterwards, and steering

    def finalize(self) -> Trajectory:
        """The trajectory after the last optimisation of the map.

        Raises:
            TrackerError: `reset` was never called.
        """
        self._begun("finalize")
        return self._backend.finalize()

    def map_outputs(self) -> MapOutputs:
        """Keyframes and map points, for ``keyframes.csv``, ``map.ply`` and the sheet.

        Raises:
            TrackerError: `reset` was never called.
        """
        self._begun("map_outputs")
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
        self._begun("save_map")
        self._backend.save_map(path, made_by)

    def configure(self, settings: Settings) -> None:
        """Put other values of online settings into force from the next frame on; `reset` undoes it.

        Args:
            settings: The complete settings, of which only online fields differ from those it was built with.
        """
        self._steering.configure(settings)

    def _takers(self, settings: Settings) -> Iterator[tuple[str, Callable[[Any], None]]]:
        """Each group of the settings with every part that takes it."""
        parts: list[tuple[str, Any]] = [(group, each) for each in self._filters for group in groups_of(each)]
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
            yield "guard", self._use_guard
        if self._objects is not None:
            yield "segmentation", self._use_objects

    def _use_guard(self, guard: GuardSettings) -> None:
        self._guard = guard

    def _use_objects(self, objects: SegmentationSettings) -> None:
        self._objects = objects

    def _begun(self, method: str) -> Camera:
        if self._camera is None:
            raise TrackerError(f"{method}() was called before reset()")
        return self._camera


def groups_of(each: DynamicFilter) -> tuple[str, ...]:
    """The groups of settings that a filter takes; its name alone where it does not say."""
    return tuple(getattr(each, "groups", (each.name,)))


def _own_depth(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """A depth image of our own, which later frames look at: float32 metres, 0 wherever depth is missing or not finite.

    The caller may reuse the buffer that it gave.
    """
    own = np.array(depth, dtype=np.float32)
    if not np.isfinite(own).all():
        own[~np.isfinite(own)] = 0
    return own
