"""What a keyframe that sees a place again asks for: to be elsewhere, and without depth of another size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

Array = NDArray[np.float64]

AGREE_M, AGREE_DEG, AGREE_SCALE = 0.1, 2.0, 0.1
"""So far the corrections of keyframes in a row may differ; of a scale, its logarithm."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What a keyframe asks for.

    Attributes:
        T_cam_before: Its pose ``[4, 4]`` as the map has it, world to camera.
        T_cam_now: Its pose by the place that it sees again.
        scale: What lengths around it are to be multiplied by.
    """

    T_cam_before: Array
    T_cam_now: Array
    scale: float

    @property
    def T_now_before(self) -> Array:
        """From the keyframe's world, once its lengths are multiplied, to that of the place, ``[4, 4]``."""
        before = self.T_cam_before.copy()
        before[:3, 3] *= self.scale
        return se3.inverse(self.T_cam_now) @ before

    @property
    def inverse(self) -> Correction:
        """What the place asks for where it is the keyframe that stays."""
        return Correction(self.T_cam_now, self.T_cam_before, 1 / self.scale)

    def moved(self, at: Array) -> Array:
        """Where a place ``[3]`` near the keyframe belongs, ``[3]``."""
        local = self.scale * se3.transform(self.T_cam_before, at[None])
        return np.asarray(se3.transform(se3.inverse(self.T_cam_now), local)[0])

    def agrees(self, other: Correction, at: Array) -> bool:
        """Whether another correction moves a place nearly as this one does."""
        apart = np.linalg.norm(self.moved(at) - other.moved(at))
        turned = se3.rotation_angle(self.T_now_before @ se3.inverse(other.T_now_before))
        scaled = abs(np.log(self.scale / other.scale))
        return bool(apart < AGREE_M and np.degrees(turned) < AGREE_DEG and scaled < AGREE_SCALE)


@dataclass(frozen=True)
class Loop:
    """A place that was recognised.

    Attributes:
        keyframe: Slot, at that time, of the keyframe that was seen again.
        frame: Index of that keyframe's frame.
        T_cam_world: Pose ``[4, 4]`` of the newest keyframe by the points around it, world to camera.
        inliers: Points that fit it.
        share: How many of the keyframe's own points in view are among them, of one.
        joins: Whether the place lies on another island of the map.
        moved_m: How far the newest keyframe is from where it was believed to be.
        turned_deg: By how much it is turned, degrees.
        scale: What lengths around the newest keyframe are to be multiplied by; 1 with depth.
        fits: Whether the island could come to lie so; without depth its lengths may have drifted apart on the way.
    """

    keyframe: int
    frame: int
    T_cam_world: Array
    inliers: int
    share: float
    joins: bool
    moved_m: float
    turned_deg: float
    scale: float
    fits: bool = True
