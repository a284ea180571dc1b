"""Orientation maps in plain numpy: the exact reference of the kernels."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow import layout
from dynslam_bench.flow.histogram_vectors import COSINES, DERIVATIVE_SHIFT
from dynslam_bench.flow.orientation_maps import FIXED_POINT, NORM_FLOOR

Array = NDArray[np.generic]


def quantised_maps(gray: Array) -> Array:
    """Histograms uint8 ``[total, 8]`` of a uint8 ``[H, W]`` image, equal to those of `orientation_maps`."""
    geometry = layout.map_geometry(*gray.shape)
    histograms = np.zeros((geometry.total, layout.BINS), np.uint8)
    maps = half_derivatives(gray)
    step = layout.LEVEL_STEPS[0]
    for level, (level_step, (taps, distance)) in enumerate(
        zip(layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True)
    ):
        if level_step != step:
            maps = halved(maps)
            step = level_step
        maps = binomial(binomial(maps, 1, taps, distance), 2, taps, distance)
        norm = np.sqrt((maps**2).sum(axis=0).astype(np.float32))
        gain = np.float32(255) / (norm + np.float32(NORM_FLOOR * FIXED_POINT))
        cells = np.moveaxis(
            (maps.astype(np.float32) * gain + np.float32(0.5)).astype(np.uint8), 0, -1
        )
        margin = layout.MARGIN // step
        base = geometry.base[level]
        stride = geometry.stride[level]
        rows, columns = cells.shape[:2]
        area = histograms[base : base + (rows + 2 * margin) * stride].reshape(
            -1, stride, layout.BINS
        )
        area[margin : margin + rows, margin : margin + columns] = cells
    return histograms


def half_derivatives(gray: Array) -> Array:
    """Rectified derivatives int32 ``[8, h, w]`` of the half-resolution image, 256ths of a level a full-image pixel."""
    pixels = even(gray.astype(np.int32))
    sums = pixels[::2, ::2] + pixels[::2, 1::2] + pixels[1::2, ::2] + pixels[1::2, 1::2]
    gx, gy = (shifted(sums, axis, 1) - shifted(sums, axis, -1) for axis in (1, 0))
    along = np.stack([gx * COSINES[b] + gy * COSINES[(b - 2) % 8] for b in range(layout.BINS)])
    return ((along + (1 << (DERIVATIVE_SHIFT - 1))) >> DERIVATIVE_SHIFT).clip(min=0)


def binomial(maps: Array, axis: int, taps: int, distance: int) -> Array:
    """A blur of 3 or 5 taps along an axis, edges repeated, made of rounded means."""
    near = mean(shifted(maps, axis, -distance), shifted(maps, axis, distance))
    if taps == 3:
        return mean(maps, near)
    far = mean(shifted(maps, axis, -2 * distance), shifted(maps, axis, 2 * distance))
    return mean(near, mean(maps, mean(maps, far)))


def mean(first: Array, second: Array) -> Array:
    return (first + second + 1) >> 1


def shifted(maps: Array, axis: int, by: int) -> Array:
    """The neighbour `by` places on along an axis, the edge's own value beyond it."""
    last = maps.shape[axis] - 1
    return maps.take((np.arange(last + 1) + by).clip(0, last), axis)


def even(maps: Array) -> Array:
    """The last two axes cut to even lengths; a single row or column is doubled."""
    for axis in (-2, -1):
        count = maps.shape[axis]
        maps = maps.take(np.arange(2 * max(1, count // 2)).clip(max=count - 1), axis)
    return maps


def halved(maps: Array) -> Array:
    """Mean of 2 x 2 histograms, rounded: rows first, then columns."""
    maps = even(maps)
    tall = mean(maps[:, ::2], maps[:, 1::2])
    return mean(tall[..., ::2], tall[..., 1::2])
