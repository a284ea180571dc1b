"""The orientation maps on any torch device.

`quantised_maps` computes what `maps` computes for the processor, in the same arrangement, so that both index it with
the same tables.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels.words import COSINES, DERIVATIVE_SHIFT
from . import layout
from .levels import MapGeometry, map_geometry
from .maps import FIXED_POINT, NORM_FLOOR


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
