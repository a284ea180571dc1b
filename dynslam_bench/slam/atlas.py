"""Maps of their own, begun after the camera was lost where nothing was recognised: where they may lie."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_files import (
    FEATURE_ARRAYS,
    KEYFRAME_ARRAYS,
    OBSERVATION_ARRAYS,
    POINT_ARRAYS,
    Arrays,
    MapFeatures,
    MapHeader,
    SavedMap,
    Sensors,
    described,
    read_map,
    write_map,
)
from dynslam_bench.slam.observation import Observations

Array = NDArray[np.float64]

UNIT_MAY_DIFFER = 10.0
"""Without depth the unit of length is the median depth of the first views: so many times another's it may be."""


@dataclass(frozen=True, eq=False)
class Submap:
    """A map that is connected with the first one by nothing.

    Attributes:
        start: Camera centre of its first frame in its own world ``[3]``, metres.
        anchor: Camera centre where the first map was left ``[3]``, in that map's world, metres.
        reach_m: How far from there it began, at most.
        slack: How far its world may be turned against the first map's, radians; any angle if it comes from a file.
    """

    start: Array
    anchor: Array
    reach_m: float
    slack: float = np.pi


class Atlas:
    """All submaps so far, by number (`Map.kf_map`).

    Args:
        known: Those of a loaded map, from number 1 on.
        stretch: How many times longer a way on an submap may be than it looks: without depth each has its own unit.
    """

    def __init__(self, known: Iterable[Submap] = (), *, stretch: float = 1.0) -> None:
        self._submaps = dict(enumerate(known, 1))
        self._stretch = stretch

    def all(self) -> list[Submap]:
        """All of them in the order of their numbers."""
        return [*self._submaps.values()]

    def begin(self, left: int, start: Array, reach_m: float, slack: float = np.pi) -> int:
        """A new submap begins where the camera was lost, as far as anybody knows.

        Args:
            left: The submap, or 0, in which the camera was tracked last.
            start: Camera centre there ``[3]``; the new submap takes it for that of its own first frame.
            reach_m: How far the camera may have gone since.
            slack: How far the directions that it has there may be turned against those of the submap left, radians.

        Returns:
            Its number.
        """
        number = 1 + len(self._submaps)
        turned = min(slack + self.slack(left, 0), np.pi)
        self._submaps[number] = Submap(start.copy(), *self._from_first(left, start, reach_m), turned)
        return number

    def carried(self, number: int, before: Array, after: Array, scales: Array) -> None:
        """Keyframes of an submap, or 0, were moved: so was what is known of places in its world, with the nearest.

        Args:
            number: The submap.
            before: World-to-camera poses ``[K, 4, 4]`` of its keyframes until now.
            after: Those from now on.
            scales: What lengths around each were multiplied by ``[K]``.
        """
        centres = se3.inverse(before)[:, :3, 3]
        for each, submap in self._submaps.items():
            if number not in (0, each):
                continue
            place = submap.start if number else submap.anchor
            nearest = int(np.linalg.norm(centres - place, axis=1).argmin())
            local = scales[nearest] * se3.transform(before[nearest], place)
            now, scale = se3.transform(se3.inverse(after[nearest]), local), float(scales[nearest])
            turned = float(se3.rotation_angle(se3.inverse(after[nearest]) @ before[nearest]))
            slack = min(submap.slack + turned, np.pi)
            self._submaps[each] = (
                replace(submap, start=now, slack=slack)
                if number
                else replace(submap, anchor=now, reach_m=scale * submap.reach_m, slack=slack)
            )

    def slack(self, one: int, other: int) -> float:
        """How far the worlds of two submaps, or 0, may be turned against each other, radians."""
        if one == other:
            return 0.0
        return float(sum(self._submaps[each].slack for each in (one, other) if each in self._submaps))

    def within(self, left: int, there: int, last: Array, now: Array, reach_m: float) -> bool:
        """Whether a camera can have got from one place to another.

        Args:
            left: The submap, or 0, in which it was tracked last.
            there: The submap, or 0, of the place where it may be now; of others nothing is known.
            last: Its centre then ``[3]``.
            now: Its centre now.
            reach_m: How far it may have gone.
        """
        anchor, most = (last, reach_m) if there == left else self._from_first(left, last, reach_m)
        return there in (left, 0) and bool(np.linalg.norm(now - anchor) <= most)

    def admits_start(self, number: int, moved: Callable[[Array], Array], drift_m: float = 0.0) -> bool:
        """Whether an submap can have begun where it would come to lie in the first map's world.

        Args:
            number: The submap.
            moved: Where in the first map's world a place ``[3]`` of the submap's would come to lie, ``[3]``.
            drift_m: By how much drift may have put it too far away.
        """
        submap = self._submaps[number]
        return bool(np.linalg.norm(moved(submap.start) - submap.anchor) <= submap.reach_m + drift_m)

    def _from_first(self, left: int, last: Array, reach_m: float) -> tuple[Array, float]:
        """Where the first map was left, and how far from there the camera can be now."""
        submap = self._submaps.get(left)
        if submap is None:
            return last.copy(), reach_m
        way = self._stretch * float(np.linalg.norm(last - submap.start))
        return submap.anchor, submap.reach_m + way + reach_m


# The map that a back end works on, from and to a file; there and back changes no bit.

UNKNOWN_FRAME = -1
"""Frame of a keyframe that is of another run; its stamp is NaN."""


def begin_map(file: str, camera: Camera, features: MapFeatures, *, depth: bool) -> tuple[Map, Atlas]:
    """The map that a run begins with: that of a file, or an empty one where none is named.

    Args:
        file: The file, or an empty text.
        camera: Undistorted intrinsics of the run.
        features: What its frames bring.
        depth: Whether they have depth.

    Raises:
        SettingsError: The file cannot be read, is no map, or one of another camera, features or sensor.
    """
    if not file:
        return Map(camera, features.scales), Atlas(stretch=1.0 if depth else UNIT_MAY_DIFFER)
    path = Path(file).expanduser()
    saved = read_map(path)
    saved.check(camera, features, _sensors(depth), str(path))
    return restored(saved, camera, features.scales)


def check_descriptors(world: Map, seen: Observations, frame: int) -> None:
    """Make sure that a frame's features can be found in a map.

    Raises:
        TrackerError: Their descriptors are not those of the map.
    """
    if len(seen) and 8 * seen.words.shape[1] != world.descriptor_bytes:
        raise TrackerError(
            f"the map's descriptors have {world.descriptor_bytes} bytes, frame {frame}'s {8 * seen.words.shape[1]}",
            "make the map with the same features",
        )


def save(path: Path, world: Map, submaps: Atlas, features: MapFeatures, *, depth: bool, made_by: str = "") -> None:
    """Write a map, with all that `begin` asks for.

    Raises:
        TrackerError: There is no map yet, or it is too large for a file.
        DynslamError: The file cannot be written.
    """
    if not world.next_keyframe:
        raise TrackerError("there is no map to save: no frame has begun one")
    header = MapHeader(
        sensors=_sensors(depth),
        camera=described(world.camera),
        features=features,
        next_keyframe=world.next_keyframe,
        next_point=world.next_point,
        made_by=made_by[:1000],
    )
    write_map(path, SavedMap(header, packed(world, submaps)))


def _sensors(depth: bool) -> Sensors:
    return "rgbd" if depth else "rgb"


def packed(world: Map, submaps: Atlas) -> dict[str, NDArray[Any]]:
    """The arrays of a map, as `saved_map` describes them."""
    slots, points = world.keyframes, world.points
    points = points[np.argsort(world.id[points], kind="stable")]
    features = np.arange(world.kf_point.shape[1]) < world.kf_count[slots][:, None]
    observations = world.observations(points)
    found = {name: getattr(world, name)[slots] for name in KEYFRAME_ARRAYS}
    found |= {name: getattr(world, name)[slots][features] for name in FEATURE_ARRAYS}
    found |= {name: getattr(world, name)[points] for name in POINT_ARRAYS}
    row_of_point = np.full(world.alive.size + 1, -1, np.int32)  # the last one stands for "no point"
    row_of_point[points] = np.arange(len(points))
    row_of_keyframe = np.zeros(world.kf_alive.size, np.int32)
    row_of_keyframe[slots] = np.arange(len(slots))
    found["kf_point"] = row_of_point[found["kf_point"]]
    found["obs_kf"] = row_of_keyframe[world.obs_kf[observations]]
    found["obs_ft"] = world.obs_ft[observations]
    every = submaps.all()
    found["submap_start"] = np.array([each.start for each in every]).reshape(-1, 3)
    found["submap_anchor"] = np.array([each.anchor for each in every]).reshape(-1, 3)
    found["submap_reach"] = np.array([each.reach_m for each in every], np.float64)
    return found


def restored(saved: SavedMap, camera: Camera, scales: Array) -> tuple[Map, Atlas]:
    """The map of a file, ready to be worked on.

    Args:
        saved: What was read; it has to fit the camera and the features.
        camera: Undistorted intrinsics.
        scales: Scale of each octave.
    """
    arrays, header = saved.arrays, saved.header
    count, n_obs = arrays["kf_count"], arrays["n_obs"]
    tables = {name: arrays[name].copy() for name in (*KEYFRAME_ARRAYS, *POINT_ARRAYS)}
    tables |= {name: _table(arrays[name], count) for name in FEATURE_ARRAYS}
    tables["kf_point"][np.arange(tables["kf_point"].shape[1]) >= count[:, None]] = -1
    tables |= {name: arrays[name].copy() for name in OBSERVATION_ARRAYS}
    tables["obs_at"], tables["obs_room"] = np.cumsum(n_obs, dtype=np.int64) - n_obs, n_obs.copy()
    tables["kf_alive"], tables["alive"] = np.ones(len(count), bool), np.ones(len(n_obs), bool)
    tables["kf_frame"] = np.full(len(count), UNKNOWN_FRAME, np.int64)
    tables["kf_stamp"] = np.full(len(count), np.nan)
    tables["kf_centre"] = np.zeros((len(count), 3))
    world = Map(camera, scales)
    world.take_over(tables, header.next_keyframe, header.next_point)
    stretch = 1.0 if header.sensors == "rgbd" else UNIT_MAY_DIFFER
    return world, Atlas(_submaps(arrays), stretch=stretch)


def _table(rows: NDArray[Any], counts: NDArray[Any]) -> NDArray[Any]:
    """Rows that follow each other, so many for each line of a table, as that table; the rest is zero."""
    width = int(counts.max(initial=0))
    table = np.zeros((len(counts), width, *rows.shape[1:]), rows.dtype)
    table[np.arange(width) < counts[:, None]] = rows
    return table


def _submaps(arrays: Arrays) -> list[Submap]:
    each = zip(arrays["submap_start"], arrays["submap_anchor"], arrays["submap_reach"], strict=True)
    return [Submap(start.copy(), anchor.copy(), float(reach)) for start, anchor, reach in each]
