"""The way of one frame through a visual SLAM system for dynamic scenes (paper, Figure 2), top to bottom.

Every published system runs this file; it differs only in its list of filters, its flow and its settings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import FeatureExtractor
from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowEstimator, FlowResult
from dynslam_bench.contracts.map_outputs import MapOutputs
from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.seeding import derive_seed, stream
from dynslam_bench.core.settings import Settings
from dynslam_bench.core.steering import Steerable, Steering
from dynslam_bench.culling.guard import GuardSettings, restore_starved
from dynslam_bench.culling.tools.ego_motion import refine_prediction
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory

from .backend import RgbdBackend
from .frame_checks import check_frame, own_depth

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


class CachedStage(Protocol):
    """A stage that may have answered its last call from the stage cache."""

    hit: bool
    saved_s: float


class SlamPipeline:
    """A tracker: features, masks, culling, flow, culling, tracking and mapping, one frame at a time.

    Args:
        extractor: Finds the keypoints.
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
        self._steering = Steering(settings, self._takers(settings))
        self._cached = dict(cached or {})
        self._camera: Camera | None = None

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence with the settings that the system was built with."""
        self._steering.restore()
        self._camera = camera
        self._seed = derive_seed(rng)
        self._backend.reset(camera, seed=self._seed)
        self._no_flow_stats = {} if self._flow is None else _keys_of(self._flow, camera)
        for each in (*self._filters, self._masks):
            if each is not None and hasattr(each, "reset"):
                each.reset(camera)
        self._previous: FrameBundle | None = None
        self._previous_keep: NDArray[np.bool_] | None = None
        self._previous_image: Any = None
        self._previous_pose: NDArray[np.float64] | None = None
        self._keyframe_due = True

    def track(self, frame: Frame) -> TrackResult:
        """Track one frame.

        Raises:
            TrackerError: `reset` was not called, or the frame's size is not the camera's.
        """
        camera = self._begun("track")
        check_frame(frame, camera)
        clock = _Clock(self._cached)
        with clock("features"):
            bundle = self._extract(frame, camera)
        with clock("segmentation"):
            if self._masks is not None:
                bundle.instances = self._masks.masks_for(frame, bundle.gray, keyframe=self._keyframe_due)
        state = FilterState(
            camera=camera,
            keep=np.ones(len(bundle), dtype=bool),
            previous=self._previous,
            previous_keep=self._previous_keep,
            T_world_prev=self._previous_pose,
            T_world_pred=self._backend.predict(frame.timestamp),
            motion_covariance=self._backend.motion_covariance(frame.timestamp),
            keyframes=self._backend.keyframe_views(KEYFRAMES_SHOWN),
            map_points=self._backend.map_points(),
            seed=int(stream(self._seed, "frame", frame.index).integers(2**63)),
        )
        image = None
        verdicts: list[FilterResult] = []
        stats: dict[str, float] = {"keypoints": float(len(bundle))}
        for each in self._filters:
            if "flow" in each.needs and image is None and self._flow is not None:
                with clock("flow"):
                    image = self._flow.prepare(bundle.gray)
                    state.flow = self._flow_to_previous(bundle, image, state)
                with clock("ego_motion"):
                    state.T_world_pred = refine_prediction(bundle, state)
            with clock(f"culling_{each.name}"):
                verdict = each.apply(bundle, state)
            verdicts.append(verdict)
            state.keep = state.keep & verdict.keep
            stats |= {f"{each.name}_{key}": value for key, value in verdict.stats.items()}
        keep, undone = restore_starved([verdict.keep for verdict in verdicts], self._guard)
        if not verdicts:
            keep = state.keep
        used = verdicts[: len(verdicts) - undone]
        mask = _union([verdict.mask for verdict in used])
        weight = np.prod([verdict.weight for verdict in used], axis=0, dtype=np.float32) if used else None
        result = self._backend.track(bundle, keep, np.ones(len(bundle), np.float32) if weight is None else weight, mask)
        stats |= {
            "culled": float(np.count_nonzero(~keep)),
            "guard_undone": float(undone),
            "mask_fraction": 0.0 if mask is None else float(mask.mean()),
        }
        if self._flow is not None:
            found = self._no_flow_stats if state.flow is None else state.flow.stats
            stats |= {f"flow_{key}": value for key, value in found.items()}
        if self._masks is not None:
            stats["segmented"] = float(self._masks.segmented)
        if self._cached:
            stats["cached_stages"] = float(sum(stage.hit for stage in self._cached.values()))
        self._remember(bundle, keep, image, result)
        return replace(
            result,
            stats=dict(result.stats) | stats,
            timings=clock.seconds | dict(result.timings),
            dynamic_mask=mask,
            keypoints_xy=bundle.keypoints.xy,
            keypoints_keep=keep,
        )

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
            if isinstance(part, Steerable) and hasattr(settings, group):
                yield group, part.configure
        if hasattr(settings, "guard"):
            yield "guard", self._use_guard

    def _use_guard(self, guard: GuardSettings) -> None:
        self._guard = guard

    def _begun(self, method: str) -> Camera:
        if self._camera is None:
            raise TrackerError(f"{method}() was called before reset()")
        return self._camera

    def _extract(self, frame: Frame, camera: Camera) -> FrameBundle:
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        keypoints = self._extractor.extract(gray)
        depth = own_depth(frame.depth)
        column, row = np.rint(keypoints.xy).astype(np.intp).T
        z = depth[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].clip(min=0)
        return FrameBundle(
            index=frame.index, timestamp=frame.timestamp, rgb=frame.rgb, gray=gray, depth=depth,
            keypoints=keypoints, xy=camera.undistort_points(keypoints.xy), z=z,
        )  # fmt: skip

    def _flow_to_previous(self, bundle: FrameBundle, image: Any, state: FilterState) -> FlowResult | None:
        """Flow of the keypoints that are left, in rows of all keypoints; None on the first frame."""
        assert self._flow is not None
        if self._previous is None:
            return None
        if self._previous_image is None:
            self._previous_image = self._flow.prepare(self._previous.gray)
        chosen = np.flatnonzero(state.keep)
        result = self._flow.track(
            image, self._previous_image, bundle.keypoints.xy[chosen],
            guess=predicted_flow(bundle, state)[chosen], seed=state.seed,
        )  # fmt: skip
        xy = np.full((len(bundle), 2), np.nan, np.float32)
        valid = np.zeros(len(bundle), bool)
        cost = np.full(len(bundle), np.inf, np.float32)
        xy[chosen], valid[chosen], cost[chosen] = result.xy, result.valid, result.cost
        return FlowResult(xy, valid, cost, result.stats)

    def _remember(self, bundle: FrameBundle, keep: NDArray[np.bool_], image: Any, result: TrackResult) -> None:
        self._previous, self._previous_keep, self._previous_image = bundle, keep, image
        self._previous_pose = result.T_world_cam if result.state == "ok" else None
        self._keyframe_due = result.state != "ok" or result.stats.get("keyframe", 0.0) > 0


def predicted_flow(bundle: FrameBundle, state: FilterState) -> NDArray[np.float32]:
    """Where the motion model expects this frame's keypoints in the previous image.

    Args:
        bundle: The current frame.
        state: With the previous pose and the predicted one.

    Returns:
        Raw pixels float32 ``[N, 2]``; NaN where depth or a prediction is missing.
    """
    guess = np.full((len(bundle), 2), np.nan, np.float32)
    known = bundle.z > 0
    if state.T_world_prev is None or state.T_world_pred is None or not known.any():
        return guess
    T_prev_cur = se3.inverse(state.T_world_prev) @ state.T_world_pred
    points = se3.transform(T_prev_cur, state.camera.unproject(bundle.xy[known], bundle.z[known]))
    ahead = points[:, 2] > 0.05
    pixels = np.full((len(points), 2), np.nan)
    pixels[ahead] = state.camera.distort_points(state.camera.project(points[ahead]))
    guess[known] = pixels
    return guess


def _keys_of(flow: FlowEstimator, camera: Camera) -> dict[str, float]:
    """The flow's stats at zero, for frames without a previous one."""
    blank = flow.prepare(np.zeros((camera.height, camera.width), np.uint8))
    return dict.fromkeys(flow.track(blank, blank, np.full((1, 2), 100.0, np.float32)).stats, 0.0)


def groups_of(each: DynamicFilter) -> tuple[str, ...]:
    """The groups of settings that a filter takes; its name alone where it does not say."""
    return tuple(getattr(each, "groups", (each.name,)))


def _union(masks: list[NDArray[np.bool_] | None]) -> NDArray[np.bool_] | None:
    given = [mask for mask in masks if mask is not None]
    return np.logical_or.reduce(given) if given else None


class _Clock:
    """Wall-clock seconds by stage, in the order of first use; what the stage cache saved is added again."""

    def __init__(self, cached: Mapping[str, CachedStage]) -> None:
        self.seconds: dict[str, float] = {}
        self._cached = cached

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        cached = self._cached.get(stage)
        if cached is not None:
            cached.hit, cached.saved_s = False, 0.0
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start + (0.0 if cached is None else cached.saved_s)
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed
