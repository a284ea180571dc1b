"""Rigs whose ground truth is that of a body that carries the camera, and what lies between the two."""

import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.se3 import Array

Matrix = tuple[tuple[float, float, float], ...]
"""The rows of a 3x3 matrix."""

# Bonn RGB-D Dynamic: the markers on the camera. The publisher states T_ROS and T_m; a camera pose
# is T_ROS^-1 T_marker T_ROS T_m. The linear part of T_m is a rotation times 1.059.
BONN_T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
BONN_T_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
BONN_R_BODY_CAM: Matrix = (
    (-0.958819, -0.172594, 0.225560),
    (-0.284016, 0.580297, -0.763276),
    (0.000845, -0.795906, -0.605420),
)
"""The rotation part of ``T_ROS T_m``, freed of its scale: from the camera's axes to those of the markers."""


def nearest_rotation(matrix: Array | Matrix) -> Array:
    """The rotations ``[..., 3, 3]`` nearest to matrices that are nearly rotations, up to scale."""
    # without the singular values, which are the scale
    left, _, right = np.linalg.svd(np.array(matrix))
    return np.asarray(left @ right)


def in_camera_axes(T_world_body: Array, R_body_cam: Matrix) -> Array:
    """Poses ``[N, 4, 4]`` of a body with the orientations of the camera on it; positions stay the body's."""
    return se3.with_rotation(T_world_body, T_world_body[:, :3, :3] @ nearest_rotation(R_body_cam))


def bonn_camera(poses: Array) -> Array:
    """Bonn's poses moved to the camera's centre by the rigid part of the calibration: a lever arm of 18.6 mm.

    Args:
        poses: Positions of the markers with the camera's orientations ``[N, 4, 4]``, as Bonn's
            sequences give them.
    """
    # the camera's centre on the markers, in the axes of the camera
    lever_cam = nearest_rotation(BONN_R_BODY_CAM).T @ (BONN_T_ROS[:3, :3] @ BONN_T_M[:3, 3])
    moved = poses.copy()
    moved[:, :3, 3] += poses[:, :3, :3] @ lever_cam
    return moved


def bonn_as_droid_w(poses: Array) -> Array:
    """Bonn's poses as WildGS-SLAM and DROID-W score against them: ``T_ROS^T T T_ROS T_m``, relative to the first.

    They take T_m as it is printed and invert the first pose as a matrix, so that T_m's scale of
    1.059 divides every position: the truth, and with it every error, comes out 5.6 % smaller.

    Args:
        poses: Positions of the markers with the camera's orientations ``[N, 4, 4]``, as Bonn's
            sequences give them.
    """
    # the markers' own poses, T of the formula
    markers = se3.with_rotation(poses, poses[:, :3, :3] @ nearest_rotation(BONN_R_BODY_CAM).T)
    corrected = BONN_T_ROS.T @ markers @ BONN_T_ROS @ BONN_T_M
    # relative to the first one, and rotations without the scale
    relative = np.linalg.inv(corrected[0]) @ corrected
    return se3.with_rotation(relative, nearest_rotation(relative[:, :3, :3]))
