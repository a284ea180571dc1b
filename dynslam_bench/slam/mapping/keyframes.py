"""When does a frame become a keyframe?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

from ..localisation.tracking import Tracked
from ..settings import KeyframeSettings
from .map import Map

Array = NDArray[np.float64]

MIN_INLIERS = 15
"""Inliers that a keyframe needs more than (ORB-SLAM2's number)."""


class KeyframeRule:
    """Decides, frame by frame, whether too little of the map is left in view, and the frame has something to add.

    Points that many keyframes observe are what counts (ORB-SLAM2's rule): on people who walk by, young points come and
    go, and a keyframe for each of them would only carry the map along with the people. Where the view itself moves on,
    the young points count as well.

    Args:
        settings: The thresholds.
        close_m: Depth below which a feature's depth is trusted, metres.
    """

    def __init__(self, settings: KeyframeSettings, close_m: float) -> None:
        self.settings = settings
        self._close_m = close_m
        self._last = -1
        self._peak = 0

    def made(self, frame: int) -> None:
        """The frame of this index has become a keyframe."""
        self._last = frame
        self._peak = 0

    def wants(self, world: Map, tracked: Tracked, frame: int, reference: int) -> bool:
        """Whether a tracked frame should become one.

        Args:
            world: The map.
            tracked: The frame, with the points that it observes.
            frame: Its index.
            reference: Slot of the keyframe that shares most points with it.
        """
        s = self.settings
        gap = frame - self._last
        if gap <= s.min_gap:
            return False
        close = (tracked.seen.z > 0) & (tracked.seen.z < self._close_m)
        known = tracked.point >= 0
        tracked_close = int(np.count_nonzero(close & known))
        new_close = int(np.count_nonzero(close & ~known))
        inliers = int(np.count_nonzero(known))
        self._peak = max(self._peak, inliers)
        if inliers <= MIN_INLIERS:
            return False
        if new_close > s.new_close and (tracked_close < s.min_close or gap >= s.max_gap):
            return True
        if inliers < s.tracked_share * established(world, reference, s.established):
            return True
        view = share_in_view(world, int(world.keyframes[-1]), tracked.T_cam_world)
        return view < s.view_share or (view < s.moved_share and inliers < s.tracked_share * self._peak)


def established(world: Map, keyframe: int, observations: int) -> int:
    """How many of a keyframe's points at least so many keyframes observe (or all of its island, if that is young)."""
    points = world.kf_point[keyframe]
    points = points[points >= 0]
    return int(
        np.count_nonzero(world.n_obs[points] >= min(observations, len(world.island(int(world.kf_island[keyframe])))))
    )


def share_in_view(world: Map, keyframe: int, T_cam_world: Array) -> float:
    """Which share of a keyframe's points lies in another camera's image; 1 if it has none."""
    points = world.kf_point[keyframe]
    local = se3.transform(T_cam_world, world.position[points[points >= 0]])
    if not len(local):
        return 1.0
    ahead = local[:, 2] > 0.05
    uv = world.camera.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
    inside = ahead & (uv >= 0).all(axis=1) & (uv[:, 0] < world.camera.width) & (uv[:, 1] < world.camera.height)
    return float(np.mean(inside))
