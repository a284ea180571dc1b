"""The back end that all trackers share: what turns the static features of a frame into a pose and a map.

`Backend.track` follows ORB-SLAM3's ``Tracking::Track``. A frame's initial pose comes from the
last frame or, if that is not trusted, from keyframes (relocalisation). The local map is matched
around it and the pose is fitted to all matches. A frame that shows enough new becomes a keyframe,
with local mapping and loop closing. A camera that is not recognised for some frames begins a submap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FrameBundle, MapOutputs, TrackingState, TrackResult
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.slam.atlas import open_atlas, save_atlas
from dynslam_bench.slam.initialisation import InitialMap, TwoViewInitialiser
from dynslam_bench.slam.local_mapping import KeyframePolicy, LocalMapper, refined
from dynslam_bench.slam.loop_closing import LoopCloser, RootMapPose
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
from dynslam_bench.slam.observations import Observations, observe
from dynslam_bench.slam.pose_optimisation import motion_covariance
from dynslam_bench.slam.relocalisation import MotionBound, PoseSearch, RelocalisationGate
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings
from dynslam_bench.slam.tracking import (
    InitialPose,
    LocalMap,
    MapFit,
    TrackedFrame,
    observe_points,
    pose_from_last_frame,
    track_local_map,
)

MIN_INITIAL = 60
"""Features with depth that the first keyframe needs."""
KNOWN_POSE = 1e6 * np.eye(6)
"""Information of a pose that defines a map's frame of reference."""
ROOT_MAP = 0
"""Number of the root map in the atlas; poses count in its world alone."""


class CameraStatus(Enum):
    """States of the back end: how well the camera's place is known.

    `INITIALISING` becomes `TRACKED` with the first keyframe or, in a loaded map, when the camera is
    found. `TRACKED` becomes `LOST` with a frame that the map does not explain. `LOST` becomes
    `TRACKED` by relocalisation or with the first keyframe of a submap.
    """

    INITIALISING = "initialising"
    """No frame has been tracked yet."""
    TRACKED = "tracked"
    """The last frame has a pose in the active map, which is the root map or a submap."""
    LOST = "lost"
    """The last frame was not recognised."""


@dataclass(frozen=True, eq=False)
class CurrentFrame:
    """The frame that is being tracked.

    Attributes:
        bundle: The frame.
        measured: Its features as they were measured.
        observations: Its features, compensated for the rolling shutter where that is known.
        last: The last tracked frame.
        prediction: World-to-camera pose ``[4, 4]`` by the motion model.
    """

    bundle: FrameBundle
    measured: Observations
    observations: Observations
    last: TrackedFrame
    prediction: Array


class UncompensatedFrame(NamedTuple):
    """The first keyframe of a map, whose rolling shutter can be compensated once the motion is known."""

    bundle: FrameBundle
    measured: Observations


class Backend:
    """Tracks frames against a map that it builds.

    Args:
        settings: Settings of tracking, mapping, bundle adjustment, keyframes and relocalisation.
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
            self.mapper.settings = settings
            self.loops.settings = settings
            self._keyframe_policy.settings = settings.keyframes

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything and begin a new sequence, in a loaded map if the settings name one.

        Args:
            camera: Intrinsics; keypoints' `xy` come undistorted, so its distortion plays no role
                here.
            seed: Seed of all random draws.

        Raises:
            SettingsError: The map cannot be read, or was made with another camera, other features
                or another sensor.
        """
        # the map, empty or loaded, and what builds it
        s = self.settings
        self.camera = camera.undistorted()
        self.seed = int(seed)
        self.atlas = open_atlas(s.map.file, self.camera, self._features, depth=self.uses_depth)
        self.map = self.atlas.map
        self.mapper = LocalMapper(self.map, s)
        self._keyframe_policy = KeyframePolicy(s.keyframes, self.mapper.close_m)

        # the camera's motion
        self.history: list[FramePose] = []
        self.motion = CameraMotion(s.motion)
        self.shutter = RollingShutter(self.camera, self.motion.intervals)

        # loops and relocalisation
        self.loops = LoopCloser(
            self.atlas, self.mapper, s, self.seed, scale_is_known=self.uses_depth
        )
        self._gate = RelocalisationGate(
            self.atlas, s.relocalisation.max_speed, anywhere=bool(s.map.file)
        )
        self._local_map = LocalMap(self.map, connected_only=s.loop_closing.enabled)
        self._map_views = MapViews(self.map, DEPTH_IMAGES if self.uses_depth else 0)

        # the state of tracking
        self._status = CameraStatus.INITIALISING
        self._mapping_enabled = not s.map.localisation_only
        self._unrecognised_frames = 0
        self._reference_keyframe = -1
        self._last_frame: TrackedFrame | None = None
        self._uncompensated_first: UncompensatedFrame | None = None
        self._refined_map: Map | None = None

    @property
    def state(self) -> TrackingState:
        """The tracking state of the last frame; a camera that is tracked in a submap counts as lost."""
        if self._status is CameraStatus.INITIALISING:
            return "initialising"
        in_root_map = self._status is CameraStatus.TRACKED and self.atlas.active == ROOT_MAP
        return "ok" if in_root_map else "lost"

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
        self._refined_map = None
        # the features that the filters keep, with depth, octave and information
        measured = observe(frame, keep, weight, self.camera, self.map.scales)
        # the first frames make the map, later ones are tracked against it
        has_map = self.map.next_keyframe > 0
        if has_map:
            result = self._track(frame, measured)
        else:
            result = self._initialise(frame, measured)

        # what the other stages did not take is tracking
        tracking_s = perf_counter() - begin - sum(result.timings.values())
        timings = {"tracking": tracking_s, "mapping": 0.0, "bundle_adjustment": 0.0}
        return replace(result, timings={**timings, **result.timings})

    def _track(self, frame: FrameBundle, measured: Observations) -> TrackResult:
        """Track a frame against the map (ORB-SLAM3's ``Tracking::Track``)."""
        # predict the pose, and undo the rolling shutter by the last frame's velocity
        current = self._predict_frame(frame, measured)

        # initial pose: from the last frame, else from keyframes (relocalisation)
        initial, pose_in_root_map = self._estimate_initial_pose(current)
        if initial is None and pose_in_root_map is not None:
            # the camera is lost in the submap, and found in the root map
            self._leave_submap(current.last)
            initial = pose_in_root_map
            pose_in_root_map = None
        if initial is None:
            return self._lose(current)

        # match the local map around the initial pose, and fit the pose to all matches
        _, points = self._local_map.around(initial.keyframe)
        map_fit = track_local_map(
            self.map,
            current.observations,
            initial.matches,
            initial.T_cam_world,
            points,
            self.settings.tracking,
        )

        # undo the rolling shutter by the motion to the fitted pose, and fit again
        observations, map_fit, velocity = self._refit_rolling_shutter(current, map_fit)

        # a pose that too few map points agree with is rejected
        if self._mapping_enabled:
            self.map.visible[map_fit.in_view] += 1
        if map_fit.count < self._min_inliers():
            return _with_match_counts(self._lose(current), map_fit, initial)

        # weigh the pose against the motion model
        tracked = self._accept_pose(current, observations, map_fit)
        self.shutter.velocity = velocity

        # the second frame of a map tells the motion in the first: begin the map again without its distortion
        first = self._uncompensated_first
        self._uncompensated_first = None
        if first is not None and velocity is not None:
            return self._restart_compensated(current, first, velocity, map_fit.count)

        # insert a keyframe if the frame shows enough new
        result = self._update_map(frame, tracked, map_fit, pose_in_root_map)
        return _with_match_counts(result, map_fit, initial)

    # ------------------------------------------------------------------ steps of tracking

    def _predict_frame(self, frame: FrameBundle, measured: Observations) -> CurrentFrame:
        """The frame with its pose by the motion model and its features by the last frame's velocity."""
        last = self._last_tracked_frame(frame, measured)
        prediction, _ = self.motion.predict_T_cam_world(last, frame.timestamp)
        observations = measured
        if self._compensates_rolling_shutter():
            observations = self.shutter.predicted(measured, last, frame.timestamp)
        return CurrentFrame(frame, measured, observations, last, prediction)

    def _compensates_rolling_shutter(self) -> bool:
        """Whether the rolling shutter is compensated; a lost camera's motion is unknown."""
        return bool(
            self.settings.tracking.rolling_shutter
            and self.camera.readout_s
            and self._status is CameraStatus.TRACKED
        )

    def _last_tracked_frame(self, frame: FrameBundle, measured: Observations) -> TrackedFrame:
        """The last tracked frame; an empty one before the camera is found in a loaded map.

        Raises:
            TrackerError: The loaded map's descriptors have another length than the frame's.
        """
        if self._last_frame is not None:
            return self._last_frame
        # a loaded map: its features must be of the frame's kind
        stored_bytes = 8 * self.map.descriptor.shape[1]
        frame_bytes = 8 * measured.descriptors.shape[1]
        if len(measured) and frame_bytes != stored_bytes:
            raise TrackerError(
                f"the map's descriptors have {stored_bytes} bytes, frame {frame.index}'s {frame_bytes}",
                "make the map with the same features",
            )
        # a frame without features, in the origin of the map's world
        keep_none = np.zeros(len(frame.xy), bool)
        weight = keep_none.astype(np.float32)
        empty = observe(frame, keep_none, weight, self.camera, self.map.scales)
        return TrackedFrame(empty, np.zeros(0, np.int64), np.eye(4), frame.timestamp)

    def _estimate_initial_pose(
        self, current: CurrentFrame
    ) -> tuple[InitialPose | None, InitialPose | None]:
        """The frame's pose in the active map and, where that is a submap, its pose in the root map."""
        tracked = self._status is CameraStatus.TRACKED
        in_submap = self.atlas.active != ROOT_MAP

        # from the last frame
        from_last_frame = pose_from_last_frame(
            self.map,
            current.last,
            current.observations,
            current.prediction,
            self._reference_keyframe,
            self.settings.tracking,
        )
        initial = None
        if from_last_frame is not None and from_last_frame.trusted and tracked:
            initial = from_last_frame
        if initial is not None and not in_submap:
            return initial, None

        # from keyframes, within the motion bound
        keyframes, bound = self._relocalisation_candidates(current)
        search = PoseSearch(
            current.observations,
            self._reference_keyframe,
            keyframes,
            lost=not tracked,
            bound=bound,
            settings=self.settings,
            seed=self.seed,
            frame=current.bundle.index,
        )
        pose_in_root_map = search.pose_in_root_map() if tracked and in_submap else None
        if initial is None:
            initial = search.relocalised(from_last_frame)
        return initial, pose_in_root_map

    def _relocalisation_candidates(
        self, current: CurrentFrame
    ) -> tuple[NDArray[np.int64], MotionBound]:
        """Slots of the keyframes that the frame is compared with, and where the camera can be."""
        last = current.last
        stamp = current.bundle.timestamp
        if self._status is CameraStatus.TRACKED:
            keyframes, _ = self._local_map.around(self._reference_keyframe)
            bound = self._gate.while_tracked(last, current.measured, stamp, current.prediction)
            return keyframes, bound
        # how other submaps lie to the active one is unknown
        keyframes = self.map.keyframes
        maps = (ROOT_MAP, self.atlas.active)
        keyframes = keyframes[np.isin(self.map.kf_map[keyframes], maps)]
        return keyframes, self._gate.while_lost(last, current.measured, stamp)

    def _leave_submap(self, last: TrackedFrame) -> None:
        """The camera is lost in the submap where it was tracked."""
        self._status = CameraStatus.LOST
        self._gate.start(last)
        self._forget_motion()

    def _refit_rolling_shutter(
        self, current: CurrentFrame, map_fit: MapFit
    ) -> tuple[Observations, MapFit, CameraVelocity | None]:
        """The features compensated by the motion to the frame's pose, the pose fitted to them, and that motion.

        The motion is None, and nothing changes, where the rolling shutter is not compensated.
        """
        if not self._compensates_rolling_shutter():
            return current.observations, map_fit, None
        return self.shutter.refitted(
            current.measured,
            current.observations,
            map_fit,
            current.last,
            current.bundle.timestamp,
            force=self._uncompensated_first is not None,
        )

    def _min_inliers(self) -> int:
        """Map points that must agree with a pose; a camera that was lost needs more."""
        if self._status is CameraStatus.TRACKED:
            return self.settings.tracking.min_inliers
        return self.settings.relocalisation.min_inliers

    def _accept_pose(
        self, current: CurrentFrame, observations: Observations, map_fit: MapFit
    ) -> TrackedFrame:
        """The frame is tracked: its pose is weighed against the motion model, its inliers count as found."""
        # the inliers count as found; `LocalMapper` culls points that are seldom found
        points = map_fit.matches.point[map_fit.inliers]
        if self._mapping_enabled:
            self.map.found[points] += 1

        # fuse the pose with the motion model's prediction, each by its information
        stamp = current.bundle.timestamp
        pose = self.motion.update(
            current.last, stamp, map_fit.estimate.T_cam_world, map_fit.estimate.information
        )

        # the tracked frame, from which the next one starts
        observed = observe_points(observations, map_fit.matches.feature[map_fit.inliers], points)
        tracked = TrackedFrame(observations, observed, pose, stamp)
        self._status = CameraStatus.TRACKED
        self._unrecognised_frames = 0
        self._last_frame = tracked
        # the reference keyframe shares most points with the frame
        covisible, _ = self.map.covisible_of(points)
        if len(covisible):
            self._reference_keyframe = int(covisible[0])
        self._update_active_map()
        return tracked

    def _lose(self, current: CurrentFrame) -> TrackResult:
        """Nothing is recognised; after some such frames, with loop closing, a submap begins."""
        measured = current.measured
        usable = measured.z > 0 if self.uses_depth else np.ones(len(measured), bool)
        # more than a blank wall or a covered lens
        textured = int(usable.sum()) >= MIN_INITIAL

        # the gate bounds the motion from the last tracked frame on
        if self._status is CameraStatus.TRACKED:
            self._gate.lose(current.last, measured, textured=textured)
        self._status = CameraStatus.LOST
        self._uncompensated_first = None
        self._forget_motion()

        self._unrecognised_frames = self._unrecognised_frames + 1 if textured else 0
        if self._submap_is_due():
            begun = self._create_submap(current)
            if begun is not None:
                return begun
        return self._result(None if self._last_frame is None else current.prediction)

    def _submap_is_due(self) -> bool:
        """Whether enough textured frames in a row were not recognised, with loop closing to merge a submap."""
        s = self.settings
        return (
            self._mapping_enabled
            and s.loop_closing.enabled
            and self._unrecognised_frames >= s.relocalisation.new_map_after
        )

    def _forget_motion(self) -> None:
        """The camera's velocity is unknown from now on."""
        self.motion.state = None
        self.shutter.velocity = None

    def _update_active_map(self) -> None:
        """The active map is that of the reference keyframe, which a merge may have changed."""
        self.atlas.active = int(self.map.kf_map[self._reference_keyframe])

    def _result(
        self, T_cam_world: Array | None, timings: Mapping[str, float] | None = None, **stats: float
    ) -> TrackResult:
        """A frame's result with the state and the map as they are now; with `timings` if it became a keyframe."""
        slam_map = self.map
        pose = None if T_cam_world is None else se3.inverse(T_cam_world)
        maps = set(slam_map.kf_map[slam_map.kf_alive].tolist())
        counts = {
            "matches": 0,
            "inliers": 0,
            "map_points": len(slam_map.points),
            "keyframes": slam_map.keyframe_count,
            "keyframe": bool(timings),
            "maps": len(maps),
            "loops": len(self.loops.closed),
            "residual_px": 0.0,
            "relocalised": False,
        }
        return TrackResult(pose, self.state, counts | stats, timings or {})

    # ------------------------------------------------------------------ beginning a map

    def _initialise(self, frame: FrameBundle, observations: Observations) -> TrackResult:
        """The first frame with enough depth is the first keyframe, and the world's frame of reference."""
        if np.count_nonzero(observations.z > 0) < MIN_INITIAL:
            return self._result(None)
        if self.settings.tracking.rolling_shutter and self.camera.readout_s:
            self._uncompensated_first = UncompensatedFrame(frame, observations)
        return self._create_initial_map(frame, observations, np.eye(4))

    def _create_initial_map(
        self, frame: FrameBundle, observations: Observations, T_cam_world: Array
    ) -> TrackResult:
        """The frame becomes the first keyframe of the active map."""
        # no feature observes a map point yet
        self._status = CameraStatus.TRACKED
        no_points = np.full(len(observations), -1, np.int64)
        tracked = TrackedFrame(observations, no_points, T_cam_world, frame.timestamp)
        self._last_frame = tracked
        # its features with depth become map points
        timings, *_ = self._insert_keyframe(frame, tracked)
        self._update_active_map()
        # the pose defines the world, so that it is known exactly
        self._record_pose(frame, np.eye(4), KNOWN_POSE)
        points = int(np.count_nonzero(tracked.point >= 0))
        return self._result(T_cam_world, timings, matches=points, inliers=points)

    def _restart_compensated(
        self,
        current: CurrentFrame,
        first: UncompensatedFrame,
        velocity: CameraVelocity,
        inliers: int,
    ) -> TrackResult:
        """Begin the map again with a compensated first frame, and track the current frame in it.

        The second frame tells the camera's motion in the first, whose points were distorted. Where
        fewer points agree then than the `inliers` before, the first frame is left uncompensated.
        """
        compensated = compensate_rolling_shutter(first.measured, self.camera, velocity)
        seconds = dict[str, float]()
        for observations, known_velocity in ((compensated, velocity), (first.measured, None)):
            self.reset(self.camera, self.seed)
            self.shutter.velocity = known_velocity
            begun = self._create_initial_map(first.bundle, observations, np.eye(4))
            result = self._track(current.bundle, current.measured)
            # both attempts took time
            for stage, spent in (*begun.timings.items(), *result.timings.items()):
                seconds[stage] = seconds.get(stage, 0.0) + spent
            if result.state == "ok" and result.stats["inliers"] >= MIN_AGREEING * inliers:
                break
        return replace(result, timings=seconds)

    def _create_submap(self, current: CurrentFrame) -> TrackResult | None:
        """Begin a submap where the camera was lost, rotated as the images tell; None if not yet."""
        # the camera turned while it was lost; how far it moved only bounds where the submap lies
        frame = current.bundle
        self._add_submap(current.last, frame.timestamp)
        T_cam_world = self._gate.rotated(current.last)
        return self._create_initial_map(frame, current.measured, T_cam_world)

    def _add_submap(self, last: TrackedFrame, timestamp: float) -> None:
        """Add an empty submap to the atlas, which begins with the frame of a stamp, and make it active."""
        self._unrecognised_frames = 0
        start = se3.inverse(last.T_cam_world)[:3, 3]
        self.atlas.begin_submap(start, self._gate.distance_m(last, timestamp), self._gate.slack)

    # ------------------------------------------------------------------ keyframes

    def _update_map(
        self,
        frame: FrameBundle,
        tracked: TrackedFrame,
        map_fit: MapFit,
        pose_in_root_map: InitialPose | None,
    ) -> TrackResult:
        """Insert the tracked frame as a keyframe if the policy or a merge asks for it, and record its pose.

        Args:
            frame: The frame.
            tracked: Its pose and map points in the active map.
            map_fit: The fit that gave them.
            pose_in_root_map: Its pose in the root map, if the camera is in a submap and was found there.
        """
        timings: dict[str, float] = {}
        root_map_pose = RootMapPose.REJECTED
        moved_by_loop = False
        # the history keeps the pose by the image alone, which `trajectory` smooths at the end;
        # `tracked` holds the fused one
        pose = map_fit.estimate.T_cam_world
        needed = pose_in_root_map is not None or self._keyframe_policy.needs_keyframe(
            self.map, tracked, frame.index, self._reference_keyframe
        )
        if self._mapping_enabled and needed:
            timings, root_map_pose, moved_by_loop = self._insert_keyframe(
                frame, tracked, pose_in_root_map
            )
            # bundle adjustment and loop closing have moved the frame
            pose = tracked.T_cam_world
            self.motion.relocate(pose)

        T_ref_world = self.map.kf_pose[self._reference_keyframe]
        T_cam_ref = pose @ se3.inverse(T_ref_world)
        self._record_pose(frame, T_cam_ref, map_fit.estimate.information)
        self._update_active_map()
        result = self._result(
            tracked.T_cam_world, timings, residual_px=map_fit.estimate.residual_px
        )
        # the covariance is that of the fit, which knows nothing of a loop or of another map's place;
        # metres are known with depth alone
        in_root_map = self.atlas.active == ROOT_MAP
        if self.uses_depth and in_root_map and not moved_by_loop:
            result = replace(result, motion_covariance=motion_covariance(map_fit.estimate))

        if pose_in_root_map is None or in_root_map or root_map_pose is RootMapPose.REJECTED:
            return result
        # the camera is in the root map, too: there its pose counts
        self._record_root_map_pose(pose_in_root_map)
        if root_map_pose is RootMapPose.CONTINUE_THERE:
            self._continue_in_root_map(tracked, pose_in_root_map)
        return replace(result, T_world_cam=se3.inverse(pose_in_root_map.T_cam_world), state="ok")

    def _record_root_map_pose(self, pose_in_root_map: InitialPose) -> None:
        """The last recorded pose becomes relative to a keyframe of the root map."""
        T_ref_world = self.map.kf_pose[pose_in_root_map.keyframe]
        recorded = self.history[-1]
        recorded.reference = pose_in_root_map.keyframe
        recorded.T_cam_ref = pose_in_root_map.T_cam_world @ se3.inverse(T_ref_world)

    def _continue_in_root_map(self, tracked: TrackedFrame, pose_in_root_map: InitialPose) -> None:
        """Tracking continues in the root map; the submap stays apart."""
        matched = pose_in_root_map.matches.point
        # mapping may have removed some of the matched points since
        alive = np.where(self.map.alive[matched], matched, -1)
        observed = observe_points(tracked.observations, pose_in_root_map.matches.feature, alive)
        # the next frame starts from the pose and the points of the root map
        self._last_frame = replace(
            tracked, point=observed, T_cam_world=pose_in_root_map.T_cam_world
        )
        self._reference_keyframe = pose_in_root_map.keyframe
        self._forget_motion()
        self._update_active_map()

    def _record_pose(self, frame: FrameBundle, T_cam_ref: Array, information: Array) -> None:
        """Add a frame to the history, relative to the reference keyframe."""
        recorded = FramePose(
            frame.timestamp, self._reference_keyframe, T_cam_ref, information.astype(np.float32)
        )
        self.history.append(recorded)

    def _insert_keyframe(
        self, frame: FrameBundle, tracked: TrackedFrame, pose_in_root_map: InitialPose | None = None
    ) -> tuple[dict[str, float], RootMapPose, bool]:
        """Make a tracked frame a keyframe, with bundle adjustment and loop closing.

        Args:
            frame: The frame.
            tracked: Its features, pose and map points; the latter two become those after mapping.
            pose_in_root_map: Its pose in the root map, if the camera is in a submap and was found there.

        Returns:
            Seconds by stage, whether the pose in the root map counts, and whether a loop or a merge of maps
            moved the frame.
        """
        slam_map = self.map
        root_map_pose = RootMapPose.REJECTED
        moved_by_loop = False

        # local mapping: insert the keyframe, triangulate, cull, adjust its neighbourhood
        slot, timings = self.mapper.insert(
            tracked.observations,
            tracked.point,
            tracked.T_cam_world,
            frame.index,
            frame.timestamp,
            self.atlas.active,
        )
        self._reference_keyframe = slot
        self._transfer_history()

        # loop closing: recognise an earlier place, and correct the map
        if self.settings.loop_closing.enabled:
            begin = perf_counter()
            T_before = slam_map.kf_pose[slot].copy()
            closing = self.loops.close(slot, tracked.observations, pose_in_root_map)
            root_map_pose = closing.root_map_pose
            moved_by_loop = not np.array_equal(T_before, slam_map.kf_pose[slot])
            rescale(self.history, closing.rescaled)
            # the rotation by a loop with depth is within the motion's noise
            if slot in closing.rescaled:
                self.motion.transform(T_before, slam_map.kf_pose[slot], closing.rescaled[slot])
            timings["loop_closing"] = perf_counter() - begin

        # the tracked frame takes over what mapping made of it
        self._keyframe_policy.keyframe_added(frame.index)
        self._map_views.add_keyframe(slot, frame.depth)
        tracked.point = slam_map.kf_point[slot, : len(tracked.observations)].astype(np.int64)
        tracked.T_cam_world = slam_map.kf_pose[slot].copy()
        slam_map.release()
        return timings, root_map_pose, moved_by_loop

    def _transfer_history(self) -> None:
        """Poses relative to a culled keyframe become relative to its replacement."""
        # the pose by way of the replacement: T_cam_replacement = T_cam_culled T_culled_replacement
        for culled, replacement, T_culled_replacement in self.mapper.culled:
            for pose in self.history:
                if pose.reference == culled:
                    pose.reference = replacement
                    pose.T_cam_ref = pose.T_cam_ref @ T_culled_replacement

    # ------------------------------------------------------------------ what filters and files read

    def predict_T_world_cam(self, timestamp: float) -> tuple[Array | None, Array | None]:
        """Camera-to-world pose at a time, and the covariance of the motion since the last frame; None while lost.

        The covariance ``[6, 6]`` is of (position in the world in metres, rotation in the camera
        frame in radians). It is None after a gap that nothing is assumed about; the pose is the
        last tracked one then.

        Args:
            timestamp: The stamp of the next frame, seconds.
        """
        if self._last_frame is None or self._status is not CameraStatus.TRACKED:
            return None, None
        T_cam_world, covariance = self.motion.predict_T_cam_world(
            self._last_frame, timestamp, jitter=JITTER
        )
        return se3.inverse(T_cam_world), covariance

    def view(self) -> MapView:
        """View for filters of the map that the camera is in; `finalize` does not change it."""
        return self._map_views.of(self.atlas.active)

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for ``keyframes.csv``, ``map.ply`` and pictures."""
        return map_outputs(self._refined_map or self.map)

    def save_map(self, path: Path, made_by: str = "") -> None:
        """Write the map to a file from which a later run may start (`backend.map.file`).

        Args:
            path: The file; ``map.npz`` in runs.
            made_by: Which run made it, in words.

        Raises:
            TrackerError: There is no map yet, or it is too large for a file.
            DynslamError: The file cannot be written.
        """
        slam_map = self._refined_map or self.map
        save_atlas(
            path, self.atlas, slam_map, self._features, depth=self.uses_depth, made_by=made_by
        )

    def finalize(self) -> Trajectory:
        """Camera-to-world poses of all tracked frames, re-expressed relative to the refined keyframes.

        With `bundle_adjustment.full` a copy of the whole map is refined first, unless the run only
        localises in it.
        """
        refines = self._mapping_enabled and self.settings.bundle_adjustment.full
        if refines and self._refined_map is None:
            self._refined_map = refined(self.map)
        return trajectory(self.history, self._refined_map or self.map, self.settings.motion)


def _with_match_counts(result: TrackResult, map_fit: MapFit, initial: InitialPose) -> TrackResult:
    """The result with the stats of matching."""
    counts = {
        "matches": len(map_fit.matches.feature),
        "inliers": map_fit.count,
        "relocalised": initial.relocalised,
    }
    return replace(result, stats={**result.stats, **counts})


class MonocularBackend(Backend):
    """Tracks frames against a map whose points are triangulated; lengths are in units of its initial median depth.

    No feature has a depth. The scale of bundle adjustment is free but for the keyframes that stay.
    """

    uses_depth = False
    settings: MonocularBackendSettings

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything and begin a new sequence, as `Backend.reset` does."""
        super().reset(camera, seed)
        self._initialiser = TwoViewInitialiser()

    def _initialise(self, frame: FrameBundle, observations: Observations) -> TrackResult:
        """Frames are ``initialising`` until one determines the motion together with an earlier one."""
        begin = perf_counter()
        initial = self._initialiser.add(frame, observations, self.camera, self.settings.two_views)
        if initial is None:
            return self._result(None)
        return self._create_map_from_two_views(initial, np.eye(4), perf_counter() - begin)

    def _create_submap(self, current: CurrentFrame) -> TrackResult | None:
        """Begin a submap as the root map began; its unit of length is the median depth of its own views."""
        begin = perf_counter()
        last = current.last
        # look for a first view again, then for a second one with enough parallax
        first_try = self._unrecognised_frames == self.settings.relocalisation.new_map_after
        if first_try:
            self._initialiser = TwoViewInitialiser()
        initial = self._initialiser.add(
            current.bundle, current.measured, self.camera, self.settings.two_views
        )
        if initial is None:
            return None
        seconds = perf_counter() - begin

        # the submap begins where the camera was lost
        self._add_submap(last, initial.first.frame.timestamp)
        # the current frame is the second view, and is rotated as the images tell
        R_first_second = initial.motion.T_second_first[:3, :3].T
        T_first_world = last.T_cam_world.copy()
        T_first_world[:3] = R_first_second @ self._gate.rotated(last)[:3]
        return self._create_map_from_two_views(initial, T_first_world, seconds)

    def _create_map_from_two_views(
        self, initial: InitialMap, T_first_world: Array, seconds: float
    ) -> TrackResult:
        """The two views become keyframes; the second, which is the current frame, is tracked."""
        # both views become keyframes, with the points triangulated from them
        first, second = initial.insert_into(self.map, T_first_world, self.atlas.active)
        frame = initial.second.frame
        observations = initial.second.observations
        pose = self.map.kf_pose[second].copy()
        point = self.map.kf_point[second, : len(observations)].astype(np.int64)

        # tracking goes on from the second view
        self._initialiser = TwoViewInitialiser()
        self._status = CameraStatus.TRACKED
        self._last_frame = TrackedFrame(observations, point, pose, frame.timestamp)
        self._reference_keyframe = second
        self._keyframe_policy.keyframe_added(frame.index)
        self._map_views.add_keyframe(first, initial.first.frame.depth)
        self._map_views.add_keyframe(second, frame.depth)
        self._update_active_map()
        # the pose defines the scale and the world, so that it is known exactly
        self._record_pose(frame, np.eye(4), KNOWN_POSE)
        count = len(initial.motion.points)
        return self._result(pose, {"mapping": seconds}, matches=count, inliers=count)


def build_backend(
    settings: BackendSettings, scale_factor: float, levels: int, extractor: str
) -> Backend:
    """Build the back end that settings ask for: without depth for `MonocularBackendSettings`, else with depth.

    Args:
        settings: Settings of the back end.
        scale_factor: Ratio of consecutive pyramid levels of the features.
        levels: Number of pyramid levels of the features.
        extractor: Id of the feature extractor.
    """
    kind = MonocularBackend if isinstance(settings, MonocularBackendSettings) else Backend
    return kind(settings, scale_factor=scale_factor, levels=levels, extractor=extractor)
