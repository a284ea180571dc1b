"""Local mapping: when a frame becomes a keyframe, and the work on the map at each new one.

New points from depth and by triangulation, fusion of duplicates, local bundle adjustment, culling
of points and keyframes (ORB-SLAM2, Section III).
"""

from __future__ import annotations

from copy import deepcopy
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
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
from dynslam_bench.slam.settings import BackendSettings, KeyframeSettings
from dynslam_bench.slam.tracking import CLOSE_BASELINES, TrackedFrame

MAX_DISTANCE = 50
"""Largest Hamming distance in fusion and triangulation (ORB-SLAM2's lower threshold)."""
MIN_PARALLAX = np.deg2rad(1.0)
"""Smallest parallax of a triangulated point."""
MIN_DEPTH_POINTS = 100
"""Features whose depth makes points at every keyframe, the nearest ones, even if they are not close (ORB-SLAM2)."""
YOUNG = 3
"""A point may be culled because it is seldom found within so many keyframes after its own."""
MIN_OBSERVATIONS = 2
"""A point is culled when, two keyframes after its creation, fewer keyframes observe it."""
FULL_ITERATIONS = 10
"""Levenberg-Marquardt iterations of full bundle adjustment."""
RECENT_SHARE = 4
"""Of the largest number of keyframes, one in so many, the newest, are kept where there are too many."""
COMPARED = 16
"""Keyframes of which the most redundant one is culled where there are too many; the next time others are compared."""

MIN_KEYFRAME_INLIERS = 15
"""Inliers that a keyframe needs more than (ORB-SLAM2's number)."""
ESTABLISHED = 3
"""Keyframes that observe an established point at least."""
MIN_CLOSE = 100
NEW_CLOSE = 70
"""A keyframe is made when fewer close points are tracked and more close features are not in the map (ORB-SLAM2)."""
VIEW_SHARE = 0.9
"""A keyframe is made when less than this share of the last keyframe's points lies in the image."""
MOVED_SHARE = 0.97
"""The view has moved when less than this share of the last keyframe's points lies in the image."""


class LocalMapper:
    """Adds keyframes to the map and keeps it clean and consistent.

    Args:
        world: The map to work on.
        settings: Of the back end.

    Attributes:
        culled: Keyframes that the last `insert` removed: slot, slot of the replacement, and the
            pose ``T_culled_replacement``.
    """

    def __init__(self, world: Map, settings: BackendSettings) -> None:
        self.world = world
        self.settings = settings
        self.close_m = CLOSE_BASELINES * world.camera.baseline_m
        self.culled: list[tuple[int, int, Array]] = []
        points = world.points
        self._young: Slots = points[world.next_keyframe - 1 - world.born[points] < YOUNG]

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
        world = self.world
        s = self.settings.mapping
        self.culled.clear()
        first = not world.submap(submap).size
        slot = world.add_keyframe(observations, T_cam_world, frame, stamp, submap)
        features = np.flatnonzero(point >= 0)
        world.observe(slot, features, point[features])
        world.refresh(world.points_of(slot))
        self._cull_points()
        self._points_from_depth(slot, observations, everything=first)
        if first:
            return slot, {"mapping": perf_counter() - begin, "bundle_adjustment": 0.0}
        neighbours = world.covisible(slot)[0][: s.neighbours]
        close = np.count_nonzero((observations.z > 0) & (observations.z < self.close_m)) / max(
            len(observations), 1
        )
        if close < s.triangulate_below:
            for other in neighbours.tolist():
                features, others, position = triangulate(world, slot, other, s.min_parallax_sigmas)
                self._add_points(slot, features, position, observations, (other, others))
        self._fuse(slot, neighbours)
        start = perf_counter()
        self.adjust(slot)
        adjusted = perf_counter() - start
        self._cull_keyframes(slot)
        return slot, {"mapping": perf_counter() - begin - adjusted, "bundle_adjustment": adjusted}

    # ------------------------------------------------------------------ points

    def _points_from_depth(
        self, slot: int, observations: Observations, *, everything: bool
    ) -> None:
        """Points for features without one: all close ones, and the nearest hundred in any case."""
        world = self.world
        free = np.flatnonzero(
            (world.kf_point[slot, : len(observations)] < 0) & (observations.z > 0)
        )
        free = free[np.argsort(observations.z[free], kind="stable")]
        if not everything:
            free = free[
                : max(np.count_nonzero(observations.z[free] < self.close_m), MIN_DEPTH_POINTS)
            ]
        position = se3.transform(
            se3.inverse(world.kf_pose[slot]),
            world.camera.unproject(observations.xy[free], observations.z[free]),
        )
        self._add_points(slot, free, position, observations)

    def _add_points(
        self,
        slot: int,
        features: Slots,
        position: Array,
        observations: Observations,
        second: tuple[int, Slots] | None = None,
    ) -> None:
        """New points that features of a keyframe observe, and those of a `second` one, if there is one."""
        created = self.world.add_points(position, observations.rgb[features], slot, features)
        if second is not None:
            self.world.observe(*second, created)
        self.world.refresh(created)
        self._young = np.concatenate([self._young, created])

    def _cull_points(self) -> None:
        """Remove young points that are seldom found where they should be seen, or that few keyframes observe."""
        world = self.world
        young = self._young[world.alive[self._young]]
        age = world.next_keyframe - 1 - world.born[young]
        seldom_found = (
            world.found[young] < self.settings.mapping.min_found_ratio * world.visible[young]
        )
        bad = seldom_found | ((age >= 2) & (world.n_obs[young] < MIN_OBSERVATIONS))
        world.remove_points(young[bad])
        self._young = young[~bad & (age < YOUNG)]

    # ------------------------------------------------------------------ fusion

    def _fuse(self, slot: int, neighbours: Slots) -> None:
        """Match the new keyframe's points in its neighbours and theirs in it; merge duplicates."""
        for other in neighbours.tolist():
            self.fuse_into(other, self.world.points_of(slot))
        self.fuse_into(slot, self.world.points_of(neighbours))
        self.world.refresh(self.world.points_of(slot))

    def fuse_into(self, keyframe: int, candidates: Slots) -> None:
        """Match points in a keyframe: new observations of them, and duplicates among its own points."""
        world = self.world
        n = int(self.world.kf_count[keyframe])
        own = world.kf_point[keyframe, :n]
        observed = np.zeros(world.alive.size, bool)
        observed[own[own >= 0]] = True
        candidates = candidates[world.alive[candidates] & ~observed[candidates]]
        points, uv, right, octave, _ = world.project(world.kf_pose[keyframe], candidates)
        xy = world.kf_xy[keyframe, :n]
        grid = CellGrid.of(xy, world.camera.width, world.camera.height)
        levels = world.kf_octave[keyframe, :n].astype(np.int64)
        features = Features(
            xy, world.kf_right[keyframe, :n], levels, world.kf_words[keyframe, :n], grid
        )
        windows = (uv, right, 3.0 * world.scales[octave])
        words = world.words[points]
        feature = search_in_radius(
            features, np.ones(n, bool), windows, octave, words, max_distance=MAX_DISTANCE
        )
        good = feature >= 0
        good &= ((xy[feature] - uv) ** 2).sum(axis=1) / world.scales[levels[feature]] ** 2 < 5.991
        points = points[good]
        feature = feature[good]
        empty = own[feature] < 0
        world.observe(keyframe, feature[empty], points[empty])
        for row, point in zip(feature[~empty].tolist(), points[~empty].tolist(), strict=True):
            duplicate = int(own[row])
            if duplicate >= 0 and duplicate != point and world.alive[point]:
                # the less observed one
                world.replace_point(*sorted((duplicate, point), key=world.n_obs.__getitem__))

    # ------------------------------------------------------------------ bundle adjustment

    def adjust(self, slot: int) -> None:
        """Local bundle adjustment around a keyframe; observations that do not fit afterwards are removed."""
        world = self.world
        settings = self.settings.bundle_adjustment
        bundle = local_bundle(world, slot, settings.window)
        if bundle is not None:
            points = bundle.points
            out = ~adjust(world, bundle, settings.iterations)
            world.unobserve(bundle.poses[bundle.problem.obs_pose[out]], bundle.features[out])
            world.refresh(points[world.alive[points]])

    # ------------------------------------------------------------------ keyframes

    def _cull_keyframes(self, slot: int) -> None:
        """Remove redundant keyframes, and the most redundant ones where there are too many."""
        world = self.world
        s = self.settings.keyframes
        neighbours, _ = world.covisible(slot)
        newest = world.keyframes[-2:]
        for other in neighbours.tolist():
            if other in newest or world.kf_id[other] == 0:
                continue
            total, redundant = world.redundancy(other, self.close_m)
            if total and redundant > s.redundant_share * total:
                self.cull_keyframe(other)
        while world.keyframe_count > s.maximum:
            others = self._dispensable(slot)
            if not len(others):
                break
            counts = [world.redundancy(other, self.close_m) for other in others.tolist()]
            shares = [redundant / max(total, 1) for total, redundant in counts]
            self.cull_keyframe(
                int(others[np.lexsort((world.kf_id[others], np.negative(shares)))[0]])
            )

    def _dispensable(self, slot: int) -> Slots:
        """Keyframes that may be culled where there are too many; at least one of each submap stays for its frames.

        Tracking depends on the newest and on those around the camera, which overlap most: they stay
        if others can be culled.
        """
        world = self.world
        kept = self.world.keyframes[1:-2]
        kept = kept[np.bincount(world.kf_map[world.keyframes])[world.kf_map[kept]] > 1]
        near, _ = world.covisible(slot)
        older = kept[
            world.kf_id[kept] < world.kf_id[slot] - self.settings.keyframes.maximum // RECENT_SHARE
        ]
        distant = older[~np.isin(older, near)]
        chosen = next((slots for slots in (distant, older, kept) if len(slots)), kept)
        return np.asarray(np.roll(chosen, -COMPARED * world.next_keyframe)[:COMPARED])

    def cull_keyframe(self, slot: int) -> None:
        """Remove a keyframe; `culled` names its replacement, the most covisible keyframe or the newest of its map."""
        world = self.world
        same_map = self.world.submap(int(self.world.kf_map[slot]))
        replacement = int(np.r_[world.covisible(slot)[0], same_map[same_map != slot][::-1]][0])
        self.culled.append(
            (slot, replacement, world.kf_pose[slot] @ se3.inverse(world.kf_pose[replacement]))
        )
        world.remove_keyframe(slot)


def adjust(world: Map, bundle: Bundle, iterations: int) -> NDArray[np.bool_]:
    """Put refined poses and points into the map; returns which observations of the bundle fit them."""
    result = adjust_bundle(bundle.problem, iterations)
    for slot, pose in zip(
        bundle.poses[: bundle.problem.variable].tolist(), result.poses, strict=False
    ):
        world.set_pose(slot, pose)
    world.position[bundle.points] = result.points
    return result.inliers


def refined(world: Map) -> Map:
    """A copy of the map after full bundle adjustment, as at the end of a run."""
    copy = deepcopy(world)
    bundle = full_bundle(world)
    if bundle is not None:
        adjust(copy, bundle, FULL_ITERATIONS)
        copy.refresh(copy.points)
    return copy


# ---------------------------------------------------------------------- when a frame becomes a
# keyframe


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
        self.made(-1)

    def made(self, frame: int) -> None:
        """The frame of this index has become a keyframe."""
        self._last = frame
        self._most_inliers = 0

    def needs_keyframe(self, world: Map, tracked: TrackedFrame, frame: int, reference: int) -> bool:
        """Whether a tracked frame should become a keyframe (ORB-SLAM's ``NeedNewKeyFrame``).

        Args:
            world: The map.
            tracked: The frame, with the points that it observes.
            frame: Its index.
            reference: Slot of the keyframe that shares most points with it.
        """
        s = self.settings
        gap = frame - self._last
        matched = tracked.point >= 0
        close = (tracked.observations.z > 0) & (tracked.observations.z < self._close_m)
        inliers = int(np.count_nonzero(matched))
        self._most_inliers = max(self._most_inliers, inliers)
        if s.schedule != "rule" or inliers <= MIN_KEYFRAME_INLIERS:
            return s.schedule == "every" and inliers > MIN_KEYFRAME_INLIERS
        few_close = np.count_nonzero(close & matched) < MIN_CLOSE
        if np.count_nonzero(close & ~matched) > NEW_CLOSE and (few_close or gap >= s.max_gap):
            return True
        if inliers < s.tracked_share * established_points(world, reference):
            return True
        view = share_in_view(
            world, int(np.where(world.kf_alive, world.kf_id, -1).argmax()), tracked.T_cam_world
        )
        return view < VIEW_SHARE or (
            view < MOVED_SHARE and inliers < s.tracked_share * self._most_inliers
        )


def established_points(world: Map, keyframe: int) -> int:
    """How many of a keyframe's points `ESTABLISHED` keyframes observe, or all of its submap if that is young."""
    points = world.kf_point[keyframe]
    young = np.count_nonzero(world.kf_alive & (world.kf_map == world.kf_map[keyframe]))
    return int(np.count_nonzero(world.n_obs[points[points >= 0]] >= min(ESTABLISHED, young)))


def share_in_view(world: Map, keyframe: int, T_cam_world: Array) -> float:
    """Which share of a keyframe's points lies in another camera's image; 1 if it has none."""
    points = world.kf_point[keyframe]
    position = world.position[points[points >= 0]]
    _, inside = world.camera.view(position @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    return float(np.mean(inside)) if len(inside) else 1.0


# ---------------------------------------------------------------------- triangulation


@kernel
def _triangulate(
    pose_a: Array,
    pose_b: Array,
    rows_a: Slots,
    rows_b: Slots,
    xy_a: Array,
    xy_b: Array,
    z_b: Array,
    octave_a: Slots,
    octave_b: Slots,
    words_a: Words,
    words_b: Words,
    scales: Array,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    sigmas: float,
) -> tuple[Slots, Slots, Array]:
    """Pairs of rows that fit one point, and its depth along the ray of camera `a`."""
    # x_b = r x_a + t
    r = np.zeros((3, 3))
    t = np.zeros(3)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                r[i, j] += pose_b[i, k] * pose_a[j, k]
    for i in range(3):
        t[i] = pose_b[i, 3]
        for k in range(3):
            t[i] -= r[i, k] * pose_a[k, 3]
    n = rows_a.shape[0]
    m = rows_b.shape[0]
    match = np.full(n, -1, np.int64)
    matched_by = np.full(m, -1, np.int64)
    depth = np.zeros(n)
    best_distance = np.full(n, FAR, np.int64)
    bx = (xy_b[rows_b, 0] - cx) / fx
    by = (xy_b[rows_b, 1] - cy) / fy
    cosine_limit = np.cos(MIN_PARALLAX)
    focal = 0.5 * (fx + fy)
    for i in range(n):
        a = rows_a[i]
        x = (xy_a[a, 0] - cx) / fx
        y = (xy_a[a, 1] - cy) / fy
        d0 = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        d1 = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        d2 = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        # epipolar line of a's ray in b: t x d
        l0 = t[1] * d2 - t[2] * d1
        l1 = t[2] * d0 - t[0] * d2
        l2 = t[0] * d1 - t[1] * d0
        norm = np.sqrt(l0 * l0 + l1 * l1)
        if norm < 1e-9:
            continue
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        for j in range(m):
            b = rows_b[j]
            sigma = scales[octave_b[b]] / focal
            off = (l0 * bx[j] + l1 * by[j] + l2) / norm
            if off * off > 3.84 * sigma * sigma:
                continue
            d = distance(words_a[a], words_b[b])
            if d > MAX_DISTANCE or d >= best_distance[i]:
                continue
            p0 = d0 - bx[j] * d2
            p1 = d1 - by[j] * d2
            q0 = bx[j] * t[2] - t[0]
            q1 = by[j] * t[2] - t[1]
            cosine = (d0 * bx[j] + d1 * by[j] + d2) / (
                length * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0)
            )
            least = sigmas * max(scales[octave_a[a]], scales[octave_b[b]]) / focal
            if cosine < cosine_limit and cosine < 1.0 - 0.5 * least * least:
                s = (p0 * q0 + p1 * q1) / (p0 * p0 + p1 * p1)
            elif z_b[b] > 0.0 and abs(d2) > 1e-6:
                s = (z_b[b] - t[2]) / d2  # too little parallax, but the other keyframe has depth
            else:
                continue
            w = d2 * s + t[2]
            if s < 0.1 or w < 0.1 or s > 40.0 or (z_b[b] > 0.0 and abs(w - z_b[b]) > 0.05 * z_b[b]):
                continue
            e0 = (d0 * s + t[0]) / w - bx[j]
            e1 = (d1 * s + t[1]) / w - by[j]
            if e0 * e0 + e1 * e1 > 5.991 * sigma * sigma:
                continue
            ratio = (s * np.sqrt(x * x + y * y + 1.0)) / (
                w * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0)
            )
            expected = scales[octave_b[b]] / scales[octave_a[a]]
            # the nearer view shows the patch larger, hence at a coarser octave
            if ratio > 1.8 * expected or ratio * 1.8 < expected:
                continue
            best_distance[i] = d
            match[i] = j
            depth[i] = s
    # one feature of b for one of a: the smaller distance wins, then the lower index
    for i in range(n):
        j = match[i]
        if j >= 0 and (matched_by[j] < 0 or best_distance[i] < best_distance[matched_by[j]]):
            matched_by[j] = i
    chosen = np.sort(matched_by[matched_by >= 0])
    return rows_a[chosen], rows_b[match[chosen]], depth[chosen]


def triangulate(
    world: Map, slot: int, other: int, min_parallax_sigmas: float
) -> tuple[Slots, Slots, Array]:
    """Features of two keyframes that observe no point yet and show one point along an epipolar line.

    Where the parallax is too small to triangulate, the other keyframe's measured depth is taken;
    where it is large enough, a measured depth must agree.

    Args:
        world: The map.
        slot: The new keyframe.
        other: One that observes the same part of the scene.
        min_parallax_sigmas: Smallest parallax in standard deviations of a feature's position.

    Returns:
        Features of `slot`, features of `other`, world points ``[M, 3]``.
    """
    n = int(world.kf_count[slot])
    m = int(world.kf_count[other])
    camera = world.camera
    features, others, depth = _triangulate(
        world.kf_pose[slot],
        world.kf_pose[other],
        np.flatnonzero(world.kf_point[slot, :n] < 0),
        np.flatnonzero(world.kf_point[other, :m] < 0),
        world.kf_xy[slot],
        world.kf_xy[other],
        world.kf_z[other].astype(np.float64),
        world.kf_octave[slot].astype(np.int64),
        world.kf_octave[other].astype(np.int64),
        world.kf_words[slot],
        world.kf_words[other],
        world.scales,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        float(min_parallax_sigmas),
    )
    local = camera.unproject(world.kf_xy[slot, features], depth)
    return features, others, se3.transform(se3.inverse(world.kf_pose[slot]), local)
