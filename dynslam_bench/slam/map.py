"""The map: keyframes and points in flat tables, so that compiled loops and numpy run over them without objects.

Keyframes and points live in numbered slots; a freed slot is used again, after the mapping step that freed it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam import map_kernels as kernels
from dynslam_bench.slam.descriptor_index import DescriptorIndex
from dynslam_bench.slam.observation import Observations

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

MIN_CAPACITY = 4
"""Observations that a point has room for when it gets its first one."""


class Map:
    """Keyframes, points and who observes what.

    Attributes (keyframes, by slot; F is the largest number of features so far):
        kf_alive, kf_id, kf_map (number of the submap, 0 for the root map),
        kf_frame, kf_stamp, kf_pose (world to camera ``[S, 4, 4]``), kf_centre ``[S, 3]``, kf_count, kf_raw
        ``[S, F, 2]`` raw pixels, kf_response, kf_xy ``[S, F, 2]`` undistorted pixels, kf_right, kf_z, kf_octave,
        kf_angle, kf_info, kf_info_right, kf_words ``[S, F, W]``, kf_point ``[S, F]`` (slot of the observed point, -1).

    Attributes (points, by slot):
        alive, id, position ``[M, 3]``, normal ``[M, 3]`` mean viewing direction, far ``[M]`` largest distance at which
        the point's reference scale is still in the pyramid, words ``[M, W]``, rgb, visible and found (frames that
        should have and did observe it), born (id of the keyframe that made it), n_obs, obs_at and obs_capacity (how
        many observations it has, where they begin in obs_kf and obs_ft, and how many fit there).

    Attributes (others):
        index: Sorted substrings of the keyframes' descriptors.

    Attributes (observations ``[O]``, those of each point in a row, oldest first):
        obs_kf, obs_ft (observing keyframe slots and feature numbers).
    """

    def __init__(self, camera: Camera, scales: Array) -> None:
        self.camera = camera
        self.scales = np.ascontiguousarray(scales, np.float64)
        self.next_keyframe = 0
        self.next_point = 0
        self._free_points: list[int] = []
        self._freed_points: list[int] = []
        self._top = 0
        self._observations = 0
        self._vacant: dict[int, list[int]] = {}
        self._features = 0
        self._words = 4
        self.index = DescriptorIndex()
        self._allocate()

    def _grow(self, name: str, length: int, axis: int = 0) -> None:
        table = getattr(self, name)
        shape = [*table.shape]
        shape[axis] = length
        longer = np.zeros(shape, table.dtype)
        longer[tuple(slice(size) for size in table.shape)] = table
        setattr(self, name, longer)

    def _allocate(self) -> None:
        s, f, w, m = 0, self._features, self._words, 0
        self.kf_alive = np.zeros(s, bool)
        self.kf_id = np.zeros(s, np.int64)
        self.kf_map = np.zeros(s, np.int64)
        self.kf_frame = np.zeros(s, np.int64)
        self.kf_stamp = np.zeros(s)
        self.kf_pose = np.zeros((s, 4, 4))
        self.kf_centre = np.zeros((s, 3))
        self.kf_count = np.zeros(s, np.int64)
        self.kf_raw = np.zeros((s, f, 2), np.float32)
        self.kf_response = np.zeros((s, f), np.float32)
        self.kf_xy = np.zeros((s, f, 2))
        self.kf_right = np.zeros((s, f))
        self.kf_z = np.zeros((s, f), np.float32)
        self.kf_octave = np.zeros((s, f), np.int8)
        self.kf_angle = np.zeros((s, f), np.float32)
        self.kf_info = np.zeros((s, f))
        self.kf_info_right = np.zeros((s, f))
        self.kf_words = np.zeros((s, f, w), np.uint64)
        self.kf_point = np.zeros((s, f), np.int32)
        self.alive = np.zeros(m, bool)
        self.id = np.zeros(m, np.int64)
        self.position = np.zeros((m, 3))
        self.normal = np.zeros((m, 3))
        self.far = np.zeros(m)
        self.words = np.zeros((m, w), np.uint64)
        self.rgb = np.zeros((m, 3), np.uint8)
        self.visible = np.zeros(m, np.int32)
        self.found = np.zeros(m, np.int32)
        self.born = np.zeros(m, np.int64)
        self.n_obs = np.zeros(m, np.int32)
        self.obs_at = np.zeros(m, np.int64)
        self.obs_capacity = np.zeros(m, np.int32)
        self.obs_kf = np.zeros(0, np.int32)
        self.obs_ft = np.zeros(0, np.int32)

    _FEATURE_TABLES = (
        "kf_raw", "kf_response", "kf_xy", "kf_right", "kf_z", "kf_octave", "kf_angle", "kf_info", "kf_info_right",
        "kf_words",
    )  # fmt: skip
    _KEYFRAME_TABLES = (
        "kf_alive", "kf_id", "kf_map", "kf_frame", "kf_stamp", "kf_pose", "kf_centre", "kf_count", "kf_point",
        *_FEATURE_TABLES,
    )  # fmt: skip
    _POINT_TABLES = (
        "alive", "id", "position", "normal", "far", "words", "rgb", "visible", "found", "born", "n_obs", "obs_at",
        "obs_capacity",
    )  # fmt: skip

    # ------------------------------------------------------------------ keyframes

    @property
    def keyframes(self) -> Slots:
        """Slots of all keyframes, oldest first."""
        slots = np.flatnonzero(self.kf_alive)
        return slots[np.argsort(self.kf_id[slots], kind="stable")]

    def submap(self, number: int) -> Slots:
        """Slots of the keyframes of a submap, oldest first."""
        slots = self.keyframes
        return slots[np.flatnonzero(self.kf_map[slots] == number)]

    def points_of(self, keyframes: Slots | int) -> Slots:
        """Slots of the points that keyframes observe, ascending."""
        return kernels.distinct(np.atleast_2d(self.kf_point[keyframes]), self.alive.size)

    @property
    def descriptor_bytes(self) -> int:
        """Length of the descriptors in the map."""
        return 8 * self._words

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes."""
        return int(np.count_nonzero(self.kf_alive))

    @property
    def map_count(self) -> int:
        """Number of maps: the root map, and the submaps that were not merged with it."""
        return len(set(self.kf_map[self.kf_alive].tolist()))

    def add_keyframe(
        self, observations: Observations, T_cam_world: Array, frame: int, stamp: float, submap: int = 0
    ) -> int:
        """Store a frame's features as a keyframe that observes no points yet; returns its slot."""
        if observations.words.shape[1] != self._words:
            if self.next_keyframe:
                raise ValueError(f"descriptors changed from {self._words} to {observations.words.shape[1]} words")
            self._words = observations.words.shape[1]
            self._allocate()
        n = len(observations)
        if n > self._features:
            for name in (*self._FEATURE_TABLES, "kf_point"):
                self._grow(name, n, axis=1)
            self.kf_point[:, self._features :] = -1
            self._features = n
        free = np.flatnonzero(~self.kf_alive)
        if not len(free):
            length = max(16, self.kf_alive.size + self.kf_alive.size // 2)
            free = np.array([self.kf_alive.size])
            for name in self._KEYFRAME_TABLES:
                self._grow(name, length)
        slot = int(free[0])
        self.kf_alive[slot] = True
        self.kf_id[slot] = self.next_keyframe
        self.next_keyframe += 1
        self.kf_map[slot] = submap
        self.kf_frame[slot] = frame
        self.kf_stamp[slot] = stamp
        self.kf_count[slot] = n
        self.set_pose(slot, T_cam_world)
        raw = observations.keypoints
        features = (
            raw.xy, raw.response, observations.xy, observations.right, observations.z, observations.octave,
            observations.angle, observations.info, observations.info_right, observations.words,
        )  # fmt: skip
        for name, values in zip(self._FEATURE_TABLES, features, strict=True):
            getattr(self, name)[slot, :n] = values
        self.kf_point[slot] = -1
        return slot

    def set_pose(self, slot: int, T_cam_world: Array) -> None:
        """Set a keyframe's world-to-camera pose."""
        self.kf_pose[slot] = T_cam_world
        self.kf_centre[slot] = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]

    def T_world_cam(self, slot: int) -> Array:
        """A keyframe's camera-to-world pose."""
        return se3.inverse(self.kf_pose[slot])

    def take_over(self, tables: Mapping[str, NDArray[Any]], next_keyframe: int, next_point: int) -> None:
        """Become the map of complete tables, in which every slot is in use; see `atlas`."""
        for name in (*self._KEYFRAME_TABLES, *self._POINT_TABLES, "obs_kf", "obs_ft"):
            setattr(self, name, tables[name])
        self._features, self._words = self.kf_words.shape[1:]
        self._top, self._observations = self.alive.size, self.obs_kf.size
        self.next_keyframe, self.next_point = next_keyframe, next_point
        for slot, pose in enumerate(self.kf_pose):
            self.set_pose(slot, pose)

    def covisible(self, slot: int) -> tuple[Slots, Slots]:
        """Keyframes that observe points of this one, most shared points first, and how many they share."""
        return self.covisible_of(self.kf_point[slot, : self.kf_count[slot]], exclude=slot)

    def covisible_of(self, points: NDArray[np.integer], exclude: int = -1) -> tuple[Slots, Slots]:
        """Keyframes that observe any of the points (-1 entries are skipped), most first, and how many."""
        counts = kernels.covisibility(
            self.obs_kf, self.obs_at, self.n_obs, np.asarray(points, np.int32), self.kf_alive.size
        )
        if exclude >= 0:
            counts[exclude] = 0
        slots = np.flatnonzero(counts)
        order = np.lexsort((-self.kf_id[slots], -counts[slots]))
        return slots[order], counts[slots[order]]

    def move_submap(self, number: int, T_new_old: Array, merged_into: int, scale: float = 1.0) -> None:
        """Move all keyframes of a submap, and their points, into another, and make them part of that.

        Args:
            number: The submap.
            T_new_old: From the submap's world to the world of the other, ``[4, 4]``.
            merged_into: The other's number.
            scale: What lengths in the submap's world are multiplied by before it is moved.
        """
        slots = np.flatnonzero(self.kf_alive & (self.kf_map == number))
        points = self.points_of(slots)
        self.kf_pose[slots, :3, 3] *= scale
        for slot in slots.tolist():
            self.set_pose(slot, self.kf_pose[slot] @ se3.inverse(T_new_old))
        self.position[points] = se3.transform(T_new_old, scale * self.position[points])
        self.kf_map[slots] = merged_into
        self.refresh(points)

    def remove_keyframe(self, slot: int) -> None:
        """Remove a keyframe, its observations, and the points that no keyframe observes any more."""
        n = self.kf_count[slot]
        features = np.flatnonzero(self.kf_point[slot, :n] >= 0)
        points = self.kf_point[slot, features].astype(np.int64)
        kernels.unlink_many(*self._observed, self.kf_point, np.full(len(features), slot, np.int64), features)
        self.kf_alive[slot] = False
        self.remove_points(points[self.n_obs[points] == 0])

    # ------------------------------------------------------------------ points

    @property
    def point_count(self) -> int:
        """Number of points."""
        return int(np.count_nonzero(self.alive[: self._top]))

    @property
    def points(self) -> Slots:
        """Slots of all points, ascending."""
        return np.flatnonzero(self.alive[: self._top])

    def add_points(self, position: Array, rgb: NDArray[np.uint8], keyframe: int, features: Slots) -> Slots:
        """New points ``[N, 3]`` that features of a keyframe observe; returns their slots."""
        n = len(position)
        reused = [self._free_points.pop() for _ in range(min(n, len(self._free_points)))]
        fresh = n - len(reused)
        if self._top + fresh > self.alive.size:
            length = max(2048, self._top + fresh, self.alive.size + self.alive.size // 2)
            for name in self._POINT_TABLES:
                self._grow(name, length)
        slots = np.concatenate([np.array(reused, np.int64), np.arange(self._top, self._top + fresh, dtype=np.int64)])
        self._top += fresh
        self.alive[slots] = True
        self.id[slots] = np.arange(self.next_point, self.next_point + n)
        self.next_point += n
        self.position[slots] = position
        self.rgb[slots] = rgb
        self.visible[slots] = 1
        self.found[slots] = 1
        self.born[slots] = self.kf_id[keyframe]
        self.n_obs[slots] = 0
        self.observe(keyframe, features, slots)
        return slots

    def observe(self, keyframe: int, features: Slots, points: Slots) -> None:
        """Add observations: features of a keyframe show points."""
        if not len(points):
            return
        self._reserve(points, 1)
        kernels.link(*self._observed, self.kf_point, keyframe, features, points)

    def unobserve(self, keyframes: Slots, features: Slots) -> None:
        """Remove observations; points that lose their last one are removed."""
        points = self.kf_point[keyframes, features].astype(np.int64)
        kernels.unlink_many(*self._observed, self.kf_point, keyframes, features)
        points = np.unique(points[points >= 0])
        self.remove_points(points[self.n_obs[points] == 0])

    def remove_points(self, points: Slots) -> None:
        """Remove points and their observations."""
        points = np.unique(points)
        points = points[self.alive[points]]
        kernels.drop_points(*self._observed, self.kf_point, points)
        self.alive[points] = False
        self._freed_points.extend(points.tolist())

    def merge(self, old: int, new: int) -> None:
        """Replace a point by another that is the same point of the scene."""
        if old == new or not self.alive[old] or not self.alive[new]:
            return
        self._reserve(np.array([new]), int(self.n_obs[old]))
        kernels.merge(*self._observed, self.kf_point, old, new)
        self.visible[new] += self.visible[old]
        self.found[new] += self.found[old]
        self.alive[old] = False
        self._freed_points.append(old)

    def refresh(self, points: Slots) -> None:
        """Renew descriptor, viewing direction and scale range of points from their observations."""
        of_points, of_keyframes = (self.position, self.normal, self.far, self.words), (self.kf_words, self.kf_octave)
        kernels.refresh(points, *of_points, *self._observed, *of_keyframes, self.kf_centre, self.scales)

    def release(self) -> None:
        """Allow the slots freed so far to be used again; called once nothing refers to them any more."""
        self._free_points.extend(sorted(self._freed_points, reverse=True))
        self._freed_points.clear()

    @property
    def _observed(self) -> tuple[NDArray[np.int32], NDArray[np.int32], Slots, NDArray[np.int32]]:
        return self.obs_kf, self.obs_ft, self.obs_at, self.n_obs

    def observations(self, points: Slots) -> Slots:
        """Rows of `obs_kf` and `obs_ft` that belong to points, one point after the other."""
        count = self.n_obs[points].astype(np.int64)
        begin = self.obs_at[points] - (np.cumsum(count) - count)
        return np.repeat(begin, count) + np.arange(count.sum())

    def _reserve(self, points: Slots, more: int) -> None:
        """Make room for so many more observations of each of the points; the room that they leave is used again."""
        full = self.n_obs[points] + more > self.obs_capacity[points]
        if not full.any():
            return
        short = np.unique(points[full])
        capacities = np.maximum(2 * self.obs_capacity[short], MIN_CAPACITY)
        if more > 1:
            capacities = np.maximum(capacities, self.n_obs[short] + more)
        for capacity in np.unique(capacities).tolist():
            moving = short[capacities == capacity]
            vacant = self._vacant.get(capacity, [])
            reused = [vacant.pop() for _ in range(min(len(vacant), len(moving)))]
            fresh = self._observations + capacity * np.arange(len(moving) - len(reused), dtype=np.int64)
            self._observations += capacity * len(fresh)
            if self._observations > self.obs_kf.size:
                length = max(self._observations, self.obs_kf.size + self.obs_kf.size // 2)
                self._grow("obs_kf", length)
                self._grow("obs_ft", length)
            left = zip(self.obs_capacity[moving].tolist(), self.obs_at[moving].tolist(), strict=True)
            kernels.move(*self._observed, moving, np.concatenate([np.array(reused, np.int64), fresh]))
            self.obs_capacity[moving] = capacity
            for size, begin in left:
                if size:
                    self._vacant.setdefault(size, []).append(begin)

    # ------------------------------------------------------------------ views

    def project(self, T_cam_world: Array, candidates: Slots) -> tuple[Slots, Array, Array, Slots, Array]:
        """The points that a camera should see, with pixels, right coordinates, octaves and viewing cosines."""
        c = self.camera
        return kernels.project(
            np.ascontiguousarray(T_cam_world), candidates, self.position, self.normal, self.far,
            c.fx, c.fy, c.cx, c.cy, c.fx * c.baseline_m, float(c.width), float(c.height),
            float(self.scales[1] / self.scales[0]) if len(self.scales) > 1 else 1.2, len(self.scales),
        )  # fmt: skip

    def redundancy(self, slot: int, close_m: float) -> tuple[int, int]:
        """A keyframe's close points, and how many of them three other keyframes see, at most one octave coarser.

        All points of a keyframe without any depth count as close.
        """
        depth = self.kf_z[slot, : self.kf_count[slot]]
        close = (depth > 0) & (depth <= close_m) if depth.any() else np.ones(len(depth), bool)
        total, redundant = kernels.redundancy(slot, close, self.kf_point, self.kf_octave, *self._observed, 3)
        return int(total), int(redundant)
