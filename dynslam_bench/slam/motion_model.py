"""Model of a hand-held camera's motion: white-noise acceleration, as a filter while tracking and a smoother afterwards.

State of the filter: position p and velocity v in the world, orientation R_cam_world and angular
velocity w in the camera frame; accelerations are white noise. The measurement is the pose that the
image gives, with the Gauss-Newton matrix of its optimisation as information. With many well-spread
inliers the image decides; with few the motion does. The smoother is the fixed-interval one of
Rauch, Tung and Striebel (1965); it makes the final trajectory.

Each row of a rolling shutter's image is exposed a little later than the one above it: a moving
camera has another pose in every row. Features are therefore moved to where the camera of the middle
row, whose pose is the frame's, would have seen them. The motion is taken as constant within a frame
(the model of Hedborg et al., Rolling Shutter Bundle Adjustment, CVPR 2012, applied before the pose
is fitted instead of in it).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel
from dynslam_bench.features.matching import CellGrid
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.geometry.gauss_newton import apply_twist
from dynslam_bench.slam.map import Array, Map
from dynslam_bench.slam.observations import Observations, right_coordinates
from dynslam_bench.slam.pose_optimisation import Intrinsics, intrinsics_of
from dynslam_bench.slam.settings import MotionModelSettings
from dynslam_bench.slam.tracking import (
    MapFit,
    TrackedFrame,
    fit_pose,
)

CHI2_POSE = 12.592
"""95 % quantile of chi-square with six degrees of freedom."""
INFLATION = 100.0
"""Factor on the covariance of a measured pose: pixel errors are not independent of each other."""
MAX_GAP_S = 0.25
"""After a longer gap between frames nothing is assumed of the motion."""
FIRST_INTERVAL_S = 1 / 30
"""Interval between frames until one was measured."""
JITTER = 0.1
"""Share of the last interval by which a stamp may be off and still count as regular: the noise of stamping."""
INTERVALS = 15
"""The latest intervals that are kept."""
MIN_AGREEING = 0.9
"""Share of the inliers before compensation that must be inliers after it."""
STAMP_NOISE = 0.25
"""Largest error of a stamp that was given after the exposure, as a share of the usual interval (TUM: up to 0.2)."""
_START_SPEED = np.repeat([1.0, 2.0], 3)
"""Standard deviations of velocity (m/s) and angular velocity (rad/s) when nothing is known of them."""


def pose_covariance(T_cam_world: Array, information: Array, inflation: float = INFLATION) -> Array:
    """Covariance ``[6, 6]`` of a measured pose: position in the world (m), rotation in the camera frame (rad).

    Args:
        T_cam_world: The measured world-to-camera pose.
        information: Gauss-Newton matrix of (translation, rotation) for ``exp(xi) @ T_cam_world``.
        inflation: Factor on the covariance, see `INFLATION`.
    """
    # derivative of the twist by (position in the world, rotation in the camera frame)
    j = np.zeros((6, 6))
    j[:3, :3] = -T_cam_world[:3, :3]
    j[3:, 3:] = np.eye(3)
    # the small term keeps directions finite that the image does not determine
    covariance = np.linalg.inv(j.T @ information @ j / inflation + 1e-3 * np.eye(6))
    return np.asarray(0.5 * (covariance + covariance.T))


def _process_noise(dt: float, settings: MotionModelSettings) -> Array:
    """Covariance ``[12, 12]`` that an acceleration, constant for `dt` seconds, adds to a `MotionState`."""
    # an acceleration a moves by a t^2 / 2 and adds a t to the speed
    variance = np.repeat([settings.acceleration**2, settings.angular_acceleration**2], 3)
    noise = np.zeros((12, 12))
    pose = np.arange(6)
    speed = np.arange(6, 12)
    noise[pose, pose] = variance * dt**4 / 4
    noise[speed, speed] = variance * dt**2
    noise[pose, speed] = noise[speed, pose] = variance * dt**3 / 2
    return noise


def _rotated(rotation: Array, vector: Array) -> Array:
    """A rotation matrix ``[3, 3]`` rotated further by a rotation vector ``[3]``, and kept orthonormal."""
    pose = np.eye(4)
    twist = np.zeros(6)
    pose[:3, :3] = rotation
    twist[3:] = vector
    return apply_twist(pose, twist)[:3, :3]


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
        r = T_cam_world[:3, :3]
        unknown = np.zeros((6, 6))
        full = np.block([[covariance, unknown], [unknown, np.diag(_START_SPEED**2)]])
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
        t = T_cam_world[:3, 3]
        return np.concatenate([-r.T @ t - self.position, se3.rotation_vectors(r @ self.rotation.T)])

    def moved(self, correction: Array, covariance: Array) -> MotionState:
        """The state after a correction ``[12]``."""
        rotation = _rotated(self.rotation, correction[3:6])
        return MotionState(
            self.position + correction[:3], rotation, self.speed + correction[6:], covariance
        )

    def transformed(self, rotation: Array, scale: float) -> MotionState:
        """The state after the world was rotated by ``[3, 3]`` and its lengths were multiplied by `scale`."""
        # position, velocity and their covariance; rotation and angular velocity are the camera's
        by = np.eye(12)
        by[:3, :3] = by[6:9, 6:9] = scale * rotation
        return MotionState(
            by[:3, :3] @ self.position,
            self.rotation @ rotation.T,
            by[6:, 6:] @ self.speed,
            by @ self.covariance @ by.T,
        )

    def predicted(self, dt: float, settings: MotionModelSettings) -> MotionState:
        """The state `dt` seconds later."""
        # constant velocity; accelerations are noise
        f = np.eye(12) + dt * np.eye(12, k=6)
        covariance = f @ self.covariance @ f.T + _process_noise(dt, settings)
        return self.moved(np.append(self.speed * dt, np.zeros(6)), covariance)

    def motion_covariance(self, dt: float, settings: MotionModelSettings) -> Array:
        """Covariance ``[6, 6]`` of the motion in the next `dt` seconds.

        Of (position in the world, rotation in the camera frame); where the camera is now plays no
        part.
        """
        return np.asarray(dt**2 * self.covariance[6:, 6:] + _process_noise(dt, settings)[:6, :6])

    def updated(self, T_cam_world: Array, covariance: Array) -> MotionState:
        """The state after a measured pose; one beyond the chi-square limit inflates the predicted covariance."""
        # chi-square of the innovation; an unlikely one means that the motion was predicted too confidently
        p = self.covariance
        innovation = self.difference(T_cam_world)
        chi2 = float(innovation @ np.linalg.solve(p[:6, :6] + covariance, innovation))
        excess = chi2 / CHI2_POSE
        if excess > 1.0:
            p = p * excess

        # Kalman gain and update
        gain = np.linalg.solve(p[:6, :6] + covariance, p[:6]).T
        reduced = p - gain @ p[:6]
        return self.moved(gain @ innovation, 0.5 * (reduced + reduced.T))


def smooth(
    stamps: Array, T_cam_world: Array, covariances: Array, settings: MotionModelSettings
) -> Array:
    """Fixed-interval smoothing of measured poses; gaps longer than `MAX_GAP_S` are not bridged.

    Args:
        stamps: Seconds ``[N]``, ascending.
        T_cam_world: Measured poses ``[N, 4, 4]``.
        covariances: Covariances of the poses ``[N, 6, 6]``, see `pose_covariance`.
        settings: Accelerations.

    Returns:
        Smoothed world-to-camera poses ``[N, 4, 4]``.
    """
    # parts without gaps, each by itself
    out = np.array(T_cam_world)
    cuts = np.flatnonzero(np.diff(stamps) > MAX_GAP_S) + 1
    for rows in np.split(np.arange(len(stamps)), cuts):
        if len(rows) > 2:
            out[rows] = _smooth_segment(
                stamps[rows], T_cam_world[rows], covariances[rows], settings
            )
    return out


def _smooth_segment(
    stamps: Array, poses: Array, covariances: Array, settings: MotionModelSettings
) -> Array:
    """`smooth` within a part without gaps.

    Args:
        stamps: Seconds ``[N]``, ascending.
        poses: Measured world-to-camera poses ``[N, 4, 4]``.
        covariances: Their covariances ``[N, 6, 6]``.
        settings: Standard deviations of the accelerations.
    """
    # forwards: filter, and keep each prediction
    state = MotionState.at(poses[0], covariances[0])
    filtered = [state]
    predicted = [state]
    steps = np.diff(stamps)
    for k in range(1, len(stamps)):
        predicted.append(state.predicted(float(steps[k - 1]), settings))
        state = predicted[k].updated(poses[k], covariances[k])
        filtered.append(state)

    # backwards: correct each filtered state by how the smoothed next one differs from its prediction
    later = state
    out = np.empty_like(poses)
    out[-1] = later.T_cam_world
    for k in range(len(stamps) - 2, -1, -1):
        ahead = predicted[k + 1]
        transition = np.eye(12) + float(steps[k]) * np.eye(12, k=6)
        gain = np.linalg.solve(ahead.covariance, transition @ filtered[k].covariance).T
        error = np.concatenate([ahead.difference(later.T_cam_world), later.speed - ahead.speed])
        covariance = filtered[k].covariance + gain @ (later.covariance - ahead.covariance) @ gain.T
        later = filtered[k].moved(gain @ error, covariance)
        out[k] = later.T_cam_world
    return out


class CameraMotion:
    """The motion model while tracking; it knows nothing at the start and after a lost frame.

    Args:
        settings: Accelerations.

    Attributes:
        state: Filtered motion of the last tracked frame; None while nothing is known.
        intervals: The latest intervals between tracked frames, seconds.
    """

    def __init__(self, settings: MotionModelSettings) -> None:
        self._settings = settings
        self._interval = FIRST_INTERVAL_S
        self.state: MotionState | None = None
        self.intervals: deque[float] = deque(maxlen=INTERVALS)

    def relocate(self, T_cam_world: Array) -> None:
        """Move to another pose with the motion unchanged, as after bundle adjustment.

        Args:
            T_cam_world: The new world-to-camera pose ``[4, 4]``.
        """
        if self.state is not None:
            r = T_cam_world[:3, :3]
            self.state = replace(self.state, position=-r.T @ T_cam_world[:3, 3], rotation=r.copy())

    def transform(self, T_cam_before: Array, T_cam_now: Array, scale: float) -> None:
        """Move the motion with the world around the camera, as after a loop was closed.

        Args:
            T_cam_before: World-to-camera pose of a keyframe nearby as it was before.
            T_cam_now: World-to-camera pose of the same keyframe now.
            scale: What lengths around it were multiplied by.
        """
        if self.state is not None:
            self.state = self.state.transformed(T_cam_now[:3, :3].T @ T_cam_before[:3, :3], scale)

    def predict_T_cam_world(
        self, last: TrackedFrame, timestamp: float, *, jitter: float = 0.0
    ) -> tuple[Array, Array | None]:
        """World-to-camera pose at a time, and the covariance of the motion since the last frame.

        Where nothing is known of the gap it is the pose of the last tracked frame, and no
        covariance.

        Args:
            last: The last tracked frame.
            timestamp: The stamp of the new one, seconds.
            jitter: Share of the usual interval within which a regular stamp is taken instead.
        """
        # a stamp that is nearly regular counts as regular
        if abs(timestamp - last.timestamp - self._interval) <= jitter * self._interval:
            timestamp = last.timestamp + self._interval

        # constant velocity, where it is known
        dt = timestamp - last.timestamp
        if self.state is None or not 0 < dt <= MAX_GAP_S:
            return last.T_cam_world, None
        covariance = self.state.motion_covariance(dt, self._settings)
        return self.state.predicted(dt, self._settings).T_cam_world, covariance

    def update(
        self, last: TrackedFrame, timestamp: float, measured: Array, information: Array
    ) -> Array:
        """Weigh the image's pose against the motion model, and remember the motion.

        Args:
            last: The last tracked frame.
            timestamp: The stamp of the new one, seconds.
            measured: Its world-to-camera pose by the image.
            information: Gauss-Newton matrix of that pose.

        Returns:
            World-to-camera pose; the measured one where nothing is known of the gap.
        """
        # after a gap the filter begins again at the measured pose
        covariance = pose_covariance(measured, information)
        dt = timestamp - last.timestamp
        if self.state is None or not 0 < dt <= MAX_GAP_S:
            self.state = MotionState.at(measured, covariance)
            return measured

        # predict, then update by the measurement
        self._interval = dt
        self.intervals.append(dt)
        self.state = self.state.predicted(dt, self._settings).updated(measured, covariance)
        return self.state.T_cam_world


# ---------------------------------------------------------------------- rolling shutter


@dataclass(frozen=True, eq=False)
class CameraVelocity:
    """Velocity of the world in the camera frame: ``X(t) = exp(angular t) X(0) + linear t``.

    Attributes:
        linear: ``[3]``, metres a second.
        angular: ``[3]``, radians a second.
    """

    linear: Array
    angular: Array

    @classmethod
    def between(cls, T_earlier: Array, T_later: Array, seconds: float) -> CameraVelocity:
        """The velocity between two world-to-camera poses ``[4, 4]``, in the camera frame of the later one.

        Args:
            T_earlier: The earlier pose.
            T_later: The later pose.
            seconds: The time between them.
        """
        angular = se3.rotation_vectors(T_later[:3, :3] @ T_earlier[:3, :3].T) / seconds
        # the world moves against the camera's centre
        moved_back = se3.inverse(T_earlier)[:3, 3] - se3.inverse(T_later)[:3, 3]
        return cls(T_later[:3, :3] @ moved_back / seconds, angular)


def compensate_rolling_shutter(
    observations: Observations, camera: Camera, velocity: CameraVelocity
) -> Observations:
    """The features as a global shutter would have seen them at the frame's stamp, the time of the middle row.

    Where a feature has no depth, only the rotation is undone.

    Args:
        observations: The measured features; their raw keypoints tell the rows.
        camera: Intrinsics without distortion, and `readout_s`.
        velocity: The motion during the frame.

    Returns:
        New observations; a feature that such a motion would put behind the camera stays where it
        is.
    """
    # seconds of each row after the middle one
    late = ((observations.keypoints.xy[:, 1] + 0.5) / camera.height - 0.5) * camera.readout_s
    xy, z = _compensated(
        observations.xy,
        observations.z,
        late,
        velocity.linear,
        velocity.angular,
        intrinsics_of(camera),
    )
    grid = CellGrid.of(xy, camera.width, camera.height)
    return replace(observations, xy=xy, z=z, right=right_coordinates(xy, z, camera), grid=grid)


@kernel
def _compensated(
    xy: Array,
    z: Array,
    late: Array,
    linear: Array,
    angular: Array,
    camera: Intrinsics,
) -> tuple[Array, Array]:
    """Move features to where the camera of the middle row would have seen them.

    Args:
        xy: Measured pixels ``[N, 2]``.
        z: Measured depths ``[N]``, metres, 0 missing.
        late: Exposure of each feature's row after the middle one ``[N]``, seconds.
        linear: Velocity ``[3]`` of the world in the camera frame, metres a second.
        angular: Its angular velocity ``[3]``, radians a second.
        camera: Intrinsics without distortion.

    Returns:
        Pixels ``[N, 2]`` and depths ``[N]``.
    """
    xy = xy.copy()
    z = z.copy()
    # axis and angle per second
    ax = angular[0]
    ay = angular[1]
    az = angular[2]
    speed = np.sqrt(ax * ax + ay * ay + az * az)
    length = max(speed, 1e-12)
    ax /= length
    ay /= length
    az /= length
    for i in range(len(xy)):
        # the point before it moved on; without depth it is a direction, which only the rotation changes
        has_depth = z[i] > 0
        depth = z[i] if has_depth else 1.0
        travelled = late[i] if has_depth else 0.0
        x = (xy[i, 0] - camera.cx) / camera.fx * depth - travelled * linear[0]
        y = (xy[i, 1] - camera.cy) / camera.fy * depth - travelled * linear[1]
        depth -= travelled * linear[2]
        # Rodrigues' rotation by -late * angular
        cosine = np.cos(late[i] * speed)
        sine = -np.sin(late[i] * speed)
        along = (1 - cosine) * (ax * x + ay * y + az * depth)
        right = cosine * x + sine * (ay * depth - az * y) + along * ax
        down = cosine * y + sine * (az * x - ax * depth) + along * ay
        ahead = cosine * depth + sine * (ax * y - ay * x) + along * az

        # project it
        if ahead > 0:
            xy[i, 0] = right / ahead * camera.fx + camera.cx
            xy[i, 1] = down / ahead * camera.fy + camera.cy
            if has_depth:
                z[i] = ahead
    return xy, z


class RollingShutter:
    """Compensates the frames that follow a tracked one: by the motion before, then by the frame's own pose.

    The velocity is not the motion filter's: that takes the acceleration as constant between frames,
    and oscillates about the true velocity of a hand-held camera from one frame to the next.

    Args:
        camera: Intrinsics without distortion, and `readout_s`.
        intervals: The latest intervals between frames, seconds.

    Attributes:
        velocity: Camera velocity in the last tracked frame; None where it is not known.
    """

    def __init__(self, camera: Camera, intervals: deque[float]) -> None:
        self._camera = camera
        self._intervals = intervals
        self.velocity: CameraVelocity | None = None

    def predicted(self, raw: Observations, last: TrackedFrame, timestamp: float) -> Observations:
        """The features compensated by the velocity in the last frame."""
        if self.velocity is None or not 0 < timestamp - last.timestamp <= MAX_GAP_S:
            return raw
        return compensate_rolling_shutter(raw, self._camera, self.velocity)

    def refitted(
        self,
        raw: Observations,
        observations: Observations,
        map_fit: MapFit,
        last: TrackedFrame,
        timestamp: float,
        *,
        force: bool,
    ) -> tuple[Observations, MapFit, CameraVelocity | None]:
        """The features compensated by the motion to the frame's pose, the pose fitted to them, and that motion.

        A pose that jumps, as at a cut, tells no motion: where fewer points agree then, nothing
        changes.

        Args:
            raw: The measured features.
            observations: The features as `predicted` gave them.
            map_fit: The pose so far, fitted to `observations`.
            last: The last tracked frame.
            timestamp: The frame's stamp, seconds.
            force: Whether fewer points may agree, as before the first frame is compensated.
        """
        pose = map_fit.estimate.T_cam_world
        dt = timestamp - last.timestamp
        if not 0 < dt <= MAX_GAP_S:
            return observations, map_fit, None

        # velocity from the last pose; a camera exposes at a regular rate, however its frames were stamped
        usual = float(np.median(self._intervals)) if self._intervals else dt
        regular = round(dt / usual) * usual
        exposed = regular if abs(dt - regular) <= STAMP_NOISE * usual else dt
        velocity = CameraVelocity.between(
            last.T_cam_world, pose, max(exposed, self._camera.readout_s)
        )

        # compensate by it and fit again
        compensated = compensate_rolling_shutter(raw, self._camera, velocity)
        refit = fit_pose(self._camera, compensated, map_fit.matches, pose, map_fit.in_view)
        if refit.count < MIN_AGREEING * map_fit.count and not force:
            return observations, map_fit, None
        return compensated, refit, velocity


# ---------------------------------------------------------------------- the trajectory


@dataclass(eq=False, slots=True)
class FramePose:
    """A tracked frame's pose relative to a keyframe, so that refinement moves it along.

    Attributes:
        timestamp: Seconds.
        reference: Slot of the keyframe.
        T_cam_ref: Pose ``[4, 4]`` from the keyframe's camera frame to the frame's.
        information: float32 ``[6, 6]``, Gauss-Newton matrix of the pose.
    """

    timestamp: float
    reference: int
    T_cam_ref: Array
    information: NDArray[np.float32]


def rescale(history: Sequence[FramePose], scales: Mapping[int, float]) -> None:
    """Rescale the frames of keyframes around which lengths were multiplied.

    Args:
        history: Changed in place.
        scales: What lengths were multiplied by, by slot of the keyframe.
    """
    for frame in history:
        scale = scales.get(frame.reference, 1.0)
        frame.T_cam_ref[:3, 3] *= scale
        # a derivative by a longer unit is smaller
        frame.information[:3] /= scale
        frame.information[:, :3] /= scale


def trajectory(
    history: Sequence[FramePose], slam_map: Map, settings: MotionModelSettings
) -> Trajectory:
    """Camera-to-world poses in the order of their stamps, smoothed where the settings say so.

    Frames of unmerged submaps are left out: where they were taken in the root map's world is
    unknown.
    """
    # frames of the root map, by stamp; of equal stamps the first
    frames = {
        frame.timestamp: frame
        for frame in reversed(history)
        if slam_map.kf_map[frame.reference] == 0
    }
    stamps = np.array(sorted(frames), np.float64)
    ordered = [frames[stamp] for stamp in sorted(frames)]

    # world-to-camera poses by the keyframes as they are now
    absolute = [frame.T_cam_ref @ slam_map.kf_pose[frame.reference] for frame in ordered]
    poses = np.array(absolute).reshape(-1, 4, 4)

    # smoothed by the motion model, each pose by its information
    if settings.smooth and len(poses) > 2:
        covariances: list[Array] = []
        for pose, frame in zip(poses, ordered, strict=True):
            covariances.append(pose_covariance(pose, frame.information.astype(float)))
        poses = smooth(stamps, poses, np.array(covariances), settings)
    return Trajectory(stamps, se3.inverse(poses))
