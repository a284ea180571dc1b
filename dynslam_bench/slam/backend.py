"""The back end that all trackers share: what turns the kept features of a frame into a pose and a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FrameBundle, KeyframeView
from dynslam_bench.contracts.tracker import MapOutputs, TrackingState
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.slam.atlas import begin_map, check_descriptors, save
from dynslam_bench.slam.initialisation import InitialMap, TwoViewInitialiser, View, put
from dynslam_bench.slam.keyframes import KeyframeRule, TrajectoryHistory
from dynslam_bench.slam.local_mapping import LocalMapper
from dynslam_bench.slam.loop_closing import LoopCloser
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_files import MapFeatures
from dynslam_bench.slam.map_views import MapViews
from dynslam_bench.slam.motion_model import STILL_AGREE, CameraMotion, RollingShutterCompensation
from dynslam_bench.slam.observation import Observations, observe
from dynslam_bench.slam.relocalisation import (
    InitialPose,
    RelocalisationGate,
    TrackingContext,
    initial_pose,
    pose_in_root_map,
    tracked_at,
)
from dynslam_bench.slam.rolling_shutter import CameraVelocity, compensate_rolling_shutter
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings
from dynslam_bench.slam.tracking import LocalMap, MapFit, TrackedFrame, fit_to_map

Array = NDArray[np.float64]

MIN_INITIAL = 60
"""Features with depth that the first keyframe needs."""


class RgbdBackend:
    """Tracks frames against a map that it builds.

    Args:
        settings: Of tracking, mapping, bundle adjustment, keyframes and relocalisation.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
        extractor: Who finds them; a saved map serves the same features alone.
    """

    uses_depth = True
    """Whether depth is read; where it is not, the pipeline shows it to nobody."""

    def __init__(
        self,
        settings: BackendSettings | None = None,
        *,
        scale_factor: float = 1.2,
        levels: int = 8,
        extractor: str = "orb",
    ) -> None:
        self.settings = settings or BackendSettings()
        self._made_of = MapFeatures(extractor=extractor, levels=max(levels, 1), scale_factor=scale_factor)
        self._scales = self._made_of.scales
        self._ready = False

    def configure(self, settings: BackendSettings) -> None:
        """Put other settings into force from the next frame on."""
        self.settings = settings
        if self._ready:
            self.mapper.settings = self.loops.settings = self._surroundings.settings = settings
            self._keyframes.settings = settings.keyframes

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins, in the map that the settings name, if they do.

        Args:
            camera: Intrinsics; keypoints' `xy` come undistorted, so its distortion plays no role here.
            seed: Founds all random draws.

        Raises:
            SettingsError: That map cannot be read, or is of another camera, other features or another sensor.
        """
        self.camera = camera.undistorted()
        self.seed = int(seed)
        start = self.settings.map
        self.world, self._submaps = begin_map(start.file, self.camera, self._made_of, depth=self.uses_depth)
        self._grows = not start.localisation_only
        self.mapper = LocalMapper(self.world, self.settings)
        self.history = TrajectoryHistory(self.world.space)
        self.state: TrackingState = "initialising"
        self._tracked = False
        self._island = 0
        self._unrecognised = 0
        self._reach = RelocalisationGate(self.camera, anywhere=bool(start.file))
        self._last: TrackedFrame | None = None
        self._first: tuple[FrameBundle, Observations] | None = None
        self.motion = CameraMotion(self.camera.readout_s)
        self._straightening = RollingShutterCompensation(self.world, self.camera, self.motion)
        self._reference = -1
        self._keyframes = KeyframeRule(self.settings.keyframes, self.mapper.close_m)
        parts = self.world, self.mapper, self._submaps, self.settings, self.seed
        self.loops = LoopCloser(*parts, scale_is_known=self.uses_depth)
        self._surroundings = LocalMap(self.world, self.settings)
        self._views = MapViews(self.world, self.mapper)
        self._ready = True

    # ------------------------------------------------------------------ one frame

    def track(self, frame: FrameBundle, keep: NDArray[np.bool_], weight: NDArray[np.float32]) -> BackendResult:
        """Find the frame's pose and, if it shows enough new, make it a keyframe.

        Args:
            frame: The frame with its features.
            keep: bool ``[N]``; features with False enter neither tracking nor map.
            weight: float32 ``[N]`` in [0, 1], confidence that a feature is static.

        Returns:
            The pose (after bundle adjustment if the frame became a keyframe), state, counts and timings.
        """
        assert self._ready, "reset() comes before track()"
        begin = perf_counter()
        self.mapper.resume()
        seen = observe(frame, keep, weight, self.camera, self._scales, self.settings.tracking)
        found = self._localise(frame, seen) if self.world.next_keyframe else self._initialise(frame, seen)
        self.world.rest()
        tracking = perf_counter() - begin - sum(found.timings.values())
        stages = {"tracking": tracking, "mapping": 0.0, "bundle_adjustment": 0.0}
        return replace(found, timings={**stages, **found.timings})

    def _initialise(self, frame: FrameBundle, seen: Observations) -> BackendResult:
        """The first frame with enough depth is the first keyframe, and the world's frame of reference."""
        if np.count_nonzero(seen.z > 0) < MIN_INITIAL:
            return self._localised(None)
        begun = self._begin_map(frame, seen, np.eye(4))
        self._first = (frame, seen) if self._rolling else None
        return begun

    def _begin_map(self, frame: FrameBundle, seen: Observations, T_cam_world: Array) -> BackendResult:
        """A keyframe that shows nothing known; until its map is joined to the first one its frames count as lost."""
        self._tracked = True
        self._last = tracked = TrackedFrame(seen, np.full(len(seen), -1, np.int64), T_cam_world, frame.timestamp)
        spent = self._make_keyframe(frame, tracked)
        self.state = self._state()
        self.history.append(frame.timestamp, self._reference, np.eye(4), 1e6 * np.eye(6))
        points = int(np.count_nonzero(tracked.point >= 0))
        return replace(self._localised(T_cam_world, spent), matches=points, inliers=points)

    def _begin_again(
        self,
        frame: FrameBundle,
        seen: Observations,
        first: tuple[FrameBundle, Observations],
        speeds: CameraVelocity,
        count: int,
    ) -> BackendResult:
        """The second frame tells how the camera moved in the first, whose points a rolling shutter had put askew.

        Where fewer points agree then than the `count` before, the first frame stays as it was.
        """
        for moving in (speeds, None):
            self.reset(self.camera, self.seed)
            self.motion.last_speeds = moving
            straight = first[1] if moving is None else compensate_rolling_shutter(first[1], self.camera, moving)
            self._begin_map(first[0], straight, np.eye(4))
            found = self._localise(frame, seen)
            if found.state == "ok" and found.inliers >= STILL_AGREE * count:
                break
        return found

    def _state(self) -> TrackingState:
        """Poses count in the world of the first map alone."""
        self._island = int(self.world.kf_map[self._reference])
        return "ok" if self._tracked and self._island == 0 else "lost"

    def _localise(self, frame: FrameBundle, seen: Observations) -> BackendResult:
        """First pose, local map, pose; then the keyframe decision with all that a keyframe brings."""
        last = self._nowhere(frame, seen) if self._last is None else self._last
        raw = seen
        if self._rolling:
            seen = self._straightening.foreseen(raw, last, frame.timestamp, self.settings.motion)
        prediction = self.motion.predicted(last, frame.timestamp, self.settings.motion)
        around = self._surroundings.keyframes(self._reference) if self._tracked else self._anywhere()
        known = last, raw, frame.timestamp, self._island, self.settings.relocalisation
        told = partial(self._reach.at_most, *known, prediction) if self._tracked else partial(self._reach.since, *known)
        where = last, prediction, self._reference, around, not self._tracked, cache(told)
        before = TrackingContext(*where, self.mapper.close_m, self.seed, frame.index)
        home = pose_in_root_map(self.world, self._submaps, seen, before, self.settings)
        first = initial_pose(self.world, self._submaps, seen, before, self.settings)
        if first is None and home is not None:
            first, home, self._tracked = home, None, False
            self._reach.left(last)
            self.motion.forget()
        if first is None:
            return self._lost(frame, raw, last, prediction)
        points = self._surroundings.points(first.keyframe, first.matches.point)
        fit = fit_to_map(self.world, seen, first.matches, first.T_cam_world, points, self.settings.tracking)
        speeds = None
        if self._rolling:
            at, motion, second = frame.timestamp, self.settings.motion, self._first is not None
            seen, fit, speeds = self._straightening.refitted(raw, seen, fit, last, at, motion, anyhow=second)
        if self._grows:
            self.world.visible[fit.in_view] += 1
        asked = self.settings.tracking if self._tracked else self.settings.relocalisation
        if fit.count < asked.min_inliers or not np.isfinite(fit.estimate.T_cam_world).all():
            found = self._lost(frame, raw, last, prediction)
        else:
            taken = self._accept(frame, seen, fit, last)
            self.motion.last_speeds = speeds
            beginning, self._first = self._first, None
            if beginning is not None and speeds is not None:
                return self._begin_again(frame, raw, beginning, speeds, fit.count)
            spent = self._keyframe_if_wanted(frame, taken, fit, home)
            found = replace(self._localised(taken.T_cam_world, spent), residual_px=fit.estimate.residual_px)
            if home is not None and self._island and self.loops.in_root_map:
                found = self._in_root_map(taken, home, found)
        return replace(found, matches=len(fit.matches), inliers=fit.count, relocalised=first.relocalised)

    @property
    def _rolling(self) -> bool:
        """Whether the frame that comes can be straightened."""
        return bool(self.settings.tracking.rolling_shutter and self.camera.readout_s and self._tracked)

    def _nowhere(self, frame: FrameBundle, seen: Observations) -> TrackedFrame:
        """What stands for the last tracked frame before the camera is found in a loaded map: it shows nothing."""
        check_descriptors(self.world, seen, frame.index)
        none, unsure = np.zeros(len(frame), bool), np.zeros(len(frame), np.float32)
        nothing = observe(frame, none, unsure, self.camera, self._scales, self.settings.tracking)
        return TrackedFrame(nothing, np.zeros(0, np.int64), np.eye(4), frame.timestamp)

    def _lost(self, frame: FrameBundle, seen: Observations, last: TrackedFrame, prediction: Array) -> BackendResult:
        """Nothing is recognised; after some such frames, with loop closing, a map of its own begins."""
        self.state, self._first = "lost", None
        shown = self._usable(seen)
        if self._tracked:
            self._reach.lost(last, seen, self.settings.relocalisation, shows=shown >= MIN_INITIAL)
        self._tracked = False
        self.motion.forget()
        self._unrecognised = self._unrecognised + 1 if shown >= MIN_INITIAL else 0
        enough = self._unrecognised >= self.settings.relocalisation.new_map_after
        begins = enough and self._grows and self.settings.loop_closing.enabled
        begun = self._begin_submap(frame, seen, last) if begins else None
        return begun or self._localised(None if self._last is None else prediction)

    def _in_root_map(self, tracked: TrackedFrame, home: InitialPose, found: BackendResult) -> BackendResult:
        """A camera on an submap is in the first map, too: there its pose counts, and it may go on there."""
        self.history.see_from(self.world, home.keyframe, home.T_cam_world)
        if self.loops.leaves:
            self._last, self._reference = tracked_at(self.world, tracked, home), home.keyframe
            self.motion.forget()
            self.state = self._state()
        return replace(found, T_world_cam=se3.inverse(home.T_cam_world), state="ok")

    def _anywhere(self) -> NDArray[np.int64]:
        """Slots of the keyframes where a lost camera may be: how other submaps lie to its own is unknown."""
        slots = self.world.keyframes
        return slots[np.isin(self.world.kf_map[slots], (0, self._island))]

    def _usable(self, seen: Observations) -> int:
        """How many features a map could begin with."""
        return int(np.count_nonzero(seen.z > 0))

    def _begin_submap(self, frame: FrameBundle, seen: Observations, last: TrackedFrame) -> BackendResult | None:
        """Begin a map of its own where the camera was lost, turned as the images say; None if not yet."""
        self._note_submap(last, frame.timestamp)
        return self._begin_map(frame, seen, self._reach.turned(last))

    def _note_submap(self, last: TrackedFrame, timestamp: float) -> None:
        """An submap begins with the frame of this stamp."""
        reach = self._reach.metres(last, timestamp, self.settings.relocalisation)
        self._unrecognised = 0
        start = se3.inverse(last.T_cam_world)[:3, 3]
        self._island = self._submaps.begin(self._island, start, reach, self._reach.slack)

    def _accept(self, frame: FrameBundle, seen: Observations, fit: MapFit, last: TrackedFrame) -> TrackedFrame:
        """The frame is tracked: what it sees counts as found, and its pose is weighed against the motion model."""
        points = fit.matches.point[fit.inliers]
        if self._grows:
            self.world.found[points] += 1
        point = np.full(len(seen), -1, np.int64)
        point[fit.matches.feature[fit.inliers]] = points
        measured = fit.estimate.T_cam_world, fit.estimate.information
        pose = self.motion.filtered(last, frame.timestamp, *measured, self.settings.motion)
        self._tracked, self._unrecognised = True, 0
        self._last = tracked = TrackedFrame(seen, point, pose, frame.timestamp)
        near, _ = self.world.covisible_of(points)
        if len(near):
            self._reference = int(near[0])
        self.state = self._state()
        return tracked

    # ------------------------------------------------------------------ keyframes

    def _keyframe_if_wanted(
        self, frame: FrameBundle, tracked: TrackedFrame, fit: MapFit, home: InitialPose | None
    ) -> dict[str, float]:
        """Make the tracked frame a keyframe if the rule or a join wants it, note its pose; what that took, by stage."""
        spent: dict[str, float] = {}
        pose = fit.estimate.T_cam_world
        wanted = home is not None or self._keyframes.wants(self.world, tracked, frame.index, self._reference)
        if self._grows and wanted:
            spent = self._make_keyframe(frame, tracked, home)
            if self.settings.bundle_adjustment.enabled or self.settings.loop_closing.enabled:
                pose = tracked.T_cam_world
                self.motion.relocated(pose)
        relative = pose @ se3.inverse(self.world.kf_pose[self._reference])
        self.history.append(frame.timestamp, self._reference, relative, fit.estimate.information)
        self.state = self._state()
        return spent

    def _make_keyframe(
        self, frame: FrameBundle, tracked: TrackedFrame, home: InitialPose | None = None
    ) -> dict[str, float]:
        pose, at = tracked.T_cam_world, (frame.index, frame.timestamp, self._island)
        slot, spent = self.mapper.insert(tracked.seen, tracked.point, pose, *at)
        self._reference = slot
        for dropped, heir, relative in self.mapper.dropped:
            self.history.inherit(dropped, heir, relative)
        if self.settings.loop_closing.enabled:
            begin = perf_counter()
            before = self.world.kf_pose[slot].copy()
            self.loops.close(slot, tracked.seen, home)
            self.history.rescale(self.loops.rescaled)
            if slot in self.loops.rescaled:  # what a loop turns with depth is within the motion's noise
                self.motion.carried(before, self.world.kf_pose[slot], self.loops.rescaled[slot])
            spent["loop_closing"] = perf_counter() - begin
        self._keyframes.made(frame.index)
        gone = [dropped for dropped, _, _ in self.mapper.dropped]
        self._views.renew(slot, frame.depth, gone, self.settings.keyframes.depth_images)
        tracked.point = self.world.kf_point[slot, : len(tracked.seen)].astype(np.int64)
        tracked.T_cam_world = self.world.kf_pose[slot].copy()
        self.world.release()
        return spent

    def _localised(self, T_cam_world: Array | None, spent: dict[str, float] | None = None) -> BackendResult:
        """A frame's outcome with the state and the map as they are now; `spent` on a keyframe, if it became one."""
        return BackendResult.of(self.world, self.state, T_cam_world, len(self.loops.closed), spent or {})

    # ------------------------------------------------------------------ what others may see

    def predict(self, timestamp: float) -> Array | None:
        """The motion model's camera-to-world pose at a time, after a long gap the last tracked one; None while lost.

        Args:
            timestamp: The stamp of the frame to come, seconds.
        """
        if self._last is None or not self._tracked:
            return None
        regular = self.motion.regular(self._last, timestamp)
        return se3.inverse(self.motion.predicted(self._last, regular, self.settings.motion))

    def motion_covariance(self, timestamp: float) -> Array | None:
        """Covariance ``[6, 6]`` of the camera's motion since the last frame, about the predicted one.

        It is of (position in the world in metres, rotation in the camera frame in radians); None while lost, when
        nothing is known yet, and after a gap that nothing is assumed about.

        Args:
            timestamp: The stamp of the frame to come, seconds.
        """
        if self._last is None:
            return None
        regular = self.motion.regular(self._last, timestamp)
        return self.motion.covariance(self._last, regular, self.settings.motion)

    def keyframe_views(self, limit: int) -> tuple[KeyframeView, ...]:
        """The newest keyframes of the map that the camera is in, newest first, at most `limit`."""
        return self._views.keyframes(limit, self._island)

    def map_points(self) -> tuple[NDArray[np.int64], Array]:
        """Ids ``[M]`` and world positions ``[M, 3]`` in metres of all points of the map that the camera is in."""
        return self._views.points(self._island)

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for ``keyframes.csv``, ``map.ply`` and the sheet."""
        return self._views.outputs()

    def save_map(self, path: Path, made_by: str = "") -> None:
        """Write the map to a file from which a later run may start (`backend.map.file`).

        Args:
            path: The file; ``map.npz`` in runs.
            made_by: Which run made it, in words.

        Raises:
            TrackerError: There is no map yet, or it is too large for a file.
            DynslamError: The file cannot be written.
        """
        save(path, self.world, self._submaps, self._made_of, depth=self.uses_depth, made_by=made_by)

    def finalize(self) -> Trajectory:
        """Camera-to-world poses of all tracked frames, re-expressed relative to the refined keyframes.

        With `bundle_adjustment.full` all of the map is refined first, unless the run only localises in it; should
        the run go on, that is taken back.
        """
        if self._grows and self.settings.bundle_adjustment.full:
            self.mapper.adjust_all()
        return self.history.trajectory(self.world, self.settings.motion)


# What the back end says of one frame.


@dataclass(frozen=True, eq=False)
class BackendResult:
    """Where a frame was taken, and what finding that out did to the map.

    Attributes:
        T_world_cam: Camera-to-world pose ``[4, 4]``, after bundle adjustment if the frame became a keyframe; a
            prediction while `state` is ``lost``; None before the first keyframe.
        state: ``ok`` (tracked), ``lost`` or ``initialising``.
        matches: Features matched with points of the map or of the last frame.
        inliers: How many of them fit the pose and observe a map point.
        residual_px: Median reprojection error of the inliers in pixels of octave 0; 0 where there is no pose.
        relocalised: Whether the first pose came from keyframes' descriptors.
        keyframe: Whether the frame became a keyframe.
        map_points: Points in the map afterwards.
        keyframes: Keyframes in the map afterwards.
        maps: Maps that they are of: beside the first one those that began after a loss and have not met it.
        loops: Loops that were closed so far.
        timings: Seconds of ``tracking``, ``mapping``, ``bundle_adjustment`` and ``loop_closing``, where they worked.
    """

    T_world_cam: Array | None
    state: TrackingState
    matches: int
    inliers: int
    residual_px: float
    relocalised: bool
    keyframe: bool
    map_points: int
    keyframes: int
    maps: int
    loops: int
    timings: Mapping[str, float]

    @classmethod
    def of(
        cls, world: Map, state: TrackingState, T_cam_world: Array | None, loops: int, timings: Mapping[str, float]
    ) -> BackendResult:
        """A frame's outcome with the map as it is now, before its matches are counted.

        Args:
            world: The map.
            state: Of tracking.
            T_cam_world: World-to-camera pose ``[4, 4]``, if there is one.
            loops: How many were closed so far.
            timings: What a keyframe took, if the frame became one.
        """
        return cls(
            T_world_cam=None if T_cam_world is None else se3.inverse(T_cam_world),
            state=state,
            matches=0,
            inliers=0,
            residual_px=0.0,
            relocalised=False,
            keyframe=bool(timings),
            map_points=world.point_count,
            keyframes=world.keyframe_count,
            maps=world.map_count,
            loops=loops,
            timings=timings,
        )


# The back end without depth: the same tracking and mapping, begun by two views instead of one.


class MonocularBackend(RgbdBackend):
    """Tracks frames against a map whose points are triangulated; lengths are in units of its first median depth.

    No feature it is given has a depth. The scale of bundle adjustment is free but for the keyframes that stay.

    Args:
        settings: Of tracking, mapping, bundle adjustment, keyframes, relocalisation and the first two views.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
        extractor: Who finds them.
    """

    uses_depth = False
    settings: MonocularBackendSettings

    def __init__(
        self,
        settings: MonocularBackendSettings | None = None,
        *,
        scale_factor: float = 1.2,
        levels: int = 8,
        extractor: str = "orb",
    ) -> None:
        own = settings or MonocularBackendSettings()
        super().__init__(own, scale_factor=scale_factor, levels=levels, extractor=extractor)

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins."""
        super().reset(camera, seed)
        self._views_so_far = TwoViewInitialiser()

    def _initialise(self, frame: FrameBundle, seen: Observations) -> BackendResult:
        """Frames are ``initialising`` until one shows, together with an earlier one, how the camera moved."""
        begin = perf_counter()
        start = self._views_so_far.take(View(frame, seen), self.camera, self.settings.two_views)
        if start is None:
            return self._localised(None)
        spent = {"mapping": perf_counter() - begin}
        return self._begin_from_two(start, np.eye(4), spent)

    def _usable(self, seen: Observations) -> int:
        """How many features a map could begin with: depth is none's."""
        return len(seen)

    def _begin_submap(self, frame: FrameBundle, seen: Observations, last: TrackedFrame) -> BackendResult | None:
        """A map of its own begins as the first one did; its unit of length is the median depth of its own views."""
        begin = perf_counter()
        if self._unrecognised == self.settings.relocalisation.new_map_after:
            self._views_so_far = TwoViewInitialiser()
        start = self._views_so_far.take(View(frame, seen), self.camera, self.settings.two_views)
        if start is None:
            return None
        spent = {"mapping": perf_counter() - begin}
        self._note_submap(last, start.first.frame.timestamp)
        T_first_world = last.T_cam_world.copy()
        T_first_world[:3] = start.T_cam_first[:3, :3].T @ self._reach.turned(last)[:3]
        return self._begin_from_two(start, T_first_world, spent)

    def _begin_from_two(self, start: InitialMap, T_first_world: Array, spent: dict[str, float]) -> BackendResult:
        """The two views become keyframes; the second, which is the frame at hand, is tracked."""
        first, second = put(self.world, start, T_first_world, self._island)
        frame, seen, pose = start.second.frame, start.second.seen, self.world.kf_pose[second].copy()
        self._views_so_far = TwoViewInitialiser()
        self._tracked = True
        point = self.world.kf_point[second, : len(seen)].astype(np.int64)
        self._last = TrackedFrame(seen, point, pose, frame.timestamp)
        self._reference = second
        self._keyframes.made(frame.index)
        for slot, view in ((first, start.first), (second, start.second)):
            self._views.renew(slot, view.frame.depth, [], self.settings.keyframes.depth_images)
        self.state = self._state()
        self.history.append(frame.timestamp, second, np.eye(4), 1e6 * np.eye(6))
        count = len(start.points)
        return replace(self._localised(pose, spent), matches=count, inliers=count)


# The back end that settings ask for: with depth or without.


def build_backend(settings: BackendSettings, scale_factor: float, levels: int, extractor: str) -> RgbdBackend:
    """A back end.

    Args:
        settings: `MonocularBackendSettings` for one without depth.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
        extractor: Who finds them.
    """
    if isinstance(settings, MonocularBackendSettings):
        return MonocularBackend(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
    return RgbdBackend(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
