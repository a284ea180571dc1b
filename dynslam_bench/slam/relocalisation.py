"""A first pose of a frame: from the last frame; else from the reference keyframe, or any that the camera can be at.

All functions are pure: they read the map and never change it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.core.seeding import stream
from dynslam_bench.features.matching import match_brute_force
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.place_recognition import (
    PnpPose,
    ambiguous,
    pnp_poses,
    pose_uncertainty,
    sight,
    top_candidates,
    verify_place,
)
from dynslam_bench.slam.pose_optimisation import PoseEstimate
from dynslam_bench.slam.settings import BackendSettings, RelocalisationSettings, TrackingSettings
from dynslam_bench.slam.tracking import ENOUGH_FIRST, Matches, TrackedFrame, match_last_frame, solve

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

TRUSTED_FIRST = 50
TRUSTED_SHARE = 0.5
"""Inliers, and their share of the matches, that make a first pose from the last frame trusted by itself."""
MANY = 60
MANY_SHARE = 0.75
"""So many points that fit a place let this much of the share of what should be in view suffice (`docs/backend.md`)."""
WIDE = 2.5
"""Factor on the search window where the narrow one gave no trusted pose."""


@dataclass(frozen=True, eq=False)
class TrackingContext:
    """What is known of the camera when a frame comes.

    Attributes:
        last: The last tracked frame.
        prediction: World-to-camera pose that the motion model expects.
        reference: Slot of the keyframe that shares most points with the last tracked frame.
        keyframes: Slots of the keyframes near which the frame may have been taken.
        lost: Whether it was lost since then; else it was tracked in the frame before.
        since: Tells what is known of the time since then, the same each time; asked of every frame of a lost camera.
        close_m: Depth below which a feature's depth is trusted, metres.
        seed: Of the sequence's random draws.
        frame: Index of the frame that comes.
    """

    last: TrackedFrame
    prediction: Array
    reference: int
    keyframes: Slots
    lost: bool
    since: Callable[[], MotionBound]
    close_m: float
    seed: int
    frame: int


@dataclass(frozen=True, eq=False)
class InitialPose:
    """A pose that enough matches agree on.

    Attributes:
        T_cam_world: World-to-camera pose.
        matches: The matches that agree.
        keyframe: Slot of a keyframe nearby: the one that they are with, or else the last frame's reference.
        relocalised: Whether the camera was lost before, or they are a keyframe's.
        share: Of the keyframe's own points that should be in view so much is, of one; NaN if nobody asked.
        pose_uncertainty: How badly they tell the pose (`recognition.pose_uncertainty`); NaN if nobody asked.
    """

    T_cam_world: Array
    matches: Matches
    keyframe: int
    relocalised: bool
    share: float = np.nan
    pose_uncertainty: float = np.nan


def initial_pose(
    world: Map, submaps: Atlas, seen: Observations, before: TrackingContext, settings: BackendSettings
) -> InitialPose | None:
    """A first pose, or None.

    The last frame's map points come first. Where they are few, what only its depth gives helps as well. A pose that few
    matches agree on, as by chance after a gap or a sudden turn, has to compete with the keyframes', and
    the camera has to be able to get to it. After a loss it counts only if all around agrees.

    Args:
        world: The map.
        submaps: Where parts of it may lie that are connected with the first one by nothing.
        seen: The frame's features.
        before: What is known of the camera.
        settings: Of tracking and relocalisation.
    """
    best: tuple[Matches, PoseEstimate] | None = None
    if before.lost:
        before.since()  # follows the turn from image to image, whatever is found
    for matches in _from_last_frame(world, seen, before, settings.tracking):
        estimate = solve(world, seen, matches, before.prediction, rounds=3)
        if estimate.count >= ENOUGH_FIRST // 2 and (best is None or estimate.count > best[1].count):
            best = matches, estimate
        if best is not None and estimate.count >= max(TRUSTED_FIRST, TRUSTED_SHARE * len(matches)):
            if not before.lost:
                return _agreed(*best, before.reference)
            break
    if before.lost and best is not None:
        guess = _there(world, submaps, seen, PnpPose(before.reference, *best), before, settings)
        if guess is not None:
            return guess
    least = ENOUGH_FIRST // 2 if best is None or before.lost else best[1].count + 1
    found = _from_keyframes(world, submaps, seen, before, settings, least)
    if found is None and best is not None and not before.lost and _within_reach(submaps, before, best[1]):
        return _agreed(*best, before.reference)
    return found


def pose_in_root_map(
    world: Map, submaps: Atlas, seen: Observations, before: TrackingContext, settings: BackendSettings
) -> InitialPose | None:
    """A pose in the first map, of a camera that is tracked on an submap: under the conditions of one that is lost.

    Arguments as of `initial_pose`.
    """
    if before.lost or not world.kf_map[before.reference]:
        return None
    lost = replace(before, keyframes=world.submap(0), lost=True)
    found = _from_keyframes(world, submaps, seen, lost, settings, ENOUGH_FIRST // 2)
    return found if found is not None and len(found.matches) >= settings.relocalisation.min_inliers else None


def tracked_at(world: Map, tracked: TrackedFrame, found: InitialPose) -> TrackedFrame:
    """A tracked frame as it is tracked at another place."""
    point = np.full(len(tracked.seen), -1, np.int64)
    point[found.matches.feature] = np.where(world.alive[found.matches.point], found.matches.point, -1)
    return replace(tracked, point=point, T_cam_world=found.T_cam_world)


def _there(
    world: Map, submaps: Atlas, seen: Observations, found: PnpPose, before: TrackingContext, settings: BackendSettings
) -> InitialPose | None:
    """The pose at a keyframe's place, if the camera can have got there, and what was mapped around that is there.

    A place may only have something in common with another.
    """
    there = int(world.kf_map[found.keyframe])
    admits = partial(before.since().admits, submaps, before.last.T_cam_world)
    if not admits(there, found.estimate.T_cam_world):
        return None
    matches = found.matches.select(found.estimate.inliers)
    place = verify_place(world, found.keyframe, seen, matches, found.estimate.T_cam_world, settings.tracking)
    many = len(place.matches) >= MANY
    if place.share < (MANY_SHARE if many else 1.0) * settings.relocalisation.min_share:
        return None
    imprecise = (
        pose_uncertainty(world, seen, place, stream(before.seed, "halves", before.frame)) if before.lost else 0.0
    )
    if imprecise > 1:
        return None
    known = {there: sight(place)}
    if before.lost and ambiguous(world, seen, known, before.keyframes, settings, before.seed, admits):
        return None
    return InitialPose(place.T_cam_world, place.matches, found.keyframe, True, place.share, imprecise)


def _within_reach(submaps: Atlas, before: TrackingContext, found: PoseEstimate) -> bool:
    """Whether the camera can have got to a pose on the submap where it was tracked last."""
    since = before.since()
    return since.admits(submaps, before.last.T_cam_world, since.submap, found.T_cam_world)


def _agreed(matches: Matches, estimate: PoseEstimate, keyframe: int, *, relocalised: bool = False) -> InitialPose:
    return InitialPose(estimate.T_cam_world, matches.select(estimate.inliers), keyframe, relocalised)


def _from_last_frame(world: Map, seen: Observations, before: TrackingContext, s: TrackingSettings) -> Iterator[Matches]:
    """Matches with the last frame, each search wider than the one before; those with too few are left out."""
    searches = ((1.0, 0.0, s.mapped_matches), (1.0, before.close_m, ENOUGH_FIRST), (WIDE, before.close_m, ENOUGH_FIRST))
    for widen, depth_m, enough in searches:
        radius = widen * s.radius_px
        matches = match_last_frame(world, before.last, seen, before.prediction, radius, depth_m, s.max_distance)
        if len(matches) >= enough:
            yield matches


def _from_keyframes(
    world: Map, submaps: Atlas, seen: Observations, before: TrackingContext, settings: BackendSettings, least: int
) -> InitialPose | None:
    """A pose with at least so many inliers by descriptors: from the reference keyframe, else from those alike.

    Each has to be one that the camera can have got to, and its place to be there; the first that is counts.
    """
    s = settings.relocalisation
    rng = stream(before.seed, "relocalisation", before.frame)
    for alike in (True,) if before.lost else (False, True):
        keyframes = top_candidates(world, before.keyframes, seen, s.searched) if alike else [before.reference]
        for found in pnp_poses(world, keyframes, seen, s, rng, settings.tracking.min_inliers):
            if found.estimate.count < least:
                continue
            if alike:
                there = _there(world, submaps, seen, found, before, settings)
                if there is not None:
                    return there
            elif _within_reach(submaps, before, found.estimate):
                return _agreed(found.matches, found.estimate, found.keyframe, relocalised=True)
    return None


# Where a camera may have got to while it was lost.


SLACK_M = 0.5
"""Metres that are believed in no time."""
SUDDEN = 60
"""A frame that shows so many map points, as many as a map begins with, followed by one that shows nothing of it: the
camera was put elsewhere."""


@dataclass(frozen=True, eq=False)
class MotionBound:
    """What is known of a camera that was lost.

    Attributes:
        submap: The submap, or 0, where it was tracked last.
        reach_m: How far it may have gone since.
        turn: How it has turned since; None if that is unknown.
    """

    submap: int
    reach_m: float
    turn: RotationEstimate | None

    def admits(self, submaps: Atlas, T_last_world: Array, submap: int, T_cam_world: Array) -> bool:
        """Whether it can have got to a pose.

        Args:
            submaps: Where they may lie, and how they may be turned.
            T_last_world: World-to-camera pose ``[4, 4]`` where it was tracked last.
            submap: The submap, or 0, of the pose.
            T_cam_world: The pose in that submap's world.
        """
        turned = submaps.slack(self.submap, submap)
        if self.turn is not None and not self.turn.allows(T_last_world, T_cam_world, turned):
            return False
        last, now = (se3.inverse(pose)[:3, 3] for pose in (T_last_world, T_cam_world))
        return submaps.within(self.submap, submap, last, now, self.reach_m)


class RelocalisationGate:
    """Bounds the way, and the turn, since the last tracked frame.

    Attributes:
        turn: The turn; None where the images are not connected.
    """

    def __init__(self, camera: Camera, *, anywhere: bool = False) -> None:
        self._camera = camera
        self._sudden = anywhere
        self.turn: RotationEstimate | None = None

    def lost(self, last: TrackedFrame, seen: Observations, settings: RelocalisationSettings, *, shows: bool) -> None:
        """The first frame that is not tracked any more.

        Args:
            last: The last tracked frame.
            seen: The new one's features.
            settings: Largest distance of descriptors.
            shows: Whether it is no blank wall, and no covered lens.
        """
        self.left(last)
        self._follow(seen, settings)
        self._sudden = self.turn is None and shows and bool(np.count_nonzero(last.point >= 0) >= SUDDEN)

    def left(self, last: TrackedFrame) -> None:
        """The camera is taken for lost from the next frame on; this one was tracked last."""
        self.turn, self._sudden = RotationEstimate(last.seen, np.eye(3)), False

    def since(
        self, last: TrackedFrame, seen: Observations, timestamp: float, submap: int, settings: RelocalisationSettings
    ) -> MotionBound:
        """The next frame of a lost camera has come: what is known of the time since the last tracked one.

        Args:
            last: That one.
            seen: The next frame's features.
            timestamp: Its stamp, seconds.
            submap: The submap, or 0, where the camera was tracked last.
            settings: The largest speed, and distance of descriptors.
        """
        self._follow(seen, settings)
        return MotionBound(submap, self.metres(last, timestamp, settings), self.turn)

    def at_most(
        self,
        last: TrackedFrame,
        seen: Observations,
        timestamp: float,
        submap: int,
        settings: RelocalisationSettings,
        prediction: Array,
    ) -> MotionBound:
        """What is known of the time since the frame before, in which the camera was tracked; arguments as `since`.

        A camera that moves fast, as on a car, may go on as the motion model has it: world-to-camera `prediction`.
        """
        turn = RotationEstimate(last.seen, np.eye(3)).on(seen, self._camera, settings.max_distance)
        centres = [se3.inverse(pose)[:3, 3] for pose in (last.T_cam_world, prediction)]
        step = float(np.linalg.norm(centres[1] - centres[0]))
        return MotionBound(submap, step + _way(last, timestamp, settings), turn)

    def _follow(self, seen: Observations, settings: RelocalisationSettings) -> None:
        if self.turn is not None:
            self.turn = self.turn.on(seen, self._camera, settings.max_distance)

    @property
    def slack(self) -> float:
        """How far the turn may be off, radians."""
        return np.pi if self.turn is None else self.turn.slack

    def turned(self, last: TrackedFrame) -> Array:
        """World-to-camera pose ``[4, 4]`` of a camera that has turned but has not moved."""
        return last.T_cam_world if self.turn is None else self.turn.after(last.T_cam_world)

    def metres(self, last: TrackedFrame, timestamp: float, settings: RelocalisationSettings) -> float:
        """The way at most until a time, metres; infinite where the camera was put elsewhere.

        Args:
            last: The last tracked frame.
            timestamp: Seconds.
            settings: The largest speed.
        """
        return np.inf if self._sudden else _way(last, timestamp, settings)


def _way(last: TrackedFrame, timestamp: float, settings: RelocalisationSettings) -> float:
    return SLACK_M + settings.max_speed * max(timestamp - last.timestamp, 0.0)


# How far a lost camera has turned, followed from image to image.


CONNECTED = 20
CONNECTED_SHARE = 0.4
"""Matches that fit one homography, and their share of all, that connect two images."""
RADIUS_PX = 4.0
"""Pixels by which they may miss it."""
SLACK = np.radians(20.0)
SHARE = 0.75
"""What the turn so far may be off: an angle, and a share of all that the images have turned. A camera that moves
sideways seems to turn. On four rendered laps none of 4,000 stretches of 3 to 30 steps was off by the share and half the
angle."""


@dataclass(frozen=True, eq=False)
class RotationEstimate:
    """The turn since the last tracked frame.

    Attributes:
        seen: Features of the newest image.
        R_now_last: From the camera's axes in the last tracked frame to those of now, ``[3, 3]``.
        apparent: All that consecutive images have turned, radians.
    """

    seen: Observations
    R_now_last: Array
    apparent: float = 0.0

    def on(self, seen: Observations, camera: Camera, max_distance: int) -> RotationEstimate | None:
        """The turn up to the next image; None where that shows nothing of the one before.

        Args:
            seen: Its features.
            camera: Intrinsics without distortion.
            max_distance: Largest Hamming distance of a match.
        """
        before, now, _ = match_brute_force(self.seen.words, seen.words, max_distance=max_distance, ratio=0.85)
        if len(before) < CONNECTED:
            return None
        one, other = self.seen.xy[before], seen.xy[now]
        found, mask = cv2.findHomography(one, other, cv2.RANSAC, RADIUS_PX)
        fits = np.zeros(len(before), bool) if found is None else mask.ravel() > 0
        if np.count_nonzero(fits) < max(CONNECTED, CONNECTED_SHARE * len(before)):
            return None
        step, _ = Rotation.align_vectors(_bearings(other[fits], camera), _bearings(one[fits], camera))
        return RotationEstimate(seen, step.as_matrix() @ self.R_now_last, self.apparent + float(step.magnitude()))

    @property
    def slack(self) -> float:
        """How far it may be off, radians."""
        return float(SLACK + SHARE * self.apparent)

    def after(self, T_last_world: Array) -> Array:
        """The world-to-camera pose ``[4, 4]`` of the last tracked frame, turned about its centre."""
        pose = T_last_world.copy()
        pose[:3] = self.R_now_last @ T_last_world[:3]
        return pose

    def allows(self, T_last_world: Array, T_now_world: Array, more: float = 0.0) -> bool:
        """Whether a pose of now is turned from that of the last tracked frame as it should be.

        Args:
            T_last_world: World-to-camera pose ``[4, 4]`` then.
            T_now_world: That of now.
            more: How far the two worlds may be turned against each other, radians.
        """
        off = se3.rotation_angle(T_now_world @ se3.inverse(self.after(T_last_world)))
        return bool(off <= self.slack + more)


def _bearings(xy: Array, camera: Camera) -> Array:
    rays = camera.unproject(xy, np.ones(len(xy)))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
