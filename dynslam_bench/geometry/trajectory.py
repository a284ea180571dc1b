"""Trajectories: stamped camera-to-world poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrajectoryError

from . import se3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Stamped poses in order of time; it may have holes.

    Attributes:
        timestamps: Seconds, float64 ``[N]``, strictly increasing.
        T_world_cam: Camera-to-world poses, float64 ``[N, 4, 4]``.
    """

    timestamps: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]

    def __post_init__(self) -> None:
        stamps = np.ascontiguousarray(self.timestamps, dtype=np.float64)
        poses = np.ascontiguousarray(self.T_world_cam, dtype=np.float64).reshape(-1, 4, 4)
        if stamps.shape != (len(poses),):
            raise TrajectoryError(f"a trajectory has {stamps.size} stamps but {len(poses)} poses")
        if not np.isfinite(stamps).all() or not np.isfinite(poses).all():
            raise TrajectoryError("a trajectory holds values that are not finite")
        if (np.diff(stamps) <= 0).any():
            at = int(np.argmax(np.diff(stamps) <= 0))
            raise TrajectoryError(f"stamps are not strictly increasing: {stamps[at]:.6f} then {stamps[at + 1]:.6f}")
        object.__setattr__(self, "timestamps", stamps)
        object.__setattr__(self, "T_world_cam", poses)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Camera centres in the world, metres ``[N, 3]``."""
        return self.T_world_cam[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between consecutive positions, metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def select(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> Trajectory:
        """The poses at an index, mask or slice."""
        return Trajectory(self.timestamps[index], self.T_world_cam[index])

    def transformed(self, T_new_world: NDArray[np.float64]) -> Trajectory:
        """The same trajectory in another world frame: ``T_new_world @ T_world_cam``."""
        return Trajectory(self.timestamps, T_new_world @ self.T_world_cam)

    def relative_to_first(self) -> Trajectory:
        """The trajectory in the frame of its own first pose."""
        return self.transformed(se3.inverse(self.T_world_cam[0]))
