"""What hints are made from: poses between their stamps, and how well positions can be aligned."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HintId = Literal[
    "several-recordings",
    "inverted-poses",
    "quaternion-order",
    "inverted-rotations",
    "camera-axes",
    "time-shift",
    "scale",
    "below-truth-noise",
]


@dataclass(frozen=True)
class Hint:
    """A probable fault of an estimate.

    Attributes:
        id: Which.
        text: One line: what was measured, and the cure.
        numbers: What was measured, by name with its unit.
    """

    id: HintId
    text: str
    numbers: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.id}: {self.text}"


class Track:
    """Poses between their stamps.

    Args:
        stamps: Seconds ``[N]``, ascending.
        poses: ``[N, 4, 4]``.
    """

    def __init__(self, stamps: Array, poses: Array) -> None:
        self.stamps, self.poses = stamps, poses
        self.positions = np.ascontiguousarray(poses[:, :3, 3])
        steps = np.diff(self.stamps)
        self.step = float(np.median(steps)) if len(steps) else 0.0
        self._holes = np.append(steps > max(0.1, 3 * self.step), True)

    def covers(self, stamps: Array) -> NDArray[np.bool_]:
        """Whether stamps lie within its time and in no hole ``[...]``."""
        after = np.searchsorted(self.stamps, stamps, side="right") - 1
        exact = self.stamps[after.clip(0)] == stamps
        return np.asarray((after >= 0) & (~self._holes[after] | exact))

    def positions_at(self, stamps: Array) -> Array:
        """Positions ``[..., 3]``, on straight lines between the stamps."""
        axes = [np.interp(stamps, self.stamps, self.positions[:, axis]) for axis in range(3)]
        return np.stack(axes, axis=-1)

    def at(self, stamps: Array) -> Array:
        """Poses ``[N, 4, 4]``: these positions, with the rotation of the pose that is nearest in time."""
        poses = self.poses[self.nearest(stamps)]
        poses[:, :3, 3] = self.positions_at(stamps)
        return poses

    def nearest(self, stamps: Array) -> NDArray[np.intp]:
        """Which poses are nearest in time ``[N]``."""
        after = np.searchsorted(self.stamps, stamps).clip(1, len(self.stamps) - 1)
        return np.asarray(after - (stamps - self.stamps[after - 1] < self.stamps[after] - stamps))


@dataclass(frozen=True)
class Fit:
    """How well positions can be aligned, from their moments: Umeyama 1991, Eq. 40-43.

    Attributes:
        scale: Of the Sim(3) alignment.
        se3_m: Root mean square error after the SE(3) alignment, metres; exact to 1e-8.
        sim3_m: The same after the Sim(3) alignment.
        extent_m: The same of a camera that stands still.
    """

    scale: float
    se3_m: float
    sim3_m: float
    extent_m: float

    @property
    def misfit(self) -> float:
        """The error after the Sim(3) alignment over that of a camera that stands still, in [0, 1]."""
        return self.sim3_m / self.extent_m if self.extent_m > 0 else 1.0


def fit(poses: Array, truth: Array) -> Fit:
    """How well the positions of poses ``[N, 4, 4]`` can be aligned with those of the true ones."""
    own, true = (each[:, :3, 3] - each[:, :3, 3].mean(axis=0) for each in (poses, truth))
    u, singular, vt = np.linalg.svd(true.T @ own / len(own))
    explained = singular[0] + singular[1] + np.sign(np.linalg.det(u) * np.linalg.det(vt)) * singular[2]
    size, extent = float((own**2).sum() / len(own)), float((true**2).sum() / len(own))
    scale = max(float(explained), 0.0) / size if size > 0 else 1.0
    errors = (size + extent - 2 * explained, extent - scale * explained)
    se3_m, sim3_m = (float(np.sqrt(max(error, 0.0))) for error in errors)
    return Fit(scale, se3_m, sim3_m, float(np.sqrt(extent)))
