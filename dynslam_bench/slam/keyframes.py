"""Keyframes: when a frame becomes one, and the view of keyframes and points that filters and files get."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import KeyframeView
from dynslam_bench.contracts.tracker import KeyframeRecord, MapOutputs
from dynslam_bench.geometry import se3
from dynslam_bench.slam.map import Array, Map, Slots
from dynslam_bench.slam.settings import KeyframeSettings
from dynslam_bench.slam.tracking import TrackedFrame

MIN_INLIERS = 15
"""Inliers that a keyframe needs more than (ORB-SLAM2's number)."""
ESTABLISHED = 3
"""Keyframes that observe an established point at least."""
MIN_CLOSE, NEW_CLOSE = 100, 70
"""A keyframe is made when fewer close points are tracked and more close features are not in the map (ORB-SLAM2)."""
VIEW_SHARE = 0.9
"""A keyframe is made when less than this share of the last keyframe's points lies in the image."""
MOVED_SHARE = 0.97
"""The view has moved when less than this share of the last keyframe's points lies in the image."""
VIEWS = 20
"""Newest keyframes that filters may read (DynaSLAM's window)."""
DEPTH_IMAGES = 8
"""Newest keyframes that keep their depth image, for filters."""


class KeyframePolicy:
    """Decides whether a tracked frame becomes a keyframe: too little of the map is in view, and the frame adds to it.

    Points that many keyframes observe count (ORB-SLAM2's rule). On moving people young points come and go, and a
    keyframe for each of them would carry the map along with the people. Where the view itself moves on, young points
    count as well.

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

    def needed(self, world: Map, tracked: TrackedFrame, frame: int, reference: int) -> bool:
        """Whether a tracked frame should become a keyframe.

        Args:
            world: The map.
            tracked: The frame, with the points that it observes.
            frame: Its index.
            reference: Slot of the keyframe that shares most points with it.
        """
        s, gap = self.settings, frame - self._last
        if gap <= 0:
            return False
        close = (tracked.observations.z > 0) & (tracked.observations.z < self._close_m)
        matched = tracked.point >= 0
        inliers = int(np.count_nonzero(matched))
        self._most_inliers = max(self._most_inliers, inliers)
        if inliers <= MIN_INLIERS:
            return False
        few_close = np.count_nonzero(close & matched) < MIN_CLOSE
        if np.count_nonzero(close & ~matched) > NEW_CLOSE and (few_close or gap >= s.max_gap):
            return True
        if inliers < s.tracked_share * established_points(world, reference):
            return True
        view = share_in_view(world, int(np.where(world.kf_alive, world.kf_id, -1).argmax()), tracked.T_cam_world)
        return view < VIEW_SHARE or (view < MOVED_SHARE and inliers < s.tracked_share * self._most_inliers)


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


class MapView(NamedTuple):
    """What filters may read of the map.

    Attributes:
        keyframes: The newest keyframes, newest first, at most `VIEWS`.
        ids: int64 ``[M]``, ids of all points.
        positions: World positions ``[M, 3]`` of the points, metres.
    """

    keyframes: tuple[KeyframeView, ...]
    ids: Slots
    positions: Array


class MapViews:
    """Views of a map for filters, made again after a keyframe or in another submap, and for files.

    Args:
        world: The map.
        depth_images: How many of the newest keyframes keep their depth image.
    """

    def __init__(self, world: Map, depth_images: int) -> None:
        self._world = world
        self._most_images = depth_images
        self._depth_images: dict[int, NDArray[np.float32]] = {}
        self._made_for: tuple[int, int] | None = None

    def add_keyframe(self, slot: int, depth: NDArray[np.float32]) -> None:
        """A keyframe was made; those that were culled for it lose their depth images."""
        self._depth_images[slot] = depth
        newest = self._world.keyframes[::-1][: self._most_images]
        self._depth_images = {at: image for at, image in self._depth_images.items() if at in newest}

    def of(self, submap: int) -> MapView:
        """What filters see while the camera is in a submap."""
        world = self._world
        if self._made_for != (world.next_keyframe, submap):
            self._made_for = world.next_keyframe, submap
            newest, points = world.submap(submap)[::-1][:VIEWS].tolist(), self._points_of(submap)
            self._view = MapView(tuple(map(self._keyframe, newest)), world.id[points], world.position[points])
        return self._view

    def outputs(self) -> MapOutputs:
        """Keyframes and map points for files and pictures; of points the root map's alone."""
        world, points = self._world, self._points_of(0)
        records = tuple(
            KeyframeRecord(
                int(world.kf_id[slot]),
                int(world.kf_frame[slot]),
                float(world.kf_stamp[slot]),
                se3.inverse(world.kf_pose[slot]),
                int(world.kf_count[slot]),
                int(np.count_nonzero(world.kf_point[slot] >= 0)),
                int(world.kf_map[slot]),
            )
            for slot in world.keyframes.tolist()
        )
        observations = world.n_obs[points].astype(np.int64)
        return MapOutputs(records, world.id[points], world.position[points], world.rgb[points], observations)

    def _points_of(self, submap: int) -> Slots:
        world, points = self._world, self._world.points
        return np.asarray(points[world.kf_map[world.obs_kf[world.obs_at[points]]] == submap])

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
            se3.inverse(world.kf_pose[slot]),
            keypoints,
            world.kf_xy[slot, :n],
            world.kf_z[slot, :n],
            self._depth_images.get(slot),
            float(world.kf_stamp[slot]),
        )
