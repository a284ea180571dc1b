"""Local mapping: when a frame becomes a keyframe, and the work on the map at each new one.

New points from depth and by triangulation, fusion of duplicates, local bundle adjustment, culling
of points and keyframes (ORB-SLAM2, Section III).
"""

from __future__ import annotations

from copy import deepcopy
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import inlined, kernel
from dynslam_bench.features.matching import (
    FAR,
    CellGrid,
    Features,
    Words,
    distance,
    search_in_radius,
)
from dynslam_bench.geometry import se3
from dynslam_bench.slam.bundle_adjustment import Bundle, adjust_bundle, full_bundle, local_bundle
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import Intrinsics, intrinsics_of
from dynslam_bench.slam.settings import BackendSettings, KeyframeSettings
from dynslam_bench.slam.tracking import CLOSE_BASELINES, TrackedFrame

MAX_DISTANCE = 50
"""Largest Hamming distance in fusion and triangulation (ORB-SLAM2's lower threshold)."""
FUSION_RADIUS_PX = 3.0
"""Points are fused with features in a window of this half side at octave 0 (ORB-SLAM2's number)."""
MIN_PARALLAX = np.deg2rad(1.0)
"""Smallest parallax of a triangulated point, radians."""
CHI2_LINE = 3.84
"""95 % quantile of chi-square with one degree of freedom: how far a match may lie from the epipolar line."""
CHI2_POINT = 5.991
"""95 % quantile of chi-square with two degrees of freedom: how far a point may lie from its feature."""
MIN_TRIANGULATED_DEPTH = 0.1
"""Triangulated points lie farther than this before both cameras, metres (without depth the map's unit)."""
MAX_TRIANGULATED_DEPTH = 40.0
"""Triangulated points lie nearer than this to the new keyframe, metres (without depth the map's unit)."""
DEPTH_TOLERANCE = 0.05
"""A triangulated depth differs from a measured one by no more than this share."""
SCALE_TOLERANCE = 1.8
"""Octaves and distances of a match agree within this factor (ORB-SLAM2: 1.5 times the pyramid's factor, 1.2)."""
MIN_DEPTH_POINTS = 100
"""Features whose depth makes points at every keyframe, the nearest ones, even if they are not close (ORB-SLAM2)."""
YOUNG = 3
"""A point may be culled because it is seldom found within so many keyframes after its own."""
MIN_OBSERVATIONS = 2
"""Keyframes that must observe a point `OBSERVED_AFTER` keyframes after its creation, or it is culled."""
OBSERVED_AFTER = 2
"""Keyframes after which a point must have `MIN_OBSERVATIONS`."""
FULL_ITERATIONS = 10
"""Levenberg-Marquardt iterations of full bundle adjustment."""
RECENT_SHARE = 4
"""One in so many of `keyframes.maximum`, the newest keyframes, are not culled where there are too many."""
COMPARED = 16
"""Keyframes of which the most redundant one is culled where there are too many; the next time others are compared."""

MIN_KEYFRAME_INLIERS = 15
"""Inliers that a keyframe needs more than (ORB-SLAM2's number)."""
ESTABLISHED = 3
"""Keyframes that observe an established point at least."""
MIN_CLOSE = 100
"""Fewer tracked close points than this are few (ORB-SLAM2)."""
NEW_CLOSE = 70
"""More close features than this that are not in the map are many: where few are tracked, they make a keyframe."""
VIEW_SHARE = 0.9
"""A keyframe is made when less than this share of the last keyframe's points lies in the image."""
MOVED_SHARE = 0.97
"""The view has moved when less than this share of the last keyframe's points lies in the image."""


class LocalMapper:
    """Adds keyframes to the map and keeps it clean and consistent.

    Args:
        slam_map: The map to work on.
        settings: Settings of the back end.

    Attributes:
        culled: Keyframes that the last `insert` removed: slot, slot of the replacement, and the
            pose ``T_culled_replacement``.
    """

    def __init__(self, slam_map: Map, settings: BackendSettings) -> None:
        self.map = slam_map
        self.settings = settings
        self.close_m = CLOSE_BASELINES * slam_map.camera.baseline_m
        self.culled: list[tuple[int, int, Array]] = []
        points = slam_map.points
        self._young: Slots = points[slam_map.next_keyframe - 1 - slam_map.born[points] < YOUNG]

    def insert(
        self,
        observations: Observations,
        point: Slots,
        T_cam_world: Array,
        frame: int,
        stamp: float,
        submap: int = 0,
    ) -> tuple[int, dict[str, float]]:
        """Make a frame a keyframe: new points, fusion, bundle adjustment, culling.

        Args:
            observations: The frame's features.
            point: Map slot that each feature observes, or -1.
            T_cam_world: The frame's pose.
            frame: Index of the frame.
            stamp: Its timestamp.
            submap: The map that it belongs to (`Map.kf_map`).

        Returns:
            The keyframe's slot, and the seconds spent on ``mapping`` and ``bundle_adjustment``.
        """
        begin = perf_counter()
        slam_map = self.map
        self.culled.clear()
        first = not slam_map.submap(submap).size

        # the keyframe, and what it observes of the map
        slot = slam_map.add_keyframe(observations, T_cam_world, frame, stamp, submap)
        features = np.flatnonzero(point >= 0)
        slam_map.observe(slot, features, point[features])
        slam_map.refresh(slam_map.points_of(slot))

        # remove bad points, create points from depth
        self._cull_points()
        self._points_from_depth(slot, observations, everything=first)
        if first:
            return slot, {"mapping": perf_counter() - begin, "bundle_adjustment": 0.0}

        # create points by triangulation, where few features are close enough for their depth
        neighbours = slam_map.covisible(slot)[0][: self.settings.mapping.neighbours]
        close = np.count_nonzero((observations.z > 0) & (observations.z < self.close_m))
        if close / max(len(observations), 1) < self.settings.mapping.triangulate_below:
            self._points_from_triangulation(slot, neighbours, observations)

        # merge duplicates, optimise, and remove redundant keyframes
        self._fuse(slot, neighbours)
        adjustment_begin = perf_counter()
        self.adjust(slot)
        adjustment_s = perf_counter() - adjustment_begin
        self._cull_keyframes(slot)
        mapping_s = perf_counter() - begin - adjustment_s
        return slot, {"mapping": mapping_s, "bundle_adjustment": adjustment_s}

    # ------------------------------------------------------------------ points

    def _points_from_depth(
        self, slot: int, observations: Observations, *, everything: bool
    ) -> None:
        """Points for features without one: all close ones, and the nearest hundred in any case."""
        # features that observe no point and have a depth, nearest first
        slam_map = self.map
        has_no_point = slam_map.kf_point[slot, : len(observations)] < 0
        free = np.flatnonzero(has_no_point & (observations.z > 0))
        nearest_first = free[np.argsort(observations.z[free], kind="stable")]
        # far depths are noisy: they make points only where there are few close ones
        if everything:
            chosen = nearest_first
        else:
            close = np.count_nonzero(observations.z[free] < self.close_m)
            chosen = nearest_first[: max(close, MIN_DEPTH_POINTS)]

        # from the camera frame to the world
        T_world_cam = se3.inverse(slam_map.kf_pose[slot])
        local = slam_map.camera.unproject(observations.xy[chosen], observations.z[chosen])
        self._add_points(slot, chosen, se3.transform(T_world_cam, local), observations)

    def _points_from_triangulation(
        self, slot: int, neighbours: Slots, observations: Observations
    ) -> None:
        """Points for features without one, by triangulation with each neighbouring keyframe in turn."""
        # features that one neighbour gave a point are no longer free for the next
        for neighbour in neighbours.tolist():
            features, neighbour_features, position = triangulate(
                self.map, slot, neighbour, self.settings.mapping.min_parallax_sigmas
            )
            second = (neighbour, neighbour_features)
            self._add_points(slot, features, position, observations, second)

    def _add_points(
        self,
        slot: int,
        features: Slots,
        position: Array,
        observations: Observations,
        second: tuple[int, Slots] | None = None,
    ) -> None:
        """New points ``[N, 3]`` that features of a keyframe observe.

        Args:
            slot: The keyframe.
            features: Its features, ``[N]``.
            position: World points, metres.
            observations: All features of the keyframe.
            second: Another keyframe that observes the points, and its features ``[N]``.
        """
        # each point with the observation that made it, and the second view's
        created = self.map.add_points(position, observations.rgb[features], slot, features)
        if second is not None:
            self.map.observe(*second, created)
        self.map.refresh(created)
        self._young = np.concatenate([self._young, created])

    def _cull_points(self) -> None:
        """Remove young points that are seldom found where they should be seen, or that few keyframes observe."""
        # points of the last `YOUNG` keyframes; older ones have proved themselves
        slam_map = self.map
        young = self._young[slam_map.alive[self._young]]
        # age in keyframes since the point was made
        age = slam_map.next_keyframe - 1 - slam_map.born[young]
        # found in too few of the frames where it was in view, or observed by too few keyframes
        min_found_ratio = self.settings.mapping.min_found_ratio
        seldom_found = slam_map.found[young] < min_found_ratio * slam_map.visible[young]
        seldom_observed = (age >= OBSERVED_AFTER) & (slam_map.n_obs[young] < MIN_OBSERVATIONS)
        bad = seldom_found | seldom_observed
        slam_map.remove_points(young[bad])
        self._young = young[~bad & (age < YOUNG)]

    # ------------------------------------------------------------------ fusion

    def _fuse(self, slot: int, neighbours: Slots) -> None:
        """Match the new keyframe's points in its neighbours and theirs in it; merge duplicates."""
        # the new points in each neighbour, then the neighbours' points in the new keyframe
        for other in neighbours.tolist():
            self.fuse_into(other, self.map.points_of(slot))
        self.fuse_into(slot, self.map.points_of(neighbours))
        self.map.refresh(self.map.points_of(slot))

    def fuse_into(self, keyframe: int, candidates: Slots) -> None:
        """Match points in a keyframe: new observations of them, and duplicates among its own points."""
        slam_map = self.map
        n = int(slam_map.kf_count[keyframe])
        xy = slam_map.kf_xy[keyframe, :n]
        octaves = slam_map.kf_octave[keyframe, :n].astype(np.int64)
        # a view: it follows what is observed and replaced below
        observed = slam_map.kf_point[keyframe, :n]

        # project the points that the keyframe does not observe yet
        is_observed = np.zeros(slam_map.alive.size, bool)
        is_observed[observed[observed >= 0]] = True
        candidates = candidates[slam_map.alive[candidates] & ~is_observed[candidates]]
        points, uv, right, octave, _ = slam_map.project(slam_map.kf_pose[keyframe], candidates)

        # match them with all features around
        grid = CellGrid.of(xy, slam_map.camera.width, slam_map.camera.height)
        right_of_features = slam_map.kf_right[keyframe, :n]
        descriptors_of_features = slam_map.kf_descriptor[keyframe, :n]
        features = Features(xy, right_of_features, octaves, descriptors_of_features, grid)
        windows = (uv, right, FUSION_RADIUS_PX * slam_map.scales[octave])
        feature = search_in_radius(
            features,
            np.ones(n, bool),
            windows,
            octave,
            slam_map.descriptor[points],
            max_distance=MAX_DISTANCE,
        )
        squared_error = ((xy[feature] - uv) ** 2).sum(axis=1)
        variance = slam_map.scales[octaves[feature]] ** 2
        good = (feature >= 0) & (squared_error / variance < CHI2_POINT)
        points = points[good]
        feature = feature[good]

        # a feature without a point observes the matched one
        empty = observed[feature] < 0
        slam_map.observe(keyframe, feature[empty], points[empty])

        # a feature with a point shows a duplicate: the less observed point is replaced
        for row, point in zip(feature[~empty].tolist(), points[~empty].tolist(), strict=True):
            duplicate = int(observed[row])
            if duplicate >= 0 and duplicate != point and slam_map.alive[point]:
                less, more = sorted((duplicate, point), key=slam_map.n_obs.__getitem__)
                slam_map.replace_point(less, more)

    # ------------------------------------------------------------------ bundle adjustment

    def adjust(self, slot: int) -> None:
        """Local bundle adjustment around a keyframe; observations that do not fit afterwards are removed."""
        # the window around the keyframe
        slam_map = self.map
        settings = self.settings.bundle_adjustment
        bundle = local_bundle(slam_map, slot, settings.window)
        if bundle is not None:
            points = bundle.points
            # observations that do not fit the optimum are removed, and their points renewed
            outliers = ~apply_bundle_adjustment(slam_map, bundle, settings.iterations)
            observers = bundle.poses[bundle.problem.obs_pose[outliers]]
            slam_map.unobserve(observers, bundle.features[outliers])
            slam_map.refresh(points[slam_map.alive[points]])

    # ------------------------------------------------------------------ keyframes

    def _cull_keyframes(self, slot: int) -> None:
        """Remove redundant keyframes, and the most redundant ones where there are too many."""
        slam_map = self.map
        settings = self.settings.keyframes

        # neighbours most of whose close points others see as well
        neighbours, _ = slam_map.covisible(slot)
        newest = slam_map.keyframes[-2:]
        for neighbour in neighbours.tolist():
            if neighbour in newest or slam_map.kf_id[neighbour] == 0:
                continue
            # redundant: three other keyframes see the point as finely
            total, redundant = slam_map.redundancy(neighbour, self.close_m)
            if total and redundant > settings.redundant_share * total:
                self.cull_keyframe(neighbour)

        # too many keyframes in all: the most redundant one, of equal ones the oldest
        while slam_map.keyframe_count > settings.maximum:
            candidates = self._dispensable(slot)
            if not len(candidates):
                break
            shares = []
            for candidate in candidates.tolist():
                total, redundant = slam_map.redundancy(candidate, self.close_m)
                shares.append(redundant / max(total, 1))
            order = np.lexsort((slam_map.kf_id[candidates], np.negative(shares)))
            self.cull_keyframe(int(candidates[order[0]]))

    def _dispensable(self, slot: int) -> Slots:
        """Keyframes that may be culled where there are too many; at least one of each submap stays for its frames.

        Tracking depends on the newest and on those around the camera, which overlap most: they stay
        if others can be culled.
        """
        slam_map = self.map
        # neither the first one nor the two newest, nor the last one of a submap
        inner = slam_map.keyframes[1:-2]
        keyframes_by_submap = np.bincount(slam_map.kf_map[slam_map.keyframes])
        inner = inner[keyframes_by_submap[slam_map.kf_map[inner]] > 1]

        # old and distant ones, else old ones, else any
        near, _ = slam_map.covisible(slot)
        recent = self.settings.keyframes.maximum // RECENT_SHARE
        old = inner[slam_map.kf_id[inner] < slam_map.kf_id[slot] - recent]
        distant = old[~np.isin(old, near)]
        chosen = inner
        for slots in (distant, old):
            if len(slots):
                chosen = slots
                break

        # compare a few, others each time
        return np.asarray(np.roll(chosen, -COMPARED * slam_map.next_keyframe)[:COMPARED])

    def cull_keyframe(self, slot: int) -> None:
        """Remove a keyframe; `culled` names its replacement, the most covisible keyframe or the newest of its map."""
        # the keyframe that shares most points takes over what refers to this one
        slam_map = self.map
        covisible, _ = slam_map.covisible(slot)
        if len(covisible):
            replacement = int(covisible[0])
        else:
            same_map = slam_map.submap(int(slam_map.kf_map[slot]))
            replacement = int(same_map[same_map != slot][-1])

        # the relative pose is kept: poses of frames are relative to keyframes
        T_culled_replacement = slam_map.kf_pose[slot] @ se3.inverse(slam_map.kf_pose[replacement])
        self.culled.append((slot, replacement, T_culled_replacement))
        slam_map.remove_keyframe(slot)


def apply_bundle_adjustment(slam_map: Map, bundle: Bundle, iterations: int) -> NDArray[np.bool_]:
    """Put refined poses and points into the map; returns which observations of the bundle fit them."""
    # fixed poses come back as they were
    result = adjust_bundle(bundle.problem, iterations)
    variable = bundle.poses[: bundle.problem.variable]
    for slot, pose in zip(variable.tolist(), result.poses, strict=False):
        slam_map.set_pose(slot, pose)
    slam_map.position[bundle.points] = result.points
    return result.inliers


def refined(slam_map: Map) -> Map:
    """A copy of the map after full bundle adjustment, as at the end of a run."""
    copy = deepcopy(slam_map)
    bundle = full_bundle(slam_map)
    if bundle is not None:
        apply_bundle_adjustment(copy, bundle, FULL_ITERATIONS)
        copy.refresh(copy.points)
    return copy


# ---------------------------------------------------------------------- keyframe decision


class KeyframePolicy:
    """Decides whether a tracked frame becomes a keyframe: too little of the map is in view, and the frame adds to it.

    Points that many keyframes observe count (ORB-SLAM2's rule). On moving people young points come
    and go, and a keyframe for each of them would carry the map along with the people. Where the
    view itself moves on, young points count as well.

    Args:
        settings: The thresholds.
        close_m: Depth below which a feature's depth is trusted, metres.
    """

    def __init__(self, settings: KeyframeSettings, close_m: float) -> None:
        self.settings = settings
        self._close_m = close_m
        self.keyframe_added(-1)

    def keyframe_added(self, frame: int) -> None:
        """Note that the frame of this index has become a keyframe."""
        self._last = frame
        self._most_inliers = 0

    def needs_keyframe(
        self, slam_map: Map, tracked: TrackedFrame, frame: int, reference: int
    ) -> bool:
        """Whether a tracked frame should become a keyframe (ORB-SLAM's ``NeedNewKeyFrame``).

        Args:
            slam_map: The map.
            tracked: The frame, with the points that it observes.
            frame: Its index.
            reference: Slot of the keyframe that shares most points with it.
        """
        # inliers now, and the most since the last keyframe
        settings = self.settings
        matched = tracked.point >= 0
        inliers = int(np.count_nonzero(matched))
        self._most_inliers = max(self._most_inliers, inliers)
        if inliers <= MIN_KEYFRAME_INLIERS:
            return False
        if settings.schedule != "rule":
            return settings.schedule == "every"

        # many close features are not in the map, and few are tracked or the last keyframe is long ago
        close = (tracked.observations.z > 0) & (tracked.observations.z < self._close_m)
        many_new = np.count_nonzero(close & ~matched) > NEW_CLOSE
        few_close = np.count_nonzero(close & matched) < MIN_CLOSE
        if many_new and (few_close or frame - self._last >= settings.max_gap):
            return True

        # little of what the reference keyframe shows is tracked
        if inliers < settings.tracked_share * established_points(slam_map, reference):
            return True

        # the view has moved on from the newest keyframe
        newest = int(np.where(slam_map.kf_alive, slam_map.kf_id, -1).argmax())
        view = share_in_view(slam_map, newest, tracked.T_cam_world)
        if view < VIEW_SHARE:
            return True
        return view < MOVED_SHARE and inliers < settings.tracked_share * self._most_inliers


def established_points(slam_map: Map, keyframe: int) -> int:
    """Number of a keyframe's points that `ESTABLISHED` keyframes observe, or all of its submap if that is young."""
    points = slam_map.kf_point[keyframe]
    # keyframes of the submap: a young one has fewer than `ESTABLISHED`
    young = np.count_nonzero(slam_map.kf_alive & (slam_map.kf_map == slam_map.kf_map[keyframe]))
    return int(np.count_nonzero(slam_map.n_obs[points[points >= 0]] >= min(ESTABLISHED, young)))


def share_in_view(slam_map: Map, keyframe: int, T_cam_world: Array) -> float:
    """Share of a keyframe's points that lies in another camera's image; 1 if it has none."""
    # its points in the other camera's frame, then in the image
    points = slam_map.kf_point[keyframe]
    position = slam_map.position[points[points >= 0]]
    _, inside = slam_map.camera.view(position @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    return float(np.mean(inside)) if len(inside) else 1.0


# ---------------------------------------------------------------------- triangulation


class View(NamedTuple):
    """A keyframe's features, as triangulation reads them.

    Attributes:
        pose: World-to-camera pose ``[4, 4]``.
        free: int64, features that observe no point yet.
        xy: float64 ``[F, 2]``, undistorted pixels.
        z: float64 ``[F]``, depth in metres, 0 missing.
        octave: int64 ``[F]``.
        descriptors: uint64 ``[F, W]``.
    """

    pose: Array
    free: Slots
    xy: Array
    z: Array
    octave: Slots
    descriptors: Words


@kernel
def _relative_pose(pose_a: Array, pose_b: Array) -> tuple[Array, Array]:
    """Rotation ``[3, 3]`` and translation ``[3]`` from camera `a` to camera `b`: ``x_b = r x_a + t``."""
    # r = R_b R_a^T
    r = np.zeros((3, 3))
    t = np.zeros(3)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                r[i, j] += pose_b[i, k] * pose_a[j, k]
    # t = t_b - r t_a
    for i in range(3):
        t[i] = pose_b[i, 3]
        for k in range(3):
            t[i] -= r[i, k] * pose_a[k, 3]
    return r, t


@inlined
def _depths_fit(depth_a: float, depth_b: float, measured_b: float) -> bool:
    """Whether a triangulated point lies before both cameras, not too far away, and where camera b measured it.

    Args:
        depth_a: Its depth in camera a, metres.
        depth_b: Its depth in camera b.
        measured_b: Depth that was measured at b's feature, 0 missing.
    """
    if depth_a < MIN_TRIANGULATED_DEPTH or depth_b < MIN_TRIANGULATED_DEPTH:
        return False
    if depth_a > MAX_TRIANGULATED_DEPTH:
        return False
    return not (measured_b > 0.0 and abs(depth_b - measured_b) > DEPTH_TOLERANCE * measured_b)


@inlined
def _scales_fit(distance_a: float, distance_b: float, scale_a: float, scale_b: float) -> bool:
    """Whether the octaves of two features agree with a point's distances: nearer means larger, at a coarser octave.

    Args:
        distance_a: Distance of the point from camera a.
        distance_b: Distance of the point from camera b.
        scale_a: Scale of the octave of a's feature, 1 for the finest.
        scale_b: Scale of the octave of b's feature.
    """
    ratio = distance_a / distance_b
    expected = scale_b / scale_a
    return not (ratio > SCALE_TOLERANCE * expected or ratio * SCALE_TOLERANCE < expected)


@kernel
def _triangulate(
    view_a: View, view_b: View, scales: Array, camera: Intrinsics, sigmas: float
) -> tuple[Slots, Slots, Array]:
    """Triangulate free features of two views that match along epipolar lines.

    Args:
        view_a: The new keyframe, with N features that observe no point yet.
        view_b: A neighbour of it, with M such features.
        scales: Scale of each octave of the image pyramid, 1 for the finest.
        camera: Intrinsics without distortion, pixels.
        sigmas: Least angle between two rays for a triangulation by both, in standard deviations of
            a feature's position.

    Returns:
        Positions in `free`: for each free feature of `view_b` the one of `view_a` whose best match
        it is, ``[M]``, -1 without; for each of `view_a` its best match ``[N]``, -1 without, and the
        point's depth in `view_a` ``[N]``, metres with depth.
    """
    r, t = _relative_pose(view_a.pose, view_b.pose)
    n = view_a.free.shape[0]
    m = view_b.free.shape[0]
    match = np.full(n, -1, np.int64)
    depth = np.zeros(n)
    best_distance = np.full(n, FAR, np.int64)
    # rays of b's features, (bx, by, 1)
    bx = np.empty(m)
    by = np.empty(m)
    for j in range(m):
        bx[j] = (view_b.xy[view_b.free[j], 0] - camera.cx) / camera.fx
        by[j] = (view_b.xy[view_b.free[j], 1] - camera.cy) / camera.fy
    cosine_limit = np.cos(MIN_PARALLAX)
    focal = 0.5 * (camera.fx + camera.fy)
    for i in range(n):
        # ray of a's feature: (x, y, 1) in the frame of camera a, (ray_x, ray_y, ray_z) in that of b
        a = view_a.free[i]
        x = (view_a.xy[a, 0] - camera.cx) / camera.fx
        y = (view_a.xy[a, 1] - camera.cy) / camera.fy
        ray_x = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        ray_y = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        ray_z = r[2, 0] * x + r[2, 1] * y + r[2, 2]

        # its epipolar line in b: t x ray
        line_x = t[1] * ray_z - t[2] * ray_y
        line_y = t[2] * ray_x - t[0] * ray_z
        line_1 = t[0] * ray_y - t[1] * ray_x
        norm = np.sqrt(line_x * line_x + line_y * line_y)
        if norm < 1e-9:
            continue
        length = np.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
        for j in range(m):
            # b's feature must lie on the line
            b = view_b.free[j]
            sigma = scales[view_b.octave[b]] / focal
            off = (line_x * bx[j] + line_y * by[j] + line_1) / norm
            if off * off > CHI2_LINE * sigma * sigma:
                continue

            # and look more alike than the best one so far, by differing bits of the descriptors
            bits = distance(view_a.descriptors[a], view_b.descriptors[b])
            if bits > MAX_DISTANCE or bits >= best_distance[i]:
                continue

            # depth along a's ray where there is parallax, so that the point's projection in b is b's
            # feature: depth_a * coefficient = offset in x and y, solved by least squares
            coefficient_x = ray_x - bx[j] * ray_z
            coefficient_y = ray_y - by[j] * ray_z
            offset_x = bx[j] * t[2] - t[0]
            offset_y = by[j] * t[2] - t[1]
            cosine = (ray_x * bx[j] + ray_y * by[j] + ray_z) / (
                length * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0)
            )
            least = sigmas * max(scales[view_a.octave[a]], scales[view_b.octave[b]]) / focal
            if cosine < cosine_limit and cosine < 1.0 - 0.5 * least * least:
                depth_a = (coefficient_x * offset_x + coefficient_y * offset_y) / (
                    coefficient_x * coefficient_x + coefficient_y * coefficient_y
                )
            # else from b's measured depth
            elif view_b.z[b] > 0.0 and abs(ray_z) > 1e-6:
                depth_a = (view_b.z[b] - t[2]) / ray_z
            else:
                continue

            # the point must fit both features
            depth_b = ray_z * depth_a + t[2]
            if not _depths_fit(depth_a, depth_b, view_b.z[b]):
                continue
            error_x = (ray_x * depth_a + t[0]) / depth_b - bx[j]
            error_y = (ray_y * depth_a + t[1]) / depth_b - by[j]
            if error_x * error_x + error_y * error_y > CHI2_POINT * sigma * sigma:
                continue
            distance_a = depth_a * np.sqrt(x * x + y * y + 1.0)
            distance_b = depth_b * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0)
            if not _scales_fit(
                distance_a, distance_b, scales[view_a.octave[a]], scales[view_b.octave[b]]
            ):
                continue
            best_distance[i] = bits
            match[i] = j
            depth[i] = depth_a

    # one feature of b for one of a: the smaller distance wins, then the lower index
    matched_by = np.full(m, -1, np.int64)
    for i in range(n):
        j = match[i]
        if j >= 0 and (matched_by[j] < 0 or best_distance[i] < best_distance[matched_by[j]]):
            matched_by[j] = i
    return matched_by, match, depth


def triangulate(
    slam_map: Map, slot: int, other: int, min_parallax_sigmas: float
) -> tuple[Slots, Slots, Array]:
    """Features of two keyframes that observe no point yet and show one point along an epipolar line.

    Where the parallax is too small to triangulate, the other keyframe's measured depth is taken;
    where it is large enough, a measured depth must agree.

    Args:
        slam_map: The map.
        slot: The new keyframe.
        other: One that observes the same part of the scene.
        min_parallax_sigmas: Smallest parallax in standard deviations of a feature's position.

    Returns:
        Features of `slot`, features of `other`, world points ``[M, 3]``.
    """
    # match and triangulate
    view = _view(slam_map, slot)
    other_view = _view(slam_map, other)
    matched_by, match, depth = _triangulate(
        view,
        other_view,
        slam_map.scales,
        intrinsics_of(slam_map.camera),
        float(min_parallax_sigmas),
    )

    # the pairs, in the order of the new keyframe's features
    chosen = np.sort(matched_by[matched_by >= 0])
    features = view.free[chosen]
    other_features = other_view.free[match[chosen]]

    # their points, from the new keyframe's frame to the world
    local = slam_map.camera.unproject(slam_map.kf_xy[slot, features], depth[chosen])
    position = se3.transform(se3.inverse(slam_map.kf_pose[slot]), local)
    return features, other_features, position


def _view(slam_map: Map, slot: int) -> View:
    """A keyframe's features as triangulation reads them."""
    n = int(slam_map.kf_count[slot])
    return View(
        slam_map.kf_pose[slot],
        np.flatnonzero(slam_map.kf_point[slot, :n] < 0),
        slam_map.kf_xy[slot],
        slam_map.kf_z[slot].astype(np.float64),
        slam_map.kf_octave[slot].astype(np.int64),
        slam_map.kf_descriptor[slot],
    )
