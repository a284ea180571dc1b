"""The back end that all trackers share: what turns the kept features of a frame into a pose and a map."""

from __future__ import annotations

from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import FrameBundle, KeyframeView
from dynslam_bench.contracts.map_outputs import KeyframeRecord, MapOutputs
from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory

from .localisation.motion_model import MotionState, pose_covariance, smooth
from .localisation.observation import Observations, observe
from .localisation.pose import PoseEstimate
from .localisation.relocalisation import Relocalised, locate
from .localisation.tracking import ENOUGH_FIRST, Matches, Tracked, local_points, match_last_frame, match_map, solve
from .mapping.history import History
from .mapping.keyframes import KeyframeRule
from .mapping.local_mapping import LocalMapper
from .mapping.map import Map
from .places import most_alike
from .settings import BackendSettings

Array = NDArray[np.float64]
State = Literal["initialising", "ok", "lost"]

MIN_INITIAL = 60
"""Features with depth that the first keyframe needs."""
TRUSTED_FIRST = 50
TRUSTED_SHARE = 0.5
"""Inliers, and their share of the matches, that make a first pose from the last frame trusted by itself."""
FIRST_INTERVAL_S = 1 / 30
"""Taken for the interval between frames until one was measured."""
JITTER = 0.1
"""Share of the last interval by which a stamp may be off and still count as regular: the noise of stamping."""


class RgbdBackend:
    """Tracks frames against a map that it builds.

    Args:
        settings: Of tracking, mapping, bundle adjustment, keyframes and relocalisation.
        scale_factor: Ratio of consecutive pyramid levels of the features that will come.
        levels: Number of pyramid levels of the features that will come.
    """

    def __init__(self, settings: BackendSettings | None = None, *, scale_factor: float = 1.2, levels: int = 8) -> None:
        self.settings = settings or BackendSettings()
        self._scales = scale_factor ** np.arange(max(levels, 1), dtype=np.float64)
        self._ready = False

    def configure(self, settings: BackendSettings) -> None:
        """Put other settings into force from the next frame on."""
        self.settings = settings
        if self._ready:
            self.mapper.settings = settings
            self._keyframes.settings = settings.keyframes

    def reset(self, camera: Camera, seed: int) -> None:
        """Forget everything: a new sequence begins.

        Args:
            camera: Intrinsics; keypoints' `xy` come undistorted, so its distortion plays no role here.
            seed: Founds all random draws.
        """
        self.camera = camera.undistorted()
        self.seed = int(seed)
        self.world = Map(self.camera, self._scales)
        self.mapper = LocalMapper(self.world, self.settings)
        self.history = History()
        self.state: State = "initialising"
        self._last: Tracked | None = None
        self._interval = FIRST_INTERVAL_S
        self._motion: MotionState | None = None
        self._reference = -1
        self._keyframes = KeyframeRule(self.settings.keyframes, self.mapper.close_m)
        self._frame = -1
        self._depth_images: dict[int, NDArray[np.float32]] = {}
        self._views: dict[int, tuple[KeyframeView, ...]] = {}
        self._cloud: tuple[NDArray[np.int64], Array] | None = None
        self._ready = True

    # ------------------------------------------------------------------ prediction

    def predict(self, timestamp: float) -> Array | None:
        """The motion model's camera-to-world pose at a time; None when nothing is known yet.

        While lost, and after a gap that nothing is assumed about, this is the last tracked pose.

        Args:
            timestamp: The stamp of the frame to come, seconds.
        """
        return None if self._last is None else se3.inverse(self._predicted(self._last, self._expected(timestamp)))

    def motion_covariance(self, timestamp: float) -> Array | None:
        """How far the camera's motion since the last frame may be from the predicted one.

        Args:
            timestamp: The stamp of the frame to come, seconds.

        Returns:
            Covariance ``[6, 6]`` of (position in the world in metres, rotation in the camera frame in radians); None
            while lost, when nothing is known yet, and after a gap that nothing is assumed about.
        """
        if self._last is None or self._motion is None:
            return None
        dt = self._known_gap(self._last, self._expected(timestamp))
        return None if dt is None else self._motion.motion_covariance(dt, self.settings.motion)

    def _expected(self, timestamp: float) -> float:
        """The stamp, or where it is within `JITTER` of a regular one, the regular one."""
        if self._last is None:
            return timestamp
        regular = abs(timestamp - self._last.timestamp - self._interval) <= JITTER * self._interval
        return self._last.timestamp + self._interval if regular else timestamp

    def _known_gap(self, last: Tracked, timestamp: float) -> float | None:
        """Seconds since the last frame; None where the motion model says nothing of them."""
        dt = timestamp - last.timestamp
        known = self._motion is not None and self.state == "ok" and 0 < dt <= self.settings.motion.max_gap_s
        return dt if known else None

    def _predicted(self, last: Tracked, timestamp: float) -> Array:
        dt = self._known_gap(last, timestamp)
        if dt is None or self._motion is None:
            return last.T_cam_world
        return self._motion.predicted(dt, self.settings.motion).T_cam_world

    def _filtered(self, last: Tracked, timestamp: float, measured: Array, information: Array) -> Array:
        """Weigh the image's pose against the motion model, and remember the motion."""
        s = self.settings.motion
        covariance = pose_covariance(measured, information, s.inflation)
        dt = self._known_gap(last, timestamp)
        if dt is None or self._motion is None:
            self._motion = MotionState.at(measured, covariance)
            return measured
        self._interval = dt
        self._motion = self._motion.predicted(dt, s).updated(measured, covariance)
        return self._motion.T_cam_world if s.filter else measured

    # ------------------------------------------------------------------ one frame

    def track(
        self,
        frame: FrameBundle,
        keep: NDArray[np.bool_],
        weight: NDArray[np.float32],
        dynamic_mask: NDArray[np.bool_] | None = None,
    ) -> TrackResult:
        """Find the frame's pose and, if it shows enough new, make it a keyframe.

        Args:
            frame: The frame with its features.
            keep: bool ``[N]``; features with False enter neither tracking nor map.
            weight: float32 ``[N]`` in [0, 1], confidence that a feature is static.
            dynamic_mask: bool ``[H, W]``, pixels held for dynamic; passed on in the result.

        Returns:
            The pose (after bundle adjustment if the frame became a keyframe), state, stats and timings.
        """
        assert self._ready, "reset() comes before track()"
        begin = perf_counter()
        self._frame = frame.index
        seen = observe(frame, keep, weight, self.camera, self._scales, self.settings.tracking)
        stats = {"matches": 0.0, "inliers": 0.0, "keyframe": 0.0, "residual_px": 0.0, "relocalised": 0.0}
        timings = {"tracking": 0.0, "mapping": 0.0, "bundle_adjustment": 0.0}
        pose: Array | None
        if self.world.keyframe_count == 0:
            pose = self._initialise(frame, seen, timings, stats)
        else:
            pose = self._localise(frame, seen, timings, stats)
        timings["tracking"] = perf_counter() - begin - timings["mapping"] - timings["bundle_adjustment"]
        return TrackResult(
            None if pose is None else se3.inverse(pose),
            self.state,
            self._stats(frame, keep, dynamic_mask, stats),
            timings,
            dynamic_mask,
            frame.keypoints.xy,
            np.asarray(keep, bool),
        )

    def _initialise(
        self, frame: FrameBundle, seen: Observations, timings: dict[str, float], stats: dict[str, float]
    ) -> Array | None:
        if np.count_nonzero(seen.z > 0) < MIN_INITIAL:
            return None
        pose = np.eye(4)
        tracked = Tracked(seen, np.full(len(seen), -1, np.int64), pose, frame.timestamp)
        self.state = "ok"
        self._last = tracked
        self._make_keyframe(frame, tracked, timings)
        stats["keyframe"] = 1.0
        stats["matches"] = stats["inliers"] = float(np.count_nonzero(tracked.point >= 0))
        self.history.append(frame.timestamp, self._reference, np.eye(4), 1e6 * np.eye(6))
        return pose

    def _localise(
        self, frame: FrameBundle, seen: Observations, timings: dict[str, float], stats: dict[str, float]
    ) -> Array:
        assert self._last is not None
        last = self._last
        prediction = self._predicted(last, frame.timestamp)
        matches, pose = self._first_pose(seen, last, prediction, stats)
        inliers: NDArray[np.bool_] = np.zeros(0, bool)
        residual = 0.0
        if matches is not None:
            found, in_view = match_map(
                self.world,
                seen,
                pose,
                matches,
                local_points(self.world, matches, self.settings.tracking.local_map),
                self.settings.tracking,
            )
            matches = matches.joined(found)
            mapped = matches.select(matches.point >= 0)
            if len(mapped) >= 2 * self.settings.tracking.min_inliers:
                matches = mapped
            estimate = solve(self.world, seen, matches, pose)
            inliers = estimate.inliers & (matches.point >= 0)
            pose, residual = estimate.T_cam_world, estimate.residual_px
            self.world.visible[in_view] += 1
            stats["matches"] = float(len(matches))
            stats["inliers"] = float(np.count_nonzero(inliers))
        if matches is None or np.count_nonzero(inliers) < self._needed_inliers() or not np.isfinite(pose).all():
            self.state = "lost"
            self._motion = None
            return prediction
        stats["residual_px"] = residual
        points = matches.point[inliers]
        self.world.found[points] += 1
        point = np.full(len(seen), -1, np.int64)
        point[matches.feature[inliers]] = points
        tracked = Tracked(seen, point, pose, frame.timestamp)
        tracked.T_cam_world = self._filtered(last, frame.timestamp, pose, estimate.information)
        self.state = "ok"
        self._last = tracked
        near, _ = self.world.covisible_of(points)
        if len(near):
            self._reference = int(near[0])
        if self._keyframes.wants(self.world, tracked, self._frame, self._reference):
            self._make_keyframe(frame, tracked, timings)
            stats["keyframe"] = 1.0
            if self.settings.bundle_adjustment.enabled:
                pose = tracked.T_cam_world
                if self._motion is not None:
                    self._motion = self._motion.relocated(pose)
        relative = pose @ se3.inverse(self.world.kf_pose[self._reference])
        self.history.append(frame.timestamp, self._reference, relative, estimate.information)
        return tracked.T_cam_world

    def _needed_inliers(self) -> int:
        return self.settings.tracking.min_inliers if self.state == "ok" else self.settings.relocalisation.min_inliers

    def _first_pose(
        self, seen: Observations, last: Tracked, prediction: Array, stats: dict[str, float]
    ) -> tuple[Matches | None, Array]:
        """A first pose: from the last frame; else from the reference keyframe or any keyframe.

        The last frame's map points come first. Where they are few, what only its depth gives helps as well. A pose
        that few matches agree on, as by chance after a gap or a sudden turn, has to compete with the keyframes'.
        """
        s = self.settings.tracking
        close_m = self.mapper.close_m
        best: tuple[Matches, PoseEstimate] | None = None
        for widen, depth_m, enough in (
            (1.0, 0.0, s.mapped_matches), (1.0, close_m, ENOUGH_FIRST), (2.5, close_m, ENOUGH_FIRST)
        ):  # fmt: skip
            matches = match_last_frame(self.world, last, seen, prediction, widen * s.radius_px, depth_m, s.max_distance)
            if len(matches) < enough:
                continue
            estimate = solve(self.world, seen, matches, prediction, rounds=3)
            if estimate.count >= ENOUGH_FIRST // 2 and (best is None or estimate.count > best[1].count):
                best = matches, estimate
            if estimate.count >= max(TRUSTED_FIRST, TRUSTED_SHARE * len(matches)):
                break
        else:
            found = self._from_keyframes(seen, ENOUGH_FIRST // 2 if best is None else best[1].count + 1)
            if found is not None:
                stats["relocalised"] = 1.0
                best = found.matches, found.estimate
        if best is None:
            return None, prediction
        return best[0].select(best[1].inliers), best[1].T_cam_world

    def _from_keyframes(self, seen: Observations, least: int) -> Relocalised | None:
        """A pose with at least so many inliers by descriptors: from the reference keyframe, else from those alike."""
        s = self.settings
        rng = stream(self.seed, "relocalisation", self._frame)
        for alike in (False, True) if self.state == "ok" else (True,):
            keyframes = [self._reference]
            if alike:
                keyframes = most_alike(self.world, self.world.keyframes, seen, s.relocalisation.searched)
            found = locate(self.world, keyframes, seen, s.relocalisation, rng, s.tracking.min_inliers)
            if found is not None and found.estimate.count >= least:
                return found
        return None

    # ------------------------------------------------------------------ keyframes

    def _make_keyframe(self, frame: FrameBundle, tracked: Tracked, timings: dict[str, float]) -> None:
        slot, spent = self.mapper.insert(tracked.seen, tracked.point, tracked.T_cam_world, frame.index, frame.timestamp)
        timings.update(spent)
        self._reference = slot
        self._keyframes.made(frame.index)
        self._views.clear()  # only keyframes change the map
        self._cloud = None
        for dropped, heir, relative in self.mapper.dropped:
            self.history.inherit(dropped, heir, relative)
            self._depth_images.pop(dropped, None)
        self._depth_images[slot] = frame.depth
        for old in self.world.keyframes[: -self.settings.keyframes.depth_images or None].tolist():
            self._depth_images.pop(old, None)
        tracked.point = self.world.kf_point[slot, : len(tracked.seen)].astype(np.int64)
        tracked.T_cam_world = self.world.kf_pose[slot].copy()
        self.world.release()

    # ------------------------------------------------------------------ what others may see

    def _stats(
        self, frame: FrameBundle, keep: NDArray[np.bool_], mask: NDArray[np.bool_] | None, stats: dict[str, float]
    ) -> dict[str, float]:
        return {
            "keypoints": float(len(frame)),
            "culled": float(len(frame) - np.count_nonzero(keep)),
            "matches": stats["matches"],
            "inliers": stats["inliers"],
            "map_points": float(len(self.map_points()[0])),
            "keyframes": float(self.world.keyframe_count),
            "keyframe": stats["keyframe"],
            "residual_px": stats["residual_px"],
            "mask_fraction": 0.0 if mask is None else float(np.count_nonzero(mask)) / max(mask.size, 1),
            "relocalised": stats["relocalised"],
        }

    def keyframe_views(self, limit: int) -> tuple[KeyframeView, ...]:
        """The newest keyframes, newest first, at most `limit`."""
        if limit not in self._views:
            self._views[limit] = self._make_views(limit)
        return self._views[limit]

    def _make_views(self, limit: int) -> tuple[KeyframeView, ...]:
        world = self.world
        views = []
        for slot in world.keyframes[::-1][: max(limit, 0)].tolist():
            n = int(world.kf_count[slot])
            keypoints = Keypoints(
                world.kf_raw[slot, :n],
                world.kf_octave[slot, :n].astype(np.int32),
                world.kf_angle[slot, :n],
                world.kf_response[slot, :n],
                world.kf_words[slot, :n].view(np.uint8),
            )
            views.append(
                KeyframeView(
                    world.T_world_cam(slot),
                    keypoints,
                    world.kf_xy[slot, :n],
                    world.kf_z[slot, :n],
                    self._depth_images.get(slot),
                    float(world.kf_stamp[slot]),
                )
            )
        return tuple(views)

    def map_points(self) -> tuple[NDArray[np.int64], Array]:
        """Ids ``[M]`` and world positions ``[M, 3]`` in metres of all map points."""
        if self._cloud is None:
            points = self.world.points
            self._cloud = self.world.id[points], self.world.position[points]
        return self._cloud

    def finalize(self) -> Trajectory:
        """Camera-to-world poses of all tracked frames, re-expressed relative to the refined keyframes."""
        stamps, poses, information = self.history.poses(self.world)
        order = np.argsort(stamps, kind="stable")
        fresh = np.r_[True, np.diff(stamps[order]) > 0] if len(order) else np.zeros(0, bool)
        rows = order[fresh]
        stamps, poses = stamps[rows], poses[rows]
        motion = self.settings.motion
        if motion.smooth and len(stamps) > 2:
            spread = [pose_covariance(*pair, motion.inflation) for pair in zip(poses, information[rows], strict=True)]
            poses = smooth(stamps, poses, np.array(spread), motion)
        return Trajectory(stamps, se3.inverse(poses))

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for ``keyframes.csv``, ``map.ply`` and the sheet."""
        world = self.world
        slots = world.keyframes
        records = tuple(
            KeyframeRecord(
                int(world.kf_id[slot]),
                int(world.kf_frame[slot]),
                float(world.kf_stamp[slot]),
                world.T_world_cam(slot),
                int(world.kf_count[slot]),
                int(np.count_nonzero(world.kf_point[slot, : world.kf_count[slot]] >= 0)),
            )
            for slot in slots.tolist()
        )
        points = world.points
        return MapOutputs(
            records, world.id[points], world.position[points], world.rgb[points], world.n_obs[points].astype(np.int64)
        )
