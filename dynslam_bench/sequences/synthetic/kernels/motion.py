"""The numba kernels of motion in the image: exact flow, and blur along it. As in `raycast`, rows are independent."""

from __future__ import annotations

import math

import numpy as np

from dynslam_bench.core.compiled import dividing_kernel

from .arrays import Intrinsics, Ints, Reals
from .hits import NEAR_M


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
def motion_blur(row0: int, row1: int, color: Reals, flow: Reals, shutter: float, blurred: Reals) -> None:
    """Average the colour of rows along the pixel's own flow over `shutter` of a frame interval, centred."""
    height, width = color.shape[:2]
    for row in range(row0, row1):
        for column in range(width):
            du, dv = flow[row, column, 0] * shutter, flow[row, column, 1] * shutter
            length = math.sqrt(du * du + dv * dv)
            if not length > 0.75:
                for ch in range(3):
                    blurred[row, column, ch] = color[row, column, ch]
                continue
            taps = min(int(length) + 2, 16)
            r, g, b = 0.0, 0.0, 0.0
            for i in range(taps):
                s = (i + 0.5) / taps - 0.5
                x = min(max(column + s * du, 0.0), width - 1.001)
                y = min(max(row + s * dv, 0.0), height - 1.001)
                x0, y0 = int(x), int(y)
                ax, ay = x - x0, y - y0
                w00, w10, w01, w11 = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
                r += (
                    w00 * color[y0, x0, 0]
                    + w10 * color[y0, x0 + 1, 0]
                    + w01 * color[y0 + 1, x0, 0]
                    + w11 * color[y0 + 1, x0 + 1, 0]
                )
                g += (
                    w00 * color[y0, x0, 1]
                    + w10 * color[y0, x0 + 1, 1]
                    + w01 * color[y0 + 1, x0, 1]
                    + w11 * color[y0 + 1, x0 + 1, 1]
                )
                b += (
                    w00 * color[y0, x0, 2]
                    + w10 * color[y0, x0 + 1, 2]
                    + w01 * color[y0 + 1, x0, 2]
                    + w11 * color[y0 + 1, x0 + 1, 2]
                )
            blurred[row, column, 0], blurred[row, column, 1], blurred[row, column, 2] = r / taps, g / taps, b / taps
