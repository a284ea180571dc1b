"""Steps of Gauss-Newton on SE(3), inside compiled loops: solve the normal equations, apply the twist to the pose."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import inlined, kernel

Array = NDArray[np.float64]


@inlined
def transform_point(pose: Array, point: Array) -> tuple[float, float, float]:
    """Coordinates of a point ``[3]`` that is moved by a pose ``[4, 4]``."""
    x = point[0]
    y = point[1]
    z = point[2]
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@inlined
def _add_to_row(
    matrix: Array,
    vector: Array,
    m: np.int64,
    weighted: float,
    j0: float,
    j1: float,
    j2: float,
    j3: float,
    j4: float,
    j5: float,
    residual: float,
) -> None:
    """Add ``weighted (j, residual)`` to row m of a matrix ``[6, 6]`` and of a vector ``[6]``."""
    matrix[m, 0] += weighted * j0
    matrix[m, 1] += weighted * j1
    matrix[m, 2] += weighted * j2
    matrix[m, 3] += weighted * j3
    matrix[m, 4] += weighted * j4
    matrix[m, 5] += weighted * j5
    vector[m] += weighted * residual


@inlined
def add_normal_equation(
    matrix: Array,
    vector: Array,
    weight: float,
    j0: float,
    j1: float,
    j2: float,
    j3: float,
    j4: float,
    j5: float,
    residual: float,
) -> None:
    """Add ``weight j^T j`` to a matrix ``[6, 6]`` and ``weight j^T residual`` to a vector ``[6]``.

    The derivatives j of the residual by the six numbers of the twist come one by one.
    """
    # row by row, not in a loop over a tuple, each access to which is a branch in compiled code;
    # for a plain 0, 1, ... numba would compile `_add_to_row` six times
    _add_to_row(matrix, vector, np.int64(0), weight * j0, j0, j1, j2, j3, j4, j5, residual)
    _add_to_row(matrix, vector, np.int64(1), weight * j1, j0, j1, j2, j3, j4, j5, residual)
    _add_to_row(matrix, vector, np.int64(2), weight * j2, j0, j1, j2, j3, j4, j5, residual)
    _add_to_row(matrix, vector, np.int64(3), weight * j3, j0, j1, j2, j3, j4, j5, residual)
    _add_to_row(matrix, vector, np.int64(4), weight * j4, j0, j1, j2, j3, j4, j5, residual)
    _add_to_row(matrix, vector, np.int64(5), weight * j5, j0, j1, j2, j3, j4, j5, residual)


@kernel
def cholesky_solve(a: Array, b: Array) -> bool:
    """Solve ``a x = b`` in place for a symmetric positive definite `a`; `b` becomes x. False if it is not definite.

    Only the lower triangle of `a` is read.
    """
    n = a.shape[0]
    # Factor a = L L^T; L takes the place of the lower triangle.
    for j in range(n):
        for i in range(j, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if not s > 1e-14:
                    return False
                a[j, j] = np.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    # Forward substitution: L y = b.
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= a[i, k] * b[k]
        b[i] = s / a[i, i]
    # Back substitution: L^T x = y.
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= a[k, i] * b[k]
        b[i] = s / a[i, i]
    return True


@kernel
def apply_twist(pose: Array, xi: Array) -> Array:
    """``exp(xi) @ pose`` for a twist (translation, rotation), re-orthonormalised."""
    # Coefficients of exp: sin(theta) / theta, (1 - cos(theta)) / theta^2 and
    # (theta - sin(theta)) / theta^3, by their series near 0.
    theta2 = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5]
    theta = np.sqrt(theta2)
    if theta < 1e-8:
        a = 1.0 - theta2 / 6.0
        b = 0.5 - theta2 / 24.0
        c = 1.0 / 6.0 - theta2 / 120.0
    else:
        a = np.sin(theta) / theta
        b = (1.0 - np.cos(theta)) / theta2
        c = (theta - np.sin(theta)) / (theta2 * theta)
    # Cross-product matrix of the rotation vector, and its square.
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -xi[5], xi[4], -xi[3]
    k[1, 0], k[2, 0], k[2, 1] = xi[5], -xi[4], xi[3]
    k2 = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                k2[i, j] += k[i, m] * k[m, j]
    # exp(xi): rotation I + a k + b k^2, translation (I + b k + c k^2) v.
    step = np.zeros((4, 4))
    for i in range(4):
        step[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            step[i, j] += a * k[i, j] + b * k2[i, j]
            step[i, 3] += (b * k[i, j] + c * k2[i, j]) * xi[j]
        step[i, 3] += xi[i]
    # Applied to the pose from the left.
    out = np.zeros((4, 4))
    out[3, 3] = 1.0
    for i in range(3):
        for j in range(4):
            s = step[i, 3] if j == 3 else 0.0
            for m in range(3):
                s += step[i, m] * pose[m, j]
            out[i, j] = s
    # Gram-Schmidt on the rows keeps rounding from building up
    n = np.sqrt(out[0, 0] ** 2 + out[0, 1] ** 2 + out[0, 2] ** 2)
    for j in range(3):
        out[0, j] /= n
    d = out[0, 0] * out[1, 0] + out[0, 1] * out[1, 1] + out[0, 2] * out[1, 2]
    for j in range(3):
        out[1, j] -= d * out[0, j]
    n = np.sqrt(out[1, 0] ** 2 + out[1, 1] ** 2 + out[1, 2] ** 2)
    for j in range(3):
        out[1, j] /= n
    out[2, 0] = out[0, 1] * out[1, 2] - out[0, 2] * out[1, 1]
    out[2, 1] = out[0, 2] * out[1, 0] - out[0, 0] * out[1, 2]
    out[2, 2] = out[0, 0] * out[1, 1] - out[0, 1] * out[1, 0]
    return out


@inlined
def cross(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float
) -> tuple[float, float, float]:
    """Cross product of (ax, ay, az) and (bx, by, bz)."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@kernel
def twist_of(pose: Array) -> Array:
    """The twist ``[6]`` (translation, rotation) whose exponential is the pose, rotated by less than half a turn."""
    # The rotation's axis times the sine of its angle, then the angle.
    rx = 0.5 * (pose[2, 1] - pose[1, 2])
    ry = 0.5 * (pose[0, 2] - pose[2, 0])
    rz = 0.5 * (pose[1, 0] - pose[0, 1])
    sine = np.sqrt(rx * rx + ry * ry + rz * rz)
    theta = np.arctan2(sine, 0.5 * (pose[0, 0] + pose[1, 1] + pose[2, 2] - 1.0))
    if theta < 1e-5:
        factor = 1.0 / 12.0 + theta * theta / 720.0
    else:
        stretch = theta / sine
        rx *= stretch
        ry *= stretch
        rz *= stretch
        factor = (1.0 - 0.5 * theta / np.tan(0.5 * theta)) / (theta * theta)
    # The inverse of the left Jacobian, applied to the translation.
    tx = pose[0, 3]
    ty = pose[1, 3]
    tz = pose[2, 3]
    once_x, once_y, once_z = cross(rx, ry, rz, tx, ty, tz)
    twice_x, twice_y, twice_z = cross(rx, ry, rz, once_x, once_y, once_z)
    out = np.empty(6)
    out[0] = tx - 0.5 * once_x + factor * twice_x
    out[1] = ty - 0.5 * once_y + factor * twice_y
    out[2] = tz - 0.5 * once_z + factor * twice_z
    out[3] = rx
    out[4] = ry
    out[5] = rz
    return out
