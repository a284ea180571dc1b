"""The map: keyframes and points in flat tables, so that compiled loops and numpy run over them without objects.

Keyframes and points live in numbered slots; a freed slot is used again, after the mapping step that
freed it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import KeyframeRecord, KeyframeView, Keypoints, MapOutputs
from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import distance
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.geometry.gauss_newton import transform_point
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.pose_optimisation import NEAR_M, Intrinsics, intrinsics_of

Array = NDArray[np.float64]
Slots = NDArray[np.int64]
Ints = NDArray[np.int32]

KEYFRAME_TABLES = {
    "kf_alive": (bool,),
    "kf_id": (np.int64,),
    "kf_map": (np.int64,),
    "kf_frame": (np.int64,),
    "kf_stamp": (float,),
    "kf_pose": (float, 4, 4),
    "kf_centre": (float, 3),
    "kf_count": (np.int64,),
}
"""Type and shape of what is stored for each keyframe, see `Map`."""
FEATURE_TABLES = {
    "kf_raw": (np.float32, 0, 2),
    "kf_response": (np.float32, 0),
    "kf_xy": (float, 0, 2),
    "kf_right": (float, 0),
    "kf_z": (np.float32, 0),
    "kf_octave": (np.int8, 0),
    "kf_angle": (np.float32, 0),
    "kf_info": (float, 0),
    "kf_info_right": (float, 0),
    "kf_descriptor": (np.uint64, 0, 4),
    "kf_point": (np.int32, 0),
}
"""Type and shape of what is stored for each feature of each keyframe; a 0 becomes the number of features."""
POINT_TABLES = {
    "alive": (bool,),
    "id": (np.int64,),
    "position": (float, 3),
    "normal": (float, 3),
    "far": (float,),
    "descriptor": (np.uint64, 4),
    "rgb": (np.uint8, 3),
    "visible": (np.int32,),
    "found": (np.int32,),
    "born": (np.int64,),
    "n_obs": (np.int32,),
    "obs_kf": (np.int32, 8),
    "obs_ft": (np.int32, 8),
}
"""Type and shape of what is stored for each point; the observations' columns grow with the longest track."""
MIN_COSINE = 0.5
"""Smallest cosine between a point's mean viewing direction and the ray to the camera (ORB-SLAM2's number)."""
WIDEN_RANGE = 1.25
"""Factor by which the scale range of a point is widened."""
REDUNDANT_VIEWS = 3
"""Other keyframes that see a redundant point (ORB-SLAM2's number)."""
DESCRIBING_OBSERVATIONS = 12
"""Newest observations of a point among which its descriptor is chosen."""

VIEWS = 20
"""Newest keyframes that filters may read (DynaSLAM's window)."""
DEPTH_IMAGES = 8
"""Newest keyframes that keep their depth image, for filters."""


class ObservationTables(NamedTuple):
    """Observations of points by keyframes, in both directions, as compiled loops take them.

    Attributes:
        obs_kf: int32 ``[M, O]``, by point the slots of the keyframes that observe it, oldest first.
        obs_ft: int32 ``[M, O]``, the features by which they do.
        n_obs: int32 ``[M]``, how many these are.
        kf_point: int32 ``[S, F]``, by keyframe and feature the observed point, or -1.
    """

    obs_kf: Ints
    obs_ft: Ints
    n_obs: Ints
    kf_point: Ints


class PointViews(NamedTuple):
    """Positions of points, and the views from which they are recognised.

    Attributes:
        position: float64 ``[M, 3]``, world points.
        normal: float64 ``[M, 3]``, mean viewing directions.
        far: float64 ``[M]``, largest distances.
    """

    position: Array
    normal: Array
    far: Array


class KeyframeViews(NamedTuple):
    """Keyframes as the points that they observe need them.

    Attributes:
        descriptors: uint64 ``[S, F, W]``.
        octave: int8 ``[S, F]``.
        centre: float64 ``[S, 3]``, camera centres in the world.
    """

    descriptors: Any
    octave: Any
    centre: Array


class VisiblePoints(NamedTuple):
    """Points that a camera should see, N of them.

    Attributes:
        points: int64 ``[N]``, their slots.
        uv: float64 ``[N, 2]``, undistorted pixels.
        right: float64 ``[N]``, right coordinates.
        octave: int64 ``[N]``, where their scale is expected in the pyramid.
        cosine: float64 ``[N]``, cosines of the angle between the ray and the mean viewing direction.
    """

    points: Slots
    uv: Array
    right: Array
    octave: Slots
    cosine: Array


class Map:
    """Keyframes, points and who observes what.

    All tables are indexed by slots: S of keyframes, M of points. F is the largest number of
    features of a keyframe so far, W the number of words of a descriptor, and O the largest number
    of observations of a point so far, rounded up.

    Args:
        camera: Intrinsics without distortion.
        scales: Pixels of the image in a pixel of each octave.

    Attributes:
        kf_alive: bool ``[S]``, whether the slot is in use.
        kf_id: int64 ``[S]``, number of the keyframe in the order of creation.
        kf_map: int64 ``[S]``, number of its submap, 0 for the root map.
        kf_frame: int64 ``[S]``, index of its frame.
        kf_stamp: float64 ``[S]``, timestamp in seconds.
        kf_pose: float64 ``[S, 4, 4]``, world to camera.
        kf_centre: float64 ``[S, 3]``, camera centre in the world.
        kf_count: int64 ``[S]``, number of features.
        kf_raw: float32 ``[S, F, 2]``, raw (distorted) pixels.
        kf_response: float32 ``[S, F]``, response of the detector.
        kf_xy: float64 ``[S, F, 2]``, undistorted pixels.
        kf_right: float64 ``[S, F]``, right coordinates, NaN without depth.
        kf_z: float32 ``[S, F]``, depth in metres, 0 missing.
        kf_octave: int8 ``[S, F]``.
        kf_angle: float32 ``[S, F]``, degrees.
        kf_info: float64 ``[S, F]``, inverse variance of the pixel, see `Observations`.
        kf_info_right: float64 ``[S, F]``, inverse variance of the right coordinate.
        kf_descriptor: uint64 ``[S, F, W]``, bits in words of 64.
        kf_point: int32 ``[S, F]``, slot of the observed point, or -1.
        alive: bool ``[M]``, whether the point's slot is in use.
        id: int64 ``[M]``, number of the point in the order of creation.
        position: float64 ``[M, 3]``, world point in metres.
        normal: float64 ``[M, 3]``, mean viewing direction.
        far: float64 ``[M]``, largest distance at which the point's reference scale is still in the
            pyramid.
        descriptor: uint64 ``[M, W]``.
        rgb: uint8 ``[M, 3]``, colour.
        visible: int32 ``[M]``, frames that should have observed it.
        found: int32 ``[M]``, frames that did.
        born: int64 ``[M]``, id of the keyframe that made it.
        n_obs: int32 ``[M]``, number of observations.
        obs_kf: int32 ``[M, O]``, slots of the observing keyframes, oldest first.
        obs_ft: int32 ``[M, O]``, their features.
        substrings: The keyframe's id and sorted substrings of its descriptors, by keyframe slot
            (`relocalisation`).
    """

    def __init__(self, camera: Camera, scales: Array) -> None:
        self.scales = np.ascontiguousarray(scales, np.float64)
        self.camera = camera
        self.next_keyframe = 0
        self.next_point = 0
        # points lie in slots below it
        self._top = 0
        # a freed slot may be used again after `release`
        self._free_points: list[int] = []
        self._freed_points: list[int] = []
        self.substrings: dict[int, tuple[int, NDArray[np.uint16]]] = {}
        for name, (kind, *shape) in (KEYFRAME_TABLES | FEATURE_TABLES | POINT_TABLES).items():
            setattr(self, name, np.zeros((0, *shape), kind))

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> NDArray[Any]: ...

    def _grow(self, names: Iterable[str], length: int, axis: int = 0) -> None:
        """Lengthen tables by zeros along an axis."""
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
        # a flag a point: each is listed once, however many keyframes observe it
        observed = np.zeros(self.alive.size, bool)
        points = self.kf_point[keyframes]
        observed[points[points >= 0]] = True
        return np.flatnonzero(observed)

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes."""
        return int(np.count_nonzero(self.kf_alive))

    def add_keyframe(
        self,
        observations: Observations,
        T_cam_world: Array,
        frame: int,
        stamp: float,
        submap: int = 0,
    ) -> int:
        """Store a frame's features as a keyframe that observes no points yet; returns its slot.

        Args:
            observations: The frame's features.
            T_cam_world: Its pose ``[4, 4]``.
            frame: Its index.
            stamp: Its timestamp, seconds.
            submap: Number of the submap that it belongs to.
        """
        # the keyframe: number, map, frame, pose
        n = len(observations)
        slot = self._free_keyframe_slot(*observations.descriptors.shape)
        self.kf_id[slot] = self.next_keyframe
        self.kf_alive[slot] = True
        self.kf_map[slot] = submap
        self.kf_frame[slot] = frame
        self.kf_stamp[slot] = stamp
        self.kf_count[slot] = n
        self.next_keyframe += 1
        self.set_pose(slot, T_cam_world)

        # its features, which observe no point yet
        raw = observations.keypoints
        self.kf_raw[slot, :n] = raw.xy
        self.kf_response[slot, :n] = raw.response
        self.kf_xy[slot, :n] = observations.xy
        self.kf_right[slot, :n] = observations.right
        self.kf_z[slot, :n] = observations.z
        self.kf_octave[slot, :n] = observations.octave
        self.kf_angle[slot, :n] = observations.angle
        self.kf_info[slot, :n] = observations.info
        self.kf_info_right[slot, :n] = observations.info_right
        self.kf_descriptor[slot, :n] = observations.descriptors
        self.kf_point[slot] = -1
        return slot

    def _free_keyframe_slot(self, features: int, words: int) -> int:
        """A free slot, in tables that have room for so many features with so many words of descriptor."""
        # the first keyframe decides how long descriptors are
        if not self.next_keyframe:
            self.kf_descriptor = np.zeros((0, 0, words), np.uint64)
            self.descriptor = np.zeros((0, words), np.uint64)

        # wider tables for more features than any keyframe had, longer ones for another keyframe
        room = self.kf_point.shape[1]
        if features > room:
            self._grow(FEATURE_TABLES, features, axis=1)
            self.kf_point[:, room:] = -1
        slots = self.kf_alive.size
        if self.kf_alive.all():
            self._grow(KEYFRAME_TABLES | FEATURE_TABLES, max(16, slots + slots // 2))
        return int(self.kf_alive.argmin())

    def set_pose(self, slot: int, T_cam_world: Array) -> None:
        """Set a keyframe's world-to-camera pose."""
        self.kf_pose[slot] = T_cam_world
        self.kf_centre[slot] = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]

    def take_over(
        self, tables: Mapping[str, NDArray[Any]], next_keyframe: int, next_point: int
    ) -> None:
        """Become the map of complete tables, in which every slot is in use; see `atlas`."""
        for name in KEYFRAME_TABLES | FEATURE_TABLES | POINT_TABLES:
            setattr(self, name, tables[name])
        self._top = self.alive.size
        self.next_keyframe = next_keyframe
        self.next_point = next_point
        for slot, pose in enumerate(self.kf_pose):
            self.set_pose(slot, pose)

    def covisible(self, slot: int) -> tuple[Slots, Slots]:
        """Keyframes that observe points of this one, most shared points first, and how many they share."""
        return self.covisible_of(self.kf_point[slot, : self.kf_count[slot]], exclude=slot)

    def covisible_of(self, points: NDArray[np.integer], exclude: int = -1) -> tuple[Slots, Slots]:
        """Keyframes that observe any of the points (-1 entries are skipped), most first, and how many."""
        # one entry for each shared point; equal counts: the newer keyframe first
        observers, _ = self.observations(points[points >= 0])
        counts = np.bincount(observers[observers != exclude], minlength=self.kf_alive.size)
        slots = np.flatnonzero(counts)
        order = np.lexsort((-self.kf_id[slots], -counts[slots]))
        return slots[order], counts[slots[order]]

    def move_submap(
        self, number: int, T_new_old: Array, merged_into: int, scale: float = 1.0
    ) -> Slots:
        """Merge a submap into another: all its keyframes and points move, and become part of that; returns their slots.

        Args:
            number: The submap.
            T_new_old: Transform ``[4, 4]`` from the submap's world to the world of the other.
            merged_into: Number of the submap that it becomes part of.
            scale: What lengths in the submap's world are multiplied by before it is moved.
        """
        # scale the keyframes' translations, then move their poses: T_cam_new = T_cam_old T_new_old^-1
        slots = self.submap(number)
        points = self.points_of(slots)
        self.kf_pose[slots, :3, 3] *= scale
        for slot in slots.tolist():
            self.set_pose(slot, self.kf_pose[slot] @ se3.inverse(T_new_old))

        # the points, likewise
        self.position[points] = se3.transform(T_new_old, scale * self.position[points])
        self.kf_map[slots] = merged_into
        self.refresh(points)
        return slots

    def remove_keyframe(self, slot: int) -> None:
        """Remove a keyframe, its observations, and the points that no keyframe observes any more."""
        features = np.flatnonzero(self.kf_point[slot] >= 0)
        self.unobserve(np.full(len(features), slot, np.int64), features)
        self.kf_alive[slot] = False

    # ------------------------------------------------------------------ points

    @property
    def points(self) -> Slots:
        """Slots of all points, ascending."""
        return np.flatnonzero(self.alive[: self._top])

    def add_points(
        self, position: Array, rgb: NDArray[np.uint8], keyframe: int, features: Slots
    ) -> Slots:
        """New points ``[N, 3]`` that features of a keyframe observe; returns their slots.

        Args:
            position: World points, metres.
            rgb: Their colours, uint8 ``[N, 3]``.
            keyframe: Slot of the keyframe.
            features: Its features ``[N]``, which observe nothing yet.
        """
        # freed slots first, then new ones behind the others
        n = len(position)
        reused = [self._free_points.pop() for _ in range(min(n, len(self._free_points)))]
        end = self._top + n - len(reused)
        size = self.alive.size
        if end > size:
            self._grow(POINT_TABLES, max(2048, end, size + size // 2))
        fresh = np.arange(self._top, end, dtype=np.int64)
        slots = np.concatenate([np.array(reused, np.int64), fresh])
        self._top = end

        # the points, observed once
        self.id[slots] = np.arange(self.next_point, self.next_point + n)
        self.next_point += n
        self.alive[slots] = True
        self.born[slots] = self.kf_id[keyframe]
        self.position[slots] = position
        self.rgb[slots] = rgb
        self.visible[slots] = 1
        self.found[slots] = 1
        self.n_obs[slots] = 0
        self.observe(keyframe, features, slots)
        return slots

    def observe(self, keyframe: int, features: Slots, points: Slots) -> None:
        """Add observations: features of a keyframe show points."""
        self._reserve(int(self.n_obs[points].max(initial=0)) + 1)
        _link(self._observation_tables, keyframe, features, points)

    def unobserve(self, keyframes: Slots, features: Slots) -> None:
        """Remove observations; points that lose their last one are removed."""
        # the points that the features observe now, before the links are cut
        points = self.kf_point[keyframes, features].astype(np.int64)
        _unlink(self._observation_tables, keyframes, features)
        # a point without observations has nothing that holds it
        points = np.unique(points[points >= 0])
        self.remove_points(points[self.n_obs[points] == 0])

    def remove_points(self, points: Slots) -> None:
        """Remove points and their observations."""
        # cut the links of the features; the slots stay taken until `release`
        points = np.unique(points[self.alive[points]])
        self.kf_point[self.observations(points)] = -1
        self.n_obs[points] = 0
        self.alive[points] = False
        self._freed_points.extend(points.tolist())

    def replace_point(self, old: int, new: int) -> None:
        """Replace a point by another that is the same point of the scene."""
        # its observations become those of the new point
        self._reserve(int(self.n_obs[new] + self.n_obs[old]))
        _replace(self._observation_tables, old, new)
        # the frames that should have observed either one, and those that did, count for the new one
        for count in (self.visible, self.found):
            count[new] += count[old]
        self.alive[old] = False
        self._freed_points.append(old)

    def refresh(self, points: Slots) -> None:
        """Renew descriptor, viewing direction and scale range of points from their observations."""
        # compiled code reads named tuples
        views = KeyframeViews(self.kf_descriptor, self.kf_octave, self.kf_centre)
        # scale of each octave, 1 for the finest
        to_octave_0 = self.scales / self.scales[0]
        _refresh(
            points, self._point_views, self.descriptor, self._observation_tables, views, to_octave_0
        )

    def release(self) -> None:
        """Allow the slots freed so far to be used again; called once nothing refers to them any more."""
        self._free_points.extend(sorted(self._freed_points, reverse=True))
        self._freed_points.clear()

    @property
    def _observation_tables(self) -> ObservationTables:
        return ObservationTables(self.obs_kf, self.obs_ft, self.n_obs, self.kf_point)

    @property
    def _point_views(self) -> PointViews:
        return PointViews(self.position, self.normal, self.far)

    def observations(self, points: NDArray[np.integer]) -> tuple[Ints, Ints]:
        """Keyframe slots and feature numbers of the observations of points, one point after the other."""
        # row and column of each observation in the tables [M, O]
        count = self.n_obs[points].astype(np.int64)
        row = np.repeat(points, count)
        column = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return self.obs_kf[row, column], self.obs_ft[row, column]

    def _reserve(self, observations: int) -> None:
        """Make room for so many observations of a point."""
        room = self.obs_kf.shape[1]
        if observations > room:
            self._grow(("obs_kf", "obs_ft"), max(observations, room + room // 2), axis=1)

    # ------------------------------------------------------------------ views

    def project(self, T_cam_world: Array, candidates: Slots) -> VisiblePoints:
        """Project candidate points: those that a camera should see, and where.

        Args:
            T_cam_world: World-to-camera pose ``[4, 4]``.
            candidates: Slots of points.
        """
        # with a single level any factor gives octave 0
        scale_factor = float(self.scales[1] / self.scales[0]) if len(self.scales) > 1 else 1.2
        count, index, uv, right, octave, cosine = _project(
            np.ascontiguousarray(T_cam_world),
            candidates,
            self._point_views,
            intrinsics_of(self.camera),
            float(self.camera.width),
            float(self.camera.height),
            scale_factor,
            len(self.scales),
        )
        return VisiblePoints(
            index[:count], uv[:count], right[:count], octave[:count], cosine[:count]
        )

    def redundancy(self, slot: int, close_m: float) -> tuple[int, int]:
        """A keyframe's close points, and how many of them three other keyframes see, at most one octave coarser.

        All points of a keyframe without any depth count as close.
        """
        # far points are known too inexactly to make a keyframe redundant or not
        depth = self.kf_z[slot, : self.kf_count[slot]]
        if depth.any():
            close = (depth > 0) & (depth <= close_m)
        else:
            close = np.ones(len(depth), bool)
        return _redundancy(slot, close, self.kf_octave, self._observation_tables)


# ---------------------------------------------------------------------- what filters and files read


MapView: TypeAlias = tuple[tuple[KeyframeView, ...], tuple[Slots, Array]]
"""The map as filters may read it: the newest keyframes, newest first, at most `VIEWS`; ids ``[M]`` and world
positions ``[M, 3]`` in metres of all points."""


def points_in(slam_map: Map, submap: int) -> Slots:
    """Slots of the points of a submap, ascending."""
    points = slam_map.points
    return np.asarray(points[slam_map.kf_map[slam_map.obs_kf[points, 0]] == submap])


def map_outputs(slam_map: Map) -> MapOutputs:
    """Keyframes and map points for files and pictures; of points the root map's alone."""
    points = points_in(slam_map, 0)
    records = tuple(_keyframe_record(slam_map, slot) for slot in slam_map.keyframes.tolist())
    observations = slam_map.n_obs[points].astype(np.int64)
    return MapOutputs(
        records, slam_map.id[points], slam_map.position[points], slam_map.rgb[points], observations
    )


def _keyframe_record(slam_map: Map, slot: int) -> KeyframeRecord:
    """The record of a keyframe that files hold."""
    return KeyframeRecord(
        int(slam_map.kf_id[slot]),
        int(slam_map.kf_frame[slot]),
        float(slam_map.kf_stamp[slot]),
        se3.inverse(slam_map.kf_pose[slot]),
        int(slam_map.kf_count[slot]),
        int(np.count_nonzero(slam_map.kf_point[slot] >= 0)),
        int(slam_map.kf_map[slot]),
    )


class MapViews:
    """Views of a map for filters; computed again after a keyframe or in another submap.

    Args:
        slam_map: The map.
        depth_images: How many of the newest keyframes keep their depth image.
    """

    def __init__(self, slam_map: Map, depth_images: int) -> None:
        self._map = slam_map
        self._max_depth_images = depth_images
        self._depth_images: dict[int, NDArray[np.float32]] = {}
        self._computed_for: tuple[int, int] | None = None

    def add_keyframe(self, slot: int, depth: NDArray[np.float32]) -> None:
        """Keep the depth image of a new keyframe; older and culled ones lose theirs.

        Args:
            slot: The keyframe.
            depth: Metres ``[H, W]``, 0 missing.
        """
        self._depth_images[slot] = depth
        newest = self._map.keyframes[::-1][: self._max_depth_images]
        self._depth_images = {
            stored: image for stored, image in self._depth_images.items() if stored in newest
        }

    def of(self, submap: int) -> MapView:
        """View that filters get while the camera is in a submap."""
        slam_map = self._map
        # keyframes only come with `next_keyframe`: until then the view holds
        if self._computed_for != (slam_map.next_keyframe, submap):
            self._computed_for = slam_map.next_keyframe, submap
            newest = slam_map.submap(submap)[::-1][:VIEWS].tolist()
            points = points_in(slam_map, submap)
            keyframes = tuple(map(self._keyframe, newest))
            self._view: MapView = (keyframes, (slam_map.id[points], slam_map.position[points]))
        return self._view

    def _keyframe(self, slot: int) -> KeyframeView:
        """The part of a keyframe that filters may read."""
        slam_map = self._map
        n = int(slam_map.kf_count[slot])
        keypoints = Keypoints(
            slam_map.kf_raw[slot, :n],
            slam_map.kf_octave[slot, :n].astype(np.int32),
            slam_map.kf_angle[slot, :n],
            slam_map.kf_response[slot, :n],
            slam_map.kf_descriptor[slot, :n].view(np.uint8),
        )
        return KeyframeView(
            se3.inverse(slam_map.kf_pose[slot]),
            keypoints,
            slam_map.kf_xy[slot, :n],
            slam_map.kf_z[slot, :n],
            self._depth_images.get(slot),
            float(slam_map.kf_stamp[slot]),
        )


# ---------------------------------------------------------------------- compiled loops


@kernel
def _link_one(tables: ObservationTables, keyframe: int, feature: int, point: int) -> None:
    """Add an observation of a point; a second one by the same keyframe is skipped."""
    # in the point's list
    end = tables.n_obs[point]
    for o in range(end):
        if tables.obs_kf[point, o] == keyframe:
            return
    tables.obs_kf[point, end] = keyframe
    tables.obs_ft[point, end] = feature
    tables.n_obs[point] += 1
    # in the keyframe's
    tables.kf_point[keyframe, feature] = point


@kernel
def _link(tables: ObservationTables, keyframe: int, features: Slots, points: Slots) -> None:
    """Add observations of the points by the keyframe's features, where these observe nothing yet."""
    for i in range(points.shape[0]):
        if tables.kf_point[keyframe, features[i]] < 0:
            _link_one(tables, keyframe, features[i], points[i])


@kernel
def _unlink(tables: ObservationTables, keyframes: Slots, features: Slots) -> None:
    """Remove observations; the order of the others is kept."""
    obs_kf = tables.obs_kf
    obs_ft = tables.obs_ft
    for i in range(keyframes.shape[0]):
        p = tables.kf_point[keyframes[i], features[i]]
        if p < 0:
            continue
        tables.kf_point[keyframes[i], features[i]] = -1
        # close the gap in the point's list, whose order stays
        left = 0
        for o in range(tables.n_obs[p]):
            if obs_kf[p, o] != keyframes[i] or obs_ft[p, o] != features[i]:
                obs_kf[p, left] = obs_kf[p, o]
                obs_ft[p, left] = obs_ft[p, o]
                left += 1
        tables.n_obs[p] = left


@kernel
def _replace(tables: ObservationTables, old: int, new: int) -> None:
    """Move the observations of `old` to `new`; where one keyframe observes both, that of `new` stays."""
    obs_kf = tables.obs_kf
    obs_ft = tables.obs_ft
    # the feature is freed first, or it would count as taken
    for o in range(tables.n_obs[old]):
        tables.kf_point[obs_kf[old, o], obs_ft[old, o]] = -1
        _link_one(tables, obs_kf[old, o], obs_ft[old, o], new)
    tables.n_obs[old] = 0


@kernel
def _refresh(
    points: Slots,
    views: PointViews,
    descriptors: Any,
    tables: ObservationTables,
    keyframes: KeyframeViews,
    scales: Array,
) -> None:
    """Renew descriptor, viewing direction and scale range of the points from their observations.

    Args:
        points: Slots of the points.
        views: Positions, viewing directions and scale ranges of all points; the latter two are
            changed.
        descriptors: uint64 ``[M, W]`` of all points, changed.
        tables: Which features of which keyframes observe them.
        keyframes: Descriptors, octaves and centres of all keyframes.
        scales: Scale of each octave, 1 for the finest.
    """
    obs_kf = tables.obs_kf
    obs_ft = tables.obs_ft
    for i in range(points.shape[0]):
        p = points[i]
        n = tables.n_obs[points[i]]
        if n == 0:
            continue

        # descriptor: the medoid of the newest ones, by the sum of Hamming distances
        first = max(n - DESCRIBING_OBSERVATIONS, 0)
        best = n - 1
        best_score = 1 << 40
        if n > 2:
            for a in range(first, n):
                score = 0
                for b in range(first, n):
                    score += distance(
                        keyframes.descriptors[obs_kf[p, a], obs_ft[p, a]],
                        keyframes.descriptors[obs_kf[p, b], obs_ft[p, b]],
                    )
                if score < best_score:
                    best = a
                    best_score = score
        # whole rows would compile a message for shapes that differ, seconds of it
        for w in range(descriptors.shape[1]):
            descriptors[p, w] = keyframes.descriptors[obs_kf[p, best], obs_ft[p, best], w]

        # mean viewing direction, and scale range by the oldest observation: at `far` the patch that it
        # saw at its octave would have the size of octave 0
        sx = 0.0
        sy = 0.0
        sz = 0.0
        for o in range(n):
            c = keyframes.centre[obs_kf[p, o]]
            x = views.position[p, 0] - c[0]
            y = views.position[p, 1] - c[1]
            z = views.position[p, 2] - c[2]
            d = np.sqrt(x * x + y * y + z * z) + 1e-12
            sx = sx + x / d
            sy = sy + y / d
            sz = sz + z / d
            if o == 0:
                views.far[p] = d * scales[keyframes.octave[obs_kf[p, o], obs_ft[p, o]]]
        length = np.sqrt(sx * sx + sy * sy + sz * sz) + 1e-12
        views.normal[p, 0] = sx / length
        views.normal[p, 1] = sy / length
        views.normal[p, 2] = sz / length


@kernel
def _project(
    pose: Array,
    candidates: Slots,
    views: PointViews,
    camera: Intrinsics,
    width: float,
    height: float,
    scale_factor: float,
    levels: int,
) -> tuple[int, Slots, Array, Array, Slots, Array]:
    """Count the candidate points that the camera should see, and list them, see `VisiblePoints`, in longer arrays.

    They lie in the image, within their scale range (widened by `WIDEN_RANGE`) and are seen from a
    side that they were seen from before (ORB-SLAM2's ``isInFrustum``).

    Args:
        pose: World to camera ``[4, 4]``.
        candidates: Slots of the points.
        views: Positions, viewing directions and scale ranges of all points.
        camera: Intrinsics without distortion.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        scale_factor: Ratio of consecutive pyramid levels.
        levels: Number of pyramid levels.
    """
    n = candidates.shape[0]
    # results, as long as if all candidates were visible
    index = np.empty(n, np.int64)
    octave = np.empty(n, np.int64)
    uv = np.empty((n, 2))
    right = np.empty(n)
    cosine = np.empty(n)

    # camera centre in the world
    tx = pose[0, 3]
    ty = pose[1, 3]
    tz = pose[2, 3]
    ox = -(pose[0, 0] * tx + pose[1, 0] * ty + pose[2, 0] * tz)
    oy = -(pose[0, 1] * tx + pose[1, 1] * ty + pose[2, 1] * tz)
    oz = -(pose[0, 2] * tx + pose[1, 2] * ty + pose[2, 2] * tz)
    coarsest_scale = scale_factor ** (levels - 1)
    inverse_log = 1.0 / np.log(scale_factor)
    count = 0
    for i in range(n):
        # in the image
        p = candidates[i]
        xc, yc, zc = transform_point(pose, views.position[p])
        if zc < NEAR_M:
            continue
        u = camera.fx * xc / zc + camera.cx
        v = camera.fy * yc / zc + camera.cy
        if u < 0.0 or u >= width or v < 0.0 or v >= height:
            continue

        # within the scale range
        dx = views.position[p, 0] - ox
        dy = views.position[p, 1] - oy
        dz = views.position[p, 2] - oz
        d = np.sqrt(dx * dx + dy * dy + dz * dz)
        far = views.far[p]
        if d > WIDEN_RANGE * far or d * WIDEN_RANGE < far / coarsest_scale:
            continue

        # from a known side
        c = (dx * views.normal[p, 0] + dy * views.normal[p, 1] + dz * views.normal[p, 2]) / d
        if c < MIN_COSINE:
            continue

        # octave by the distance; the small term keeps exact powers at their own octave
        level = int(np.ceil(np.log(far / d) * inverse_log - 1e-9))
        octave[count] = min(max(level, 0), levels - 1)
        index[count] = p
        uv[count, 0] = u
        uv[count, 1] = v
        right[count] = u - camera.bf / zc
        cosine[count] = c
        count += 1
    return count, index, uv, right, octave, cosine


@kernel
def _redundancy(
    keyframe: int, close: NDArray[np.bool_], kf_octave: Any, tables: ObservationTables
) -> tuple[int, int]:
    """Close points that the keyframe observes, and those that `REDUNDANT_VIEWS` see, at most one octave coarser.

    Args:
        keyframe: Slot of the keyframe.
        close: bool ``[F]``, features whose depth is close.
        kf_octave: Octaves ``[S, F]`` of all keyframes' features.
        tables: Which features of which keyframes observe which points.
    """
    obs_kf = tables.obs_kf
    obs_ft = tables.obs_ft
    total = 0
    redundant = 0
    for f in range(close.shape[0]):
        p = tables.kf_point[keyframe, f]
        if p < 0 or not close[f]:
            continue
        # other keyframes that observe the point as finely, up to one octave
        total = total + 1
        fine = 0
        for o in range(tables.n_obs[p]):
            if (
                obs_kf[p, o] != keyframe
                and kf_octave[obs_kf[p, o], obs_ft[p, o]] <= kf_octave[keyframe, f] + 1
            ):
                fine += 1
        redundant += fine >= REDUNDANT_VIEWS
    return total, redundant
