"""Tracking: a frame's features, their matches with the last frame and the local map, and the pose that follows.

`pose_from_last_frame` gives an initial pose, `track_local_map` refines it with the local map
(ORB-SLAM2's ``TrackWithMotionModel`` and ``TrackLocalMap``). All functions are pure: they read the
map and never change it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

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
"""Points of the last frame are matched up to this distance outside the image, at octave 0."""
LAST_FRAME_RATIO = 0.9
"""Largest ratio of nearest to second nearest descriptor distance in the search of the last frame's points."""
MAP_RATIO = 0.85
"""Largest ratio of nearest to second nearest descriptor distance in the search of the local map's points."""
FRONTAL_COSINE = 0.998
"""Points seen within this cosine of their mean viewing direction have the narrow search window (ORB-SLAM2)."""
OBLIQUE_FACTOR = 1.6
"""Factor on the search window of all other points (ORB-SLAM2: 4.0 instead of 2.5)."""
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
"""Inliers that a pose from the last frame needs to be trusted by itself."""
TRUSTED_SHARE = 0.5
"""Share of the matches that must be inliers as well."""
LAST_FRAME_ROUNDS = 3
"""Rounds of the pose optimisation from the last frame; the local map's has one more."""


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
        features: Indices of the features that observe a point, ``[M]``.
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
            np.concatenate([self.feature, other.feature]),
            np.concatenate([self.point, other.point]),
            np.concatenate([self.position, other.position]),
        )


@dataclass(frozen=True, eq=False)
class InitialPose:
    """A pose that enough matches agree on.

    Attributes:
        T_cam_world: World-to-camera pose.
        matches: The matches that agree.
        keyframe: Slot of a keyframe nearby: the one that is matched, or else the last frame's
            reference.
        seen_share: Which share of the keyframe's own points, in view and behind no mask, is matched; NaN
            if not verified.
        depth: Median depth of the matches' points; NaN if not verified.
        uncertainty: `relocalisation.pose_uncertainty`; NaN if not verified.
        relocalised: Whether it comes from a keyframe, or the camera was lost before.
        trusted: Whether so many matches with the last frame agree that keyframes need not be searched.
    """

    T_cam_world: Array
    matches: Matches
    keyframe: int
    seen_share: float = np.nan
    depth: float = np.nan
    uncertainty: float = np.nan
    relocalised: bool = True
    trusted: bool = False


class LastFrameSearch(NamedTuple):
    """A search of the last frame's points in the new frame.

    Attributes:
        widen: Factor on the search window.
        uses_depth: Whether points are used that only the last frame's depth gives.
        min_matches: Matches without which no pose is computed.
    """

    widen: float
    uses_depth: bool
    min_matches: int


LAST_FRAME_SEARCHES = (
    LastFrameSearch(1.0, uses_depth=False, min_matches=ENOUGH_MAPPED),
    LastFrameSearch(1.0, uses_depth=True, min_matches=ENOUGH_MATCHES),
    LastFrameSearch(WIDEN, uses_depth=True, min_matches=ENOUGH_MATCHES),
)
"""Searches in turn, until one gives a trusted pose."""


def pose_from_last_frame(
    slam_map: Map,
    last: TrackedFrame,
    observations: Observations,
    prediction: Array,
    reference: int,
    settings: TrackingSettings,
) -> InitialPose | None:
    """The best pose from the last frame; each search is wider than the one before, until a pose is trusted.

    Args:
        slam_map: The map.
        last: The last tracked frame.
        observations: The new frame's features.
        prediction: Its world-to-camera pose by the motion model.
        reference: Slot of the keyframe that shares most points with the last frame.
        settings: Radius and descriptor distance.
    """
    best: InitialPose | None = None
    for search in LAST_FRAME_SEARCHES:
        # match around the predicted projections
        matches = match_last_frame(
            slam_map,
            last,
            observations,
            prediction,
            search.widen * settings.radius_px,
            CLOSE_BASELINES * slam_map.camera.baseline_m if search.uses_depth else 0.0,
            settings.max_distance,
        )
        if len(matches) < search.min_matches:
            continue

        # fit the pose; the one with the most inliers is kept
        estimate = solve(
            slam_map.camera, observations, matches, prediction, rounds=LAST_FRAME_ROUNDS
        )
        if estimate.count >= MIN_MATCHES and (best is None or estimate.count > len(best.matches)):
            inliers = matches.select(estimate.inliers)
            best = InitialPose(estimate.T_cam_world, inliers, reference, relocalised=False)

        # enough agree: no wider search
        trusted_count = max(TRUSTED_INLIERS, TRUSTED_SHARE * len(matches))
        if best is not None and estimate.count >= trusted_count:
            return replace(best, trusted=True)
    return best


def match_last_frame(
    slam_map: Map,
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
        slam_map: The map.
        last: The last tracked frame.
        observations: The new frame's features.
        T_cam_world: Predicted pose of the new frame.
        radius_px: Half side of the window at octave 0; it grows with the feature's scale.
        close_m: Depth below which the last frame's own depth is used, metres; 0 to use map points
            alone.
        max_distance: Largest Hamming distance.
    """
    camera = slam_map.camera
    last_observations = last.observations

    # the points' positions in the world: of the map, or from the last frame's depth
    mapped = last.point >= 0
    rows = np.flatnonzero(mapped | (last_observations.z > 0) & (last_observations.z < close_m))
    position = slam_map.position[last.point[rows]]
    unmapped = ~mapped[rows]
    in_last_camera = camera.unproject(
        last_observations.xy[rows[unmapped]], last_observations.z[rows[unmapped]]
    )
    position[unmapped] = se3.transform(se3.inverse(last.T_cam_world), in_last_camera)

    # their projections into the new frame
    local = position @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    uv, inside = camera.view(local, MARGIN_PX * slam_map.scales[0])
    rows = rows[inside]
    position = position[inside]
    uv = uv[inside]
    depth = local[inside, 2]
    octave = last_observations.octave[rows]
    right = uv[:, 0] - camera.fx * camera.baseline_m / depth

    # match by descriptor in a window around each
    feature = search_in_radius(
        observations,
        np.ones(len(observations.xy), bool),
        (uv, right, radius_px * slam_map.scales[octave]),
        octave,
        last_observations.descriptors[rows],
        max_distance=max_distance,
        ratio=LAST_FRAME_RATIO,
    )
    matched = feature >= 0
    matches = Matches(feature[matched], last.point[rows[matched]], position[matched])

    # drop matches whose features are rotated in the image unlike the others
    angles_before = last_observations.angle[rows[matched]]
    angles_now = observations.angle[matches.feature]
    return matches.select(rotation_consistent(angles_before, angles_now))


def match_map(
    slam_map: Map,
    observations: Observations,
    T_cam_world: Array,
    matches: Matches,
    candidates: Slots,
    settings: TrackingSettings,
    widen: float = 1.0,
) -> tuple[Matches, Slots]:
    """Match map points in view to the features that have no match yet.

    Args:
        slam_map: The map.
        observations: The new frame's features.
        T_cam_world: Its pose so far.
        matches: Matches so far; their features and points are left alone.
        candidates: Slots of the points to match.
        settings: Radius and descriptor distance.
        widen: Factor on the radius.

    Returns:
        New matches, and the slots of all candidates in view (matched or not).
    """
    # points that should be in view and have no match yet, features that have none
    points, uv, right, octave, cosine = slam_map.project(T_cam_world, candidates)
    rest = ~np.isin(points, matches.point)
    wanted = points[rest]
    free = np.ones(len(observations.xy), bool)
    free[matches.feature] = False

    # match by descriptor; the window grows with the octave, and away from the usual viewing direction
    view_factor = np.where(cosine > FRONTAL_COSINE, 1.0, OBLIQUE_FACTOR)
    radius = settings.map_radius_px * widen * view_factor * slam_map.scales[octave]
    feature = search_in_radius(
        observations,
        free,
        (uv[rest], right[rest], radius[rest]),
        octave[rest],
        slam_map.descriptor[wanted],
        max_distance=settings.max_distance,
        ratio=MAP_RATIO,
    )
    matched = feature >= 0
    matched_points = wanted[matched]
    return Matches(feature[matched], matched_points, slam_map.position[matched_points]), points


def solve(
    camera: Camera,
    observations: Observations,
    matches: Matches,
    T_cam_world: Array,
    *,
    rounds: int = 4,
) -> PoseEstimate:
    """The world-to-camera pose ``[4, 4]`` that fits the matches, starting from a given one.

    Args:
        camera: Intrinsics without distortion.
        observations: The frame's features.
        matches: Which of them show which world points.
        T_cam_world: Pose to start from.
        rounds: Optimisations, each followed by a new sorting into inliers and outliers.
    """
    measured = observations.measurements(matches.feature)
    return optimise_pose(T_cam_world, matches.position, measured, camera, rounds=rounds)


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
    """Fit the pose to matches with the local map.

    Args:
        camera: Intrinsics without distortion.
        observations: The frame's features.
        matches: Which of them show which points.
        T_cam_world: Pose ``[4, 4]`` to start from.
        in_view: Slots of the map points that should be in view.
    """
    # points that only the last frame's depth gives are no observations of the map
    estimate = solve(camera, observations, matches, T_cam_world)
    inliers = estimate.inliers & (matches.point >= 0)
    return MapFit(matches, estimate, in_view, inliers, int(np.count_nonzero(inliers)))


def track_local_map(
    slam_map: Map,
    observations: Observations,
    matches: Matches,
    T_cam_world: Array,
    candidates: Slots,
    settings: TrackingSettings,
) -> MapFit:
    """Match the rest of the local map around an initial pose, and fit the pose to all matches.

    Points that only the last frame's depth gives are left out where there are enough map points.

    Args:
        slam_map: The map.
        observations: The frame's features.
        matches: Matches of the initial pose.
        T_cam_world: The initial pose.
        candidates: Slots of the points of the local map.
        settings: Radius, descriptor distance and number of inliers.
    """
    # points of the local map that are in view and have no match yet
    more, in_view = match_map(slam_map, observations, T_cam_world, matches, candidates, settings)
    matches = matches.joined(more)

    # enough map points: leave out what only the last frame's depth gives
    mapped = matches.point >= 0
    if np.count_nonzero(mapped) >= 2 * settings.min_inliers:
        matches = matches.select(mapped)
    # the pose by all matches
    return fit_pose(slam_map.camera, observations, matches, T_cam_world, in_view)


# ---------------------------------------------------------------------- the local map


class LocalMap:
    """The keyframes and points that a frame is matched with; computed again after a keyframe or at another place.

    Without loop closing that is the whole map. With loop closing it ends where the covisibility
    graph does: what was left long ago is left to the loop closer. If its points were matched by
    projection, the pose would jump there, and the path since would keep its drift.

    Args:
        slam_map: The map.
        connected_only: Whether loops are closed.
    """

    def __init__(self, slam_map: Map, *, connected_only: bool) -> None:
        self._map = slam_map
        self._connected_only = connected_only
        self._computed_for: tuple[int, int] | None = None

    def around(self, reference: int) -> tuple[Slots, Slots]:
        """Slots of the keyframes around one, oldest first, and slots of the points to match there."""
        slam_map = self._map
        if self._computed_for != (reference, slam_map.next_keyframe):
            self._computed_for = reference, slam_map.next_keyframe
            self._keyframes = slam_map.keyframes
            self._points = slam_map.points
            # with loop closing, what the covisibility graph does not reach is left to the loop closer
            distant = unconnected(slam_map, reference) if self._connected_only else ()
            if len(distant):
                self._keyframes = self._keyframes[~np.isin(self._keyframes, distant)]
                self._points = slam_map.points_of(self._keyframes)
        return self._keyframes, self._points


def unconnected(slam_map: Map, keyframe: int, gap: int = MIN_KEYFRAME_GAP) -> Slots:
    """Slots of the keyframes made `gap` before or after one, or longer, that share no covisible keyframe with it.

    Those of other submaps always are.
    """
    # neighbours in the covisibility graph, and their neighbours
    near, _ = slam_map.covisible(keyframe)
    further, _ = slam_map.covisible_of(slam_map.points_of(near))
    return _long_ago(slam_map, keyframe, gap, np.concatenate([near, further]))


def weakly_connected(slam_map: Map, keyframe: int, gap: int = MIN_KEYFRAME_GAP) -> Slots:
    """Slots of the keyframes made `gap` before or after one, or longer, that are not strongly covisible with it.

    Strong covisibility counts directly or over one third keyframe. After a loop that was closed
    inaccurately, a second visit is connected with the first by fewer points and drifts beside it:
    such a place may be recognised again. Keyframes of other submaps always may.
    """
    # neighbours by strong edges of the covisibility graph, and theirs
    near, shared = slam_map.covisible(keyframe)
    near = near[shared >= STRONG_COVISIBILITY]
    further = []
    for neighbour in near.tolist():
        second, second_shared = slam_map.covisible(neighbour)
        further.append(second[second_shared >= STRONG_COVISIBILITY])
    return _long_ago(slam_map, keyframe, gap, np.concatenate([near, *further]))


def _long_ago(slam_map: Map, keyframe: int, gap: int, connected: Slots) -> Slots:
    """Slots of the keyframes made `gap` before or after one, or longer, without the connected; all of other submaps."""
    # made long before or after, and not connected; or in another submap
    long_ago = np.abs(slam_map.kf_id - slam_map.kf_id[keyframe]) >= gap
    long_ago[connected] = False
    return np.flatnonzero(
        slam_map.kf_alive & (long_ago | (slam_map.kf_map != slam_map.kf_map[keyframe]))
    )
