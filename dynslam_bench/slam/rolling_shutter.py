"""Rolling-shutter compensation: each row of an image is exposed a little later than the one above it.

While the camera moves, its pose is another one in every row. Features are therefore moved to where the camera of the
middle row, whose pose is the frame's, would have seen them. The motion is taken as constant within a frame (the model
of Hedborg et al., Rolling Shutter Bundle Adjustment, CVPR 2012, applied before the pose is fitted instead of in it).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dynslam_bench.features.matching import CellGrid
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.map import Array
from dynslam_bench.slam.motion_model import MAX_GAP_S
from dynslam_bench.slam.tracking import MapFit, Observations, TrackedFrame, fit_pose, right_coordinates

MIN_AGREEING = 0.9
"""Share of the inliers before compensation that must be inliers after it."""
STAMP_NOISE = 0.25
"""Largest error of a stamp that was given after the exposure, as a share of the usual interval (TUM: up to 0.2)."""


@dataclass(frozen=True, eq=False)
class CameraVelocity:
    """How the world moves in the camera frame: ``X(t) = exp(angular t) X(0) + linear t``.

    Attributes:
        linear: ``[3]``, metres a second.
        angular: ``[3]``, radians a second.
    """

    linear: Array
    angular: Array

    @classmethod
    def between(cls, before: Array, now: Array, seconds: float) -> CameraVelocity:
        """From two world-to-camera poses ``[4, 4]`` so many seconds apart; in the camera frame of the later one."""
        angular = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).as_rotvec() / seconds
        return cls(now[:3, :3] @ (se3.inverse(before)[:3, 3] - se3.inverse(now)[:3, 3]) / seconds, angular)


def compensate_rolling_shutter(observations: Observations, camera: Camera, velocity: CameraVelocity) -> Observations:
    """The features as a global shutter would have seen them at the frame's stamp, the time of the middle row.

    Where a feature has no depth, only the rotation is undone.

    Args:
        observations: The measured features; their raw keypoints tell the rows.
        camera: Intrinsics without distortion, and `readout_s`.
        velocity: The motion during the frame.

    Returns:
        New observations; a feature that such a motion would put behind the camera stays where it is.
    """
    if not len(observations):
        return observations
    row = observations.keypoints.xy[:, 1:].astype(np.float64)
    late = ((row + 0.5) / camera.height - 0.5) * camera.readout_s
    has_depth = observations.z > 0
    points = camera.unproject(observations.xy, np.where(has_depth, observations.z, 1.0))
    points = points - np.where(has_depth[:, None], late, 0.0) * velocity.linear
    points = Rotation.from_rotvec(-late * velocity.angular).apply(points)
    ahead = points[:, 2] > 0
    xy = np.where(ahead[:, None], camera.project(points), observations.xy)
    z = np.where(ahead & has_depth, points[:, 2], observations.z)
    grid = CellGrid.of(xy, camera.width, camera.height)
    return replace(observations, xy=xy, z=z, right=right_coordinates(xy, z, camera), grid=grid)


class RollingShutter:
    """Compensates the frames that follow a tracked one: by the motion before, then by the frame's own pose.

    The velocity is not the motion filter's: that takes the acceleration as constant between frames, and oscillates
    about the true velocity of a hand-held camera from one frame to the next.

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
        fit: MapFit,
        last: TrackedFrame,
        timestamp: float,
        *,
        force: bool,
    ) -> tuple[Observations, MapFit, CameraVelocity | None]:
        """The features compensated by the motion to the frame's pose, the pose fitted to them, and that motion.

        A pose that jumps, as at a cut, tells no motion: where fewer points agree then, nothing changes.

        Args:
            raw: The measured features.
            observations: The features as `predicted` gave them.
            fit: The pose so far, fitted to `observations`.
            last: The last tracked frame.
            timestamp: The frame's stamp, seconds.
            force: Whether fewer points may agree, as before the first frame is compensated.
        """
        pose, dt = fit.estimate.T_cam_world, timestamp - last.timestamp
        if not 0 < dt <= MAX_GAP_S or not np.isfinite(pose).all():
            return observations, fit, None
        # a camera exposes at a regular rate, however its frames were stamped
        usual = float(np.median(self._intervals)) if self._intervals else dt
        regular = round(dt / usual) * usual
        exposed = regular if abs(dt - regular) <= STAMP_NOISE * usual else dt
        velocity = CameraVelocity.between(last.T_cam_world, pose, max(exposed, self._camera.readout_s))
        compensated = compensate_rolling_shutter(raw, self._camera, velocity)
        refit = fit_pose(self._camera, compensated, fit.matches, pose, fit.in_view)
        if refit.count < MIN_AGREEING * fit.count and not force:
            return observations, fit, None
        return compensated, refit, velocity
