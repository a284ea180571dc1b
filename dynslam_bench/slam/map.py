"""The map: keyframes and points in flat tables, so that compiled loops and numpy run over them without objects.

Keyframes and points live in numbered slots; a freed slot is used again, after the mapping step that freed it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import distance
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

if TYPE_CHECKING:
    from dynslam_bench.slam.tracking import Observations

Array = NDArray[np.float64]
Slots = NDArray[np.int64]
Ints = NDArray[np.int32]

KEYFRAME_TABLES = {
    "kf_alive": (bool,), "kf_id": (np.int64,), "kf_map": (np.int64,), "kf_frame": (np.int64,), "kf_stamp": (float,),
    "kf_pose": (float, 4, 4), "kf_centre": (float, 3), "kf_count": (np.int64,),
}  # fmt: skip
"""Type and shape of what is stored of each keyframe, see `Map`."""
FEATURE_TABLES = {
    "kf_raw": (np.float32, 0, 2), "kf_response": (np.float32, 0), "kf_xy": (float, 0, 2), "kf_right": (float, 0),
    "kf_z": (np.float32, 0), "kf_octave": (np.int8, 0), "kf_angle": (np.float32, 0), "kf_info": (float, 0),
    "kf_info_right": (float, 0), "kf_words": (np.uint64, 0, 4), "kf_point": (np.int32, 0),
}  # fmt: skip
"""Of each feature of each keyframe."""
POINT_TABLES = {
    "alive": (bool,), "id": (np.int64,), "position": (float, 3), "normal": (float, 3), "far": (float,),
    "words": (np.uint64, 4), "rgb": (np.uint8, 3), "visible": (np.int32,), "found": (np.int32,), "born": (np.int64,),
    "n_obs": (np.int32,), "obs_at": (np.int64,), "obs_capacity": (np.int32,),
}  # fmt: skip
"""Of each point."""
OBSERVATION_TABLES = {"obs_kf": (np.int32,), "obs_ft": (np.int32,)}
"""Of each observation."""
MIN_CAPACITY = 4
"""Observations that a point has room for when it gets its first one."""
MIN_COSINE = 0.5
"""Smallest cosine between a point's mean viewing direction and the ray to the camera (ORB-SLAM2's number)."""
WIDEN_RANGE = 1.25
"""Factor by which the scale range of a point is widened."""
REDUNDANT_VIEWS = 3
"""Other keyframes that see a redundant point (ORB-SLAM2's number)."""


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
        substrings: By keyframe slot the keyframe's id, and sorted substrings of its descriptors (`place_recognition`).

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
        self._features = 0
        self.substrings: dict[int, tuple[int, NDArray[np.uint16]]] = {}
        for name, (kind, *shape) in (KEYFRAME_TABLES | FEATURE_TABLES | POINT_TABLES | OBSERVATION_TABLES).items():
            setattr(self, name, np.zeros((0, *shape), kind))

    if TYPE_CHECKING:
        obs_kf: Ints
        obs_ft: Ints

        def __getattr__(self, name: str) -> NDArray[Any]: ...

    def _grow(self, names: Iterable[str], length: int, axis: int = 0) -> None:
        for name in names:
            table = getattr(self, name)
            shape = list(table.shape)
            shape[axis] = length - shape[axis]
            setattr(self, name, np.concatenate([table, np.zeros(shape, table.dtype)], axis))

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
        observed, points = np.zeros(self.alive.size, bool), self.kf_point[keyframes]
        observed[points[points >= 0]] = True
        return np.flatnonzero(observed)

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
        n, words = observations.words.shape
        if not self.next_keyframe:
            self.kf_words, self.words = np.zeros((0, 0, words), np.uint64), np.zeros((0, words), np.uint64)
        if n > self._features:
            self._grow(FEATURE_TABLES, n, axis=1)
            self.kf_point[:, self._features :] = -1
            self._features = n
        free = np.flatnonzero(~self.kf_alive)
        if not len(free):
            free = np.array([self.kf_alive.size])
            self._grow(KEYFRAME_TABLES | FEATURE_TABLES, max(16, self.kf_alive.size + self.kf_alive.size // 2))
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
        for name, values in zip(FEATURE_TABLES, features, strict=False):
            getattr(self, name)[slot, :n] = values
        self.kf_point[slot] = -1
        return slot

    def set_pose(self, slot: int, T_cam_world: Array) -> None:
        """Set a keyframe's world-to-camera pose."""
        self.kf_pose[slot] = T_cam_world
        self.kf_centre[slot] = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]

    def take_over(self, tables: Mapping[str, NDArray[Any]], next_keyframe: int, next_point: int) -> None:
        """Become the map of complete tables, in which every slot is in use; see `atlas`."""
        for name in KEYFRAME_TABLES | FEATURE_TABLES | POINT_TABLES | OBSERVATION_TABLES:
            setattr(self, name, tables[name])
        self._features = self.kf_words.shape[1]
        self._top, self._observations = self.alive.size, self.obs_kf.size
        self.next_keyframe, self.next_point = next_keyframe, next_point
        for slot, pose in enumerate(self.kf_pose):
            self.set_pose(slot, pose)

    def covisible(self, slot: int) -> tuple[Slots, Slots]:
        """Keyframes that observe points of this one, most shared points first, and how many they share."""
        return self.covisible_of(self.kf_point[slot, : self.kf_count[slot]], exclude=slot)

    def covisible_of(self, points: NDArray[np.integer], exclude: int = -1) -> tuple[Slots, Slots]:
        """Keyframes that observe any of the points (-1 entries are skipped), most first, and how many."""
        observers = self.obs_kf[self.observations(points[points >= 0])]
        counts = np.bincount(observers, minlength=self.kf_alive.size)
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
        features = np.flatnonzero(self.kf_point[slot] >= 0)
        self.unobserve(np.full(len(features), slot, np.int64), features)
        self.kf_alive[slot] = False

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
            self._grow(POINT_TABLES, max(2048, self._top + fresh, self.alive.size + self.alive.size // 2))
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
        _link(*self._observed, self.kf_point, keyframe, features, points)

    def unobserve(self, keyframes: Slots, features: Slots) -> None:
        """Remove observations; points that lose their last one are removed."""
        points = self.kf_point[keyframes, features].astype(np.int64)
        _unlink(*self._observed, self.kf_point, keyframes, features)
        points = np.unique(points[points >= 0])
        self.remove_points(points[self.n_obs[points] == 0])

    def remove_points(self, points: Slots) -> None:
        """Remove points and their observations."""
        points = np.unique(points)
        points = points[self.alive[points]]
        rows = self.observations(points)
        self.kf_point[self.obs_kf[rows], self.obs_ft[rows]] = -1
        self.n_obs[points], self.alive[points] = 0, False
        self._freed_points.extend(points.tolist())

    def replace_point(self, old: int, new: int) -> None:
        """Replace a point by another that is the same point of the scene."""
        if old == new or not self.alive[old] or not self.alive[new]:
            return
        self._reserve(np.array([new]), int(self.n_obs[old]))
        _replace(*self._observed, self.kf_point, old, new)
        self.visible[new] += self.visible[old]
        self.found[new] += self.found[old]
        self.alive[old] = False
        self._freed_points.append(old)

    def refresh(self, points: Slots) -> None:
        """Renew descriptor, viewing direction and scale range of points from their observations."""
        of_points, of_keyframes = (self.position, self.normal, self.far, self.words), (self.kf_words, self.kf_octave)
        _refresh(points, *of_points, *self._observed, *of_keyframes, self.kf_centre, self.scales)

    def release(self) -> None:
        """Allow the slots freed so far to be used again; called once nothing refers to them any more."""
        self._free_points.extend(sorted(self._freed_points, reverse=True))
        self._freed_points.clear()

    @property
    def _observed(self) -> tuple[NDArray[np.int32], NDArray[np.int32], Slots, NDArray[np.int32]]:
        return self.obs_kf, self.obs_ft, self.obs_at, self.n_obs

    def observations(self, points: NDArray[np.integer]) -> Slots:
        """Rows of `obs_kf` and `obs_ft` that belong to points, one point after the other."""
        count = self.n_obs[points].astype(np.int64)
        begin = self.obs_at[points] - (np.cumsum(count) - count)
        return np.repeat(begin, count) + np.arange(count.sum())

    def _reserve(self, points: Slots, more: int) -> None:
        """Make room for so many more observations of each of the points."""
        full = self.n_obs[points] + more > self.obs_capacity[points]
        if not full.any():
            return
        short = np.unique(points[full])
        room = np.maximum(2 * self.obs_capacity[short], self.n_obs[short] + more).clip(min=MIN_CAPACITY)
        if self._observations + room.sum() > self.obs_kf.size:
            placed = np.flatnonzero(self.obs_capacity)
            present = self.obs_capacity[placed]
            self._place(placed, present, int(1.5 * (present.sum() + room.sum())))
        self._place(short, room)

    def _place(self, points: Slots, room: Ints, length: int = 0) -> None:
        """Move the observations of points to where each has `room`: behind all others, or into a pool of `length`."""
        rows = self.observations(points)
        keyframes, features = self.obs_kf[rows], self.obs_ft[rows]
        if length:
            self.obs_kf, self.obs_ft = np.zeros(length, np.int32), np.zeros(length, np.int32)
            self._observations = 0
        self.obs_at[points] = self._observations + np.cumsum(room, dtype=np.int64) - room
        self.obs_capacity[points] = room
        self._observations += int(room.sum())
        rows = self.observations(points)
        self.obs_kf[rows], self.obs_ft[rows] = keyframes, features

    # ------------------------------------------------------------------ views

    def project(self, T_cam_world: Array, candidates: Slots) -> tuple[Slots, Array, Array, Slots, Array]:
        """The points that a camera should see, with pixels, right coordinates, octaves and viewing cosines."""
        c = self.camera
        return _project(
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
        total, redundant = _redundancy(slot, close, self.kf_point, self.kf_octave, *self._observed)
        return int(total), int(redundant)


# ---------------------------------------------------------------------- compiled loops over the tables


@kernel
def _link_one(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Ints, keyframe: int, feature: int, point: int
) -> None:
    begin, end = obs_at[point], obs_at[point] + n_obs[point]
    for o in range(begin, end):
        if obs_kf[o] == keyframe:
            return
    obs_kf[end] = keyframe
    obs_ft[end] = feature
    n_obs[point] += 1
    kf_point[keyframe, feature] = point


@kernel
def _link(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Ints, keyframe: int, features: Slots,
    points: Slots,
) -> None:  # fmt: skip
    """Add observations of the points by the keyframe's features; a second one by the same keyframe is skipped."""
    for i in range(points.shape[0]):
        if kf_point[keyframe, features[i]] < 0:
            _link_one(obs_kf, obs_ft, obs_at, n_obs, kf_point, keyframe, features[i], points[i])


@kernel
def _unlink(
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Ints, keyframes: Slots, features: Slots
) -> None:
    """Remove observations; the order of the others is kept."""
    for i in range(keyframes.shape[0]):
        p = kf_point[keyframes[i], features[i]]
        if p < 0:
            continue
        kf_point[keyframes[i], features[i]] = -1
        out = obs_at[p]
        for o in range(obs_at[p], obs_at[p] + n_obs[p]):
            if obs_kf[o] != keyframes[i] or obs_ft[o] != features[i]:
                obs_kf[out] = obs_kf[o]
                obs_ft[out] = obs_ft[o]
                out += 1
        n_obs[p] = out - obs_at[p]


@kernel
def _replace(obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints, kf_point: Ints, old: int, new: int) -> None:
    """Move the observations of `old` to `new`; where one keyframe observes both, that of `new` stays."""
    for o in range(obs_at[old], obs_at[old] + n_obs[old]):
        kf_point[obs_kf[o], obs_ft[o]] = -1
        _link_one(obs_kf, obs_ft, obs_at, n_obs, kf_point, obs_kf[o], obs_ft[o], new)
    n_obs[old] = 0


@kernel
def _refresh(
    points: Slots, position: Array, normal: Array, far: Array, words: Any, obs_kf: Ints, obs_ft: Ints, obs_at: Slots,
    n_obs: Ints, kf_words: Any, kf_octave: Any, kf_centre: Array, scales: Array,
) -> None:  # fmt: skip
    """Renew descriptor (the medoid of the observed ones), viewing direction and scale range of the points."""
    for i in range(points.shape[0]):
        p = points[i]
        n = n_obs[p]
        if n == 0:
            continue
        begin, end = obs_at[p], obs_at[p] + n
        m = min(n, 12)  # only the newest observations count
        best = end - 1
        if m > 2:
            best_score = 1 << 40
            for a in range(end - m, end):
                score = 0
                for b in range(end - m, end):
                    score += distance(kf_words[obs_kf[a], obs_ft[a]], kf_words[obs_kf[b], obs_ft[b]])
                if score < best_score:
                    best, best_score = a, score
        for w in range(words.shape[1]):  # whole rows would compile a message for shapes that differ, seconds of it
            words[p, w] = kf_words[obs_kf[best], obs_ft[best], w]
        sx, sy, sz = 0.0, 0.0, 0.0
        reference_distance = 0.0
        for o in range(begin, end):
            c = kf_centre[obs_kf[o]]
            x, y, z = position[p, 0] - c[0], position[p, 1] - c[1], position[p, 2] - c[2]
            d = np.sqrt(x * x + y * y + z * z) + 1e-12
            sx += x / d
            sy += y / d
            sz += z / d
            if o == begin:
                reference_distance = d * scales[kf_octave[obs_kf[o], obs_ft[o]]]
        length = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        normal[p, 0], normal[p, 1], normal[p, 2] = sx / length, sy / length, sz / length
        far[p] = reference_distance


@kernel
def _project(
    pose: Array, candidates: Slots, position: Array, normal: Array, far: Array,
    fx: float, fy: float, cx: float, cy: float, bf: float, width: float, height: float, scale_factor: float,
    levels: int,
) -> tuple[Slots, Array, Array, Slots, Array]:  # fmt: skip
    """The candidate points that the camera should see: in the image, at a fit distance, from a fit side.

    Returns:
        Points, pixels, right coordinates, predicted octaves and cosines of the viewing angle.
    """
    n = candidates.shape[0]
    index = np.empty(n, np.int64)
    uv = np.empty((n, 2))
    right = np.empty(n)
    octave = np.empty(n, np.int64)
    cosine = np.empty(n)
    r, t = pose[:3, :3], pose[:3, 3]
    ox = -(r[0, 0] * t[0] + r[1, 0] * t[1] + r[2, 0] * t[2])
    oy = -(r[0, 1] * t[0] + r[1, 1] * t[1] + r[2, 1] * t[2])
    oz = -(r[0, 2] * t[0] + r[1, 2] * t[1] + r[2, 2] * t[2])
    nearest = scale_factor ** (levels - 1)
    inverse_log = 1.0 / np.log(scale_factor)
    count = 0
    for i in range(n):
        p = candidates[i]
        x, y, z = position[p, 0], position[p, 1], position[p, 2]
        zc = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if zc < 0.05:
            continue
        u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / zc + cx
        v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / zc + cy
        if u < 0.0 or u >= width or v < 0.0 or v >= height:
            continue
        dx, dy, dz = x - ox, y - oy, z - oz
        d = np.sqrt(dx * dx + dy * dy + dz * dz)
        if d > WIDEN_RANGE * far[p] or d * WIDEN_RANGE < far[p] / nearest:
            continue
        c = (dx * normal[p, 0] + dy * normal[p, 1] + dz * normal[p, 2]) / d
        if c < MIN_COSINE:
            continue
        level = int(np.ceil(np.log(far[p] / d) * inverse_log - 1e-9))
        index[count] = p
        uv[count, 0], uv[count, 1] = u, v
        right[count] = u - bf / zc
        octave[count] = min(max(level, 0), levels - 1)
        cosine[count] = c
        count += 1
    return index[:count].copy(), uv[:count].copy(), right[:count].copy(), octave[:count].copy(), cosine[:count].copy()


@kernel
def _redundancy(
    keyframe: int, close: NDArray[np.bool_], kf_point: Ints, kf_octave: Any,
    obs_kf: Ints, obs_ft: Ints, obs_at: Slots, n_obs: Ints,
) -> tuple[int, int]:  # fmt: skip
    """Close points that the keyframe observes, and those that `REDUNDANT_VIEWS` see, at most one octave coarser."""
    total, redundant = 0, 0
    for f in range(close.shape[0]):
        p = kf_point[keyframe, f]
        if p < 0 or not close[f]:
            continue
        total += 1
        if n_obs[p] <= REDUNDANT_VIEWS:
            continue
        fine = 0
        for o in range(obs_at[p], obs_at[p] + n_obs[p]):
            if obs_kf[o] != keyframe and kf_octave[obs_kf[o], obs_ft[o]] <= kf_octave[keyframe, f] + 1:
                fine += 1
        redundant += fine >= REDUNDANT_VIEWS
    return total, redundant
