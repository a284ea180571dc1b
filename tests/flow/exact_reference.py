"""Orientation maps, rotated descriptors and matching costs in plain numpy: the exact reference of the kernels."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.flow import layout
from dynslam_bench.flow.matching_cost import OUTSIDE, CostTables
from dynslam_bench.flow.orientation_maps import FIXED_POINT, NORM_FLOOR
from dynslam_bench.flow.simd import COSINES, DERIVATIVE_SHIFT

Array = NDArray[np.generic]


def quantised_maps(gray: Array) -> Array:
    """Histograms uint8 ``[total, 8]`` of a uint8 ``[H, W]`` image, equal to those of `orientation_maps`."""
    geometry = layout.map_geometry(*gray.shape)
    histograms = np.zeros((geometry.total, layout.BINS), np.uint8)
    maps, step = half_derivatives(gray), layout.LEVEL_STEPS[0]
    for level, (level_step, (taps, distance)) in enumerate(zip(layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True)):
        if level_step != step:
            maps, step = halved(maps), level_step
        maps = binomial(binomial(maps, 1, taps, distance), 2, taps, distance)
        norm = np.sqrt((maps**2).sum(axis=0).astype(np.float32))
        gain = np.float32(255) / (norm + np.float32(NORM_FLOOR * FIXED_POINT))
        cells = np.moveaxis((maps.astype(np.float32) * gain + np.float32(0.5)).astype(np.uint8), 0, -1)
        margin, base, stride = layout.MARGIN // step, geometry.base[level], geometry.stride[level]
        rows, columns = cells.shape[:2]
        area = histograms[base : base + (rows + 2 * margin) * stride].reshape(-1, stride, layout.BINS)
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


def sample(histograms: Array, xy: Array, scale: Array, rotation: Array, tables: CostTables) -> Array:
    """Histograms ``[..., 17, 8]`` at positions ``[..., 2]`` for scale and rotation indices ``[...]``."""
    cells = []
    for level, places in ((tables.ring0[scale], slice(0, 9)), (tables.ring1[scale], slice(9, 17))):
        quarter = (xy * 4 + np.float32(0.5)).astype(np.int64) + level[..., 3:4]
        half = quarter >> (level[..., 2:3] - 1)
        first = level[..., 0] + (half[..., 1] >> 1) * level[..., 1] + (half[..., 0] >> 1)
        phase = 2 * (half[..., 1] & 1) + (half[..., 0] & 1)
        cells.append(first[..., None] + tables.samples[scale, rotation, phase][..., places] // layout.BINS)
    return histograms[np.concatenate(cells, axis=-1)].astype(np.int32)


def within(xy: Array, shape: tuple[int, int]) -> Array:
    return np.minimum(xy.clip(min=0), np.array(shape[::-1], np.float32) - 1)


def rotated_descriptors(histograms: Array, points: Array, shape: tuple[int, int], tables: CostTables) -> Array:
    """Reference descriptors uint8 ``[N, S, ROTATIONS, 17, 8]`` of points float32 ``[N, 2]``."""
    xy = within(points[:, None] + tables.support.astype(np.float32), shape)
    neutral = np.full(xy.shape[:-1], -layout.SCALE_LOW)
    plain = sample(histograms, xy, neutral, np.full_like(neutral, -layout.ANGLE_LOW), tables)
    turned = []
    for sixths in range(layout.ANGLE_LOW, layout.ANGLE_HIGH + 1):
        whole, part = divmod(sixths, 6)
        far = part * 171  # of 1026
        turned.append(((1026 - far) * np.roll(plain, whole, -1) + far * np.roll(plain, whole + 1, -1) + 512) >> 10)
    return np.stack(turned, axis=2).astype(np.uint8)


def label_costs(
    points: Array, labels: Array, descriptors: Array, histograms: Array, shape: tuple[int, int], tables: CostTables
) -> Array:
    """First term of Eq. 1 of one label a point, ``[N, 4]``; `OUTSIDE` where it leaves the image. Int64 ``[N]``."""
    centre = points + labels[:, :2]
    inside = (centre == within(centre, shape)).all(axis=1)
    labels = np.where(inside[:, None], labels, 0)
    scale = np.floor(labels[:, 2] * 4 + np.float32(0.5)).astype(int) - layout.SCALE_LOW
    rotation = np.floor(labels[:, 3] * np.float32(7.639437268410976) + np.float32(0.5)).astype(int) - layout.ANGLE_LOW
    scale, rotation = scale.clip(0, layout.SCALE_HIGH - layout.SCALE_LOW), rotation.clip(0, layout.ROTATIONS - 1)
    c, s = np.exp2(labels[:, 2]) * (np.cos(labels[:, 3]), np.sin(labels[:, 3]))
    total = np.zeros(len(points), np.int64)
    for q, (dx, dy) in enumerate(tables.support.astype(np.float32)):
        xy = points + labels[:, :2] + np.stack([c * dx - s * dy, s * dx + c * dy], axis=1)
        theirs = sample(histograms, within(xy, shape), scale, rotation, tables)
        distance = np.abs(theirs - descriptors[np.arange(len(points)), q, rotation].astype(np.int32)).sum(axis=2)
        total += distance.clip(max=tables.truncation).sum(axis=1)
    return np.where(inside, total, OUTSIDE)
