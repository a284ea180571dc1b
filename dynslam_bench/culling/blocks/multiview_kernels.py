"""Compiled loops of DynaSLAM's multi-view geometry: which projected points are hidden, and what hides them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

BIN_M = 0.005
"""Depth resolution at which the next pixel of a region is chosen: the one nearest to the region's mean comes first."""


@kernel
def hidden(
    depth: NDArray[np.float32], centre: NDArray[np.int64], expected: NDArray[np.float64], tau: float, radius: int
) -> NDArray[np.bool_]:
    """Which points are hidden by something nearer, whatever small error their projection has.

    The depth that a point is compared with is the one in the window that is nearest to what is expected, among those
    in front of it: a point beside an object is not hidden, only one well inside its outline is.

    Args:
        depth: float32 ``[H, W]`` metres, 0 missing.
        centre: int64 ``[N, 2]`` pixels (column, row) of the projected points, at least `radius` from the border.
        expected: float64 ``[N]`` depth at which the points should be seen, metres.
        tau: How far in front of it everything must be, metres.
        radius: Half side of the window, pixels.

    Returns:
        Bool ``[N]``; False also where the point's own pixel has no depth, or nothing in the window is nearer.
    """
    found = np.zeros(len(centre), np.bool_)
    for i in range(len(centre)):
        column, row = centre[i]
        if not depth[row, column] > 0:
            continue
        nearer, all_far = False, True
        for y in range(row - radius, row + radius + 1):
            for x in range(column - radius, column + radius + 1):
                z = depth[y, x]
                if 0 < z < expected[i]:
                    nearer = True
                    if expected[i] - z <= tau:
                        all_far = False
                        break
            if not all_far:
                break
        found[i] = nearer and all_far
    return found


@kernel
def grow(depth: NDArray[np.float32], seeds: NDArray[np.int64], step: float, bin_m: float) -> NDArray[np.uint8]:
    """Regions of like depth around seeds: neighbours join while they are within `step` of the region's mean.

    Of all neighbours of a region the one nearest to its mean joins next (to `bin_m`), and the mean moves along. Pixels
    without depth never join. A seed within an earlier region founds none of its own.

    Args:
        depth: float32 ``[H, W]`` metres, 0 missing, at most a few ten metres.
        seeds: int64 ``[N, 2]`` pixels (column, row).
        step: Largest distance to the mean, metres.
        bin_m: Resolution of the order, metres.

    Returns:
        uint8 ``[H, W]``, 1 in a region.
    """
    height, width = depth.shape
    mask = np.zeros((height, width), np.uint8)
    visited = np.zeros(height * width, np.int32)  # number of the region that last touched the pixel
    following = np.empty(height * width, np.int64)
    bins = int(np.ceil(depth.max() / bin_m)) + 2
    head = np.full(bins, -1, np.int64)
    reach = int(np.ceil(step / bin_m)) + 1
    flat, out = depth.ravel(), mask.ravel()
    for k in range(len(seeds)):
        start = seeds[k, 1] * width + seeds[k, 0]
        if out[start] or not flat[start] > 0:
            continue
        head[:] = -1
        mean, size, pixel = 0.0, 0, start
        visited[start] = k + 1
        while pixel >= 0:
            out[pixel] = 1
            mean = (mean * size + flat[pixel]) / (size + 1)
            size += 1
            row, column = pixel // width, pixel % width
            for side in range(4):
                r = row + (side == 0) - (side == 1)
                c = column + (side == 2) - (side == 3)
                if 0 <= r < height and 0 <= c < width:
                    other = r * width + c
                    if visited[other] != k + 1 and flat[other] > 0:
                        visited[other] = k + 1
                        b = int(flat[other] / bin_m)
                        following[other] = head[b]
                        head[b] = other
            pixel = -1
            middle = int(mean / bin_m)
            for away in range(reach + 1):
                for b in (middle - away, middle + away):
                    if 0 <= b < bins and head[b] >= 0 and abs(flat[head[b]] - mean) < step:
                        pixel = head[b]
                        head[b] = following[pixel]
                        break
                if pixel >= 0:
                    break
    return mask
