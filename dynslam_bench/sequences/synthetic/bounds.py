"""Where in the image a primitive can be seen: the rectangle around the part of its box that lies before the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .kernels.hits import NEAR_M
from .settings import CAMERA

Array = NDArray[np.float64]
_MARGIN_PX = 2.0
_EDGES = np.array([(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1])
"""The twelve edges of a box, as pairs of corners; bit k of a corner's number is its side along axis k."""


def bounds_of(points: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Bounds of boxes.

    Args:
        points: Corners ``[P, 8, 3]`` in the camera frame, metres.

    Returns:
        Least depth of all corners, and least u, least v, greatest u, greatest v (pixels, with a margin); an empty
        rectangle (least above greatest) where a box lies behind the camera.
    """
    depth = points[:, :, 2]
    rectangle = _project(points, depth > NEAR_M)
    crossing = np.flatnonzero((depth.min(axis=1) <= NEAR_M) & (depth.max(axis=1) > NEAR_M))
    if len(crossing):
        a, b = points[crossing][:, _EDGES[:, 0]], points[crossing][:, _EDGES[:, 1]]
        cut = (a[..., 2] > NEAR_M) != (b[..., 2] > NEAR_M)
        share = (NEAR_M - a[..., 2]) / np.where(cut, b[..., 2] - a[..., 2], 1.0)
        ends = a + share[..., None] * (b - a)
        at_cut = _project(ends, cut)
        rectangle[:2, crossing] = np.minimum(rectangle[:2, crossing], at_cut[:2])
        rectangle[2:, crossing] = np.maximum(rectangle[2:, crossing], at_cut[2:])
    low_u, low_v, high_u, high_v = rectangle
    return depth.min(axis=1), low_u - _MARGIN_PX, low_v - _MARGIN_PX, high_u + _MARGIN_PX, high_v + _MARGIN_PX


def _project(points: Array, valid: NDArray[np.bool_]) -> Array:
    """Rectangle ``[4, P]`` (least u, v, greatest u, v) around the valid ones of points ``[P, K, 3]``."""
    z = np.where(valid, points[..., 2], 1.0)
    u = points[..., 0] / z * CAMERA.fx + CAMERA.cx
    v = points[..., 1] / z * CAMERA.fy + CAMERA.cy
    low = [np.where(valid, x, np.inf).min(axis=1) for x in (u, v)]
    high = [np.where(valid, x, -np.inf).max(axis=1) for x in (u, v)]
    return np.stack(low + high)
