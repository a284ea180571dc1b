"""A rolling shutter: each row of an image is exposed a little later than the one above it.

While the camera moves, its pose is another one in every row. Features are therefore moved to where the camera of the
middle row, whose pose is the frame's, would have seen them, with the motion taken as constant within a frame (the model
of Hedborg et al., Rolling Shutter Bundle Adjustment, CVPR 2012, applied before the pose is fitted instead of in it).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.features.matching import CellGrid
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.observation import Observations, right_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraVelocity:
    """How the world moves in the camera frame: ``X(t) = exp(turning t) X(0) + velocity t``.

    Attributes:
        velocity: ``[3]``, metres a second.
        turning: ``[3]``, radians a second.
    """

    velocity: Array
    turning: Array

    @classmethod
    def between(cls, before: Array, now: Array, seconds: float) -> CameraVelocity:
        """From two world-to-camera poses ``[4, 4]`` so many seconds apart; in the camera frame of the later one."""
        turning = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).as_rotvec() / seconds
        back = se3.inverse(before)[:3, 3] - se3.inverse(now)[:3, 3]
        return cls(now[:3, :3] @ back / seconds, turning)


def compensate_rolling_shutter(seen: Observations, camera: Camera, speeds: CameraVelocity) -> Observations:
    """The features as a camera with a global shutter would have seen them at the frame's stamp, the middle row's time.

    Where a feature has no depth, only the turning is undone.

    Args:
        seen: The features as they were found; their raw keypoints tell the rows.
        camera: Intrinsics without distortion, and `readout_s`.
        speeds: The motion during the frame.

    Returns:
        New observations; a feature that such a motion would put behind the camera stays where it is.
    """
    if not len(seen):
        return seen
    row = seen.keypoints.xy[:, 1].astype(np.float64)
    late = (((row + 0.5) / camera.height - 0.5) * camera.readout_s)[:, None]
    deep = seen.z > 0
    points = camera.unproject(seen.xy, np.where(deep, seen.z, 1.0))
    points = points - np.where(deep[:, None], late, 0.0) * speeds.velocity
    points = Rotation.from_rotvec(-late * speeds.turning).apply(points)
    ahead = points[:, 2] > 0
    xy = np.where(ahead[:, None], camera.project(points), seen.xy)
    z = np.where(ahead & deep, points[:, 2], seen.z)
    grid = CellGrid.of(xy, camera.width, camera.height)
    return replace(seen, xy=xy, z=z, right=right_of(xy, z, camera), grid=grid)
