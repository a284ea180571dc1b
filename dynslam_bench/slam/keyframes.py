"""When does a frame become a keyframe?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.motion_model import pose_covariance, smooth
from dynslam_bench.slam.settings import KeyframeSettings, MotionModelSettings
from dynslam_bench.slam.table_space import TableSpace
from dynslam_bench.slam.tracking import TrackedFrame

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

    def wants(self, world: Map, tracked: TrackedFrame, frame: int, reference: int) -> bool:
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
    """How many of a keyframe's points at least so many keyframes observe (or all of its submap, if that is young)."""
    points = world.kf_point[keyframe]
    points = points[points >= 0]
    return int(
        np.count_nonzero(world.n_obs[points] >= min(observations, len(world.submap(int(world.kf_map[keyframe])))))
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


# The poses of all tracked frames, each kept relative to a keyframe so that later refinement moves it along.


TABLES = ("_stamp", "_reference", "_relative", "_information")
RESTS = 64
"""After so many frames those before them may leave the memory."""


class TrajectoryHistory:
    """Frames with stamp, reference keyframe and pose relative to it; grows by doubling.

    Args:
        space: Where its tables have room to grow.
    """

    def __init__(self, space: TableSpace) -> None:
        self.count = 0
        self._space = space
        self._stamp = np.zeros(64)
        self._reference = np.zeros(64, np.int32)
        self._relative = np.zeros((64, 4, 4))
        self._information = np.zeros((64, 6, 6), np.float32)

    def append(self, stamp: float, reference: int, T_cam_ref: Array, information: Array) -> None:
        """Note a tracked frame: stamp, reference keyframe's slot, ``T_cam_ref`` and the information of the pose."""
        if self.count == len(self._stamp):
            for name in TABLES:
                setattr(self, name, self._space.grown(f"history{name}", getattr(self, name), 2 * self.count))
        if self.count % RESTS == 0:
            self._space.rest(*(f"history{name}" for name in TABLES))
        self._stamp[self.count] = stamp
        self._reference[self.count] = reference
        self._relative[self.count] = T_cam_ref
        self._information[self.count] = information
        self.count += 1

    def see_from(self, world: Map, reference: int, T_cam_world: Array) -> None:
        """The newest frame's pose is known from another keyframe, with its world."""
        self._reference[self.count - 1] = reference
        self._relative[self.count - 1] = T_cam_world @ se3.inverse(world.kf_pose[reference])

    def inherit(self, dropped: int, heir: int, T_dropped_heir: Array) -> None:
        """Re-anchor the frames of a removed keyframe."""
        rows = np.flatnonzero(self._reference[: self.count] == dropped)
        self._relative[rows] = self._relative[rows] @ T_dropped_heir
        self._reference[rows] = heir

    def rescale(self, factors: Mapping[int, float]) -> None:
        """Lengths around keyframes were multiplied by factors: so are the ways of their frames from them.

        Args:
            factors: Of each keyframe's slot; keyframes that are not named keep their lengths.
        """
        for reference, factor in factors.items():
            rows = np.flatnonzero(self._reference[: self.count] == reference)
            self._relative[rows, :3, 3] *= factor
            self._information[rows, :3] /= factor
            self._information[rows, :, :3] /= factor

    def poses(self, world: Map) -> tuple[Array, Array, Array]:
        """Stamps ``[N]``, ``T_cam_world`` ``[N, 4, 4]`` with the present keyframes, information ``[N, 6, 6]``.

        Frames of submaps that never met the first map are left out: where they were taken in its world is unknown.
        """
        rows = np.flatnonzero(world.kf_map[self._reference[: self.count]] == 0)
        poses = self._relative[rows] @ world.kf_pose[self._reference[rows]]
        return self._stamp[rows], poses, self._information[rows].astype(np.float64)

    def trajectory(self, world: Map, motion: MotionModelSettings) -> Trajectory:
        """Camera-to-world poses in the order of their stamps, smoothed where the settings say so."""
        stamps, poses, information = self.poses(world)
        order = np.argsort(stamps, kind="stable")
        fresh = np.r_[True, np.diff(stamps[order]) > 0] if len(order) else np.zeros(0, bool)
        rows = order[fresh]
        stamps, poses = stamps[rows], poses[rows]
        if motion.smooth and len(stamps) > 2:
            spread = [pose_covariance(*pair, motion.inflation) for pair in zip(poses, information[rows], strict=True)]
            poses = smooth(stamps, poses, np.array(spread), motion)
        return Trajectory(stamps, se3.inverse(poses))
