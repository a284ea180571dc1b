"""Tracking: a frame's features, their matches with the last frame and the local map, and the pose that follows.

All functions are pure: they read the map and never change it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import rotation_consistent, search_in_radius
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import PoseEstimate, optimise_pose
from dynslam_bench.slam.settings import TrackingSettings

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
ENOUGH_MAPPED = 100
"""So many matches with map points of the last frame make points from its depth alone unnecessary."""
ENOUGH_MATCHES = 20
"""Matches with the last frame that make a second, wider search unnecessary (ORB-SLAM2's number)."""
MIN_MATCHES = 10
"""Inliers that a pose needs at least to be a candidate."""
WIDEN = 2.5
"""Factor on the search window where the narrow one gave no trusted pose."""
TRUSTED_INLIERS = 50
TRUSTED_SHARE = 0.5
"""Inliers, and their share of the matches, that make a pose from the last frame trusted by itself."""


@dataclass(eq=False)
class TrackedFrame:
    """A frame with a pose, kept until the next one was tracked.

    Attributes:
        observations: Its features.
        point: int64 ``[N]``, slot of the map point that each feature observes (inliers only), or
            -1.
        T_cam_world: World-to-camera pose.
        timestamp: Seconds.
    """

    observations: Observations
    point: Slots
    T_cam_world: Array
    timestamp: float


def observe_points(observations: Observations, features: Slots, points: Slots) -> Slots:
    """The map point that each feature of a frame observes, ``[N]``, or -1.

    Args:
        observations: The frame's N features.
        features: Those that observe a point, ``[M]``.
        points: Slots of their points, ``[M]``; -1 for none.
    """
    observed = np.full(len(observations), -1, np.int64)
    observed[features] = points
    return observed


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
        return Matches(
            *map(np.concatenate, zip(vars(self).values(), vars(other).values(), strict=True))
        )


@dataclass(frozen=True, eq=False)
class InitialPose:
    """A pose that enough matches agree on.

    Attributes:
        T_cam_world: World-to-camera pose.
        matches: The matches that agree.
        keyframe: Slot of a keyframe nearby: the one that is matched, or else the last frame's
            reference.
        share: Which share of the keyframe's own points, in view and behind no mask, is matched; NaN
            if not verified.
        depth: Median depth of the matches' points; NaN if not verified.
        uncertainty: `relocalisation.pose_uncertainty`; NaN if not verified.
        relocalised: Whether it comes from a keyframe, or the camera was lost before.
    """

    T_cam_world: Array
    matches: Matches
    keyframe: int
    share: float = np.nan
    depth: float = np.nan
    uncertainty: float = np.nan
    relocalised: bool = True


def pose_from_last_frame(
    world: Map,
    last: TrackedFrame,
    observations: Observations,
    prediction: Array,
    reference: int,
    settings: TrackingSettings,
) -> tuple[InitialPose | None, bool]:
    """The best pose from the last frame, and whether it is trusted; each search is wider than the one before.

    Args:
        world: The map.
        last: The last tracked frame.
        observations: The new frame's features.
        prediction: Its world-to-camera pose by the motion model.
        reference: Slot of the keyframe that shares most points with the last frame.
        settings: Radius and descriptor distance.
    """
    close_m = CLOSE_BASELINES * world.camera.baseline_m
    best: InitialPose | None = None
    for widen, depth_m, enough in (
        (1.0, 0.0, ENOUGH_MAPPED),
        (1.0, close_m, ENOUGH_MATCHES),
        (WIDEN, close_m, ENOUGH_MATCHES),
    ):
        radius = widen * settings.radius_px
        matches = match_last_frame(
            world, last, observations, prediction, radius, depth_m, settings.max_distance
        )
        if len(matches) < enough:
            continue
        estimate = solve(world.camera, observations, matches, prediction, rounds=3)
        if estimate.count >= MIN_MATCHES and (best is None or estimate.count > len(best.matches)):
            best = InitialPose(
                estimate.T_cam_world, matches.select(estimate.inliers), reference, relocalised=False
            )
        if best is not None and estimate.count >= max(
            TRUSTED_INLIERS, TRUSTED_SHARE * len(matches)
        ):
            return best, True
    return best, False


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

    Beside map points these are points that only the last frame's depth gives, nearer than
    `close_m`.

    Args:
        world: The map.
        last: The last tracked frame.
        observations: The new frame's features.
        T_cam_world: Predicted pose of the new frame.
        radius_px: Half side of the window at octave 0; it grows with the feature's scale.
        close_m: Depth below which the last frame's own depth is used, metres; 0 to use map points
            alone.
        max_distance: Largest Hamming distance.
    """
    camera = world.camera
    from_map = last.point >= 0
    rows = np.flatnonzero(from_map | (last.observations.z > 0) & (last.observations.z < close_m))
    position = world.position[last.point[rows]]
    unmapped = ~from_map[rows]
    local = camera.unproject(
        last.observations.xy[rows[unmapped]], last.observations.z[rows[unmapped]]
    )
    position[unmapped] = se3.transform(se3.inverse(last.T_cam_world), local)
    local = position @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    uv, inside = camera.view(local, MARGIN_PX)
    rows = rows[inside]
    position = position[inside]
    uv = uv[inside]
    depth = local[inside, 2]
    octave = last.observations.octave[rows]
    right = uv[:, 0] - camera.fx * camera.baseline_m / depth
    feature = search_in_radius(
        observations,
        np.ones(len(observations.xy), bool),
        (uv, right, radius_px * world.scales[octave]),
        octave,
        last.observations.words[rows],
        max_distance=max_distance,
        ratio=LAST_FRAME_RATIO,
    )
    hit = feature >= 0
    matches = Matches(feature[hit], last.point[rows[hit]], position[hit])
    return matches.select(
        rotation_consistent(last.observations.angle[rows[hit]], observations.angle[matches.feature])
    )


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
    free = np.ones(len(observations.xy), bool)
    free[matches.feature] = False
    rest = ~np.isin(points, matches.point)
    radius = (
        settings.map_radius_px * widen * np.where(cosine > 0.998, 1.0, 1.6) * world.scales[octave]
    )
    wanted = points[rest]
    feature = search_in_radius(
        observations,
        free,
        (uv[rest], right[rest], radius[rest]),
        octave[rest],
        world.words[wanted],
        max_distance=settings.max_distance,
        ratio=MAP_RATIO,
    )
    hit = feature >= 0
    return Matches(feature[hit], wanted[hit], world.position[wanted[hit]]), points


def solve(
    camera: Camera,
    observations: Observations,
    matches: Matches,
    T_cam_world: Array,
    *,
    rounds: int = 4,
) -> PoseEstimate:
    """The pose that fits the matches, starting from a given one."""
    f = matches.feature
    measured = (
        observations.xy[f],
        observations.right[f],
        observations.info[f],
        observations.info_right[f],
    )
    return optimise_pose(T_cam_world, matches.position, *measured, camera, rounds=rounds)


@dataclass(frozen=True, eq=False)
class MapFit:
    """A pose fitted to all matches with the local map.

    Attributes:
        matches: The matches it was fitted to.
        estimate: The pose.
        in_view: Slots of the map points that should be in view.
        inliers: bool ``[M]``, which matches fit the pose and show a map point.
        count: How many do.
    """

    matches: Matches
    estimate: PoseEstimate
    in_view: Slots
    inliers: NDArray[np.bool_]
    count: int


def fit_pose(
    camera: Camera, observations: Observations, matches: Matches, T_cam_world: Array, in_view: Slots
) -> MapFit:
    """Fit the pose to matches with the local map."""
    estimate = solve(camera, observations, matches, T_cam_world)
    inliers = estimate.inliers & (matches.point >= 0)
    return MapFit(matches, estimate, in_view, inliers, int(np.count_nonzero(inliers)))


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
    mapped = matches.point >= 0
    if np.count_nonzero(mapped) >= 2 * settings.min_inliers:
        matches = matches.select(mapped)
    return fit_pose(world.camera, observations, matches, T_cam_world, in_view)


# ---------------------------------------------------------------------- the local map


class LocalMap:
    """The keyframes and points that a frame is matched with; computed again after a keyframe or at another place.

    Without loop closing that is the whole map. With loop closing it ends where the covisibility
    graph does: what was left long ago is left to the loop closer. If its points were matched by
    projection, the pose would jump there, and the path since would keep its drift.

    Args:
        world: The map.
        connected_only: Whether loops are closed.
    """

    def __init__(self, world: Map, *, connected_only: bool) -> None:
        self._world = world
        self._connected_only = connected_only
        self._computed_for: tuple[int, int] | None = None

    def around(self, reference: int) -> tuple[Slots, Slots]:
        """Slots of the keyframes around one, oldest first, and slots of the points to match there."""
        world = self._world
        if self._computed_for != (reference, world.next_keyframe):
            self._computed_for = reference, world.next_keyframe
            self._keyframes = world.keyframes
            self._points = world.points
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

    Strong covisibility counts directly or over one third keyframe. After a loop that was closed
    inaccurately, a second visit is connected with the first by fewer points and drifts beside it:
    such a place may be recognised again. Keyframes of other submaps always may.
    """
    near, shared = world.covisible(keyframe)
    near = near[shared >= STRONG_COVISIBILITY]
    further = [
        other[count >= STRONG_COVISIBILITY] for other, count in map(world.covisible, near.tolist())
    ]
    return _long_ago(world, keyframe, gap, np.concatenate([near, *further]))


def _long_ago(world: Map, keyframe: int, gap: int, connected: Slots) -> Slots:
    long_ago = np.abs(world.kf_id - world.kf_id[keyframe]) >= gap
    long_ago[connected] = False
    return np.flatnonzero(world.kf_alive & (long_ago | (world.kf_map != world.kf_map[keyframe])))
