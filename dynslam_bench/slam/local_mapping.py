"""Local mapping: what a new keyframe does to the map."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import FAR, CellGrid, Words, distance, search_in_radius
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.bundle_adjustment import Bundle, BundleResult, adjust_bundle, around, whole
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_kernels import distinct
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.settings import BackendSettings, MappingSettings

Array = NDArray[np.float64]
Slots = NDArray[np.int64]


TENDER = 3
"""So many keyframes after its own a point may still go because it is seldom found."""
RECENT = 4
"""Of as many keyframes as may be kept, the newest that stay: one in so many."""
COMPARED = 16
"""Keyframes of which the most redundant one goes where there are too many; others are compared the next time."""


class LocalMapper:
    """Adds keyframes to the map and keeps it clean and consistent.

    Args:
        world: The map to work on.
        settings: Of the back end.
    """

    def __init__(self, world: Map, settings: BackendSettings) -> None:
        self.world = world
        self.settings = settings
        self.dropped: list[tuple[int, int, Array]] = []
        """Keyframes that the last `insert` removed: slot, heir's slot, and the pose ``T_dropped_heir``."""
        self._unrefined: tuple[Slots, Array, Slots, dict[str, NDArray[Any]]] | None = None
        points = world.points
        self._young: Slots = points[world.next_keyframe - 1 - world.born[points] < TENDER]

    @property
    def close_m(self) -> float:
        """Depth below which a point is close, metres."""
        return self.settings.tracking.close_factor * self.world.camera.baseline_m

    def insert(
        self, seen: Observations, point: Slots, T_cam_world: Array, frame: int, stamp: float, submap: int = 0
    ) -> tuple[int, dict[str, float]]:
        """Make a frame a keyframe: new points, fusion, bundle adjustment, culling.

        Args:
            seen: The frame's features.
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
        self.dropped.clear()
        first = not world.submap(submap).size
        slot = world.add_keyframe(seen, T_cam_world, frame, stamp, submap)
        features = np.flatnonzero(point >= 0)
        world.observe(slot, features, point[features])
        world.refresh(np.unique(world.kf_point[slot, features][world.kf_point[slot, features] >= 0]).astype(np.int64))
        self._cull_points()
        self._points_from_depth(slot, seen, everything=first)
        adjusted = 0.0
        if not first:
            neighbours, _ = world.covisible(slot)
            neighbours = neighbours[: self.settings.mapping.neighbours]
            share = np.count_nonzero((seen.z > 0) & (seen.z < self.close_m)) / max(len(seen), 1)
            if share < self.settings.mapping.triangulate_below:
                self._points_from_views(slot, seen, neighbours)
            self._fuse(slot, neighbours)
            start = perf_counter()
            if self.settings.bundle_adjustment.enabled:
                self.adjust(slot)
            adjusted = perf_counter() - start
            self._cull_keyframes(slot)
        return slot, {"mapping": perf_counter() - begin - adjusted, "bundle_adjustment": adjusted}

    # ------------------------------------------------------------------ points

    def _points_from_depth(self, slot: int, seen: Observations, *, everything: bool) -> None:
        """Points for features without one: all close ones, and the nearest hundred in any case."""
        world = self.world
        n = len(seen)
        free = np.flatnonzero((world.kf_point[slot, :n] < 0) & (seen.z > 0))
        if not len(free):
            return
        free = free[np.argsort(seen.z[free], kind="stable")]
        if not everything:
            close = int(np.count_nonzero(seen.z[free] < self.close_m))
            free = free[: max(close, min(len(free), 100))]
        local = world.camera.unproject(seen.xy[free], seen.z[free])
        position = se3.transform(world.T_world_cam(slot), local)
        created = world.add_points(position, seen.rgb[free], slot, free)
        world.refresh(created)
        self._young = np.concatenate([self._young, created])

    def _points_from_views(self, slot: int, seen: Observations, neighbours: Slots) -> None:
        """Points for features that have no point yet, by triangulation with the neighbours."""
        world = self.world
        for other in neighbours.tolist():
            ours, theirs, position = triangulate(world, slot, other, self.settings.mapping)
            if len(ours):
                created = world.add_points(position, seen.rgb[ours], slot, ours)
                world.observe(other, theirs, created)
                world.refresh(created)
                self._young = np.concatenate([self._young, created])

    def _cull_points(self) -> None:
        """Remove young points that are seldom found where they should be seen, or that few keyframes observe."""
        world, s = self.world, self.settings.mapping
        young = self._young[world.alive[self._young]]
        age = world.next_keyframe - 1 - world.born[young]
        poor = world.found[young] < s.min_found_ratio * world.visible[young]
        lonely = (age >= 2) & (world.n_obs[young] < s.min_observations)
        bad = poor | lonely
        world.remove_points(young[bad])
        self._young = young[~bad & (age < TENDER)]

    # ------------------------------------------------------------------ fusion

    def _fuse(self, slot: int, neighbours: Slots) -> None:
        """Find the new keyframe's points in its neighbours and theirs in it; merge what is one thing."""
        world = self.world
        n = int(world.kf_count[slot])
        for other in neighbours.tolist():
            own = world.kf_point[slot, :n]
            self.fuse_into(other, np.unique(own[own >= 0]).astype(np.int64))
        self.fuse_into(slot, distinct(world.kf_point[neighbours], world.alive.size))
        own = world.kf_point[slot, :n]
        world.refresh(np.unique(own[own >= 0]).astype(np.int64))

    def fuse_into(self, keyframe: int, candidates: Slots) -> None:
        """Look for points in a keyframe: new observations of them, and points of its own that are the same thing."""
        world = self.world
        n = int(world.kf_count[keyframe])
        seen_here = np.zeros(world.alive.size, bool)
        here = world.kf_point[keyframe, :n]
        seen_here[here[here >= 0]] = True
        candidates = candidates[world.alive[candidates] & ~seen_here[candidates]]
        points, uv, right, octave, _ = world.project(world.kf_pose[keyframe], candidates)
        if not len(points):
            return
        xy = world.kf_xy[keyframe, :n]
        grid = CellGrid.of(xy, world.camera.width, world.camera.height)
        levels = world.kf_octave[keyframe, :n].astype(np.int64)
        arrays = xy, world.kf_right[keyframe, :n], levels, world.kf_words[keyframe, :n]
        windows, octaves = (uv, right, 3.0 * world.scales[octave]), (octave - 1, octave + 1)
        free, words = np.ones(n, bool), world.words[points]
        found, _ = search_in_radius(grid, arrays, free, windows, octaves, words, max_distance=50)
        hit = found >= 0
        points, found = points[hit], found[hit]
        residual = ((xy[found] - uv[hit]) ** 2).sum(axis=1) / world.scales[arrays[2][found]] ** 2
        good = residual < 5.991
        points, found = points[good], found[good]
        empty = here[found] < 0
        world.observe(keyframe, found[empty], points[empty])
        for feature, point in zip(found[~empty].tolist(), points[~empty].tolist(), strict=True):
            rival = int(world.kf_point[keyframe, feature])
            if rival < 0 or rival == point or not world.alive[point]:
                continue
            if world.n_obs[rival] > world.n_obs[point]:
                world.merge(point, rival)
            else:
                world.merge(rival, point)

    # ------------------------------------------------------------------ bundle adjustment

    def adjust(self, slot: int) -> None:
        """Refine the window around a keyframe."""
        settings = self.settings.bundle_adjustment
        self._refine(around(self.world, slot, settings), settings.iterations)

    def adjust_all(self) -> None:
        """Refine all keyframes but the oldest, and all points, as the end of a run; `resume` takes it back."""
        if self._unrefined is not None:
            return
        world, keyframes, points = self.world, self.world.keyframes, self.world.points
        tables = {name: getattr(world, name)[points] for name in ("position", "normal", "far", "words")}
        self._unrefined = keyframes, world.kf_pose[keyframes], points, tables
        if self._solve(whole(world), self.settings.bundle_adjustment.full_iterations) is not None:
            world.refresh(points)

    @property
    def refined(self) -> bool:
        """Whether the map is as `adjust_all` left it."""
        return self._unrefined is not None

    def resume(self) -> None:
        """The run goes on: the map is again what it was before `adjust_all`."""
        if self._unrefined is None:
            return
        keyframes, poses, points, tables = self._unrefined
        self._unrefined = None
        for slot, pose in zip(keyframes.tolist(), poses, strict=True):
            self.world.set_pose(slot, pose)
        for name, values in tables.items():
            getattr(self.world, name)[points] = values

    def _refine(self, chosen: Bundle | None, iterations: int) -> None:
        """Refine poses and points, and forget the observations that do not fit then."""
        result = self._solve(chosen, iterations)
        if chosen is None or result is None:
            return
        world, problem, points = self.world, chosen.problem, chosen.points
        out = ~result.inliers
        world.unobserve(chosen.poses[problem.obs_pose[out]], chosen.features[out])
        world.refresh(points[world.alive[points]])

    def _solve(self, chosen: Bundle | None, iterations: int) -> BundleResult | None:
        """Put refined poses and points into the map; None if there are none."""
        if chosen is None:
            return None
        world, problem, poses, points = self.world, chosen.problem, chosen.poses, chosen.points
        solver = adjust_bundle
        if self.settings.bundle_adjustment.solver == "gtsam":
            from dynslam_bench.slam.bundle_adjustment import adjust_bundle_gtsam as solver
        result = solver(problem, iterations)
        if not (np.isfinite(result.poses).all() and np.isfinite(result.points).all()):
            return None
        for k in range(problem.variable):
            world.set_pose(int(poses[k]), result.poses[k])
        world.position[points] = result.points
        return result

    # ------------------------------------------------------------------ keyframes

    def _cull_keyframes(self, slot: int) -> None:
        world, s = self.world, self.settings.keyframes
        neighbours, _ = world.covisible(slot)
        newest = world.keyframes[-2:]
        for other in neighbours.tolist():
            if other in newest or world.kf_id[other] == 0:
                continue
            total, redundant = world.redundancy(other, self.close_m)
            if total and redundant > s.redundant_share * total:
                self.drop_keyframe(other)
        while world.keyframe_count > s.maximum:
            shares = []
            for other in self._far(slot).tolist():
                total, redundant = world.redundancy(other, self.close_m)
                shares.append((-redundant / max(total, 1), int(world.kf_id[other]), other))
            if not shares:
                break
            self.drop_keyframe(min(shares)[2])

    def _far(self, slot: int) -> Slots:
        """Keyframes that may go where there are too many: of an submap one stays, its frames hang on it.

        The newest and those around the camera are what tracking lives on, and overlap most: they stay if others can go.
        """
        world = self.world
        kept = world.keyframes[1:-2]
        kept = kept[np.bincount(world.kf_map[world.keyframes])[world.kf_map[kept]] > 1]
        near, _ = world.covisible(slot)
        older = kept[world.kf_id[kept] < world.kf_id[slot] - self.settings.keyframes.maximum // RECENT]
        far = older[~np.isin(older, near)]
        some = next((each for each in (far, older, kept) if len(each)), kept)
        return np.roll(some, -COMPARED * world.next_keyframe)[:COMPARED]

    def drop_keyframe(self, slot: int) -> None:
        """Remove a keyframe; the heirs of its frames are told through `dropped`."""
        world = self.world
        heirs, _ = world.covisible(slot)
        if not len(heirs):
            kin = world.submap(int(world.kf_map[slot]))
            heirs = kin[kin != slot][::-1]
        heir = int(heirs[0])
        self.dropped.append((slot, heir, world.kf_pose[slot] @ se3.inverse(world.kf_pose[heir])))
        world.remove_keyframe(slot)


# New points from two keyframes, for features whose depth the sensor does not give.


MAX_DISTANCE = 50
"""Largest Hamming distance of a match along an epipolar line (ORB-SLAM2's lower threshold)."""


@kernel
def _triangulate(
    pose_a: Array, pose_b: Array, rows_a: Slots, rows_b: Slots, xy_a: Array, xy_b: Array, z_b: Array,
    octave_a: Slots, octave_b: Slots, words_a: Words, words_b: Words, scales: Array,
    fx: float, fy: float, cx: float, cy: float, min_parallax: float, sigmas: float, max_distance: int,
) -> tuple[Slots, Slots, Array]:  # fmt: skip
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
    n, m = rows_a.shape[0], rows_b.shape[0]
    partner = np.full(n, -1, np.int64)
    found_depth = np.zeros(n)
    owner = np.full(m, -1, np.int64)
    best_distance = np.full(n, FAR, np.int64)
    bx, by = np.empty(m), np.empty(m)
    for j in range(m):
        bx[j] = (xy_b[rows_b[j], 0] - cx) / fx
        by[j] = (xy_b[rows_b[j], 1] - cy) / fy
    cosine_limit = np.cos(min_parallax)
    focal = 0.5 * (fx + fy)
    for i in range(n):
        a = rows_a[i]
        x, y = (xy_a[a, 0] - cx) / fx, (xy_a[a, 1] - cy) / fy
        d0 = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        d1 = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        d2 = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        # epipolar line of a's ray in b: t x d
        l0, l1, l2 = t[1] * d2 - t[2] * d1, t[2] * d0 - t[0] * d2, t[0] * d1 - t[1] * d0
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
            if d > max_distance or d >= best_distance[i]:
                continue
            p0, p1 = d0 - bx[j] * d2, d1 - by[j] * d2
            q0, q1 = bx[j] * t[2] - t[0], by[j] * t[2] - t[1]
            cosine = (d0 * bx[j] + d1 * by[j] + d2) / (length * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0))
            least = sigmas * max(scales[octave_a[a]], scales[octave_b[b]]) / focal
            if cosine < cosine_limit and cosine < 1.0 - 0.5 * least * least:
                s = (p0 * q0 + p1 * q1) / (p0 * p0 + p1 * p1)
            elif z_b[b] > 0.0 and abs(d2) > 1e-6:
                s = (z_b[b] - t[2]) / d2  # too little parallax, but the other keyframe has depth
            else:
                continue
            w = d2 * s + t[2]
            if s < 0.1 or w < 0.1 or s > 40.0:
                continue
            if z_b[b] > 0.0 and abs(w - z_b[b]) > 0.05 * z_b[b]:
                continue
            e0 = (d0 * s + t[0]) / w - bx[j]
            e1 = (d1 * s + t[1]) / w - by[j]
            if e0 * e0 + e1 * e1 > 5.991 * sigma * sigma:
                continue
            ratio = (s * np.sqrt(x * x + y * y + 1.0)) / (w * np.sqrt(bx[j] * bx[j] + by[j] * by[j] + 1.0))
            expected = scales[octave_b[b]] / scales[octave_a[a]]
            # the nearer view shows the patch larger, hence at a coarser octave
            if ratio > 1.8 * expected or ratio * 1.8 < expected:
                continue
            best_distance[i] = d
            partner[i] = j
            found_depth[i] = s
    for i in range(n):  # one feature of b for one of a: the smaller distance wins, then the lower index
        j = partner[i]
        if j >= 0 and (owner[j] < 0 or best_distance[i] < best_distance[owner[j]]):
            owner[j] = i
    count = 0
    out_a, out_b, out_z = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
    for i in range(n):
        if partner[i] >= 0 and owner[partner[i]] == i:
            out_a[count], out_b[count], out_z[count] = rows_a[i], rows_b[partner[i]], found_depth[i]
            count += 1
    return out_a[:count].copy(), out_b[:count].copy(), out_z[:count].copy()


def triangulate(world: Map, slot: int, other: int, settings: MappingSettings) -> tuple[Slots, Slots, Array]:
    """Features of two keyframes that observe no point yet and show one point along an epipolar line.

    Where the parallax is too small for a depth of its own, the other keyframe's measured depth is taken; where it is
    large enough, a measured depth must agree.

    Args:
        world: The map.
        slot: The new keyframe.
        other: One that sees the same part of the world.
        settings: Smallest angle between the rays of a triangulated point, and how far above their noise it must be.

    Returns:
        Features of `slot`, features of `other`, world points ``[M, 3]``.
    """
    n, m = int(world.kf_count[slot]), int(world.kf_count[other])
    camera: Camera = world.camera
    ours, theirs, depth = _triangulate(
        world.kf_pose[slot], world.kf_pose[other],
        np.flatnonzero(world.kf_point[slot, :n] < 0), np.flatnonzero(world.kf_point[other, :m] < 0),
        world.kf_xy[slot], world.kf_xy[other], world.kf_z[other].astype(np.float64),
        world.kf_octave[slot].astype(np.int64), world.kf_octave[other].astype(np.int64),
        world.kf_words[slot], world.kf_words[other], world.scales,
        camera.fx, camera.fy, camera.cx, camera.cy, float(np.deg2rad(settings.min_parallax_deg)),
        float(settings.min_parallax_sigmas), MAX_DISTANCE,
    )  # fmt: skip
    pose = world.T_world_cam(slot)
    local = camera.unproject(world.kf_xy[slot, ours], depth)
    return ours, theirs, local @ pose[:3, :3].T + pose[:3, 3]
