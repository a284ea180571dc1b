"""How a hand-held camera moves: white-noise acceleration, as a filter while tracking and a smoother afterwards.

State of the filter: position p and velocity v in the world, orientation R_cam_world and angular velocity w in the
camera frame; accelerations are white noise. The measurement is the pose that the image gives, with the Gauss-Newton
matrix of its optimisation as information. With many well-spread inliers the image decides; with few the motion does.
The smoother is the fixed-interval one of Rauch, Tung and Striebel (1965).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.pose_optimisation import apply_twist
from dynslam_bench.slam.rolling_shutter import CameraVelocity, compensate_rolling_shutter
from dynslam_bench.slam.settings import MotionModelSettings
from dynslam_bench.slam.tracking import MapFit, TrackedFrame

Array = NDArray[np.float64]

CHI2_POSE = 12.592
"""95 % quantile of chi-square with six degrees of freedom."""
_START_SPEED = np.repeat([1.0, 2.0], 3)
"""Standard deviations of velocity (m/s) and angular velocity (rad/s) when nothing is known of them."""


def pose_covariance(T_cam_world: Array, information: Array, inflation: float) -> Array:
    """Covariance ``[6, 6]`` of (position in the world, rotation in the camera frame) of a measured pose.

    Args:
        T_cam_world: The measured world-to-camera pose.
        information: Gauss-Newton matrix of (translation, rotation) for ``exp(xi) @ T_cam_world``.
        inflation: Factor on the covariance: pixel errors are not independent of each other.
    """
    j = np.zeros((6, 6))
    j[:3, :3] = -T_cam_world[:3, :3]
    j[3:, 3:] = np.eye(3)
    matrix = j.T @ information @ j / inflation
    covariance = np.linalg.inv(matrix + 1e-3 * np.eye(6))
    return np.asarray(0.5 * (covariance + covariance.T))


def _process_noise(dt: float, acceleration: float, angular_acceleration: float) -> Array:
    q = np.repeat([acceleration**2, angular_acceleration**2], 3)
    noise = np.zeros((12, 12))
    noise[:6, :6] = np.diag(q * dt**4 / 4)
    noise[:6, 6:] = noise[6:, :6] = np.diag(q * dt**3 / 2)
    noise[6:, 6:] = np.diag(q * dt**2)
    return noise


def _transition(dt: float) -> Array:
    f = np.eye(12)
    f[:6, 6:] = dt * np.eye(6)
    return f


@dataclass(eq=False)
class MotionState:
    """Pose, velocities and their covariance.

    Attributes:
        position: Camera centre in the world, metres ``[3]``.
        rotation: ``R_cam_world`` ``[3, 3]``.
        speed: Velocity in the world (m/s) and angular velocity in the camera frame (rad/s) ``[6]``.
        covariance: ``[12, 12]`` of (position, rotation, velocity, angular velocity).
    """

    position: Array
    rotation: Array
    speed: Array
    covariance: Array

    @classmethod
    def at(cls, T_cam_world: Array, covariance: Array) -> MotionState:
        """A state with known pose and unknown velocity."""
        full = np.zeros((12, 12))
        full[:6, :6] = covariance
        full[6:, 6:] = np.diag(_START_SPEED**2)
        r = T_cam_world[:3, :3]
        return cls(-r.T @ T_cam_world[:3, 3], r.copy(), np.zeros(6), full)

    @property
    def T_cam_world(self) -> Array:
        """World-to-camera pose ``[4, 4]``."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation
        pose[:3, 3] = -self.rotation @ self.position
        return pose

    def difference(self, T_cam_world: Array) -> Array:
        """(position, rotation) ``[6]`` that leads from this state's pose to another."""
        r = T_cam_world[:3, :3]
        turn = Rotation.from_matrix(r @ self.rotation.T).as_rotvec()
        return np.concatenate([-r.T @ T_cam_world[:3, 3] - self.position, turn])

    def moved(self, correction: Array, covariance: Array) -> MotionState:
        """The state after a correction ``[12]``."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation
        twist = np.concatenate([np.zeros(3), correction[3:6]])
        rotation = apply_twist(pose, twist)[:3, :3]  # keeps it orthonormal
        return MotionState(self.position + correction[:3], rotation, self.speed + correction[6:], covariance)

    def carried(self, turn: Array, factor: float) -> MotionState:
        """The same motion where the world was turned by a rotation ``[3, 3]`` and its lengths were multiplied."""
        by = np.eye(12)
        by[:3, :3] = by[6:9, 6:9] = factor * turn
        return MotionState(
            by[:3, :3] @ self.position, self.rotation @ turn.T, by[6:, 6:] @ self.speed, by @ self.covariance @ by.T
        )

    def relocated(self, T_cam_world: Array) -> MotionState:
        """The same motion at another pose, e.g. after bundle adjustment."""
        r = T_cam_world[:3, :3]
        return MotionState(-r.T @ T_cam_world[:3, 3], r.copy(), self.speed, self.covariance)

    def predicted(self, dt: float, settings: MotionModelSettings) -> MotionState:
        """The state `dt` seconds later."""
        f = _transition(dt)
        noise = _process_noise(dt, settings.acceleration, settings.angular_acceleration)
        step = np.concatenate([self.speed * dt, np.zeros(6)])
        return self.moved(step, f @ self.covariance @ f.T + noise)

    def motion_covariance(self, dt: float, settings: MotionModelSettings) -> Array:
        """Covariance ``[6, 6]`` of the motion in the next `dt` seconds.

        Of (position in the world, rotation in the camera frame); where the camera is now plays no part.
        """
        noise = _process_noise(dt, settings.acceleration, settings.angular_acceleration)
        return np.asarray(dt**2 * self.covariance[6:, 6:] + noise[:6, :6])

    def updated(self, T_cam_world: Array, covariance: Array) -> MotionState:
        """The state after a measured pose; a surprising one (chi-square) is believed more than the motion model."""
        p = self.covariance
        innovation = self.difference(T_cam_world)
        s = p[:6, :6] + covariance
        surprise = float(innovation @ np.linalg.solve(s, innovation)) / CHI2_POSE
        if surprise > 1.0:
            p = p * surprise
            s = p[:6, :6] + covariance
        gain = np.linalg.solve(s, p[:6]).T
        reduced = p - gain @ p[:6]
        return self.moved(gain @ innovation, 0.5 * (reduced + reduced.T))


def smooth(stamps: Array, T_cam_world: Array, covariances: Array, settings: MotionModelSettings) -> Array:
    """Fixed-interval smoothing of measured poses; gaps longer than `MotionModelSettings.max_gap_s` are not bridged.

    Args:
        stamps: Seconds ``[N]``, ascending.
        T_cam_world: Measured poses ``[N, 4, 4]``.
        covariances: Of `pose_covariance` ``[N, 6, 6]``.
        settings: Accelerations.

    Returns:
        Smoothed world-to-camera poses ``[N, 4, 4]``.
    """
    out = np.array(T_cam_world)
    cuts = np.flatnonzero(np.diff(stamps) > settings.max_gap_s) + 1
    for rows in np.split(np.arange(len(stamps)), cuts):
        if len(rows) > 2:
            out[rows] = _smooth_part(stamps[rows], T_cam_world[rows], covariances[rows], settings)
    return out


def _smooth_part(stamps: Array, poses: Array, covariances: Array, settings: MotionModelSettings) -> Array:
    state = MotionState.at(poses[0], covariances[0])
    filtered, predicted, steps = [state], [state], np.diff(stamps)
    for k in range(1, len(stamps)):
        ahead = state.predicted(float(steps[k - 1]), settings)
        state = ahead.updated(poses[k], covariances[k])
        predicted.append(ahead)
        filtered.append(state)
    out = np.empty_like(poses)
    out[-1] = state.T_cam_world
    later = state
    for k in range(len(stamps) - 2, -1, -1):
        ahead = predicted[k + 1]
        f = _transition(float(steps[k]))
        gain = np.linalg.solve(ahead.covariance, f @ filtered[k].covariance).T
        error = np.concatenate([ahead.difference(later.T_cam_world), later.speed - ahead.speed])
        covariance = filtered[k].covariance + gain @ (later.covariance - ahead.covariance) @ gain.T
        later = filtered[k].moved(gain @ error, covariance)
        out[k] = later.T_cam_world
    return out


# Where the camera should be now: the motion model's state from frame to frame, and what stamps it believes.


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
        self.last_speeds: CameraVelocity | None = None
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

    def regular(self, last: TrackedFrame, timestamp: float) -> float:
        """The stamp, or where it is within `JITTER` of a regular one, the regular one."""
        due = abs(timestamp - last.timestamp - self._interval) <= JITTER * self._interval
        return last.timestamp + self._interval if due else timestamp

    def predicted(self, last: TrackedFrame, timestamp: float, settings: MotionModelSettings) -> Array:
        """World-to-camera pose at a time; that of the last tracked frame where nothing is known of the gap."""
        ahead = self._ahead(last, timestamp, settings)
        return last.T_cam_world if ahead is None else ahead.T_cam_world

    def speeds(
        self, last: TrackedFrame, timestamp: float, settings: MotionModelSettings, pose: Array | None = None
    ) -> CameraVelocity | None:
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
        return (
            self.last_speeds
            if pose is None
            else CameraVelocity.between(last.T_cam_world, pose, self._exposed_apart(dt))
        )

    def covariance(self, last: TrackedFrame, timestamp: float, settings: MotionModelSettings) -> Array | None:
        """How far the motion since the last frame may be from the predicted one (`MotionState.motion_covariance`)."""
        dt = self._known_gap(last, timestamp, settings)
        return None if dt is None or self._state is None else self._state.motion_covariance(dt, settings)

    def filtered(
        self, last: TrackedFrame, timestamp: float, measured: Array, information: Array, settings: MotionModelSettings
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

    def _ahead(self, last: TrackedFrame, timestamp: float, settings: MotionModelSettings) -> MotionState | None:
        dt = self._known_gap(last, timestamp, settings)
        return None if dt is None or self._state is None else self._state.predicted(dt, settings)

    def _known_gap(self, last: TrackedFrame, timestamp: float, settings: MotionModelSettings) -> float | None:
        """Seconds since the last frame; None where the motion model says nothing of them."""
        dt = timestamp - last.timestamp
        return dt if self._state is not None and 0 < dt <= settings.max_gap_s else None


# Frames of a rolling shutter while tracking: straightened by the motion before, then by what their own pose tells.

STILL_AGREE = 0.9
"""Share of the points that agreed before which must agree with straightened features, too."""


class RollingShutterCompensation:
    """Straightens the features of frames that follow a tracked one.

    Args:
        world: The map that poses are fitted to.
        camera: Intrinsics without distortion, and `readout_s`.
        motion: The motion model; its `last_speeds` is what the frame before told.
    """

    def __init__(self, world: Map, camera: Camera, motion: CameraMotion) -> None:
        self._world, self._camera, self._motion = world, camera, motion

    def foreseen(
        self, seen: Observations, last: TrackedFrame, timestamp: float, settings: MotionModelSettings
    ) -> Observations:
        """The features as a global shutter would have shown them, if the camera goes on as in the last frame."""
        speeds = self._motion.speeds(last, timestamp, settings)
        return seen if speeds is None else compensate_rolling_shutter(seen, self._camera, speeds)

    def refitted(
        self, raw: Observations, seen: Observations, fit: MapFit, last: TrackedFrame, timestamp: float,
        settings: MotionModelSettings, *, anyhow: bool = False,
    ) -> tuple[Observations, MapFit, CameraVelocity | None]:  # fmt: skip
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
        moved = compensate_rolling_shutter(raw, self._camera, speeds)
        again = fit.again(self._world, moved)
        if again.count < STILL_AGREE * fit.count and not anyhow:
            return seen, fit, None
        return moved, again, speeds
