"""The frame pipeline of a visual SLAM system for dynamic scenes (paper, Figure 2), from top to bottom.

`SlamPipeline.track` is the path of one frame. Every published system runs this file; systems differ
only in their list of filters, their flow and their settings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import (
    DynamicFilter,
    FeatureExtractor,
    FilterResult,
    FilterState,
    FlowEstimator,
    FlowResult,
    Frame,
    FrameBundle,
    Instances,
    Keypoints,
    MapOutputs,
    MaskedExtractor,
    TrackResult,
)
from dynslam_bench.contracts.checks import check_frame
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.seeding import derive_seed, stream
from dynslam_bench.core.settings import OnlineSettings, Reconfigurable, Settings
from dynslam_bench.culling.settings import GuardSettings
from dynslam_bench.features.enlarging import enlarged, enlarged_mask, in_given_image
from dynslam_bench.geometry import Camera, Trajectory, pixel_index, se3
from dynslam_bench.segmentation.postprocess import dynamic_mask
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.slam.backend import Backend

if TYPE_CHECKING:
    from dynslam_bench.segmentation.schedule import MaskScheduler

MIN_PREDICTED_DEPTH_M = 0.05
"""Points nearer than this to the previous camera plane have no predicted flow."""

RefinePrediction = Callable[[FrameBundle, FilterState], NDArray[np.float64] | None]
"""Called with a frame and what is known beside it, its flow among that; gives ``T_world_cam`` or None."""


class CachedStage(Protocol):
    """A stage that may have answered its last call from the stage cache.

    Attributes:
        hit: Whether it did.
        saved_s: Seconds that this saved.
    """

    hit: bool
    saved_s: float


class StageClock:
    """Wall-clock seconds by stage, in the order of first use; what the stage cache saved is added again.

    Args:
        cached: Stages that answer from the stage cache, by name.
    """

    def __init__(self, cached: Mapping[str, CachedStage]) -> None:
        self.seconds: dict[str, float] = {}
        self._cached = cached

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time the body as part of a stage."""
        cached = self._cached.get(stage)
        if cached is not None:
            cached.hit = False
            cached.saved_s = 0.0
        start = time.perf_counter()
        yield
        elapsed = time.perf_counter() - start + (0.0 if cached is None else cached.saved_s)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed


@dataclass(frozen=True, eq=False)
class PreviousFrame:
    """The previous frame, as filters and flow read it.

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
        extractor: Extracts the keypoints; a `MaskedExtractor` extracts enough of them outside the
            dynamic mask.
        mask_scheduler: Segmentation stage; None for systems without semantics.
        filters: Dynamic feature filters in the order of application.
        flow: Flow of the keypoints that are left to the previous image; run before the first filter
            that needs it.
        refine_prediction: Gives the predicted pose ``T_world_cam`` that follows from the flow and
            the motion model, None where neither tells; needed with a flow.
        backend: Tracking and mapping.
        settings: The system's complete settings; their group ``guard`` says what the filters must
            leave.
        cached: Stages that answer from the stage cache, by name (``features``, ``segmentation``);
            their times are reported as they are without it, and ``cached_stages`` in `stats` says
            how many answered from it.

    Raises:
        TrackerError: A filter needs a flow and there is none.
        SettingsError: No part takes an online setting that has an effect.
    """

    def __init__(
        self,
        *,
        extractor: FeatureExtractor,
        mask_scheduler: MaskScheduler | None,
        filters: Sequence[DynamicFilter],
        flow: FlowEstimator | None,
        backend: Backend,
        refine_prediction: RefinePrediction | None = None,
        settings: Settings,
        cached: Mapping[str, CachedStage] | None = None,
    ) -> None:
        # a filter that needs a flow has one, and a flow what refines the prediction with it
        needing = [f.name for f in filters if "flow" in f.needs]
        if needing and flow is None:
            raise TrackerError(f"filter '{needing[0]}' needs an optical flow, the system has none")

        # the parts, in the order in which a frame passes them
        self._extractor = extractor
        self._mask_scheduler = mask_scheduler
        self._filters = tuple(filters)
        if flow is not None and refine_prediction is None:
            raise TrackerError(
                "a system with an optical flow needs a function that refines the predicted pose with it"
            )
        self._flow = flow
        self._refine_prediction = refine_prediction
        self._backend = backend

        # settings of steps that are no part of their own
        self._guard: GuardSettings = getattr(settings, "guard", GuardSettings())
        self._segmentation: SegmentationSettings | None = getattr(settings, "segmentation", None)
        # parts whose settings may change while a sequence runs
        self._online = OnlineSettings(settings, self._configurable_parts(settings))
        self._cached = dict(cached or {})

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence with the settings that the system was built with."""
        # every part forgets the last sequence; one seed is drawn for all
        self._online.restore()
        self._camera = camera
        self._seed = derive_seed(rng)
        self._backend.reset(camera, seed=self._seed)
        for part in (*self._filters, self._mask_scheduler):
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
        backend = self._started()
        check_frame(frame, self._camera)
        clock = StageClock(self._cached)

        # grey levels, and depth without missing values; a monocular system sees none
        if not backend.uses_depth:
            no_depth = np.zeros((self._camera.height, self._camera.width), np.float32)
            frame = replace(frame, depth=no_depth)
        gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        depth = frame.depth.astype(np.float32)
        depth[~np.isfinite(depth)] = 0

        # objects that may move, and the mask of all of them
        instances, mask = self._segment(frame, gray, depth, clock)

        # keypoints, enough of them outside the mask; undistorted, with depth
        keypoints, xy = self._extract(gray, mask, clock)
        z = _depth_at(keypoints, depth)
        bundle = FrameBundle(
            frame.index, frame.timestamp, frame.rgb, gray, depth, keypoints, xy, z, instances, mask
        )

        # what else filters may read: the previous frame, the predicted pose, the map
        state = self._filter_state(bundle)

        # static keypoints; flow runs on demand, on what the masks leave
        filter_result, image = self._cull(bundle, state, clock)

        # pose by the static keypoints, with mapping and loop closing
        result = backend.track(bundle, filter_result.keep, filter_result.weight)

        # remember the frame for the next one; its pose only if it is in the root map's world
        pose = result.T_world_cam if result.state == backend.state == "ok" else None
        self._previous = PreviousFrame(bundle, filter_result.keep, image, pose)
        self._keyframe_due = result.state != "ok" or bool(result.stats["keyframe"])

        # report; a detector in a thread of its own is not a part of the frame's time
        timings = clock.seconds | dict(result.timings)
        if self._mask_scheduler is not None and self._mask_scheduler.async_segmenter_s:
            timings["detector"] = self._mask_scheduler.async_segmenter_s
        stats = self._stats(bundle, state, filter_result, result)
        return TrackResult(
            result.T_world_cam,
            result.state,
            stats,
            timings,
            filter_result.mask,
            keypoints.xy,
            filter_result.keep,
            result.motion_covariance,
        )

    # ------------------------------------------------------------------ steps of a frame

    def _segment(
        self,
        frame: Frame,
        gray: NDArray[np.uint8],
        depth: NDArray[np.float32],
        clock: StageClock,
    ) -> tuple[Instances | None, NDArray[np.bool_] | None]:
        """The frame's instances and the mask ``[H, W]`` of the dynamic ones; None each where there are none.

        Args:
            frame: The frame.
            gray: uint8 ``[H, W]``, its grey levels.
            depth: float32 ``[H, W]`` metres, 0 missing.
            clock: Times the stage.
        """
        if self._mask_scheduler is None:
            return None, None
        # masks now, or those of the last segmented frame moved to this one
        mask = None
        with clock("segmentation"):
            instances = self._mask_scheduler.masks_for(frame, gray, keyframe=self._keyframe_due)
            if self._segmentation is not None and instances.class_names:
                mask = dynamic_mask(instances, self._segmentation, depth)
        return instances, mask

    def _extract(
        self, gray: NDArray[np.uint8], mask: NDArray[np.bool_] | None, clock: StageClock
    ) -> tuple[Keypoints, NDArray[np.float64]]:
        """Keypoints, and their undistorted pixels ``[N, 2]``."""
        extractor = self._extractor
        with clock("features"):
            # a narrow image is enlarged
            image = enlarged(gray)
            if (
                mask is not None
                and self._segmentation is not None
                and isinstance(extractor, MaskedExtractor)
            ):
                share = self._segmentation.outside_share
                keypoints = extractor.extract_masked(image, enlarged_mask(mask), share)
            else:
                keypoints = extractor.extract(image)
            keypoints = in_given_image(keypoints, gray)
            xy = self._camera.undistort_points(keypoints.xy)
        return keypoints, xy

    def _filter_state(self, frame: FrameBundle) -> FilterState:
        """State that filters may read beside the frame: the previous frame, the prediction and the map."""
        previous = self._previous
        T_world_pred, covariance = self._backend.predict_T_world_cam(frame.timestamp)
        keyframes, map_points = self._backend.view()
        return FilterState(
            camera=self._camera,
            keep=np.ones(len(frame.xy), dtype=bool),
            previous=None if previous is None else previous.frame,
            previous_keep=None if previous is None else previous.keep,
            T_world_prev=None if previous is None else previous.T_world_cam,
            T_world_pred=T_world_pred,
            motion_covariance=covariance,
            keyframes=keyframes,
            map_points=map_points,
            seed=int(stream(self._seed, "frame", frame.index).integers(2**63)),
        )

    def _cull(
        self, frame: FrameBundle, state: FilterState, clock: StageClock
    ) -> tuple[FilterResult, Any]:
        """Judge which keypoints are static, by all filters in order; the first that needs the flow starts it.

        Returns:
            The filters' common verdict. Its stats are every filter's, each name with the filter's
            before it, how many of the last filters the guard set aside because too few keypoints
            would be left, and how many masked keypoints it gave back. Beside it this frame's image
            as the flow prepared it, None if no flow ran.
        """
        # each filter judges what the ones before have left
        image = None
        verdicts: list[FilterResult] = []
        stats: dict[str, float] = {}
        for dynamic_filter in self._filters:
            if "flow" in dynamic_filter.needs and image is None:
                image = self._run_flow(frame, state, clock)
            with clock(f"culling_{dynamic_filter.name}"):
                verdict = dynamic_filter.apply(frame, state)
            state.keep = state.keep & verdict.keep
            verdicts.append(verdict)
            for key, value in verdict.stats.items():
                stats[f"{dynamic_filter.name}_{key}"] = value

        # the starvation guard sets the last filters aside while too few keypoints would be left
        keep, n_set_aside, restored = self._guarded(frame, verdicts)
        stats["guard_undone"] = float(n_set_aside)
        stats["guard_returned"] = float(np.count_nonzero(restored))

        # weights multiply and masks join, of the filters that count; what is given back counts in full
        counted = verdicts[: len(verdicts) - n_set_aside]
        weight = np.ones(len(frame.xy), np.float32)
        for verdict in counted:
            weight *= verdict.weight
        weight[restored] = 1
        masks = [verdict.mask for verdict in counted if verdict.mask is not None]
        mask = np.logical_or.reduce(masks) if masks else None
        return FilterResult(keep, weight, stats, mask), image

    def _guarded(
        self, frame: FrameBundle, verdicts: Sequence[FilterResult]
    ) -> tuple[NDArray[np.bool_], int, NDArray[np.bool_]]:
        """The starvation guard: which keypoints are used, ``[N]``.

        Beside them how many of the last verdicts it sets aside, and which masked keypoints ``[N]``
        it gives back.
        """
        total = len(frame.xy)
        needed = self._guard.needed(total)
        keep, n_set_aside = combine_verdicts([verdict.keep for verdict in verdicts], total, needed)
        restored = np.zeros(total, bool)

        # the first verdict leaves enough, or there is no mask that tells which keypoints are the least doubtful
        if n_set_aside < len(verdicts) or not verdicts:
            return keep, n_set_aside, restored
        first = verdicts[0]
        mask = first.mask if frame.mask is None else frame.mask
        if mask is None:
            return keep, n_set_aside, restored

        # masked keypoints are given back to a camera that is tracked; no map begins with them
        if self._backend.state == "ok":
            restored = least_masked(first.keep, mask, frame.keypoints.xy, needed)
        return first.keep | restored, len(verdicts) - 1, restored

    def _run_flow(self, frame: FrameBundle, state: FilterState, clock: StageClock) -> Any:
        """Compute the flow to the previous image and the pose that it predicts.

        Args:
            frame: The frame.
            state: Takes the flow, if there is a previous frame, and the predicted pose.
            clock: Times both.

        Returns:
            This frame's image as the flow prepared it.
        """
        # both are checked in the constructor
        assert self._flow is not None
        assert self._refine_prediction is not None
        with clock("flow"):
            image = self._flow.prepare(frame.gray)
            previous = self._previous
            if previous is not None:
                # no flow ran on the previous frame: prepare its image now
                previous_image = previous.image
                if previous_image is None:
                    previous_image = self._flow.prepare(previous.frame.gray)
                state.flow = flow_to_previous(self._flow, image, previous_image, frame, state)
        with clock("ego_motion"):
            state.T_world_pred = self._refine_prediction(frame, state)
        return image

    def _stats(
        self,
        frame: FrameBundle,
        state: FilterState,
        filter_result: FilterResult,
        result: TrackResult,
    ) -> dict[str, float]:
        """The frame's diagnostics, the same keys on every frame."""
        # counts of the frame, of the back end and of each filter
        stats = {
            "keypoints": float(len(frame.xy)),
            "culled": float(np.count_nonzero(~filter_result.keep)),
            **{name: float(value) for name, value in result.stats.items()},
            "mask_fraction": 0.0
            if filter_result.mask is None
            else float(filter_result.mask.mean()),
            **filter_result.stats,
        }
        # a flow that did not run has 0 in each of its diagnostics
        flow_stats = {} if state.flow is None else state.flow.stats
        for name in getattr(self._flow, "stats_names", ()):
            stats[f"flow_{name}"] = flow_stats.get(name, 0.0)
        if self._mask_scheduler is not None:
            stats["segmented"] = float(self._mask_scheduler.segmented)
        if self._cached:
            stats["cached_stages"] = float(sum(stage.hit for stage in self._cached.values()))
        return stats

    # ------------------------------------------------------------------ outputs and settings

    def finalize(self) -> Trajectory:
        """The trajectory after the last optimisation of the map.

        Raises:
            TrackerError: `reset` was never called.
        """
        return self._started().finalize()

    def map_outputs(self) -> MapOutputs:
        """Keyframes and map points, for ``keyframes.csv``, ``map.ply`` and pictures.

        Raises:
            TrackerError: `reset` was never called.
        """
        return self._started().outputs()

    def save_map(self, path: Path, made_by: str = "") -> None:
        """Write the map to a file from which a later run may start (setting ``backend.map.file``).

        Args:
            path: The file.
            made_by: Which run made it, in words.

        Raises:
            TrackerError: `reset` was never called, there is no map yet, or it is too large for a
                file.
            DynslamError: The file cannot be written.
        """
        self._started().save_map(path, made_by)

    def close(self) -> None:
        """Wait for the segmenter beside tracking."""
        if self._mask_scheduler is not None:
            self._mask_scheduler.wait_for_segmenter()

    def configure(self, settings: Settings) -> None:
        """Put other values of online settings into force from the next frame on; `reset` undoes it.

        Args:
            settings: The complete settings, of which only online fields differ from those it was
                built with.
        """
        self._online.configure(settings)

    def _configurable_parts(
        self, settings: Settings
    ) -> Iterator[tuple[str, Callable[[Any], None]]]:
        """Each group of the settings with the function of every part that takes it."""
        # each group with the parts that it may configure
        parts: list[tuple[str, Any]] = []
        for dynamic_filter in self._filters:
            for group in getattr(dynamic_filter, "groups", (dynamic_filter.name,)):
                parts.append((group, dynamic_filter))
        parts.append(("features", self._extractor))
        parts.append(("segmentation", self._mask_scheduler))
        parts.append(("flow", self._flow))
        parts.append(("backend", self._backend))
        for group, part in parts:
            if isinstance(part, Reconfigurable) and hasattr(settings, group):
                yield group, part.configure
        if hasattr(settings, "guard"):
            # a deep copy of this function configures the copied pipeline, unlike a closure
            yield "guard", partial(setattr, self, "_guard")
        if self._segmentation is not None:
            yield "segmentation", partial(setattr, self, "_segmentation")

    def _started(self) -> Backend:
        """The back end.

        Raises:
            TrackerError: `reset` was never called.
        """
        if not hasattr(self, "_camera"):
            raise TrackerError("the tracker was used before reset()")
        return self._backend


def _depth_at(keypoints: Keypoints, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth ``[N]`` in metres at the nearest pixel of each keypoint; 0 missing."""
    # the border pixel for keypoints at the edge
    height, width = depth.shape
    column, row = np.rint(keypoints.xy).astype(np.intp).T
    nearest = depth[row.clip(0, height - 1), column.clip(0, width - 1)]
    return np.asarray(nearest.clip(min=0))


def combine_verdicts(
    verdicts: Sequence[NDArray[np.bool_]], total: int, needed: int
) -> tuple[NDArray[np.bool_], int]:
    """The starvation guard: combine the filters' verdicts, without the last ones while too few features remain.

    The first filter of a system is the most reliable (a semantic mask), the last one the least.

    Args:
        verdicts: bool ``[N]`` a filter, True = keep, in the order of application.
        total: N.
        needed: How many features must remain.

    Returns:
        The combined keep mask ``[N]`` and how many verdicts were set aside; with all set aside
        every feature is kept.
    """
    for n_set_aside in range(len(verdicts)):
        keep = np.logical_and.reduce(verdicts[: len(verdicts) - n_set_aside])
        if np.count_nonzero(keep) >= needed:
            return keep, n_set_aside
    return np.ones(total, dtype=bool), len(verdicts)


def least_masked(
    keep: NDArray[np.bool_], mask: NDArray[np.bool_], xy: NDArray[np.floating], needed: int
) -> NDArray[np.bool_]:
    """The features that the starvation guard gives back: the fewest, nearest to the mask's outside first.

    Args:
        keep: bool ``[N]``, the features that are left, fewer than needed.
        mask: bool ``[H, W]``, dynamic pixels.
        xy: Raw pixels of the features ``[N, 2]``.
        needed: How many features must remain.
    """
    # distance of each feature from the mask's outside
    outside_px = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    at, _ = pixel_index(xy, mask.shape)
    masked_px = outside_px[at]

    # as many of the dropped ones as are missing
    dropped = np.flatnonzero(~keep)
    nearest = dropped[np.argsort(masked_px[dropped], kind="stable")]
    restored = np.zeros(len(keep), bool)
    restored[nearest[: max(0, needed - int(np.count_nonzero(keep)))]] = True
    return restored


def flow_to_previous(
    flow: FlowEstimator, image: Any, previous: Any, frame: FrameBundle, state: FilterState
) -> FlowResult:
    """Flow of the kept keypoints, in rows of all keypoints; the others' rows are not valid.

    Args:
        flow: The method.
        image: This frame's image as `flow` prepared it.
        previous: The previous frame's.
        frame: This frame.
        state: With the keypoints that are left and both poses.
    """
    # only the keypoints that are left are tracked, from where the motion model expects them
    kept = np.flatnonzero(state.keep)
    count = len(frame.xy)
    guess = predicted_flow(frame, state)[kept]
    result = flow.track(image, previous, frame.keypoints.xy[kept], guess=guess, seed=state.seed)
    # back into rows of all keypoints
    xy = np.full((count, 2), np.nan, np.float32)
    cost = np.full(count, np.inf, np.float32)
    valid = np.zeros(count, bool)
    xy[kept] = result.xy
    valid[kept] = result.valid
    cost[kept] = result.cost
    return FlowResult(xy, valid, cost, result.stats)


def predicted_flow(frame: FrameBundle, state: FilterState) -> NDArray[np.float32]:
    """Places in the previous image where the motion model expects this frame's keypoints.

    Args:
        frame: The current frame.
        state: With the previous pose and the predicted one.

    Returns:
        Raw pixels float32 ``[N, 2]``; NaN where depth or a prediction is missing.
    """
    guess = np.full((len(frame.xy), 2), np.nan, np.float32)
    has_depth = frame.z > 0
    if state.T_world_prev is None or state.T_world_pred is None or not has_depth.any():
        return guess
    # the keypoints as points in the previous camera
    camera = state.camera
    T_prev_cur = se3.inverse(state.T_world_prev) @ state.T_world_pred
    current_points = camera.unproject(frame.xy[has_depth], frame.z[has_depth])
    points = current_points @ T_prev_cur[:3, :3].T + T_prev_cur[:3, 3]

    # where they appear in the previous image, unless they would lie behind its camera
    ahead = points[:, 2] > MIN_PREDICTED_DEPTH_M
    rows = np.flatnonzero(has_depth)[ahead]
    guess[rows] = camera.distort_points(camera.project(points[ahead]))
    return guess
