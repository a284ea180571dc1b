"""What consistent regions say about the regions around them: affine motions, fitted and read at every pixel.

Used twice: as further labels for regions whose own label failed the way back, and to fill and smooth the final flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .superpixels import Superpixels

NEIGHBOURS = 9
SHARE = 0.5
"""A region is reliable if this share of its pixels is consistent."""
SMOOTH_PX = 3.0
"""Consistent pixels this close to the fitted motion take it: a similarity a region cannot follow a slanted plane."""


@dataclass(frozen=True, eq=False)
class RegionalMotion:
    """Affine motions of K regions.

    Attributes:
        centres: float64 ``[K, 2]``, full-image pixels.
        spread: float64 ``[K, 1]``, pixels a unit of `motion`.
        motion: float64 ``[K, 3, 2]``, flow at the centre, and its change per unit along x and y.
        region: int64 ``[H * W]``, region of every full-image pixel.
    """

    centres: NDArray[np.float64]
    spread: NDArray[np.float64]
    motion: NDArray[np.float64]
    region: NDArray[np.int64]

    def labels(self) -> NDArray[np.float32]:
        """The similarity nearest to each region's motion at its centre, as labels ``[K, 4]``."""
        slope = self.motion[:, 1:] / self.spread[:, :, None]  # d flow / d (x, y): [K, (x, y), (u, v)]
        a = 1 + 0.5 * (slope[:, 0, 0] + slope[:, 1, 1])
        b = 0.5 * (slope[:, 0, 1] - slope[:, 1, 0])
        s, theta = np.log2(np.maximum(np.hypot(a, b), 0.25)), np.arctan2(b, a)
        return np.column_stack([self.motion[:, 0], s, theta]).astype(np.float32)


def fit_regional_motion(
    flow: NDArray[np.float32], valid: NDArray[np.bool_], regions: Superpixels, guide: NDArray[np.uint8]
) -> RegionalMotion | None:
    """Fit an affine motion to the reliable regions around each region, robustly.

    Args:
        flow: float32 ``[H, W, 2]``.
        valid: bool ``[H, W]``, consistent pixels.
        regions: Superpixels at half resolution.
        guide: uint8 ``[H / 2, W / 2]``, their image; regions of similar grey level count more.

    Returns:
        The motions; None where fewer than three regions are reliable.
    """
    height, width = valid.shape
    y, x = np.minimum(np.arange(height) // 2, guide.shape[0] - 1), np.minimum(np.arange(width) // 2, guide.shape[1] - 1)
    region = regions.labels[np.ix_(y, x)].ravel().astype(np.int64)
    count = len(regions.centres)
    good = valid.ravel()
    pixels = np.maximum(np.bincount(region, minlength=count), 1)
    consistent = np.bincount(region, weights=good, minlength=count)
    reliable = np.flatnonzero((consistent >= SHARE * pixels) & (consistent > 0))
    if len(reliable) < 3:
        return None
    kept = np.flatnonzero(good)
    mean = np.empty((count, 4))  # position and flow of each region's consistent pixels
    columns = (kept % width, kept // width, *flow.reshape(-1, 2)[kept].T)
    for column, values in enumerate(columns):
        mean[:, column] = np.bincount(region[kept], weights=values, minlength=count) / np.maximum(consistent, 1)
    centres = regions.centres.astype(np.float64) * 2 + 0.5
    total = np.bincount(regions.labels.ravel(), weights=guide.ravel(), minlength=count)
    grey = total / np.maximum(np.bincount(regions.labels.ravel(), minlength=count), 1)
    near = min(NEIGHBOURS, len(reliable))
    distance, index = cKDTree(mean[reliable, :2]).query(centres, k=near)
    chosen = reliable[np.asarray(index).reshape(count, near)]
    distance = np.asarray(distance).reshape(count, near)
    spread = np.maximum(distance.mean(axis=1, keepdims=True), 1.0)
    weight = np.exp(-0.5 * (distance / spread) ** 2 - np.abs(grey[chosen] - grey[:, None]) / 20.0) + 1e-6
    offset = (mean[chosen, :2] - centres[:, None]) / spread[..., None]
    basis = np.concatenate([np.ones((count, near, 1)), offset], axis=2)
    values = mean[chosen, 2:]
    motion = np.zeros((count, 3, 2))
    for _ in range(3):  # iteratively reweighted: a foreground region must not bend the background
        weighted = basis * weight[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis
        normal[:, (0, 1, 2), (0, 1, 2)] += weight.sum(axis=1, keepdims=True) * (1e-6, 0.05, 0.05)
        motion = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ values)
        residual = np.linalg.norm(values - basis @ motion, axis=2)
        weight = weight / (1 + (residual / 2.0) ** 2)
    return RegionalMotion(centres, spread, motion, region)


def fill_and_smooth(flow: NDArray[np.float32], valid: NDArray[np.bool_], fitted: RegionalMotion) -> NDArray[np.float32]:
    """Replace pixels that are not valid, or lie within `SMOOTH_PX` of it, by the fitted motion."""
    height, width = valid.shape
    r = fitted.region
    at = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    local = ((at - fitted.centres[r]) / fitted.spread[r]).astype(np.float32)
    motion = fitted.motion.astype(np.float32)
    smooth = motion[r, 0] + local[:, :1] * motion[r, 1] + local[:, 1:] * motion[r, 2]
    own = flow.reshape(-1, 2)
    difference = smooth - own
    replaced = ~valid.ravel() | ((difference**2).sum(axis=1) < SMOOTH_PX**2)
    return np.where(replaced[:, None], smooth, own).astype(np.float32).reshape(flow.shape)
