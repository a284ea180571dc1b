"""The two sensors: a structured-light depth camera and a colour camera with a rolling readout, as numba kernels.

Noise is a function of (seed, frame, pixel) through an integer hash, so that it depends neither on the order of
rendering nor on the number of threads.

Depth model, in the order of the physics of a Kinect-like sensor:

1. The projector stands one baseline beside the camera; what it cannot see is in its shadow and has no depth.
2. The disparity ``fx * baseline / z`` carries noise and is quantised to 1/8 pixel: the depth steps grow with z^2.
3. Correlation fails near depth edges, on dark surfaces far away, on slanted surfaces, and outside the range.
"""

from __future__ import annotations

import math

import numpy as np

from dynslam_bench.core.compiled import Scalar, dividing_kernel
from dynslam_bench.sequences.synthetic.kernels import Intrinsics, Ints, Reals


@dividing_kernel
def _hash(a: Scalar, b: Scalar) -> Scalar:
    """A 64-bit hash (splitmix64 finaliser) of two 64-bit integers."""
    z = np.uint64(a) + np.uint64(0x9E3779B97F4A7C15) * (np.uint64(b) + np.uint64(1))
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@dividing_kernel
def _normal(h: Scalar) -> float:
    """About normal with variance 1: the centred sum of the four 16-bit parts of a hash."""
    m = np.uint64(0xFFFF)
    total = float(h & m) + float((h >> np.uint64(16)) & m) + float((h >> np.uint64(32)) & m) + float(h >> np.uint64(48))
    return (total - 131070.0) * (1.7320508075688772 / 65536.0)


@dividing_kernel
def _uniform(h: Scalar) -> float:
    return float(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@dividing_kernel
def _depths_around(depth: Reals, row: int, u: int, reach: int) -> tuple[float, float]:
    """The least and the greatest depth of a pixel and of those `reach` away on either side, above and below."""
    height, width = depth.shape
    lowest, highest = depth[row, u], depth[row, u]
    for down, right in ((0, -reach), (0, reach), (-reach, 0), (reach, 0)):
        v2, u2 = row + down, u + right
        if 0 <= v2 < height and 0 <= u2 < width:
            other = depth[v2, u2]
            if other > 0.0:
                lowest, highest = min(lowest, other), max(highest, other)
    return lowest, highest


@dividing_kernel
def measure_depth(
    row0: int, row1: int, seed: Scalar, fx: float, baseline: float, depth: Reals, cosine: Reals, color: Reals,
    disparity_noise: float, near: float, far: float, edge_px: int, dark: float, factor: float, out: Ints,
) -> None:  # fmt: skip
    """Raw depth (uint16, `factor` units a metre, 0 = missing) of rows from the exact z-depth."""
    width = depth.shape[1]
    shadow_right = np.empty(width, np.bool_)
    for row in range(row0, row1):
        # 1. Projector to the right of the camera: its column is u + d - const; scanning from the right, a pixel is
        # lit only if its projector column lies left of all columns taken so far.
        limit = 1e30
        for i in range(width):
            u = width - 1 - i
            z = depth[row, u]
            if z <= 0.0:
                shadow_right[u] = True
                continue
            column = u + fx * baseline / z
            shadow_right[u] = column >= limit + 0.5
            limit = min(limit, column)
        for u in range(width):
            z = depth[row, u]
            out[row, u] = 0
            if shadow_right[u] or z < near or z > far:
                continue
            h = _hash(seed, row * width + u)
            # 3a. Depth edges: the correlation window (about 9x9 pixels) mixes two surfaces.
            lowest, highest = _depths_around(depth, row, u, edge_px)
            chance = 0.0
            step = fx * baseline * (1.0 / lowest - 1.0 / highest)
            if step > 1.0:
                chance = 0.75 if z > 0.5 * (lowest + highest) else 0.35
            # 3b. Returned light: albedo x cosine / z^2, against a threshold that varies in blotches of 4x4 pixels.
            light = (0.3 * color[row, u, 0] + 0.59 * color[row, u, 1] + 0.11 * color[row, u, 2]) / 255.0
            power = (light + 0.04) * cosine[row, u] / (z * z)
            blotch = _uniform(_hash(seed ^ np.uint64(0x5DEECE66D), (row >> 2) * width + (u >> 2)))
            if power < dark * (0.4 + 1.2 * blotch):
                chance = 1.0
            # 3c. Slant, and the far end of the range.
            if cosine[row, u] < 0.12 + 0.1 * blotch:
                chance = 1.0
            fade = (z - 0.8 * far) / (0.2 * far)
            if fade > 0.0:
                chance = max(chance, fade * fade)
            if _uniform(_hash(h, 1)) < chance:
                continue
            # 2. Disparity noise (partly common to a correlation window) and quantisation.
            common = _normal(_hash(seed ^ np.uint64(0xA5A5A5A5), (row >> 1) * width + (u >> 1)))
            noise = disparity_noise * (0.8 * common + 0.6 * _normal(h))
            disparity = math.floor((fx * baseline / z + noise) * 8.0 + 0.5) / 8.0
            if disparity > 0.0:
                measured = fx * baseline / disparity * factor + 0.5
                if near * factor <= measured < 65535.0:
                    out[row, u] = int(measured)


@dividing_kernel
def dim(
    row0: int, row1: int, intrinsics: Intrinsics, pose: Reals, depth: Reals, light: Reals, height: float, spots: Reals,
    color: Reals,
) -> None:  # fmt: skip
    """Darken the colour of rows where a soft spot hides the lamp.

    Each pixel's surface point is followed towards the lamp (direction ``light`` in the world) up to the plane
    z = ``height``, where ``spots`` [K, 4] lie: x, y, radius (metres) and darkness.
    """
    fx, fy, cx, cy = intrinsics
    width = color.shape[1]
    for row in range(row0, row1):
        for column in range(width):
            z = depth[row, column]
            x, y = (column - cx) / fx * z, (row - cy) / fy * z
            wx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
            wy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
            wz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            up = (height - wz) / light[2]
            if z <= 0.0 or up <= 0.0:
                continue
            wx, wy = wx + light[0] * up, wy + light[1] * up
            factor = 1.0
            for k in range(spots.shape[0]):
                near = 1.0 - ((wx - spots[k, 0]) ** 2 + (wy - spots[k, 1]) ** 2) / (spots[k, 2] * spots[k, 2])
                if near > 0.0:
                    factor *= 1.0 - spots[k, 3] * min(1.0, 2.0 * near)
            for ch in range(3):
                color[row, column, ch] *= factor


@dividing_kernel
def expose(
    row0: int, row1: int, seed: Scalar, color: Reals, gain: Reals, read_noise: float, shot_noise: float,
    out: Ints,
) -> None:  # fmt: skip
    """8-bit colours of rows: gain of each row, shot and read noise, rounding, clipping."""
    width = color.shape[1]
    for row in range(row0, row1):
        for u in range(width):
            h = _hash(seed, row * width + u)
            common = _normal(h)
            for ch in range(3):
                value = color[row, u, ch] * gain[row]
                sigma = math.sqrt(read_noise * read_noise + shot_noise * max(value, 0.0))
                value += sigma * (0.75 * common + 0.66 * _normal(_hash(h, ch + 7)))
                out[row, u, ch] = np.uint8(min(max(value, 0.0), 255.0) + 0.5) if value < 254.5 else np.uint8(255)
