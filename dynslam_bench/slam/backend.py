"""The back end that all trackers share: what turns the static features of a frame into a pose and a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FrameBundle, MapOutputs, TrackingState, TrackResult
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.slam.atlas import open_atlas, save_atlas
from dynslam_bench.slam.initialisation import InitialMap, TwoViewInitialiser
from dynslam_bench.slam.local_mapping import KeyframePolicy, LocalMapper, refined
from dynslam_bench.slam.loop_closing import LoopCloser
from dynslam_bench.slam.map import DEPTH_IMAGES, Array, Map, MapView, MapViews, map_outputs
from dynslam_bench.slam.map_files import MapFeatures
from dynslam_bench.slam.motion_model import (
    JITTER,
    MIN_AGREEING,
    CameraMotion,
    CameraVelocity,
    FramePose,
    RollingShutter,
    compensate_rolling_shutter,
    rescale,
    trajectory,
)
from dynslam_bench.slam.relocalisation import PoseSearch, RelocalisationGate
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings
from dynslam_bench.slam.tracking import (
    InitialPose,
    LocalMap,
    MapFit,
    Observations,
    TrackedFrame,
    observe,
    pose_from_last_frame,
    track_local_map,
)

MIN_INITIAL = 60
"""Features with depth that the first keyframe needs."""
KNOWN_POSE = 1e6 * np.eye(6)
"""Information of a pose that defines a map's frame of reference."""


class RgbdBackend:
    """Tracks frames against a map that it builds.

    Args:
        settings: Of tracking, mapping, bundle adjustment, keyframes and relocalisation.
        scale_factor: Ratio of consecutive pyramid levels of the features.
        levels: Number of pyramid levels of the features.
        extractor: Id of the feature extractor; a saved map serves the same features alone.
    """

    uses_depth = True
    """Whether depth is read; where it is not, the pipeline hides it."""

    def __init__(
        self,
        settings: BackendSettings,
        *,
        scale_factor: float = 1.2,
        levels: int = 8,
        extractor: str = "orb",
    ) -> None:
        self.settings = settings
        self._features = MapFeatures(
            extractor=extractor, levels=max(levels, 1), scale_factor=scale_factor
        )

    def configure(self, settings: BackendSettings) -> None:
        """Put other settings into force from the next frame on."""
        self.settings = settings
        if hasattr(self, "mapper"):
            self.mapper.settings = self.loops.settings = settings
            self._keyframes.settings = settings.keyframes

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins, in the map that the settings name, if they do.

        Args:
            camera: Intrinsics; keypoints' `xy` come undistorted, so its distortion plays no role
                here.
            seed: Founds all random draws.

        Raises:
            SettingsError: That map cannot be read, or is of another camera, other features or
                another sensor.
        """
        s = self.settings
        self.camera = camera.undistorted()
        self.seed = int(seed)
        self.atlas = open_atlas(s.map.file, self.camera, self._features, depth=self.uses_depth)
        self.world = self.atlas.world
        self.mapper = LocalMapper(self.world, s)
        self.history: list[FramePose] = []
        self.motion = CameraMotion(s.motion)
        self.shutter = RollingShutter(self.camera, self.motion.intervals)
        self.loops = LoopCloser(
            self.atlas, self.mapper, s, self.seed, scale_is_known=self.uses_depth
        )
        self.state: TrackingState = "initialising"
        self._grows = not s.map.localisation_only
        self._gate = RelocalisationGate(
            self.atlas, s.relocalisation.max_speed, anywhere=bool(s.map.file)
        )
        self._keyframes = KeyframePolicy(s.keyframes, self.mapper.close_m)
        self._local_map = LocalMap(self.world, connected_only=s.loop_closing.enabled)
        self._views = MapViews(self.world, DEPTH_IMAGES if self.uses_depth else 0)
        self._tracked = False
        self._unrecognised = 0
        self._reference = -1
        self._last: TrackedFrame | None = None
        self._first: tuple[FrameBundle, Observations] | None = None
        self._refined: Map | None = None

    # ------------------------------------------------------------------ one frame

    def track(
        self, frame: FrameBundle, keep: NDArray[np.bool_], weight: NDArray[np.float32]
    ) -> TrackResult:
        """Find the frame's pose and, if it shows enough new, make it a keyframe.

        Args:
            frame: The frame with its features.
            keep: bool ``[N]``; features with False enter neither tracking nor map.
            weight: float32 ``[N]`` in [0, 1], confidence that a feature is static.

        Returns:
            The pose, after bundle adjustment if the frame became a keyframe, and None before the
            first keyframe; the state. Stats: ``matches`` (features matched with points of the map
            or of the last frame), ``inliers`` (how many of them fit the pose and observe a map
            point), ``residual_px`` (their median reprojection error in pixels of octave 0; 0
            without a pose), ``relocalised`` (whether the initial pose came from keyframes), and
            what the map holds afterwards: ``map_points``, ``keyframes``, ``maps`` (the root map,
            and submaps that were not merged with it), ``loops`` (closed so far), ``keyframe``
            (whether the frame became one). Timings: seconds of ``tracking``, ``mapping``,
            ``bundle_adjustment`` and ``loop_closing``, where they worked.
        """
        begin = perf_counter()
        self._refined = None
        observations = observe(frame, keep, weight, self.camera, self.world.scales)
        result = (
            self._track(frame, observations)
            if self.world.next_keyframe
            else self._initialise(frame, observations)
        )
        stages = {"tracking": perf_counter() - begin - sum(result.timings.values())}
        return replace(
            result, timings={**stages, "mapping": 0.0, "bundle_adjustment": 0.0, **result.timings}
        )

    def _track(self, frame: FrameBundle, raw: Observations) -> TrackResult:
        """Predict, match the last frame or relocalise, track the local map, insert a keyframe."""
        last = self._last_frame(frame, raw)
        stamp = frame.timestamp
        tracking = self.settings.tracking
        rolling = bool(tracking.rolling_shutter and self.camera.readout_s and self._tracked)
        observations = self.shutter.predicted(raw, last, stamp) if rolling else raw
        prediction, _ = self.motion.expected(last, stamp)
        initial, root = self._initial_pose(frame, raw, observations, last, prediction)
        if initial is None:
            return self._lose(frame, raw, last, prediction)
        _, points = self._local_map.around(initial.keyframe)
        fit = track_local_map(
            self.world, observations, initial.matches, initial.T_cam_world, points, tracking
        )
        velocity = None
        if rolling and self._tracked:
            observations, fit, velocity = self.shutter.refitted(
                raw, observations, fit, last, stamp, force=self._first is not None
            )
        if self._grows:
            self.world.visible[fit.in_view] += 1
        required = (
            tracking.min_inliers if self._tracked else self.settings.relocalisation.min_inliers
        )
        if fit.count < required:
            result = self._lose(frame, raw, last, prediction)
        else:
            tracked = self._accept(frame, observations, fit, last)
            self.shutter.velocity = velocity
            first = self._first
            self._first = None
            if first is not None and velocity is not None:
                return self._restart(frame, raw, first, velocity, fit.count)
            result = self._update_map(frame, tracked, fit, root)
        counts = {
            "matches": len(fit.matches.feature),
            "inliers": fit.count,
            "relocalised": initial.relocalised,
        }
        return replace(result, stats={**result.stats, **counts})

    def _initial_pose(
        self,
        frame: FrameBundle,
        raw: Observations,
        observations: Observations,
        last: TrackedFrame,
        prediction: Array,
    ) -> tuple[InitialPose | None, InitialPose | None]:
        """The frame's initial pose, and its pose in the root map where a submap's camera is found there, too."""
        world = self.world
        reference = self._reference
        candidate, trusted = pose_from_last_frame(
            world, last, observations, prediction, reference, self.settings.tracking
        )
        initial = candidate if trusted and self._tracked else None
        if initial is not None and not self.atlas.active:
            return initial, None
        if self._tracked:
            keyframes, _ = self._local_map.around(reference)
            bound = self._gate.while_tracked(last, raw, frame.timestamp, prediction)
        else:  # how other submaps lie to the active one is unknown
            keyframes = world.keyframes
            keyframes = keyframes[np.isin(world.kf_map[keyframes], (0, self.atlas.active))]
            bound = self._gate.while_lost(last, raw, frame.timestamp)
        search = PoseSearch(
            observations,
            reference,
            keyframes,
            not self._tracked,
            bound,
            self.settings,
            self.seed,
            frame.index,
        )
        root = search.in_root_map() if self._tracked and self.atlas.active else None
        initial = initial or search.relocalised(candidate)
        # the camera is lost in the submap, and found in the root map
        if initial is None and root is not None:
            self._tracked = False
            self._gate.start(last)
            self._forget_motion()
            return root, None
        return initial, root

    def _last_frame(self, frame: FrameBundle, observations: Observations) -> TrackedFrame:
        """The last tracked frame; an empty one before the camera is found in a loaded map."""
        if self._last is not None:
            return self._last
        stored, own = (8 * words.shape[1] for words in (self.world.words, observations.words))
        if len(observations) and own != stored:
            raise TrackerError(
                f"the map's descriptors have {stored} bytes, frame {frame.index}'s {own}",
                "make the map with the same features",
            )
        keep = np.zeros(len(frame.xy), bool)
        none = observe(frame, keep, keep.astype(np.float32), self.camera, self.world.scales)
        return TrackedFrame(none, np.zeros(0, np.int64), np.eye(4), frame.timestamp)

    def _accept(
        self, frame: FrameBundle, observations: Observations, fit: MapFit, last: TrackedFrame
    ) -> TrackedFrame:
        """The frame is tracked: its pose is weighed against the motion model, its inliers count as found."""
        points = fit.matches.point[fit.inliers]
        if self._grows:
            self.world.found[points] += 1
        point = np.full(len(observations.xy), -1, np.int64)
        point[fit.matches.feature[fit.inliers]] = points
        pose = self.motion.filtered(
            last, frame.timestamp, fit.estimate.T_cam_world, fit.estimate.information
        )
        self._tracked = True
        self._unrecognised = 0
        self._last = tracked = TrackedFrame(observations, point, pose, frame.timestamp)
        near, _ = self.world.covisible_of(points)
        self._reference = int(near[0]) if len(near) else self._reference
        self._update_state()
        return tracked

    def _lose(
        self, frame: FrameBundle, observations: Observations, last: TrackedFrame, prediction: Array
    ) -> TrackResult:
        """Nothing is recognised; after some such frames, with loop closing, a submap begins."""
        self.state = "lost"
        self._first = None
        textured = int(((observations.z > 0) | (not self.uses_depth)).sum()) >= MIN_INITIAL
        if self._tracked:
            self._gate.lose(last, observations, textured=textured)
        self._tracked = False
        self._forget_motion()
        self._unrecognised = self._unrecognised + 1 if textured else 0
        begun = None
        s = self.settings
        if (
            self._grows
            and s.loop_closing.enabled
            and self._unrecognised >= s.relocalisation.new_map_after
        ):
            begun = self._begin_submap(frame, observations, last)
        return begun or self._result(None if self._last is None else prediction)

    def _forget_motion(self) -> None:
        self.motion.state = None
        self.shutter.velocity = None

    def _update_state(self) -> None:
        """Poses count in the world of the root map alone."""
        self.atlas.active = int(self.world.kf_map[self._reference])
        self.state = "ok" if self._tracked and self.atlas.active == 0 else "lost"

    def _result(
        self, T_cam_world: Array | None, timings: Mapping[str, float] | None = None, **stats: float
    ) -> TrackResult:
        """A frame's result with the state and the map as they are now; with `timings` if it became a keyframe."""
        world = self.world
        pose = None if T_cam_world is None else se3.inverse(T_cam_world)
        counts = {
            "matches": 0, "inliers": 0, "map_points": len(world.points), "keyframes": world.keyframe_count,
            "keyframe": bool(timings), "maps": len(set(world.kf_map[world.kf_alive].tolist())),
            "loops": len(self.loops.closed), "residual_px": 0.0, "relocalised": False,
        }  # fmt: skip
        return TrackResult(pose, self.state, counts | stats, timings or {})

    # ------------------------------------------------------------------ beginning a map

    def _initialise(self, frame: FrameBundle, observations: Observations) -> TrackResult:
        """The first frame with enough depth is the first keyframe, and the world's frame of reference."""
        if np.count_nonzero(observations.z > 0) < MIN_INITIAL:
            return self._result(None)
        if self.settings.tracking.rolling_shutter and self.camera.readout_s:
            self._first = frame, observations
        return self._begin_map(frame, observations, np.eye(4))

    def _begin_map(
        self, frame: FrameBundle, observations: Observations, T_cam_world: Array
    ) -> TrackResult:
        """The frame becomes the first keyframe of the active map."""
        self._tracked = True
        point = np.full(len(observations), -1, np.int64)
        self._last = tracked = TrackedFrame(observations, point, T_cam_world, frame.timestamp)
        timings = self._insert_keyframe(frame, tracked)
        self._update_state()
        self._remember(frame, np.eye(4), KNOWN_POSE)
        points = int(np.count_nonzero(tracked.point >= 0))
        return self._result(T_cam_world, timings, matches=points, inliers=points)

    def _restart(
        self,
        frame: FrameBundle,
        raw: Observations,
        first: tuple[FrameBundle, Observations],
        velocity: CameraVelocity,
        inliers: int,
    ) -> TrackResult:
        """Begin the map again: the second frame tells the camera's motion in the first, whose points were distorted.

        Where fewer points agree then than the `inliers` before, the first frame is left
        uncompensated.
        """
        seconds = dict[str, float]()
        for assumed in (velocity, None):
            self.reset(self.camera, self.seed)
            self.shutter.velocity = assumed
            observations = (
                first[1]
                if assumed is None
                else compensate_rolling_shutter(first[1], self.camera, assumed)
            )
            begun = self._begin_map(first[0], observations, np.eye(4))
            result = self._track(frame, raw)
            for stage, spent in (*begun.timings.items(), *result.timings.items()):
                seconds[stage] = seconds.get(stage, 0.0) + spent
            if result.state == "ok" and result.stats["inliers"] >= MIN_AGREEING * inliers:
                break
        return replace(result, timings=seconds)

    def _begin_submap(
        self, frame: FrameBundle, observations: Observations, last: TrackedFrame
    ) -> TrackResult | None:
        """Begin a submap where the camera was lost, rotated as the images tell; None if not yet."""
        self._note_submap(last, frame.timestamp)
        return self._begin_map(frame, observations, self._gate.rotated(last))

    def _note_submap(self, last: TrackedFrame, timestamp: float) -> None:
        """A submap begins with the frame of this stamp."""
        self._unrecognised = 0
        start = se3.inverse(last.T_cam_world)[:3, 3]
        self.atlas.begin_submap(start, self._gate.distance_m(last, timestamp), self._gate.slack)

    # ------------------------------------------------------------------ keyframes

    def _update_map(
        self, frame: FrameBundle, tracked: TrackedFrame, fit: MapFit, root: InitialPose | None
    ) -> TrackResult:
        """Make the tracked frame a keyframe if the policy or a merge asks for it, and add its pose to the history."""
        timings = {}
        pose = fit.estimate.T_cam_world
        needed = root is not None or self._keyframes.needs_keyframe(
            self.world, tracked, frame.index, self._reference
        )
        if self._grows and needed:
            timings = self._insert_keyframe(frame, tracked, root)
            pose = tracked.T_cam_world
            self.motion.relocated(pose)
        self._remember(
            frame, pose @ se3.inverse(self.world.kf_pose[self._reference]), fit.estimate.information
        )
        self._update_state()
        result = self._result(tracked.T_cam_world, timings, residual_px=fit.estimate.residual_px)
        if root is None or not self.atlas.active or not self.loops.in_root_map:
            return result
        # the camera is in the root map, too: there its pose counts, and it may continue there
        self.history[-1].reference = root.keyframe
        self.history[-1].T_cam_ref = root.T_cam_world @ se3.inverse(
            self.world.kf_pose[root.keyframe]
        )
        if self.loops.leaves_submap:
            point = np.full(len(tracked.observations), -1, np.int64)
            point[root.matches.feature] = np.where(
                self.world.alive[root.matches.point], root.matches.point, -1
            )
            self._last = replace(tracked, point=point, T_cam_world=root.T_cam_world)
            self._reference = root.keyframe
            self._forget_motion()
            self._update_state()
        return replace(result, T_world_cam=se3.inverse(root.T_cam_world), state="ok")

    def _remember(self, frame: FrameBundle, T_cam_ref: Array, information: Array) -> None:
        self.history.append(
            FramePose(frame.timestamp, self._reference, T_cam_ref, information.astype(np.float32))
        )

    def _insert_keyframe(
        self, frame: FrameBundle, tracked: TrackedFrame, root: InitialPose | None = None
    ) -> dict[str, float]:
        """Make a tracked frame a keyframe, with bundle adjustment and loop closing; returns seconds by stage."""
        world = self.world
        mapper = self.mapper
        slot, timings = mapper.insert(
            tracked.observations,
            tracked.point,
            tracked.T_cam_world,
            frame.index,
            frame.timestamp,
            self.atlas.active,
        )
        self._reference = slot
        for culled, replacement, relative in mapper.culled:
            for pose in (pose for pose in self.history if pose.reference == culled):
                pose.reference = replacement
                pose.T_cam_ref = pose.T_cam_ref @ relative
        if self.settings.loop_closing.enabled:
            begin = perf_counter()
            before = world.kf_pose[slot].copy()
            self.loops.close(slot, tracked.observations, root)
            rescale(self.history, self.loops.rescaled)
            # the rotation by a loop with depth is within the motion's noise
            if slot in self.loops.rescaled:
                self.motion.transformed(before, world.kf_pose[slot], self.loops.rescaled[slot])
            timings["loop_closing"] = perf_counter() - begin
        self._keyframes.made(frame.index)
        self._views.add_keyframe(slot, frame.depth)
        tracked.point = world.kf_point[slot, : len(tracked.observations)].astype(np.int64)
        tracked.T_cam_world = world.kf_pose[slot].copy()
        world.release()
        return timings

    # ------------------------------------------------------------------ what filters and files read

    def predict(self, timestamp: float) -> tuple[Array | None, Array | None]:
        """Camera-to-world pose at a time, and the covariance of the motion since the last frame; None while lost.

        The covariance ``[6, 6]`` is of (position in the world in metres, rotation in the camera
        frame in radians). It is None after a gap that nothing is assumed about; the pose is the
        last tracked one then.

        Args:
            timestamp: The stamp of the next frame, seconds.
        """
        if self._last is None or not self._tracked:
            return None, None
        T_cam_world, covariance = self.motion.expected(self._last, timestamp, jitter=JITTER)
        return se3.inverse(T_cam_world), covariance

    def view(self) -> MapView:
        """What filters may read of the map that the camera is in, as it was before a `finalize`."""
        return self._views.of(self.atlas.active)

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for ``keyframes.csv``, ``map.ply`` and pictures."""
        return map_outputs(self._refined or self.world)

    def save_map(self, path: Path, made_by: str = "") -> None:
        """Write the map to a file from which a later run may start (`backend.map.file`).

        Args:
            path: The file; ``map.npz`` in runs.
            made_by: Which run made it, in words.

        Raises:
            TrackerError: There is no map yet, or it is too large for a file.
            DynslamError: The file cannot be written.
        """
        world = self._refined or self.world
        save_atlas(path, self.atlas, world, self._features, depth=self.uses_depth, made_by=made_by)

    def finalize(self) -> Trajectory:
        """Camera-to-world poses of all tracked frames, re-expressed relative to the refined keyframes.

        With `bundle_adjustment.full` a copy of the whole map is refined first, unless the run only
        localises in it.
        """
        if self._grows and self.settings.bundle_adjustment.full and self._refined is None:
            self._refined = refined(self.world)
        return trajectory(self.history, self._refined or self.world, self.settings.motion)


class MonocularBackend(RgbdBackend):
    """Tracks frames against a map whose points are triangulated; lengths are in units of its initial median depth.

    No feature has a depth. The scale of bundle adjustment is free but for the keyframes that stay.
    """

    uses_depth = False
    settings: MonocularBackendSettings

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins."""
        super().reset(camera, seed)
        self._initialiser = TwoViewInitialiser()

    def _initialise(self, frame: FrameBundle, observations: Observations) -> TrackResult:
        """Frames are ``initialising`` until one determines the motion together with an earlier one."""
        begin = perf_counter()
        initial = self._initialiser.add(frame, observations, self.camera, self.settings.two_views)
        if initial is None:
            return self._result(None)
        return self._begin_from_two(initial, np.eye(4), perf_counter() - begin)

    def _begin_submap(
        self, frame: FrameBundle, observations: Observations, last: TrackedFrame
    ) -> TrackResult | None:
        """Begin a submap as the root map began; its unit of length is the median depth of its own views."""
        begin = perf_counter()
        if self._unrecognised == self.settings.relocalisation.new_map_after:
            self._initialiser = TwoViewInitialiser()
        initial = self._initialiser.add(frame, observations, self.camera, self.settings.two_views)
        if initial is None:
            return None
        seconds = perf_counter() - begin
        self._note_submap(last, initial.first.frame.timestamp)
        T_first_world = last.T_cam_world.copy()
        T_first_world[:3] = initial.motion.T_second_first[:3, :3].T @ self._gate.rotated(last)[:3]
        return self._begin_from_two(initial, T_first_world, seconds)

    def _begin_from_two(
        self, initial: InitialMap, T_first_world: Array, seconds: float
    ) -> TrackResult:
        """The two views become keyframes; the second, which is the current frame, is tracked."""
        first, second = initial.insert_into(self.world, T_first_world, self.atlas.active)
        frame = initial.second.frame
        observations = initial.second.observations
        pose = self.world.kf_pose[second].copy()
        self._initialiser = TwoViewInitialiser()
        self._tracked = True
        point = self.world.kf_point[second, : len(observations)].astype(np.int64)
        self._last = TrackedFrame(observations, point, pose, frame.timestamp)
        self._reference = second
        self._keyframes.made(frame.index)
        self._views.add_keyframe(first, initial.first.frame.depth)
        self._views.add_keyframe(second, frame.depth)
        self._update_state()
        self._remember(frame, np.eye(4), KNOWN_POSE)
        count = len(initial.motion.points)
        return self._result(pose, {"mapping": seconds}, matches=count, inliers=count)


def build_backend(
    settings: BackendSettings, scale_factor: float, levels: int, extractor: str
) -> RgbdBackend:
    """The back end that settings ask for: with depth or, of `MonocularBackendSettings`, without.

    Args:
        settings: Of the back end.
        scale_factor: Ratio of consecutive pyramid levels of the features.
        levels: Number of pyramid levels of the features.
        extractor: Id of the feature extractor.
    """
    kind = MonocularBackend if isinstance(settings, MonocularBackendSettings) else RgbdBackend
    return kind(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
