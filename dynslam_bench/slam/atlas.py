"""The atlas: the root map and the submaps that begin after the camera was lost; saved maps.

As in ORB-SLAM3 (Campos et al., 2021) a camera that is not relocalised begins a new submap, which is
merged when a place of another map is recognised. Keyframes and points of all maps lie in one `Map`
(`Map.kf_map` says which is whose; 0 is the root map). The atlas knows where an unmerged submap may
lie, `loop_closing` merges it. Poses count in the world of the root map alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.slam.map import Array, Map
from dynslam_bench.slam.map_files import (
    FEATURE_ARRAYS,
    KEYFRAME_ARRAYS,
    OBSERVATION_ARRAYS,
    POINT_ARRAYS,
    MapFeatures,
    MapHeader,
    SavedMap,
    described,
    read_map,
    write_map,
)

MAX_UNIT_RATIO = 10.0
"""Without depth each map has its own unit of length, the median depth of its first views: their largest ratio."""
UNKNOWN_FRAME = -1
"""Frame of a keyframe that is of another run; its stamp is NaN."""
TABLE_OF_ARRAY = {"kf_words": "kf_descriptor", "words": "descriptor"}
"""The map's tables that have another name in files."""


@dataclass(frozen=True, eq=False)
class Submap:
    """A map that is not connected with the root map.

    Attributes:
        start: Camera centre of its first frame in its own world ``[3]``, metres.
        anchor: Camera centre where the root map was left ``[3]``, in that map's world, metres.
        bound_m: How far from there it began, at most.
        slack: How far its world may be rotated against the root map's, radians; any angle if it
            comes from a file.
    """

    start: Array
    anchor: Array
    bound_m: float
    slack: float = np.pi


class Atlas:
    """The root map and all submaps, by number.

    Args:
        slam_map: Keyframes and points of all maps.
        submaps: Submaps of a loaded map; they get the numbers from 1 on.
        unit_ratio: Factor by which units of length of two maps may differ: 1 with depth.

    Attributes:
        map: Keyframes and points of all maps.
        active: Number of the map that the camera is in, or was in last.
        submaps: The submaps by number, merged ones included.
    """

    def __init__(
        self, slam_map: Map, submaps: Iterable[Submap] = (), *, unit_ratio: float = 1.0
    ) -> None:
        self.map = slam_map
        self.active = 0
        self._unit_ratio = unit_ratio
        self.submaps = dict(enumerate(submaps, 1))

    def begin_submap(self, start: Array, bound_m: float, slack: float = np.pi) -> None:
        """A submap begins where the camera was lost, as far as is known, and becomes the active one.

        Args:
            start: Camera centre in the map that was active ``[3]``; the submap takes it for that of
                its first frame.
            bound_m: How far the camera may have moved since it was lost.
            slack: How far the submap's directions may be rotated against those of the map that was
                active, radians.
        """
        # the new map's uncertainty adds to that of the map where the camera was lost
        slack = min(slack + self.slack(self.active, 0), np.pi)
        submap = Submap(start.copy(), *self._from_root(self.active, start, bound_m), slack)
        self.active = 1 + len(self.submaps)
        self.submaps[self.active] = submap

    def move_nearby(self, number: int, T_before: Array, T_after: Array, scales: Array) -> None:
        """Keyframes of a map were moved: what is known of places in its world moves with the nearest keyframe.

        Args:
            number: The submap, or 0.
            T_before: World-to-camera poses ``[K, 4, 4]`` of its keyframes until now.
            T_after: World-to-camera poses ``[K, 4, 4]`` of these keyframes from now on.
            scales: What lengths around each were multiplied by ``[K]``.
        """
        centres = se3.inverse(T_before)[:, :3, 3]
        for other, submap in self.submaps.items():
            if number not in (0, other):
                continue
            # the place in that map's world: a submap began at its start, and left the root map at its anchor
            place = submap.start if number else submap.anchor
            nearest = int(np.linalg.norm(centres - place, axis=1).argmin())
            scale = float(scales[nearest])

            # it stays where it is as seen from the nearest keyframe
            T_world_cam = se3.inverse(T_after[nearest])
            moved = se3.transform(T_world_cam, scale * se3.transform(T_before[nearest], place))
            rotation = float(se3.rotation_angle(T_world_cam @ T_before[nearest]))
            slack = min(submap.slack + rotation, np.pi)
            if number:
                self.submaps[other] = replace(submap, start=moved, slack=slack)
            else:
                self.submaps[other] = replace(
                    submap, anchor=moved, bound_m=scale * submap.bound_m, slack=slack
                )

    def slack(self, one: int, other: int) -> float:
        """Largest rotation of the worlds of two maps against each other, radians."""
        if one == other:
            return 0.0
        # the root map has none
        slacks = [self.submaps[number].slack for number in (one, other) if number in self.submaps]
        return float(sum(slacks))

    def reachable(
        self, left: int, there: int, last_centre: Array, centre: Array, bound_m: float
    ) -> bool:
        """Whether a camera can have moved from one place to another.

        Args:
            left: The map in which it was tracked last.
            there: The map of the place; nothing is known of the way to submaps other than `left`.
            last_centre: Its centre then ``[3]``.
            centre: Its centre at the place ``[3]``.
            bound_m: How far it may have moved.
        """
        # within one map by the straight distance; to the root map by what is known of the submap's place
        if there == left:
            return bool(np.linalg.norm(centre - last_centre) <= bound_m)
        if there != 0:
            return False
        anchor, bound = self._from_root(left, last_centre, bound_m)
        return bool(np.linalg.norm(centre - anchor) <= bound)

    def admits_start(
        self, number: int, moved: Callable[[Array], Array], drift_m: float = 0.0
    ) -> bool:
        """Whether a submap can have begun where a merge would put its start.

        Args:
            number: The submap.
            moved: Where in the root map's world the merge puts a place ``[3]`` of the submap,
                ``[3]``.
            drift_m: Distance by which drift may have put it too far away, in units of the root map.
        """
        # the start must lie within the bound around the place where the root map was left
        submap = self.submaps[number]
        return bool(np.linalg.norm(moved(submap.start) - submap.anchor) <= submap.bound_m + drift_m)

    def _from_root(self, left: int, last: Array, bound_m: float) -> tuple[Array, float]:
        """Place where the root map was left ``[3]``, and how far from there the camera can be now.

        Args:
            left: The map in which the camera was tracked last.
            last: Its centre then ``[3]``.
            bound_m: How far it may have moved since.
        """
        submap = self.submaps.get(left)
        if submap is None:
            return last.copy(), bound_m
        # to the submap's beginning, then within it, then since it was left
        within_m = float(np.linalg.norm(last - submap.start))
        return submap.anchor, submap.bound_m + self._unit_ratio * within_m + bound_m


# ---------------------------------------------------------------------- from and to a file


def open_atlas(file: str, camera: Camera, features: MapFeatures, *, depth: bool) -> Atlas:
    """The atlas that a run begins with: that of a file, or an empty one where none is named.

    Args:
        file: The file, or an empty text.
        camera: Undistorted intrinsics of the run.
        features: The features of its frames.
        depth: Whether they have depth.

    Raises:
        SettingsError: The file cannot be read, is no map, or one of another camera, features or
            sensor.
    """
    scales = features.scales(camera.width)
    if not file:
        return Atlas(Map(camera, scales), unit_ratio=1.0 if depth else MAX_UNIT_RATIO)
    path = Path(file).expanduser()
    saved = read_map(path)
    saved.check(camera, features, "rgbd" if depth else "rgb", str(path))
    return unpacked(saved, camera, scales)


def save_atlas(
    path: Path,
    atlas: Atlas,
    slam_map: Map,
    features: MapFeatures,
    *,
    depth: bool,
    made_by: str = "",
) -> None:
    """Write the atlas to a file; `open_atlas` restores every bit.

    Args:
        path: The file.
        atlas: The atlas.
        slam_map: Its keyframes and points, or a refined copy of them.
        features: The features that it is made of.
        depth: Whether they have depth.
        made_by: Which run made it, in words.

    Raises:
        TrackerError: There is no map yet, or it is too large for a file.
        DynslamError: The file cannot be written.
    """
    if not slam_map.next_keyframe:
        raise TrackerError("there is no map to save: no frame has begun one")
    header = MapHeader(
        sensors="rgbd" if depth else "rgb",
        camera=described(slam_map.camera),
        features=features,
        next_keyframe=slam_map.next_keyframe,
        next_point=slam_map.next_point,
        made_by=made_by[:1000],
    )
    write_map(path, SavedMap(header, packed(slam_map, atlas.submaps.values())))


def packed(slam_map: Map, submaps: Collection[Submap]) -> dict[str, NDArray[Any]]:
    """The arrays of a map and its submaps, as `map_files` describes them."""
    # keyframes and points, oldest first; features of each keyframe, without the unused columns
    slots = slam_map.keyframes
    points = slam_map.points
    points = points[np.argsort(slam_map.id[points], kind="stable")]
    features = np.arange(slam_map.kf_point.shape[1]) < slam_map.kf_count[slots][:, None]
    arrays = {name: _table(slam_map, name)[slots] for name in KEYFRAME_ARRAYS}
    arrays |= {name: _table(slam_map, name)[slots][features] for name in FEATURE_ARRAYS}
    arrays |= {name: _table(slam_map, name)[points] for name in POINT_ARRAYS}

    # observations, one point after the other; they name keyframes by row
    keyframe, feature = slam_map.observations(points)
    row_of_keyframe = np.zeros(slam_map.kf_alive.size, np.int32)
    row_of_keyframe[slots] = np.arange(len(slots))
    arrays["obs_kf"] = row_of_keyframe[keyframe]
    arrays["obs_ft"] = feature

    # where each submap began, and how far it may lie from there
    places = np.array([(submap.start, submap.anchor) for submap in submaps]).reshape(-1, 2, 3)
    arrays["submap_start"] = places[:, 0]
    arrays["submap_anchor"] = places[:, 1]
    arrays["submap_bound"] = np.array([submap.bound_m for submap in submaps], np.float64)
    return arrays


def _table(slam_map: Map, name: str) -> NDArray[Any]:
    """The map's table that files hold under a name."""
    return np.asarray(getattr(slam_map, TABLE_OF_ARRAY.get(name, name)))


def unpacked(saved: SavedMap, camera: Camera, scales: Array) -> Atlas:
    """The atlas of a file.

    Args:
        saved: What was read; it has to fit the camera and the features.
        camera: Undistorted intrinsics.
        scales: Pixels of the image in a pixel of each octave.
    """
    arrays = saved.arrays
    header = saved.header
    count = arrays["kf_count"]
    n_obs = arrays["n_obs"]

    # what the file holds, each keyframe's features and each point's observations in a row of a table
    tables = {name: arrays[name].copy() for name in (*KEYFRAME_ARRAYS, *POINT_ARRAYS)}
    tables |= {name: _padded(arrays[name], count) for name in FEATURE_ARRAYS}
    tables |= {name: _padded(arrays[name], n_obs) for name in OBSERVATION_ARRAYS}

    # what the file leaves out, as it follows from the rest or is of another run
    tables["kf_point"] = np.full(tables["kf_octave"].shape, -1, np.int32)
    tables["kf_point"][arrays["obs_kf"], arrays["obs_ft"]] = np.repeat(np.arange(len(n_obs)), n_obs)
    tables["kf_alive"] = np.ones(len(count), bool)
    tables["alive"] = np.ones(len(n_obs), bool)
    tables["kf_frame"] = np.full(len(count), UNKNOWN_FRAME, np.int64)
    tables["kf_stamp"] = np.full(len(count), np.nan)
    tables["kf_centre"] = np.zeros((len(count), 3))
    for name, table in TABLE_OF_ARRAY.items():
        tables[table] = tables.pop(name)
    slam_map = Map(camera, scales)
    slam_map.take_over(tables, header.next_keyframe, header.next_point)

    # where each submap began, and how far it may lie from there
    submaps: list[Submap] = []
    for start, anchor, bound in zip(
        arrays["submap_start"], arrays["submap_anchor"], arrays["submap_bound"], strict=True
    ):
        submaps.append(Submap(start.copy(), anchor.copy(), float(bound)))
    return Atlas(slam_map, submaps, unit_ratio=1.0 if header.sensors == "rgbd" else MAX_UNIT_RATIO)


def _padded(rows: NDArray[Any], counts: NDArray[np.integer]) -> NDArray[Any]:
    """A table ``[N, most, ...]`` with the first `counts` ``[N]`` places of each line filled from the rows in turn.

    The other places are 0.
    """
    # row r uses its first counts[r] places; a mask fills them row by row
    in_use = np.arange(int(counts.max(initial=1))) < counts[:, None]
    table = np.zeros((*in_use.shape, *rows.shape[1:]), rows.dtype)
    table[in_use] = rows
    return table
