"""A first pose of a frame: from the last frame; else from the reference keyframe, or any that the camera can be at.

All functions are pure: they read the map and never change it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream

from ..mapping.islands import Islands
from ..mapping.map import Map
from ..places import most_alike
from ..settings import BackendSettings, TrackingSettings
from .lookalikes import ambiguous, sight
from .observation import Observations
from .pose import PoseEstimate
from .reach import Lost
from .recognition import imprecision, recognise
from .relocalisation import Relocalised, located
from .tracking import ENOUGH_FIRST, Matches, Tracked, match_last_frame, solve

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
class Before:
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

    last: Tracked
    prediction: Array
    reference: int
    keyframes: Slots
    lost: bool
    since: Callable[[], Lost]
    close_m: float
    seed: int
    frame: int


@dataclass(frozen=True, eq=False)
class FirstPose:
    """A pose that enough matches agree on.

    Attributes:
        T_cam_world: World-to-camera pose.
        matches: The matches that agree.
        keyframe: Slot of a keyframe nearby: the one that they are with, or else the last frame's reference.
        relocalised: Whether the camera was lost before, or they are a keyframe's.
        share: Of the keyframe's own points that should be in view so much is, of one; NaN if nobody asked.
        imprecision: How badly they tell the pose (`recognition.imprecision`); NaN if nobody asked.
    """

    T_cam_world: Array
    matches: Matches
    keyframe: int
    relocalised: bool
    share: float = np.nan
    imprecision: float = np.nan


def first_pose(
    world: Map, islands: Islands, seen: Observations, before: Before, settings: BackendSettings
) -> FirstPose | None:
    """A first pose, or None.

    The last frame's map points come first. Where they are few, what only its depth gives helps as well. A pose that few
    matches agree on, as by chance after a gap or a sudden turn, has to compete with the keyframes', and
    the camera has to be able to get to it. After a loss it counts only if all around agrees.

    Args:
        world: The map.
        islands: Where parts of it may lie that are connected with the first one by nothing.
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
        guess = _there(world, islands, seen, Relocalised(before.reference, *best), before, settings)
        if guess is not None:
            return guess
    least = ENOUGH_FIRST // 2 if best is None or before.lost else best[1].count + 1
    found = _from_keyframes(world, islands, seen, before, settings, least)
    if found is None and best is not None and not before.lost and _within_reach(islands, before, best[1]):
        return _agreed(*best, before.reference)
    return found


def pose_at_home(
    world: Map, islands: Islands, seen: Observations, before: Before, settings: BackendSettings
) -> FirstPose | None:
    """A pose in the first map, of a camera that is tracked on an island: under the conditions of one that is lost.

    Arguments as of `first_pose`.
    """
    if before.lost or not world.kf_island[before.reference]:
        return None
    lost = replace(before, keyframes=world.island(0), lost=True)
    found = _from_keyframes(world, islands, seen, lost, settings, ENOUGH_FIRST // 2)
    return found if found is not None and len(found.matches) >= settings.relocalisation.min_inliers else None


def tracked_at(world: Map, tracked: Tracked, found: FirstPose) -> Tracked:
    """A tracked frame as it is tracked at another place."""
    point = np.full(len(tracked.seen), -1, np.int64)
    point[found.matches.feature] = np.where(world.alive[found.matches.point], found.matches.point, -1)
    return replace(tracked, point=point, T_cam_world=found.T_cam_world)


def _there(
    world: Map, islands: Islands, seen: Observations, found: Relocalised, before: Before, settings: BackendSettings
) -> FirstPose | None:
    """The pose at a keyframe's place, if the camera can have got there, and what was mapped around that is there.

    A place may only have something in common with another.
    """
    there = int(world.kf_island[found.keyframe])
    may_be = partial(before.since().may_be, islands, before.last.T_cam_world)
    if not may_be(there, found.estimate.T_cam_world):
        return None
    matches = found.matches.select(found.estimate.inliers)
    place = recognise(world, found.keyframe, seen, matches, found.estimate.T_cam_world, settings.tracking)
    many = len(place.matches) >= MANY
    if place.share < (MANY_SHARE if many else 1.0) * settings.relocalisation.min_share:
        return None
    imprecise = imprecision(world, seen, place, stream(before.seed, "halves", before.frame)) if before.lost else 0.0
    if imprecise > 1:
        return None
    known = {there: sight(place)}
    if before.lost and ambiguous(world, seen, known, before.keyframes, settings, before.seed, may_be):
        return None
    return FirstPose(place.T_cam_world, place.matches, found.keyframe, True, place.share, imprecise)


def _within_reach(islands: Islands, before: Before, found: PoseEstimate) -> bool:
    """Whether the camera can have got to a pose on the island where it was tracked last."""
    since = before.since()
    return since.may_be(islands, before.last.T_cam_world, since.island, found.T_cam_world)


def _agreed(matches: Matches, estimate: PoseEstimate, keyframe: int, *, relocalised: bool = False) -> FirstPose:
    return FirstPose(estimate.T_cam_world, matches.select(estimate.inliers), keyframe, relocalised)


def _from_last_frame(world: Map, seen: Observations, before: Before, s: TrackingSettings) -> Iterator[Matches]:
    """Matches with the last frame, each search wider than the one before; those with too few are left out."""
    searches = ((1.0, 0.0, s.mapped_matches), (1.0, before.close_m, ENOUGH_FIRST), (WIDE, before.close_m, ENOUGH_FIRST))
    for widen, depth_m, enough in searches:
        radius = widen * s.radius_px
        matches = match_last_frame(world, before.last, seen, before.prediction, radius, depth_m, s.max_distance)
        if len(matches) >= enough:
            yield matches


def _from_keyframes(
    world: Map, islands: Islands, seen: Observations, before: Before, settings: BackendSettings, least: int
) -> FirstPose | None:
    """A pose with at least so many inliers by descriptors: from the reference keyframe, else from those alike.

    Each has to be one that the camera can have got to, and its place to be there; the first that is counts.
    """
    s = settings.relocalisation
    rng = stream(before.seed, "relocalisation", before.frame)
    for alike in (True,) if before.lost else (False, True):
        keyframes = most_alike(world, before.keyframes, seen, s.searched) if alike else [before.reference]
        for found in located(world, keyframes, seen, s, rng, settings.tracking.min_inliers):
            if found.estimate.count < least:
                continue
            if alike:
                there = _there(world, islands, seen, found, before, settings)
                if there is not None:
                    return there
            elif _within_reach(islands, before, found.estimate):
                return _agreed(found.matches, found.estimate, found.keyframe, relocalised=True)
    return None
