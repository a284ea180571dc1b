"""What filters, files and the sheet may see of the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import KeyframeView
from dynslam_bench.contracts.tracker import KeyframeRecord, MapOutputs
from dynslam_bench.slam.local_mapping import LocalMapper
from dynslam_bench.slam.map import Map

Array = NDArray[np.float64]


class MapViews:
    """Keyframes and points of a map, looked up anew only after a keyframe: little else changes the map.

    Args:
        world: The map.
        mapper: Who may have refined it for the end of a run, which a run that goes on takes back.
    """

    def __init__(self, world: Map, mapper: LocalMapper) -> None:
        self._world = world
        self._mapper = mapper
        self._depth_images: dict[int, NDArray[np.float32]] = {}
        self._views: dict[tuple[int, int, bool], tuple[KeyframeView, ...]] = {}
        self._clouds: dict[tuple[int, bool], tuple[NDArray[np.int64], Array]] = {}

    def renew(self, slot: int, depth: NDArray[np.float32], dropped: list[int], depth_images: int) -> None:
        """A keyframe was made.

        Args:
            slot: Its slot.
            depth: Its depth image.
            dropped: Slots of the keyframes that went.
            depth_images: How many of the newest keyframes keep their depth image.
        """
        self._views.clear()
        self._clouds.clear()
        for gone in dropped:
            self._depth_images.pop(gone, None)
        self._depth_images[slot] = depth
        for old in self._world.keyframes[: -depth_images or None].tolist():
            self._depth_images.pop(old, None)

    def keyframes(self, limit: int, submap: int) -> tuple[KeyframeView, ...]:
        """The newest keyframes of an submap, newest first, at most `limit`: where others lie is unknown there."""
        key = limit, submap, self._mapper.refined
        if key not in self._views:
            newest = self._world.submap(submap)[::-1][: max(limit, 0)].tolist()
            self._views[key] = tuple(self._keyframe(slot) for slot in newest)
        return self._views[key]

    def points(self, submap: int) -> tuple[NDArray[np.int64], Array]:
        """Ids ``[M]`` and world positions ``[M, 3]`` in metres of all map points of an submap."""
        key = submap, self._mapper.refined
        if key not in self._clouds:
            points = self._of(submap)
            self._clouds[key] = self._world.id[points], self._world.position[points]
        return self._clouds[key]

    def _of(self, submap: int) -> NDArray[np.int64]:
        """Slots of the points of an submap."""
        world, points = self._world, self._world.points
        return np.asarray(points[world.kf_map[world.obs_kf[world.obs_at[points]]] == submap])

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for ``keyframes.csv``, ``map.ply`` and the sheet; no points of unjoined submaps."""
        world, points = self._world, self._of(0)
        records = tuple(_record(world, slot) for slot in world.keyframes.tolist())
        observations = world.n_obs[points].astype(np.int64)
        return MapOutputs(records, world.id[points], world.position[points], world.rgb[points], observations)

    def _keyframe(self, slot: int) -> KeyframeView:
        world, n = self._world, int(self._world.kf_count[slot])
        keypoints = Keypoints(
            world.kf_raw[slot, :n],
            world.kf_octave[slot, :n].astype(np.int32),
            world.kf_angle[slot, :n],
            world.kf_response[slot, :n],
            world.kf_words[slot, :n].view(np.uint8),
        )
        return KeyframeView(
            world.T_world_cam(slot),
            keypoints,
            world.kf_xy[slot, :n],
            world.kf_z[slot, :n],
            self._depth_images.get(slot),
            float(world.kf_stamp[slot]),
        )


def _record(world: Map, slot: int) -> KeyframeRecord:
    count = int(world.kf_count[slot])
    return KeyframeRecord(
        int(world.kf_id[slot]),
        int(world.kf_frame[slot]),
        float(world.kf_stamp[slot]),
        world.T_world_cam(slot),
        count,
        int(np.count_nonzero(world.kf_point[slot, :count] >= 0)),
        int(world.kf_map[slot]),
    )
