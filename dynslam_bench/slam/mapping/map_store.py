"""The map that a back end works on, from and to a file; there and back changes no bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.geometry.camera import Camera

from ..localisation.observation import Observations
from .islands import UNIT_MAY_DIFFER, Island, Islands
from .map import Map
from .saved_map import (
    FEATURE_ARRAYS,
    KEYFRAME_ARRAYS,
    OBSERVATION_ARRAYS,
    POINT_ARRAYS,
    MapFeatures,
    MapHeader,
    SavedMap,
    Sensors,
    described,
    read_map,
    write_map,
)
from .saved_map_faults import Arrays

Array = NDArray[np.float64]
UNKNOWN_FRAME = -1
"""Frame of a keyframe that is of another run; its stamp is NaN."""


def begin_map(file: str, camera: Camera, features: MapFeatures, *, depth: bool) -> tuple[Map, Islands]:
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
        return Map(camera, features.scales), Islands(stretch=1.0 if depth else UNIT_MAY_DIFFER)
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


def save(path: Path, world: Map, islands: Islands, features: MapFeatures, *, depth: bool, made_by: str = "") -> None:
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
    write_map(path, SavedMap(header, packed(world, islands)))


def _sensors(depth: bool) -> Sensors:
    return "rgbd" if depth else "rgb"


def packed(world: Map, islands: Islands) -> dict[str, NDArray[Any]]:
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
    every = islands.all()
    found["island_start"] = np.array([each.start for each in every]).reshape(-1, 3)
    found["island_anchor"] = np.array([each.anchor for each in every]).reshape(-1, 3)
    found["island_reach"] = np.array([each.reach_m for each in every], np.float64)
    return found


def restored(saved: SavedMap, camera: Camera, scales: Array) -> tuple[Map, Islands]:
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
    return world, Islands(_islands(arrays), stretch=stretch)


def _table(rows: NDArray[Any], counts: NDArray[Any]) -> NDArray[Any]:
    """Rows that follow each other, so many for each line of a table, as that table; the rest is zero."""
    width = int(counts.max(initial=0))
    table = np.zeros((len(counts), width, *rows.shape[1:]), rows.dtype)
    table[np.arange(width) < counts[:, None]] = rows
    return table


def _islands(arrays: Arrays) -> list[Island]:
    each = zip(arrays["island_start"], arrays["island_anchor"], arrays["island_reach"], strict=True)
    return [Island(start.copy(), anchor.copy(), float(reach)) for start, anchor, reach in each]
