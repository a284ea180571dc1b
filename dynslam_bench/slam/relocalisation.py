"""Relocalisation: the initial pose of a frame from keyframes, within what the camera can have moved.

Buildings repeat themselves: the next door looks like the last one, and the local map there agrees. The relocalisation
gate tells such places apart: a camera covers a limited distance in the time, and the images since the last tracked
frame tell how far it has rotated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from dynslam_bench.core.seeding import stream
from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.place_recognition import (
    MAX_DISTANCE,
    RATIO,
    is_aliased,
    pnp_poses,
    pose_uncertainty,
    top_candidates,
    verify_place,
)
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.slam.tracking import MIN_MATCHES, InitialPose, Observations, PoseCandidate, TrackedFrame

CANDIDATES = 10
"""Best-ranked keyframes that are matched feature by feature; bounds the time of a frame."""
MANY_POINTS = 60
MANY_POINTS_SHARE = 0.75
"""With so many matches at a place this factor of the required share suffices."""

SLACK_M = 0.5
"""Distance that the camera may have moved in no time, metres."""
KIDNAP_POINTS = 60
"""A frame that shows so many map points, as many as a map begins with, followed by one that shows none of them and is
not connected with it: the camera was kidnapped."""
CONNECTED = 20
CONNECTED_SHARE = 0.4
"""Matches that fit one homography, and their share of all, that connect two images."""
HOMOGRAPHY_PX = 4.0
"""Largest error of these matches, pixels."""
ROTATION_SLACK = np.radians(20.0)
ROTATION_SLACK_SHARE = 0.75
"""Largest error of the rotation: an angle, and a share of all rotations between images. A camera that moves sideways
seems to rotate. On four rendered laps none of 4,000 sections of 3 to 30 steps exceeded the share and half the angle."""


# ---------------------------------------------------------------------- the relocalisation gate


@dataclass(frozen=True, eq=False)
class RotationEstimate:
    """The rotation since the last tracked frame, by images alone.

    Attributes:
        observations: Features of the newest image.
        R_now_last: From the camera's axes in the last tracked frame to those of now, ``[3, 3]``.
        apparent: Sum of the rotations between consecutive images, radians.
    """

    observations: Observations
    R_now_last: Array
    apparent: float = 0.0

    def advanced(self, observations: Observations, camera: Camera) -> RotationEstimate | None:
        """The rotation up to the next image; None where that is not connected with the one before.

        Args:
            observations: Its features.
            camera: Intrinsics without distortion.
        """
        before, now = match_brute_force(
            self.observations.words, observations.words, max_distance=MAX_DISTANCE, ratio=RATIO
        )
        if len(before) < CONNECTED:
            return None
        xy_before, xy_now = self.observations.xy[before], observations.xy[now]
        homography, mask = cv2.findHomography(xy_before, xy_now, cv2.RANSAC, HOMOGRAPHY_PX)
        fits = np.zeros(len(before), bool) if homography is None else mask.ravel() > 0
        if np.count_nonzero(fits) < max(CONNECTED, CONNECTED_SHARE * len(before)):
            return None
        step, _ = Rotation.align_vectors(_bearings(xy_now[fits], camera), _bearings(xy_before[fits], camera))
        return RotationEstimate(
            observations, step.as_matrix() @ self.R_now_last, self.apparent + float(step.magnitude())
        )

    @property
    def slack(self) -> float:
        """Largest error of the rotation, radians."""
        return float(ROTATION_SLACK + ROTATION_SLACK_SHARE * self.apparent)

    def applied(self, T_last_world: Array) -> Array:
        """The world-to-camera pose ``[4, 4]`` of the last tracked frame, rotated about its centre."""
        pose = T_last_world.copy()
        pose[:3] = self.R_now_last @ T_last_world[:3]
        return pose

    def allows(self, T_last_world: Array, T_now_world: Array, more: float = 0.0) -> bool:
        """Whether the rotation between two poses agrees with the images.

        Args:
            T_last_world: World-to-camera pose ``[4, 4]`` in the last tracked frame.
            T_now_world: That of now.
            more: How far the two worlds may be rotated against each other, radians.
        """
        return bool(se3.rotation_angle(T_now_world @ se3.inverse(self.applied(T_last_world))) <= self.slack + more)


def _bearings(xy: Array, camera: Camera) -> Array:
    rays = camera.unproject(xy, np.ones(len(xy)))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class MotionBound:
    """Where the camera can be.

    Attributes:
        atlas: Where the submaps may lie; the camera was tracked last in the active one.
        T_last_world: World-to-camera pose ``[4, 4]`` in the last tracked frame.
        distance_m: How far it may have moved since.
        rotation: How it has rotated since; None if that is unknown.
    """

    atlas: Atlas
    T_last_world: Array
    distance_m: float
    rotation: RotationEstimate | None

    def admits(self, submap: int, T_cam_world: Array) -> bool:
        """Whether the camera can be at a world-to-camera pose in a submap."""
        slack = self.atlas.slack(self.atlas.active, submap)
        if self.rotation is not None and not self.rotation.allows(self.T_last_world, T_cam_world, slack):
            return False
        last, now = (se3.inverse(pose)[:3, 3] for pose in (self.T_last_world, T_cam_world))
        return self.atlas.reachable(self.atlas.active, submap, last, now, self.distance_m)


class RelocalisationGate:
    """Bounds distance and rotation since the last tracked frame.

    Args:
        atlas: Where the submaps may lie.
        max_speed: Largest speed of the camera, metres a second.
        anywhere: Whether the camera may be anywhere at first, as in a loaded map.

    Attributes:
        rotation: The rotation since then; None where the images are not connected.
    """

    def __init__(self, atlas: Atlas, max_speed: float, *, anywhere: bool = False) -> None:
        self._atlas = atlas
        self._max_speed = max_speed
        self._kidnapped = anywhere
        self.rotation: RotationEstimate | None = None

    def lose(self, last: TrackedFrame, observations: Observations, *, textured: bool) -> None:
        """The first frame that is not tracked any more.

        Args:
            last: The last tracked frame.
            observations: The new one's features.
            textured: Whether it shows more than a blank wall or a covered lens.
        """
        self.start(last)
        self._advance(observations)
        self._kidnapped = self.rotation is None and textured and int((last.point >= 0).sum()) >= KIDNAP_POINTS

    def start(self, last: TrackedFrame) -> None:
        """The camera counts as lost from the next frame on; `last` is the last tracked one."""
        self.rotation, self._kidnapped = RotationEstimate(last.observations, np.eye(3)), False

    def while_lost(self, last: TrackedFrame, observations: Observations, timestamp: float) -> MotionBound:
        """The bound for the next frame of a lost camera; has to be called for every one of them."""
        self._advance(observations)
        return MotionBound(self._atlas, last.T_cam_world, self.distance_m(last, timestamp), self.rotation)

    def while_tracked(
        self, last: TrackedFrame, observations: Observations, timestamp: float, prediction: Array
    ) -> MotionBound:
        """The bound for the frame after a tracked one.

        A camera that moves fast, as on a car, may go on as the motion model has it: world-to-camera `prediction`.
        """
        rotation = RotationEstimate(last.observations, np.eye(3)).advanced(observations, self._atlas.world.camera)
        centres = se3.inverse(np.stack([last.T_cam_world, prediction]))[:, :3, 3]
        step = float(np.linalg.norm(centres[1] - centres[0]))
        return MotionBound(self._atlas, last.T_cam_world, step + self._distance(last, timestamp), rotation)

    def _advance(self, observations: Observations) -> None:
        if self.rotation is not None:
            self.rotation = self.rotation.advanced(observations, self._atlas.world.camera)

    @property
    def slack(self) -> float:
        """Largest error of the rotation, radians."""
        return np.pi if self.rotation is None else self.rotation.slack

    def rotated(self, last: TrackedFrame) -> Array:
        """World-to-camera pose ``[4, 4]`` of a camera that has rotated but has not moved."""
        return last.T_cam_world if self.rotation is None else self.rotation.applied(last.T_cam_world)

    def distance_m(self, last: TrackedFrame, timestamp: float) -> float:
        """Largest distance until a time, metres; infinite for a kidnapped camera."""
        return np.inf if self._kidnapped else self._distance(last, timestamp)

    def _distance(self, last: TrackedFrame, timestamp: float) -> float:
        return SLACK_M + self._max_speed * max(timestamp - last.timestamp, 0.0)


# ---------------------------------------------------------------------- the initial pose


@dataclass(frozen=True, eq=False)
class PoseSearch:
    """The search of keyframes for the initial pose of one frame; it reads the map and never changes it.

    Attributes:
        world: The maps.
        observations: The frame's features.
        reference: Slot of the keyframe that shares most points with the last tracked frame.
        keyframes: Slots of the candidate keyframes.
        lost: Whether the camera was lost since then; else it was tracked in the frame before.
        bound: Where the camera can be.
        settings: Of the back end.
        seed: Of the sequence's random draws.
        frame: Index of the frame.
    """

    world: Map
    observations: Observations
    reference: int
    keyframes: Slots
    lost: bool
    bound: MotionBound
    settings: BackendSettings
    seed: int
    frame: int

    def relocalised(self, weak: PoseCandidate | None) -> InitialPose | None:
        """The pose from keyframes.

        A pose from the last frame that few matches agree on, as by chance after a gap or a sudden rotation, competes
        with those of keyframes, and has to be within the motion bound. After a loss it counts only if the place is
        verified.

        Args:
            weak: The pose from the last frame, if there is one.
        """
        if weak is None:
            return self._relocalise(MIN_MATCHES)
        if self.lost:
            return self._verified(weak) or self._relocalise(MIN_MATCHES)
        pose = self._relocalise(weak.estimate.count + 1)
        if pose is None and self._within_bound(weak):
            return weak.initial_pose(relocalised=False)
        return pose

    def in_root_map(self) -> InitialPose | None:
        """The pose in the root map of a camera that is tracked in a submap, as strict as for a lost one."""
        pose = replace(self, keyframes=self.world.submap(0), lost=True)._relocalise(MIN_MATCHES)
        return pose if pose and len(pose.matches) >= self.settings.relocalisation.min_inliers else None

    def _relocalise(self, min_inliers: int) -> InitialPose | None:
        """A pose by descriptors: from the reference keyframe, else from the best-ranked candidates."""
        world, rng = self.world, stream(self.seed, "relocalisation", self.frame)
        least = self.settings.tracking.min_inliers
        if not self.lost:
            for candidate in pnp_poses(world, [self.reference], self.observations, rng, least):
                if candidate.estimate.count >= min_inliers and self._within_bound(candidate):
                    return candidate.initial_pose(relocalised=True)
        keyframes = top_candidates(world, self.keyframes, self.observations, CANDIDATES)
        candidates = pnp_poses(world, keyframes, self.observations, rng, least)
        verified = (self._verified(one) for one in candidates if one.estimate.count >= min_inliers)
        return next((pose for pose in verified if pose is not None), None)

    def _verified(self, candidate: PoseCandidate) -> InitialPose | None:
        """The pose at a candidate's place, if it is within the motion bound and the place is verified."""
        world, observations, s = self.world, self.observations, self.settings
        submap, admits = int(world.kf_map[candidate.keyframe]), self.bound.admits
        if not admits(submap, candidate.estimate.T_cam_world):
            return None
        inliers = candidate.matches.select(candidate.estimate.inliers)
        place = verify_place(
            world, candidate.keyframe, observations, inliers, candidate.estimate.T_cam_world, s.tracking
        )
        factor = MANY_POINTS_SHARE if len(place.matches) >= MANY_POINTS else 1.0
        if place.share < factor * s.relocalisation.min_share:
            return None
        uncertainty = 0.0
        if self.lost:
            uncertainty = pose_uncertainty(world, observations, place, stream(self.seed, "halves", self.frame))
            candidates = {submap: place.hypothesis}, self.keyframes
            if uncertainty > 1 or is_aliased(world, observations, *candidates, s.tracking, self.seed, admits):
                return None
        return InitialPose(place.T_cam_world, place.matches, candidate.keyframe, True, place.share, uncertainty)

    def _within_bound(self, candidate: PoseCandidate) -> bool:
        """Whether the camera can be at a pose in the map where it was tracked last."""
        return self.bound.admits(self.bound.atlas.active, candidate.estimate.T_cam_world)
