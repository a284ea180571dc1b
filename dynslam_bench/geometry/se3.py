"""SE(3): exponential, logarithm, inverse, quaternions; poses are 4x4 float64 matrices, batched along leading axes."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers; docstrings state the shape."""
_SQUARES = 1e100
"""Numbers up to this, and down to its inverse, have squares and sums of squares that are numbers, too."""


def hat(v: Array) -> Array:
    """Skew-symmetric matrices ``[..., 3, 3]`` of vectors ``[..., 3]``."""
    x, y, z = np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def exp(xi: Array) -> Array:
    """Poses ``[..., 4, 4]`` of twists ``[..., 6]`` = (translation rho, rotation phi in rad).

    Rotation by Rodrigues' formula ``R = I + a [phi] + b [phi]^2``, translation ``V rho`` with
    ``V = I + b [phi] + c [phi]^2``.
    """
    xi = np.asarray(xi, dtype=np.float64)
    rho = xi[..., :3]
    phi = xi[..., 3:]
    # a = sin t / t, b = (1 - cos t) / t^2, c = (t - sin t) / t^3; their series where the angle is small
    theta = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = theta < 1e-5
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1 - theta**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - theta**2 / 120, (safe - np.sin(safe)) / safe**3)
    skew = hat(phi)
    skew2 = skew @ skew
    translation = ((np.eye(3) + b * skew + c * skew2) @ rho[..., None])[..., 0]
    return from_matrix(translation, np.eye(3) + a * skew + b * skew2)


def log(pose: Array) -> Array:
    """Twists ``[..., 6]`` = (rho, phi) of poses ``[..., 4, 4]``; rotation angles in [0, pi].

    The inverse of `exp`: ``rho = V^-1 t`` with ``V^-1 = I - [phi] / 2 + f [phi]^2``.
    """
    pose = np.asarray(pose, dtype=np.float64)
    flat = pose.reshape(-1, 4, 4)
    phi = rotation_vectors(flat)
    # f = (1 - (t / 2) / tan(t / 2)) / t^2; its series where the angle is small
    theta = np.linalg.norm(phi, axis=-1)[:, None, None]
    small = theta < 1e-5
    safe = np.where(small, 1.0, theta)
    half = safe / 2
    factor = np.where(small, 1 / 12 + theta**2 / 720, (1 - half / np.tan(half)) / safe**2)
    skew = hat(phi)
    rho = ((np.eye(3) - 0.5 * skew + factor * (skew @ skew)) @ flat[:, :3, 3:])[..., 0]
    return np.concatenate([rho, phi], axis=-1).reshape(*pose.shape[:-2], 6)


def inverse(pose: Array) -> Array:
    """Inverse poses, by transposition of the rotation."""
    pose = np.asarray(pose, dtype=np.float64)
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    return from_matrix(-(rotation_t @ pose[..., :3, 3:])[..., 0], rotation_t)


def from_matrix(
    translation: NDArray[np.integer | np.floating], rotation: NDArray[np.integer | np.floating]
) -> Array:
    """Poses ``[..., 4, 4]`` of translations ``[..., 3]`` and rotation matrices ``[..., 3, 3]``."""
    pose = np.zeros((*rotation.shape[:-2], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def from_quaternion(translation: Array, quaternion: Array) -> Array:
    """Poses ``[..., 4, 4]`` of translations ``[..., 3]`` and quaternions ``[..., 4]`` in TUM's order qx qy qz qw.

    Quaternions of any length but 0 are rotations, also of one whose square is no number any more.
    The rotation has the bits of SciPy's, which takes a third of a second to load.
    """
    # very large and very small numbers are scaled, so that their squares are numbers
    quaternion = np.asarray(quaternion, dtype=np.float64)
    largest = np.abs(quaternion).max(axis=-1, keepdims=True, initial=0.0)
    if ((largest > _SQUARES) | ((largest > 0) & (largest < 1 / _SQUARES))).any():
        quaternion = quaternion / np.where(largest > 0, largest, 1.0)

    # unit length; the squares are added one after the other
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if not length.all():
        raise ValueError("a quaternion of length 0 is no rotation")
    x, y, z, w = np.moveaxis(quaternion / length[..., None], -1, 0)

    rows = [
        [x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w],
    ]
    rotation = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return from_matrix(translation, rotation)


def to_quaternion(pose: Array) -> tuple[Array, Array]:
    """Translations ``[..., 3]`` and unit quaternions ``[..., 4]`` (qx qy qz qw, qw >= 0) of poses ``[..., 4, 4]``."""
    from scipy.spatial.transform import Rotation

    pose = np.asarray(pose, dtype=np.float64)
    quaternion = Rotation.from_matrix(pose[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return pose[..., :3, 3].copy(), quaternion.reshape(*pose.shape[:-2], 4)


def rotation_angle(pose: Array) -> Array:
    """Rotation angles ``[...]`` in rad, in [0, pi], all of them accurate: by sine and cosine together."""
    return scaled_axes(pose)[1]


def rotation_vectors(pose: Array) -> Array:
    """Rotation vectors ``[..., 3]`` in rad of poses or rotation matrices, of length in [0, pi]."""
    pose = np.asarray(pose, dtype=np.float64)
    axes, angle = scaled_axes(pose)
    # near a half turn the sine does not tell the axis
    if np.max(angle, initial=0.0) > 3.0:
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_matrix(pose[..., :3, :3].reshape(-1, 3, 3))
        return np.asarray(rotation.as_rotvec().reshape(*angle.shape, 3))
    # axes times the sine become axes times the angle; near zero both are the same
    sine = np.sin(angle)
    return np.asarray(
        axes * np.where(sine > 1e-9, angle / np.where(sine > 1e-9, sine, 1.0), 1.0)[..., None]
    )


def scaled_axes(pose: Array) -> tuple[Array, Array]:
    """Axes ``[..., 3]`` times the sine of the angle, and the angles ``[...]``, of rotations."""
    # R - R^T holds twice the axis times the sine, the trace is 1 + 2 cos
    pose = np.asarray(pose, dtype=np.float64)
    x = pose[..., 2, 1] - pose[..., 1, 2]
    y = pose[..., 0, 2] - pose[..., 2, 0]
    z = pose[..., 1, 0] - pose[..., 0, 1]
    trace = pose[..., 0, 0] + pose[..., 1, 1] + pose[..., 2, 2]
    angle = np.arctan2(np.sqrt(x * x + y * y + z * z), trace - 1.0)
    return 0.5 * np.stack([x, y, z], axis=-1), np.asarray(angle)


# how far the poses of a camera that stands still may lie apart: the noise of a motion capture system
STILL_M = 1e-3
"""In position, metres."""
STILL_DEG = 0.1
"""In orientation, degrees."""


def is_static(poses: Array) -> bool:
    """Whether all poses ``[N, 4, 4]``, N > 0, are the first one, to a millimetre and a tenth of a degree."""
    moved = inverse(poses[0]) @ poses
    within = np.linalg.norm(moved[:, :3, 3], axis=1).max() <= STILL_M
    return bool(within and np.degrees(rotation_angle(moved)).max() <= STILL_DEG)


def between(poses: Array, pairs: NDArray[np.intp]) -> Array:
    """The second pose of each pair ``[P, 2]`` of poses ``[N, 4, 4]`` in the frame of the first one, ``[P, 4, 4]``."""
    return np.asarray(inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]])


def transform(pose: Array, points: Array) -> Array:
    """Points ``[N, 3]`` moved by one pose ``[4, 4]``."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def from_wxyz_read_as_xyzw(pose: Array) -> Array:
    """The poses ``[N, 4, 4]`` of a file that holds qw qx qy qz and was read as if it held qx qy qz qw."""
    translation, quaternion = to_quaternion(pose)
    return from_quaternion(translation, np.roll(quaternion, -1, axis=1))


def with_rotation(pose: Array, rotation: Array) -> Array:
    """The poses ``[..., 4, 4]`` with other rotations ``[..., 3, 3]``."""
    turned = pose.copy()
    turned[..., :3, :3] = rotation
    return turned


def is_pose(pose: object, tolerance: float = 1e-4) -> bool:
    """Whether the value is a finite 4x4 rigid transformation: orthonormal rotation, determinant 1, last row 0 0 0 1."""
    if (
        not isinstance(pose, np.ndarray)
        or pose.shape != (4, 4)
        or not np.issubdtype(pose.dtype, np.floating)
    ):
        return False
    rotation = pose[:3, :3]
    return bool(
        np.isfinite(pose).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < tolerance
        and np.linalg.det(rotation) > 0
        and np.abs(pose[3] - (0, 0, 0, 1)).max() < tolerance
    )
