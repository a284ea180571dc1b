"""The DAISY descriptor's sampling pattern for every quantised label, and the arrangement of the orientation maps.

The layout is DAISY Filter Flow's: radius 16 px, two rings of eight histograms around a centre,
eight bins each: (2 * 8 + 1) * 8 = 136 numbers. The Gaussian of ring r has sigma (r + 1) * 16 / 4 =
4, 8 px; the centre shares ring 0's.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RINGS = 2
"""Rings of histograms around the centre's."""
ANGLES = 8
"""Histograms a ring."""
BINS = 8
"""Orientations of a histogram."""
HISTOGRAMS = RINGS * ANGLES + 1
"""Histograms of a descriptor: the centre's, and those of the rings."""
LENGTH = HISTOGRAMS * BINS
"""Numbers of a descriptor."""
RING_RADII = (8.0, 16.0)
"""Distance of each ring from the centre, px at scale 1."""
RING_SIGMAS = (4.0, 8.0)
"""Sigma of each ring's Gaussian, px at scale 1."""

# scale indices k: s = 2 ** (k / 4) for k in -4..5, that is 0.5 to 2.38
SCALE_STEP_OCTAVES = 0.25
"""Octaves from one scale index to the next."""
SCALE_LOW = -4
"""Lowest scale index."""
SCALE_HIGH = 5
"""Highest scale index."""

# rotation indices: 7.5 degrees each, -45 to 45
ANGLE_STEP_DEG = 7.5
"""Degrees from one rotation index to the next."""
ANGLE_LOW = -6
"""Lowest rotation index."""
ANGLE_HIGH = 6
"""Highest rotation index."""
ROTATIONS = ANGLE_HIGH - ANGLE_LOW + 1
"""Number of rotation indices."""

LEVEL_SIGMAS = (2.0, 2.0 * 2**0.5, 4.0, 4.0 * 2**0.5, 8.0, 8.0 * 2**0.5, 16.0)
"""Gaussian sigmas of the orientation maps, px of the full image."""
LEVEL_STEPS = (2, 2, 2, 4, 4, 4, 4)
"""Full-image pixels per map pixel of each level."""
LEVEL_BLURS = ((5, 1), (5, 1), (3, 2), (5, 1), (3, 2), (5, 2), (3, 4))
"""Each level's blur of the one before: taps of a binomial and their distance in map pixels.

Its variance is ``(taps - 1) / 4 * distance ** 2``: 1, 1, 2 at half resolution, that is sigmas of 2,
2.83 and 4 px; the mean of 2 x 2 brings 4.12 px, and 1, 2, 4, 8 at quarter resolution make 5.7, 8.1, 11.4 and 16.1.
"""
MARGIN = 48
"""Empty border around each map in full-image pixels: the outermost sample lies 16 * 2.38 = 38 px from the centre."""

SUBPIXEL = 4
"""Positions are quantised to a quarter of a pixel before the map is indexed."""


def unit_pattern() -> NDArray[np.float64]:
    """The 17 sampling points of the unscaled, unrotated descriptor, ``[HISTOGRAMS, 2]`` px: centre, ring 0, ring 1."""
    angles = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    rings = [np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius for radius in RING_RADII]
    return np.concatenate([np.zeros((1, 2)), *rings])


def sampling_table() -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The pattern for every scale and rotation index: ``s * R(theta) * g_k`` (Eq. 1's D_{s,theta}).

    Returns:
        int32 ``[scales, ROTATIONS, HISTOGRAMS, 2]``, displacement (x, y) from the centre in quarter
        pixels, and int64 ``[scales, RINGS]``, map level of each ring at each scale: the one whose
        Gaussian is closest in ratio.
    """
    # every point of the pattern, scaled and rotated: [scales, rotations, points, 2]
    pattern = unit_pattern()
    scales = 2.0 ** (np.arange(SCALE_LOW, SCALE_HIGH + 1) * SCALE_STEP_OCTAVES)
    theta = np.deg2rad(np.arange(ANGLE_LOW, ANGLE_HIGH + 1) * ANGLE_STEP_DEG)
    c = np.cos(theta)
    s = np.sin(theta)
    rotation = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    points = np.einsum("s,rij,kj->srki", scales, rotation, pattern)

    # the level of each ring at each scale
    sigmas = scales[:, None] * RING_SIGMAS
    levels = np.abs(np.log(LEVEL_SIGMAS) - np.log(sigmas)[..., None]).argmin(axis=-1)
    return np.rint(points * SUBPIXEL).astype(np.int32), levels


class MapGeometry(NamedTuple):
    """Geometry of the maps: where each level lies in the flat histogram array.

    Attributes:
        base: int64 ``[LEVELS]``, index of each level's first histogram (the corner of its margin).
        stride: int64 ``[LEVELS]``, histograms a row, margins included.
        shift: int64 ``[LEVELS]``, quarter pixels to map pixels:
            ``index = (position + bias) >> shift``.
        bias: int64 ``[LEVELS]``, rounding and margin.
        total: Number of histograms.
    """

    base: NDArray[np.int64]
    stride: NDArray[np.int64]
    shift: NDArray[np.int64]
    bias: NDArray[np.int64]
    total: int


@lru_cache(maxsize=16)
def map_geometry(height: int, width: int) -> MapGeometry:
    """The arrangement of the seven levels for an image size in pixels."""
    levels = []
    total = 0
    for step in LEVEL_STEPS:
        # an odd last row or column is dropped
        rows = max(1, height // step)
        columns = max(1, width // step)
        margin = MARGIN // step
        # full-image x (pixel centres at integers) lies in map pixel floor((x + 0.5) / step)
        shift = int(np.log2(step * SUBPIXEL))
        # half a pixel and the margin, in quarter pixels
        bias = SUBPIXEL // 2 + margin * step * SUBPIXEL
        levels.append((total, columns + 2 * margin, shift, bias))
        total += (rows + 2 * margin) * (columns + 2 * margin)
    base, stride, shift, bias = np.array(levels, dtype=np.int64).T.copy()
    return MapGeometry(base, stride, shift, bias, total)
