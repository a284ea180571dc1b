"""Matching a frame against the last frame and the local map, and the pose that follows.

All functions are pure: they read the map and never change it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.pose_optimisation import PoseEstimate, optimise_pose
from dynslam_bench.slam.settings import TrackingSettings

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

CLOSE_BASELINES = 40.0
"""Points nearer than this many stereo baselines are close: their depth is trusted at once (ORB-SLAM2's number)."""
MARGIN_PX = 8.0
"""Points of the last frame are matched up to this distance outside the image."""
LAST_FRAME_RATIO = 0.9
MAP_RATIO = 0.85
"""Nearest over second nearest descriptor distance allowed in the two searches."""
MIN_KEYFRAME_GAP = 20
"""Keyframes at least between one and another that a loop is closed to."""
STRONG_COVISIBILITY = 15
"""Two keyframes that share so many points constrain each other (the least that ORB-SLAM2 calls covisible)."""


@dataclass(eq=False)
class TrackedFrame:
    """A frame with a pose, kept until the next one was tracked.

    Attributes:
        observations: Its features.
        point: int64 ``[N]``, slot of the map point that each feature observes (inliers only), or -1.
        T_cam_world: World-to-camera pose.
        timestamp: Seconds.
    """

    observations: Observations
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
    observations: Observations,
    T_cam_world: Array,
    radius_px: float,
    close_m: float,
    max_distance: int,
) -> Matches:
    """Match the last frame's points around their projections into the new frame.

    Beside map points these are points that only the last frame's depth gives, nearer than `close_m`.

    Args:
        world: The map.
        last: The last tracked frame.
        observations: The new frame's features.
        T_cam_world: Predicted pose of the new frame.
        radius_px: Half side of the window at octave 0; it grows with the feature's scale.
        close_m: Depth below which the last frame's own depth is used, metres; 0 to use map points alone.
        max_distance: Largest Hamming distance.
    """
    camera = world.camera
    from_map = last.point >= 0
    from_depth = ~from_map & (last.observations.z > 0) & (last.observations.z < close_m)
    rows = np.flatnonzero(from_map | from_depth)
    position = np.zeros((len(rows), 3))
    mapped = from_map[rows]
    position[mapped] = world.position[last.point[rows[mapped]]]
    unmapped = rows[~mapped]
    position[~mapped] = se3.transform(
        se3.inverse(last.T_cam_world), camera.unproject(last.observations.xy[unmapped], last.observations.z[unmapped])
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
    octave = last.observations.octave[rows]
    free, words = np.ones(len(observations), bool), last.observations.words[rows]
    right = uv[:, 0] - camera.fx * camera.baseline_m / depth
    windows, octaves = (uv, right, radius_px * world.scales[octave]), (octave - 1, octave + 1)
    feature, _ = search_in_radius(
        observations.grid,
        observations.arrays,
        free,
        windows,
        octaves,
        words,
        max_distance=max_distance,
        ratio=LAST_FRAME_RATIO,
    )
    hit = feature >= 0
    rows, position, feature = rows[hit], position[hit], feature[hit]
    consistent = rotation_consistent(last.observations.angle[rows], observations.angle[feature])
    return Matches(feature[consistent], last.point[rows[consistent]], position[consistent])


def match_map(
    world: Map,
    observations: Observations,
    T_cam_world: Array,
    matches: Matches,
    candidates: Slots,
    settings: TrackingSettings,
    widen: float = 1.0,
) -> tuple[Matches, Slots]:
    """Match map points in view to the features that have no match yet.

    Args:
        world: The map.
        observations: The new frame's features.
        T_cam_world: Its pose so far.
        matches: Matches so far; their features and points are left alone.
        candidates: Slots of the points to match.
        settings: Radius and descriptor distance.
        widen: Factor on the radius.

    Returns:
        New matches, and the slots of all candidates in view (matched or not).
    """
    points, uv, right, octave, cosine = world.project(T_cam_world, candidates)
    matched = np.zeros(world.alive.size, bool)
    matched[matches.point[matches.point >= 0]] = True
    free = np.ones(len(observations), bool)
    free[matches.feature] = False
    rest = ~matched[points]
    radius = settings.map_radius_px * widen * np.where(cosine > 0.998, 1.0, 1.6) * world.scales[octave]
    wanted = points[rest]
    windows, octaves = (uv[rest], right[rest], radius[rest]), (octave[rest] - 1, octave[rest] + 1)
    words, bits = world.words[wanted], settings.max_distance
    feature, _ = search_in_radius(
        observations.grid, observations.arrays, free, windows, octaves, words, max_distance=bits, ratio=MAP_RATIO
    )
    hit = feature >= 0
    return Matches(feature[hit], wanted[hit], world.position[wanted[hit]]), points


def solve(
    camera: Camera, observations: Observations, matches: Matches, T_cam_world: Array, *, rounds: int = 4
) -> PoseEstimate:
    """The pose that fits the matches, starting from a given one."""
    f = matches.feature
    measured = observations.xy[f], observations.right[f], observations.info[f], observations.info_right[f]
    return optimise_pose(T_cam_world, matches.position, *measured, camera, rounds=rounds)


@dataclass(frozen=True, eq=False)
class MapFit:
    """A pose fitted to all matches with the local map.

    Attributes:
        matches: The matches it was fitted to.
        estimate: The pose.
        in_view: Slots of the map points that should be in view.
    """

    matches: Matches
    estimate: PoseEstimate
    in_view: Slots

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Boolean ``[M]``: which matches fit the pose and show a map point."""
        return self.estimate.inliers & (self.matches.point >= 0)

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inliers))

    def refit(self, observations: Observations, camera: Camera) -> MapFit:
        """The pose fitted again to the same matches, the features of which have moved a little."""
        return replace(self, estimate=solve(camera, observations, self.matches, self.estimate.T_cam_world))


def track_local_map(
    world: Map,
    observations: Observations,
    matches: Matches,
    T_cam_world: Array,
    candidates: Slots,
    settings: TrackingSettings,
) -> MapFit:
    """Match the rest of the local map around an initial pose, and fit the pose to all matches.

    Points that only the last frame's depth gives are left out where there are enough map points.

    Args:
        world: The map.
        observations: The frame's features.
        matches: Matches of the initial pose.
        T_cam_world: The initial pose.
        candidates: Slots of the points of the local map.
        settings: Radius, descriptor distance and number of inliers.
    """
    more, in_view = match_map(world, observations, T_cam_world, matches, candidates, settings)
    matches = matches.joined(more)
    mapped = matches.select(matches.point >= 0)
    if len(mapped) >= 2 * settings.min_inliers:
        matches = mapped
    return MapFit(matches, solve(world.camera, observations, matches, T_cam_world), in_view)


# ---------------------------------------------------------------------- the local map


class LocalMap:
    """The keyframes and points that a frame is matched with; computed again after a keyframe or at another place.

    Without loop closing that is the whole map. With loop closing it ends where the covisibility graph does: what was
    left long ago is left to the loop closer. If its points were matched by projection, the pose would jump there, and
    the path since would keep its drift.

    Args:
        world: The map.
        connected_only: Whether loops are closed.
    """

    def __init__(self, world: Map, *, connected_only: bool) -> None:
        self._world = world
        self._connected_only = connected_only
        self._computed_for: tuple[int, int] | None = None
        self._keyframes: Slots = np.zeros(0, np.int64)
        self._points: Slots = np.zeros(0, np.int64)

    def around(self, reference: int) -> tuple[Slots, Slots]:
        """Slots of the keyframes around one, oldest first, and slots of the points to match there."""
        world = self._world
        if self._computed_for != (reference, world.next_keyframe):
            self._computed_for = reference, world.next_keyframe
            self._keyframes, self._points = world.keyframes, world.points
            distant = unconnected(world, reference) if self._connected_only else ()
            if len(distant):
                self._keyframes = self._keyframes[~np.isin(self._keyframes, distant)]
                self._points = world.points_of(self._keyframes)
        return self._keyframes, self._points


def unconnected(world: Map, keyframe: int, gap: int = MIN_KEYFRAME_GAP) -> Slots:
    """Slots of the keyframes made `gap` before or after one, or longer, that share no covisible keyframe with it.

    Those of other submaps always are.
    """
    near, _ = world.covisible(keyframe)
    further, _ = world.covisible_of(world.points_of(near))
    return _long_ago(world, keyframe, gap, np.concatenate([near, further]))


def weakly_connected(world: Map, keyframe: int, gap: int = MIN_KEYFRAME_GAP) -> Slots:
    """Slots of the keyframes made `gap` before or after one, or longer, that are not strongly covisible with it.

    Strong covisibility counts directly or over one third keyframe. After a loop that was closed inaccurately, a second
    visit is connected with the first by fewer points and drifts beside it: such a place may be recognised again.
    Keyframes of other submaps always may.
    """
    near, shared = world.covisible(keyframe)
    near = near[shared >= STRONG_COVISIBILITY]
    further = [other[count >= STRONG_COVISIBILITY] for other, count in map(world.covisible, near.tolist())]
    return _long_ago(world, keyframe, gap, np.concatenate([near, *further]))


def _long_ago(world: Map, keyframe: int, gap: int, connected: Slots) -> Slots:
    here = np.zeros(world.kf_alive.size, bool)
    here[keyframe] = True
    here[connected] = True
    long_ago = (np.abs(world.kf_id - world.kf_id[keyframe]) >= gap) & ~here
    return np.flatnonzero(world.kf_alive & (long_ago | (world.kf_map != world.kf_map[keyframe])))
