"""Orientation maps and rotated descriptors in plain torch code: the exact reference of the compiled kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from dynslam_bench.flow import layout
from dynslam_bench.flow.layout import MapGeometry, map_geometry
from dynslam_bench.flow.orientation_maps import FIXED_POINT, NORM_FLOOR
from dynslam_bench.flow.simd import COSINES, DERIVATIVE_SHIFT
from dynslam_bench.flow.torch_flow import TorchTables, sample


def quantised_maps(gray: Tensor) -> tuple[Tensor, MapGeometry]:
    """The orientation maps of `maps.orientation_maps` on any device.

    Args:
        gray: uint8 ``[H, W]``.

    Returns:
        uint8 ``[total, 8]`` histograms, equal to those of the processor's kernels, and their arrangement.
    """
    height, width = int(gray.shape[0]), int(gray.shape[1])
    geometry = map_geometry(height, width)
    histograms = torch.zeros((geometry.total, layout.BINS), dtype=torch.uint8, device=gray.device)
    maps = _whole_derivatives(gray)
    step = layout.LEVEL_STEPS[0]
    for level, (level_step, (taps, distance)) in enumerate(zip(layout.LEVEL_STEPS, layout.LEVEL_BLURS, strict=True)):
        if level_step != step:
            maps, step = _halve(maps), level_step
        for axis in (1, 2):
            maps = _binomial(maps, axis, taps, distance)
        norm = maps.square().sum(dim=0, keepdim=True).float().sqrt()
        gain = torch.full_like(norm, 255) / (norm + torch.full_like(norm, NORM_FLOOR * FIXED_POINT))
        cells = (maps.float() * gain + 0.5).to(torch.uint8).permute(1, 2, 0)
        margin = layout.MARGIN // step
        base, stride = int(geometry.base[level]), int(geometry.stride[level])
        rows, columns = cells.shape[:2]
        area = histograms[base : base + (rows + 2 * margin) * stride].view(rows + 2 * margin, stride, layout.BINS)
        area[margin : margin + rows, margin : margin + columns] = cells
    return histograms, geometry


def _whole_derivatives(gray: Tensor) -> Tensor:
    """Rectified derivatives int32 ``[8, h, w]`` of the half-resolution image, 256ths of a level a full-image pixel."""
    pixels = _even(gray.int())
    sums = (pixels[::2, ::2] + pixels[::2, 1::2]) + (pixels[1::2, ::2] + pixels[1::2, 1::2])
    gx = _moved(sums, 1, 1) - _moved(sums, 1, -1)
    gy = _moved(sums, 0, 1) - _moved(sums, 0, -1)
    bins = [gx * COSINES[b] + gy * COSINES[(b - 2) % 8] for b in range(layout.BINS)]
    return ((torch.stack(bins) + (1 << (DERIVATIVE_SHIFT - 1))) >> DERIVATIVE_SHIFT).clamp(min=0)


def _binomial(maps: Tensor, axis: int, taps: int, distance: int) -> Tensor:
    """One blur of `smoothing.smooth_line` along an axis, edges repeated."""
    near = _mean(_moved(maps, axis, -distance), _moved(maps, axis, distance))
    if taps == 3:
        return _mean(maps, near)
    far = _mean(_moved(maps, axis, -2 * distance), _moved(maps, axis, 2 * distance))
    return _mean(near, _mean(maps, _mean(maps, far)))


def _mean(first: Tensor, second: Tensor) -> Tensor:
    return (first + second + 1) >> 1


def _moved(maps: Tensor, axis: int, by: int) -> Tensor:
    """The neighbour `by` places on along an axis, the edge's own value beyond it."""
    last = maps.shape[axis] - 1
    return maps.index_select(axis, (torch.arange(last + 1, device=maps.device) + by).clamp(0, last))


def _even(maps: Tensor) -> Tensor:
    """The last two axes cut to even lengths; a single row or column is doubled."""
    for axis in (-2, -1):
        count = maps.shape[axis]
        index = torch.arange(2 * max(1, count // 2), device=maps.device).clamp(max=count - 1)
        maps = maps.index_select(axis, index)
    return maps


def _halve(maps: Tensor) -> Tensor:
    """Mean of 2 x 2 histograms, rounded as in `smoothing.fine_levels`: rows first, then columns."""
    maps = _even(maps)
    tall = _mean(maps[:, ::2], maps[:, 1::2])
    return _mean(tall[..., ::2], tall[..., 1::2])


def rotated_descriptors(histograms: Tensor, points: Tensor, tables: TorchTables) -> Tensor:
    """Reference descriptors uint8 ``[N, S, ROTATIONS, 17, 8]`` of points float32 ``[N, 2]``."""
    limit = torch.tensor([tables.width - 1, tables.height - 1], dtype=points.dtype, device=points.device)
    xy = (points[:, None] + tables.support.to(points.dtype)).clamp(min=0).minimum(limit)
    neutral = torch.full(xy.shape[:-1], -layout.SCALE_LOW, device=points.device)
    straight = torch.full_like(neutral, -layout.ANGLE_LOW)
    plain = sample(histograms, xy, neutral, straight, tables).int()
    turned = []
    for sixths in range(layout.ANGLE_LOW, layout.ANGLE_HIGH + 1):
        whole, part = divmod(sixths, 6)
        far = part * 171  # of 1026
        near_bins, far_bins = plain.roll(whole, dims=-1), plain.roll(whole + 1, dims=-1)
        turned.append((((1026 - far) * near_bins + far * far_bins + 512) >> 10).to(torch.uint8))
    return torch.stack(turned, dim=2)
