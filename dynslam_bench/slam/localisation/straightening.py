"""Frames of a rolling shutter while tracking: straightened by the motion before, then by what their own pose tells."""

from __future__ import annotations

import numpy as np

from dynslam_bench.geometry.camera import Camera

from ..mapping.map import Map
from ..settings import MotionModelSettings
from .camera_motion import CameraMotion
from .observation import Observations
from .rolling_shutter import Speeds, as_seen_at_once
from .tracking import MapFit, Tracked

STILL_AGREE = 0.9
"""Share of the points that agreed before which must agree with straightened features, too."""


class Straightening:
    """Straightens the features of frames that follow a tracked one.

    Args:
        world: The map that poses are fitted to.
        camera: Intrinsics without distortion, and `readout_s`.
        motion: The motion model; its `last_speeds` is what the frame before told.
    """

    def __init__(self, world: Map, camera: Camera, motion: CameraMotion) -> None:
        self._world, self._camera, self._motion = world, camera, motion

    def foreseen(
        self, seen: Observations, last: Tracked, timestamp: float, settings: MotionModelSettings
    ) -> Observations:
        """The features as a global shutter would have shown them, if the camera goes on as in the last frame."""
        speeds = self._motion.speeds(last, timestamp, settings)
        return seen if speeds is None else as_seen_at_once(seen, self._camera, speeds)

    def refitted(
        self, raw: Observations, seen: Observations, fit: MapFit, last: Tracked, timestamp: float,
        settings: MotionModelSettings, *, anyhow: bool = False,
    ) -> tuple[Observations, MapFit, Speeds | None]:  # fmt: skip
        """The features straightened by what the frame's pose tells, the pose fitted to them, and the motion.

        A pose that jumps, as at a cut, tells no motion: where fewer points agree then, all stays as it was.

        Args:
            raw: The features as they were found.
            seen: The same as foreseen.
            fit: The pose so far, fitted to those.
            last: The last tracked frame.
            timestamp: The frame's stamp, seconds.
            settings: Of the motion model.
            anyhow: Whether points may disagree: before the first frame is straightened they have to.
        """
        pose = fit.estimate.T_cam_world
        speeds = self._motion.speeds(last, timestamp, settings, pose) if np.isfinite(pose).all() else None
        if speeds is None:
            return seen, fit, None
        moved = as_seen_at_once(raw, self._camera, speeds)
        again = fit.again(self._world, moved)
        if again.count < STILL_AGREE * fit.count and not anyhow:
            return seen, fit, None
        return moved, again, speeds
