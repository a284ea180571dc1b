"""Superpixels by k-means in position and grey level from a regular grid on (SLIC, Achanta et al. 2012, simplified)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

from ..kernels.arrays import Bytes, Doubles, Ints


@dataclass(frozen=True, eq=False)
class Superpixels:
    """A division of an image into K regions.

    Attributes:
        labels: int32 ``[H, W]``, region of every pixel.
        centres: float32 ``[K, 2]``, mean position of each region, pixels.
        members: int64 ``[H * W]``, flat pixel indices ordered by region.
        starts: int64 ``[K + 1]``, where each region's members begin.
    """

    labels: NDArray[np.int32]
    centres: NDArray[np.float32]
    members: NDArray[np.int64]
    starts: NDArray[np.int64]


def superpixels(gray: NDArray[np.uint8], size: int, *, compactness: float = 20.0, iterations: int = 4) -> Superpixels:
    """Divide a uint8 ``[H, W]`` image into regions of about ``size * size`` pixels.

    Args:
        gray: The image.
        size: Side of the initial squares, pixels.
        compactness: Grey levels that weigh as much as a distance of `size`.
        iterations: Of k-means.
    """
    height, width = gray.shape
    rows, columns = max(1, round(height / size)), max(1, round(width / size))
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    centres = np.zeros((rows * columns, 3), dtype=np.float64)
    centres[:, 0], centres[:, 1] = np.tile(x, rows), np.repeat(y, columns)
    centres[:, 2] = gray[np.rint(centres[:, 1]).astype(int), np.rint(centres[:, 0]).astype(int)]
    labels = np.empty((height, width), dtype=np.int32)
    assign_pixels(gray, centres, size, (size / compactness) ** 2, iterations, labels)
    flat = labels.reshape(-1)
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=len(centres)))])
    members = np.argsort(flat, kind="stable")
    return Superpixels(labels, centres[:, :2].astype(np.float32), members, starts.astype(np.int64))


@kernel
def assign_pixels(gray: Bytes, centres: Doubles, size: int, weight: float, iterations: int, labels: Ints) -> None:
    """K-means: each centre competes for the pixels within `size` of it; fills `labels`, moves `centres`."""
    height, width = gray.shape
    distance = np.empty((height, width), dtype=np.float64)
    sums = np.empty((len(centres), 4), dtype=np.float64)
    for _ in range(iterations):
        distance[:] = np.inf
        labels[:] = -1
        for k in range(len(centres)):
            cx, cy, cg = centres[k, 0], centres[k, 1], centres[k, 2]
            for y in range(max(0, int(cy - size)), min(height, int(cy + size) + 2)):
                for x in range(max(0, int(cx - size)), min(width, int(cx + size) + 2)):
                    dx, dy, dg = x - cx, y - cy, gray[y, x] - cg
                    d = dx * dx + dy * dy + weight * dg * dg
                    if d < distance[y, x]:
                        distance[y, x], labels[y, x] = d, k
        sums[:] = 0
        for y in range(height):
            for x in range(width):
                k = labels[y, x]
                if k < 0:  # too far from every centre: the nearest in position
                    best = np.inf
                    for other in range(len(centres)):
                        d = (x - centres[other, 0]) ** 2 + (y - centres[other, 1]) ** 2
                        if d < best:
                            best, k = d, other
                    labels[y, x] = k
                sums[k, 0] += x
                sums[k, 1] += y
                sums[k, 2] += gray[y, x]
                sums[k, 3] += 1
        for k in range(len(centres)):
            if sums[k, 3] > 0:
                for j in range(3):
                    centres[k, j] = sums[k, j] / sums[k, 3]
