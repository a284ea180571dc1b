"""DAISY by its definition (Tola, Lepetit, Fua 2010), in floating point, with DAISY Filter Flow's layout.

Rectified directional derivatives, blurred at full resolution with the Gaussian of each ring, sampled bilinearly around
a point on a pattern that is scaled and rotated on demand, each histogram normalised on its own.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from dynslam_bench.flow import layout

PARTIAL_FLOOR = 0.01


def describe(
    image: NDArray[np.uint8], points: NDArray[np.floating], scale: float = 1.0, rotation: float = 0.0
) -> NDArray[np.float64]:
    """DAISY descriptors ``[N, 17, 8]`` of points ``[N, 2]``, pattern and bins scaled and rotated (radians).

    Each histogram has norm at most one. Samples outside the image are zero.
    """
    gray = np.pad(image / 255.0, 1, mode="edge")
    gx, gy = (gray[1:-1, 2:] - gray[1:-1, :-2]) / 2, (gray[2:, 1:-1] - gray[:-2, 1:-1]) / 2
    angle = np.arange(layout.BINS) * (2 * np.pi / layout.BINS)
    derivatives = np.maximum(gx * np.cos(angle)[:, None, None] + gy * np.sin(angle)[:, None, None], 0)
    c, s = scale * np.cos(rotation), scale * np.sin(rotation)
    x, y = np.moveaxis(np.asarray(points)[:, None] + layout.unit_pattern() @ [[c, s], [-s, c]], -1, 0)
    out = np.zeros((len(points), layout.HISTOGRAMS, layout.BINS))
    for sigma, ring in zip(layout.RING_SIGMAS, (slice(0, 9), slice(9, 17)), strict=True):
        for b, derivative in enumerate(derivatives):
            blurred = gaussian_filter(derivative, scale * sigma, mode="nearest", truncate=2.5)
            out[:, ring, b] = map_coordinates(blurred, (y[:, ring], x[:, ring]), order=1)
    whole, part = divmod(rotation * layout.BINS / (2 * np.pi), 1)  # bin b is read at direction b + theta / 45 degrees
    turned = (1 - part) * np.roll(out, -int(whole), -1) + part * np.roll(out, -int(whole) - 1, -1)
    return turned / (np.linalg.norm(turned, axis=-1, keepdims=True) + PARTIAL_FLOOR)
