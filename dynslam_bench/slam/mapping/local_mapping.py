"""Local mapping: what a new keyframe does to the map."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.features.matching import CellGrid, search_in_radius
from dynslam_bench.geometry import se3

from ..bundle.schur import BundleResult, adjust_bundle
from ..localisation.observation import Observations
from ..settings import BackendSettings
from .bundles import Bundle, around, whole
from .map import Map
from .map_kernels import distinct
from .triangulation import triangulate

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
        self, seen: Observations, point: Slots, T_cam_world: Array, frame: int, stamp: float, island: int = 0
    ) -> tuple[int, dict[str, float]]:
        """Make a frame a keyframe: new points, fusion, bundle adjustment, culling.

        Args:
            seen: The frame's features.
            point: Map slot that each feature observes, or -1.
            T_cam_world: The frame's pose.
            frame: Index of the frame.
            stamp: Its timestamp.
            island: The map that it belongs to (`Map.kf_island`).

        Returns:
            The keyframe's slot, and the seconds spent on ``mapping`` and ``bundle_adjustment``.
        """
        begin = perf_counter()
        world = self.world
        self.dropped.clear()
        first = not world.island(island).size
        slot = world.add_keyframe(seen, T_cam_world, frame, stamp, island)
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
            from ..bundle.with_gtsam import adjust_bundle_gtsam as solver
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
        """Keyframes that may go where there are too many: of an island one stays, its frames hang on it.

        The newest and those around the camera are what tracking lives on, and overlap most: they stay if others can go.
        """
        world = self.world
        kept = world.keyframes[1:-2]
        kept = kept[np.bincount(world.kf_island[world.keyframes])[world.kf_island[kept]] > 1]
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
            kin = world.island(int(world.kf_island[slot]))
            heirs = kin[kin != slot][::-1]
        heir = int(heirs[0])
        self.dropped.append((slot, heir, world.kf_pose[slot] @ se3.inverse(world.kf_pose[heir])))
        world.remove_keyframe(slot)
