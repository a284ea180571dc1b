"""The numba kernels of motion in the image: exact flow, and blur along it. As in `raycast`, rows are independent."""

from __future__ import annotations

import math

import numpy as np

from dynslam_bench.core.compiled import dividing_kernel

from .arrays import Intrinsics, Ints, Reals
from .hits import NEAR_M

MOST_TAPS = 16
"""Samples of the longest blur."""


def tap_shares() -> Reals:
    """Where along a blur each of its taps lies, as shares of its length from the middle: ``[n, i]`` for tap i of n."""
    taps, i = np.arange(MOST_TAPS + 1)[:, None], np.arange(MOST_TAPS)[None]
    return np.where(i < taps, (i + 0.5) / np.maximum(taps, 1) - 0.5, 0.0)


@dividing_kernel
def flow_field(
    row0: int, row1: int, intrinsics: Intrinsics, hit: Ints, depth: Reals, motion: Reals, flow: Reals
) -> None:
    """Exact optical flow (float32 pixels) of rows.

    ``motion`` [P, 12] takes a point in this camera's frame, fixed to primitive p, to the other camera's frame; where
    nothing is hit or the point leaves the front of the camera, the flow is NaN.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        for column in range(width):
            key = hit[row, column]
            if key < 0:
                flow[row, column, 0] = flow[row, column, 1] = np.nan
                continue
            p = key >> 3
            z = depth[row, column]
            x, y = (column - cx) / fx * z, (row - cy) / fy * z
            w = motion[p, 8] * x + motion[p, 9] * y + motion[p, 10] * z + motion[p, 11]
            if w <= NEAR_M:
                flow[row, column, 0] = flow[row, column, 1] = np.nan
                continue
            u = motion[p, 0] * x + motion[p, 1] * y + motion[p, 2] * z + motion[p, 3]
            v = motion[p, 4] * x + motion[p, 5] * y + motion[p, 6] * z + motion[p, 7]
            flow[row, column, 0] = u / w * fx + cx - column
            flow[row, column, 1] = v / w * fy + cy - row


@dividing_kernel
def motion_blur(
    row0: int, row1: int, color: Reals, exact: Reals, shares: Reals, flow: Reals, shutter: float, blurred: Reals
) -> None:
    """Average the colour of rows along the pixel's own flow over `shutter` of a frame interval, centred.

    ``exact`` is the whole colour image as flat float64: what all taps read is converted once. ``shares`` are
    `tap_shares`. Unsigned indices need no test for negative ones.
    """
    height, width = color.shape[:2]
    right, below, stride = width - 1.001, height - 1.001, np.uint64(3 * width)
    one, two, three, four, five = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5)
    for row in range(row0, row1):
        for column in range(width):
            du, dv = flow[row, column, 0] * shutter, flow[row, column, 1] * shutter
            length = math.sqrt(du * du + dv * dv)
            if not length > 0.75:
                for ch in range(3):
                    blurred[row, column, ch] = color[row, column, ch]
                continue
            taps = min(int(length) + 2, MOST_TAPS)
            r, g, b = 0.0, 0.0, 0.0
            for i in range(taps):
                s = shares[taps, i]
                x = min(max(column + s * du, 0.0), right)
                y = min(max(row + s * dv, 0.0), below)
                x0, y0 = np.uint32(x), np.uint32(y)
                ax, ay = x - x0, y - y0
                w00, w10, w01, w11 = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
                k = np.uint64(y0) * stride + three * np.uint64(x0)
                m = k + stride
                r += w00 * exact[k] + w10 * exact[k + three] + w01 * exact[m] + w11 * exact[m + three]
                g += w00 * exact[k + one] + w10 * exact[k + four] + w01 * exact[m + one] + w11 * exact[m + four]
                b += w00 * exact[k + two] + w10 * exact[k + five] + w01 * exact[m + two] + w11 * exact[m + five]
            blurred[row, column, 0], blurred[row, column, 1], blurred[row, column, 2] = r / taps, g / taps, b / taps
