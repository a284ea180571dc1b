"""Trajectories: stamped camera-to-world poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import TrajectoryError
from dynslam_bench.geometry.stamps import LEAST_GAP_NS, NS_PER_S, format_ns, from_seconds, ns_of

T = TypeVar("T", bound="Trajectory")


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Stamped poses in order of time; it may have holes.

    Attributes:
        timestamps: Seconds, float64 ``[N]``, strictly increasing.
        T_world_cam: Camera-to-world poses, float64 ``[N, 4, 4]``.
        exact_ns: The `timestamps` in nanoseconds, int64 ``[N]``, where they are known to more digits
            than a float holds; None where the floats are all that is known.
    """

    timestamps: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]
    exact_ns: NDArray[np.int64] | None = None
    _may_repeat: ClassVar[bool] = False

    def __post_init__(self) -> None:
        # stamps and poses, as many of each, finite
        stamps = np.ascontiguousarray(self.timestamps, dtype=np.float64)
        poses = np.ascontiguousarray(self.T_world_cam, dtype=np.float64).reshape(-1, 4, 4)
        if stamps.shape != (len(poses),):
            raise TrajectoryError(f"a trajectory has {stamps.size} stamps but {len(poses)} poses")
        if not np.isfinite(stamps).all() or not np.isfinite(poses).all():
            raise TrajectoryError("a trajectory holds values that are not finite")

        # stamps in order of time
        steps = np.diff(stamps)
        wrong = steps < 0 if self._may_repeat else steps <= 0
        if wrong.any():
            at = int(np.argmax(wrong))
            raise TrajectoryError(
                f"stamps are not strictly increasing: {stamps[at]:.9f} then {stamps[at + 1]:.9f}"
            )

        # the class is frozen
        object.__setattr__(self, "timestamps", stamps)
        object.__setattr__(self, "T_world_cam", poses)
        if self.exact_ns is not None:
            object.__setattr__(
                self, "exact_ns", np.ascontiguousarray(self.exact_ns, dtype=np.int64)
            )
            if len(self.timestamps_ns) != len(stamps):
                raise TrajectoryError(
                    f"a trajectory has {stamps.size} stamps but {len(self.timestamps_ns)} in ns"
                )

        # stamps that differ as floats may be one number of nanoseconds
        if len(stamps) > 1 and steps.min() * NS_PER_S < LEAST_GAP_NS and not self._may_repeat:
            gaps = np.diff(self.timestamps_ns)
            at = int(gaps.argmin())
            if gaps[at] <= 0:
                first, second = (format_ns(int(ns)) for ns in self.timestamps_ns[at : at + 2])
                raise TrajectoryError(
                    f"stamps are not strictly increasing in nanoseconds: {first} then {second}"
                )

    def __len__(self) -> int:
        return len(self.timestamps)

    @cached_property
    def timestamps_ns(self) -> NDArray[np.int64]:
        """Stamps in nanoseconds, int64 ``[N]``: what files hold."""
        return from_seconds(self.timestamps.tolist()) if self.exact_ns is None else self.exact_ns

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
        exact = None if self.exact_ns is None else self.exact_ns[index]
        return type(self)(self.timestamps[index], self.T_world_cam[index], exact)

    def with_poses(self: T, T_world_cam: NDArray[np.float64]) -> T:
        """Other poses ``[N, 4, 4]`` at the same stamps."""
        return type(self)(self.timestamps, T_world_cam, self.exact_ns)

    def with_exact(self, exact: Mapping[float, int]) -> Trajectory:
        """This trajectory with the nanoseconds of those stamps that a table of seconds to nanoseconds holds."""
        stamps = self.timestamps.tolist()
        if exact.keys().isdisjoint(stamps):
            return self
        ns = [exact[stamp] if stamp in exact else ns_of(stamp) for stamp in stamps]
        return Trajectory(self.timestamps, self.T_world_cam, np.array(ns, dtype=np.int64))


class RepeatedStamps(Trajectory):
    """Poses of which several may have the same stamp, in the order of their file."""

    _may_repeat = True
