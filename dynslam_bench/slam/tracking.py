"""Where is this frame? Matching against the last frame and the map, and the pose that follows.

All functions are pure: they read the map and never change it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import se3
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_kernels import distinct
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.pose_optimisation import PoseEstimate, optimise_pose
from dynslam_bench.slam.settings import BackendSettings, TrackingSettings

Array = NDArray[np.float64]
Slots = NDArray[np.int64]


MARGIN_PX = 8.0
"""So far outside the image a point of the last frame is still looked for."""
ENOUGH_FIRST = 20
"""Matches with the last frame that make a second, wider search unnecessary (ORB-SLAM2's number)."""


@dataclass(eq=False)
class TrackedFrame:
    """A frame with a pose, kept until the next one was tracked.

    Attributes:
        seen: Its features.
        point: int64 ``[N]``, slot of the map point that each feature observes (inliers only), or -1.
        T_cam_world: World-to-camera pose.
        timestamp: Seconds.
    """

    seen: Observations
    point: Slots
    T_cam_world: Array
    timestamp: float


@dataclass(frozen=True, eq=False)
class Matches:
    """Features of the new frame and the world points that they may show.

    Attributes:
        feature: int64 ``[M]``, feature of the new frame.
        point: int64 ``[M]``, map slot, or -1 for a point that only the last frame's depth gives.
        position: World points ``[M, 3]``, metres.
    """

    feature: Slots
    point: Slots
    position: Array

    def __len__(self) -> int:
        return len(self.feature)

    def select(self, index: NDArray[np.bool_]) -> Matches:
        """The matches of a mask."""
        return Matches(self.feature[index], self.point[index], self.position[index])

    def joined(self, other: Matches) -> Matches:
        """These matches, then the others."""
        feature = np.concatenate((self.feature, other.feature))
        point = np.concatenate((self.point, other.point))
        return Matches(feature, point, np.concatenate((self.position, other.position)))


def match_last_frame(
    world: Map,
    last: TrackedFrame,
    seen: Observations,
    T_cam_world: Array,
    radius_px: float,
    close_m: float,
    max_distance: int,
) -> Matches:
    """Look for the last frame's points around their projections into the new frame.

    Beside map points these are points that only the last frame's depth gives, nearer than `close_m`.

    Args:
        world: The map.
        last: The last tracked frame.
        seen: The new frame's features.
        T_cam_world: Predicted pose of the new frame.
        radius_px: Half side of the window at octave 0; it grows with the feature's scale.
        close_m: Depth below which the last frame's own depth is used, metres; 0 to use map points alone.
        max_distance: Largest Hamming distance.
    """
    camera = world.camera
    from_map = last.point >= 0
    from_depth = ~from_map & (last.seen.z > 0) & (last.seen.z < close_m)
    rows = np.flatnonzero(from_map | from_depth)
    position = np.zeros((len(rows), 3))
    mapped = from_map[rows]
    position[mapped] = world.position[last.point[rows[mapped]]]
    own = rows[~mapped]
    position[~mapped] = se3.transform(
        se3.inverse(last.T_cam_world), camera.unproject(last.seen.xy[own], last.seen.z[own])
    )
    local = se3.transform(T_cam_world, position)
    ahead = local[:, 2] > 0.05
    uv = camera.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
    inside = (
        ahead
        & (uv >= -MARGIN_PX).all(axis=1)
        & (uv < (camera.width + MARGIN_PX, camera.height + MARGIN_PX)).all(axis=1)
    )
    rows, position, uv, depth = rows[inside], position[inside], uv[inside], local[inside, 2]
    octave = last.seen.octave[rows]
    free, words = np.ones(len(seen), bool), last.seen.words[rows]
    right = uv[:, 0] - camera.fx * camera.baseline_m / depth
    windows, octaves = (uv, right, radius_px * world.scales[octave]), (octave - 1, octave + 1)
    found, _ = search_in_radius(
        seen.grid, seen.arrays, free, windows, octaves, words, max_distance=max_distance, ratio=0.9
    )
    hit = found >= 0
    rows, position, found = rows[hit], position[hit], found[hit]
    steady = rotation_consistent(last.seen.angle[rows], seen.angle[found])
    return Matches(found[steady], last.point[rows[steady]], position[steady])


def match_map(
    world: Map,
    seen: Observations,
    T_cam_world: Array,
    known: Matches,
    candidates: Slots,
    settings: TrackingSettings,
    widen: float = 1.0,
) -> tuple[Matches, Slots]:
    """Look for map points in view among the features that have no match yet.

    Args:
        world: The map.
        seen: The new frame's features.
        T_cam_world: Its pose so far.
        known: Matches already found; their features and points are left alone.
        candidates: Slots of the points to look for.
        settings: Radius and descriptor distances.
        widen: Factor on the radius.

    Returns:
        New matches, and the slots of all candidates in view (whether found or not).
    """
    points, uv, right, octave, cosine = world.project(T_cam_world, candidates)
    taken = np.zeros(world.alive.size, bool)
    taken[known.point[known.point >= 0]] = True
    free = np.ones(len(seen), bool)
    free[known.feature] = False
    rest = ~taken[points]
    radius = settings.map_radius_px * widen * np.where(cosine > 0.998, 1.0, 1.6) * world.scales[octave]
    wanted = points[rest]
    windows, octaves = (uv[rest], right[rest], radius[rest]), (octave[rest] - 1, octave[rest] + 1)
    words, bits, ratio = world.words[wanted], settings.max_distance, settings.ratio
    found, _ = search_in_radius(seen.grid, seen.arrays, free, windows, octaves, words, max_distance=bits, ratio=ratio)
    hit = found >= 0
    return Matches(found[hit], wanted[hit], world.position[wanted[hit]]), points


def solve(world: Map, seen: Observations, matches: Matches, T_cam_world: Array, *, rounds: int = 4) -> PoseEstimate:
    """The pose that fits the matches, starting from a given one."""
    f = matches.feature
    measured = seen.xy[f], seen.right[f], seen.info[f], seen.info_right[f]
    return optimise_pose(T_cam_world, matches.position, *measured, world.camera, rounds=rounds)


@dataclass(frozen=True, eq=False)
class MapFit:
    """A pose by all that the frame sees of the map.

    Attributes:
        matches: The matches it was fitted to.
        estimate: The pose.
        inliers: bool ``[M]``, which matches fit it and show a map point.
        in_view: Slots of the map points that should be in view.
    """

    matches: Matches
    estimate: PoseEstimate
    inliers: NDArray[np.bool_]
    in_view: Slots

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inliers))

    def again(self, world: Map, seen: Observations) -> MapFit:
        """The pose fitted anew to the same matches, the features of which have moved a little."""
        estimate = solve(world, seen, self.matches, self.estimate.T_cam_world)
        return replace(self, estimate=estimate, inliers=estimate.inliers & (self.matches.point >= 0))


def fit_to_map(
    world: Map,
    seen: Observations,
    known: Matches,
    T_cam_world: Array,
    candidates: Slots,
    settings: TrackingSettings,
) -> MapFit:
    """Look for the rest of the local map around a first pose, and fit the pose to all of it.

    Points that only the last frame's depth gives count no more where there are enough of the map's own.

    Args:
        world: The map.
        seen: The frame's features.
        known: Matches of the first pose.
        T_cam_world: The first pose.
        candidates: Slots of the points to look for.
        settings: Radius, descriptor distances and number of inliers.
    """
    found, in_view = match_map(world, seen, T_cam_world, known, candidates, settings)
    matches = known.joined(found)
    mapped = matches.select(matches.point >= 0)
    if len(mapped) >= 2 * settings.min_inliers:
        matches = mapped
    estimate = solve(world, seen, matches, T_cam_world)
    return MapFit(matches, estimate, estimate.inliers & (matches.point >= 0), in_view)


# Which part of the map a frame is looked for in.


HELD = 15
"""Two keyframes that share so many points hold each other in place (the least that ORB-SLAM2 calls covisible)."""
LIMIT = 80
"""Keyframes at most whose points are looked for where the local map is the covisible one."""


class LocalMap:
    """Keyframes and points around the camera's place; looked up anew only after a keyframe, or at another place.

    Args:
        world: The map.
        settings: Of the back end.
    """

    def __init__(self, world: Map, settings: BackendSettings) -> None:
        self._world = world
        self.settings = settings
        self._at: tuple[int, int] | None = None
        self._keyframes: Slots = np.zeros(0, np.int64)
        self._points: Slots = np.zeros(0, np.int64)

    def keyframes(self, reference: int) -> Slots:
        """Slots of the keyframes around one, oldest first."""
        self._look_around(reference)
        return self._keyframes

    def points(self, reference: int, known: Slots) -> Slots:
        """Slots of the points to look for.

        Args:
            reference: Slot of the keyframe that shares most points with the camera's view.
            known: Slots of points that are known to be in view (-1 entries are skipped).
        """
        if self.settings.tracking.local_map == "covisible":
            near, _ = self._world.covisible_of(known)
            return _observed(self._world, near[:LIMIT])
        self._look_around(reference)
        return self._points

    def _look_around(self, reference: int) -> None:
        """Renew what is known of the place, unless neither map nor place have changed."""
        world = self._world
        if self._at == (reference, world.next_keyframe):
            return
        self._at = reference, world.next_keyframe
        self._keyframes, self._points = world.keyframes, world.points
        if self.settings.loop_closing.enabled:
            away = apart(world, reference, self.settings.loop_closing.away)
            if len(away):
                self._keyframes = self._keyframes[~np.isin(self._keyframes, away)]
                self._points = _observed(world, self._keyframes)


def apart(world: Map, keyframe: int, away: int) -> Slots:
    """Slots of the keyframes made `away` before or after one, or longer, and connected with it over no third.

    Those of other submaps always are.
    """
    near, _ = world.covisible(keyframe)
    further, _ = world.covisible_of(_observed(world, near))
    return _long_ago(world, keyframe, away, np.concatenate([near, further]))


def weakly_connected(world: Map, keyframe: int, away: int) -> Slots:
    """Slots of the keyframes made `away` before or after one, or longer, that nothing holds in place beside it.

    Two that share `HELD` points hold each other, and so does a third that shares as many with both. After a loop that
    was closed a little off, a second visit is connected with the first by fewer, and drifts beside it: such a place may
    be recognised anew. Keyframes of other submaps always may.
    """
    near, shared = world.covisible(keyframe)
    near = near[shared >= HELD]
    further = [other[count >= HELD] for other, count in map(world.covisible, near.tolist())]
    return _long_ago(world, keyframe, away, np.concatenate([near, *further]))


def _long_ago(world: Map, keyframe: int, away: int, connected: Slots) -> Slots:
    here = np.zeros(world.kf_alive.size, bool)
    here[keyframe] = True
    here[connected] = True
    long_ago = (np.abs(world.kf_id - world.kf_id[keyframe]) >= away) & ~here
    return np.flatnonzero(world.kf_alive & (long_ago | (world.kf_map != world.kf_map[keyframe])))


def _observed(world: Map, keyframes: Slots) -> Slots:
    """Slots of the points that keyframes observe, ascending."""
    return distinct(world.kf_point[keyframes], world.alive.size)
