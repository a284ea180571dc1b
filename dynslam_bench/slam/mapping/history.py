"""The poses of all tracked frames, each kept relative to a keyframe so that later refinement moves it along."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

from ..localisation.motion_model import pose_covariance, smooth
from ..settings import MotionModelSettings
from .map import Map
from .table_space import TableSpace

Array = NDArray[np.float64]

TABLES = ("_stamp", "_reference", "_relative", "_information")
RESTS = 64
"""After so many frames those before them may leave the memory."""


class History:
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

        Frames of islands that never met the first map are left out: where they were taken in its world is unknown.
        """
        rows = np.flatnonzero(world.kf_island[self._reference[: self.count]] == 0)
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
