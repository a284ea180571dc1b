"""Where the camera should be now: the motion model's state from frame to frame, and what stamps it believes."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from ..settings import MotionModelSettings
from .motion_model import MotionState, pose_covariance
from .rolling_shutter import Speeds
from .tracking import Tracked

Array = NDArray[np.float64]

FIRST_INTERVAL_S = 1 / 30
"""Taken for the interval between frames until one was measured."""
JITTER = 0.1
"""Share of the last interval by which a stamp may be off and still count as regular: the noise of stamping."""

STAMPING = 0.25
"""Share of the usual interval by which a stamp may be off that was given after the exposure (TUM's are off by 0.2)."""
GAPS = 15
"""So many intervals tell the usual one."""


class CameraMotion:
    """The motion model while tracking; it knows nothing at the start and after a lost frame.

    Args:
        readout_s: Seconds that the camera takes to read out a frame: no two are exposed less apart.

    Attributes:
        last_speeds: How the world moved past a rolling shutter in the last tracked frame; None where it is not known.
    """

    def __init__(self, readout_s: float = 0.0) -> None:
        self._readout_s = readout_s
        self._state: MotionState | None = None
        self._interval = FIRST_INTERVAL_S
        self.last_speeds: Speeds | None = None
        self._gaps: deque[float] = deque(maxlen=GAPS)

    def forget(self) -> None:
        """The camera was lost: nothing is known of its motion."""
        self._state = self.last_speeds = None

    def relocated(self, T_cam_world: Array) -> None:
        """The same motion at another pose, as after bundle adjustment."""
        if self._state is not None:
            self._state = self._state.relocated(T_cam_world)

    def carried(self, T_cam_before: Array, T_cam_now: Array, factor: float) -> None:
        """The same motion after a loop was closed.

        Args:
            T_cam_before: World-to-camera pose of a keyframe nearby as it was before.
            T_cam_now: That pose now.
            factor: What lengths around it were multiplied by.
        """
        if self._state is not None:
            self._state = self._state.carried(T_cam_now[:3, :3].T @ T_cam_before[:3, :3], factor)

    def regular(self, last: Tracked, timestamp: float) -> float:
        """The stamp, or where it is within `JITTER` of a regular one, the regular one."""
        due = abs(timestamp - last.timestamp - self._interval) <= JITTER * self._interval
        return last.timestamp + self._interval if due else timestamp

    def predicted(self, last: Tracked, timestamp: float, settings: MotionModelSettings) -> Array:
        """World-to-camera pose at a time; that of the last tracked frame where nothing is known of the gap."""
        ahead = self._ahead(last, timestamp, settings)
        return last.T_cam_world if ahead is None else ahead.T_cam_world

    def speeds(
        self, last: Tracked, timestamp: float, settings: MotionModelSettings, pose: Array | None = None
    ) -> Speeds | None:
        """How the world moves past the camera during a frame; None where nothing is known of it, or need be.

        Not the filter's: that takes the acceleration as constant between frames, and follows a hand by swinging about
        the true speed from one frame to the next.

        Args:
            last: The last tracked frame.
            timestamp: The frame's stamp, seconds.
            settings: Of the motion model.
            pose: The frame's world-to-camera pose, if it was found already; else it goes on as it went before.
        """
        dt = timestamp - last.timestamp
        if not (self._readout_s and 0 < dt <= settings.max_gap_s):
            return None
        return self.last_speeds if pose is None else Speeds.between(last.T_cam_world, pose, self._exposed_apart(dt))

    def covariance(self, last: Tracked, timestamp: float, settings: MotionModelSettings) -> Array | None:
        """How far the motion since the last frame may be from the predicted one (`MotionState.motion_covariance`)."""
        dt = self._known_gap(last, timestamp, settings)
        return None if dt is None or self._state is None else self._state.motion_covariance(dt, settings)

    def filtered(
        self, last: Tracked, timestamp: float, measured: Array, information: Array, settings: MotionModelSettings
    ) -> Array:
        """Weigh the image's pose against the motion model, and remember the motion.

        Args:
            last: The last tracked frame.
            timestamp: The stamp of the new one, seconds.
            measured: Its world-to-camera pose by the image.
            information: Gauss-Newton matrix of that pose.
            settings: Of the motion model.

        Returns:
            World-to-camera pose; the measured one where nothing is known of the gap, or the filter is off.
        """
        covariance = pose_covariance(measured, information, settings.inflation)
        dt, ahead = self._known_gap(last, timestamp, settings), self._ahead(last, timestamp, settings)
        if dt is None or ahead is None:
            self._state = MotionState.at(measured, covariance)
            return measured
        self._interval = dt
        self._gaps.append(dt)
        self._state = ahead.updated(measured, covariance)
        return self._state.T_cam_world if settings.filter else measured

    def _exposed_apart(self, dt: float) -> float:
        """Seconds between two exposures: a camera ticks evenly however its frames were stamped, and reads out each."""
        tick = float(np.median(self._gaps)) if self._gaps else dt
        ticks = round(dt / tick) * tick
        return max(ticks if abs(dt - ticks) <= STAMPING * tick else dt, self._readout_s)

    def _ahead(self, last: Tracked, timestamp: float, settings: MotionModelSettings) -> MotionState | None:
        dt = self._known_gap(last, timestamp, settings)
        return None if dt is None or self._state is None else self._state.predicted(dt, settings)

    def _known_gap(self, last: Tracked, timestamp: float, settings: MotionModelSettings) -> float | None:
        """Seconds since the last frame; None where the motion model says nothing of them."""
        dt = timestamp - last.timestamp
        return dt if self._state is not None and 0 < dt <= settings.max_gap_s else None
