"""DAISY on any torch device: the reference in floating point, and the quantised maps of the matching cost.

`describe` follows the definition (Tola, Lepetit, Fua 2010) with DAISY Filter Flow's layout: rectified directional
derivatives, blurred at full resolution with the Gaussian of each ring, sampled bilinearly around a point on a pattern
that is scaled and rotated on demand, each histogram normalised on its own. `quantised_maps` computes what `maps`
computes for the processor, in the same arrangement, so that both index it with the same tables.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from ..kernels.words import COSINES, DERIVATIVE_SHIFT
from . import layout
from .maps import FIXED_POINT, NORM_FLOOR, MapGeometry, gaussian_weights, map_geometry

PARTIAL_FLOOR = 0.01


def directional_derivatives(images: Tensor, *, bins: int = layout.BINS) -> Tensor:
    """Rectified derivatives along equally spaced directions.

    Args:
        images: float ``[B, H, W]``.
        bins: Number of directions; bin k looks along ``k * 360 / bins`` degrees (x to the right, y down).

    Returns:
        ``[B, bins, H, W]``, central differences, at least 0.
    """
    padded = functional.pad(images[:, None], (1, 1, 1, 1), mode="replicate")
    gx = 0.5 * (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2])
    gy = 0.5 * (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1])
    angle = torch.arange(bins, device=images.device, dtype=images.dtype) * (2 * np.pi / bins)
    return torch.relu(gx * angle.cos()[:, None, None] + gy * angle.sin()[:, None, None])


def blur(maps: Tensor, weights: Tensor) -> Tensor:
    """Separable convolution of ``[B, C, H, W]`` with a symmetric kernel given by its half, edges repeated."""
    radius = len(weights) - 1
    kernel = torch.cat([weights.flip(0), weights[1:]])
    flat = maps.reshape(-1, 1, *maps.shape[-2:])
    flat = functional.conv2d(
        functional.pad(flat, (0, 0, radius, radius), mode="replicate"), kernel[None, None, :, None]
    )
    flat = functional.conv2d(functional.pad(flat, (radius, radius, 0, 0), mode="replicate"), kernel[None, None, None])
    return flat.reshape(maps.shape)


def describe(images: Tensor, points: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
    """DAISY descriptors of points at given scales and rotations.

    Args:
        images: float ``[B, H, W]``, grey levels in [0, 1].
        points: float ``[B, N, 2]``, pixels (x, y).
        scales: float ``[B, N]``; each distinct value costs one blur per ring.
        rotations: float ``[B, N]``, radians; pattern and bins turn along.

    Returns:
        float ``[B, N, 17, 8]``; each histogram has norm at most one. Samples outside the image are zero.
    """
    batch, height, width = images.shape
    derivatives = directional_derivatives(images)
    pattern = torch.as_tensor(layout.unit_pattern(), dtype=images.dtype, device=images.device)
    out = images.new_zeros((batch, points.shape[1], layout.HISTOGRAMS, layout.BINS))
    c, s = rotations.cos(), rotations.sin()
    turn = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    places = points[:, :, None] + scales[..., None, None] * torch.einsum("bnij,kj->bnki", turn, pattern)
    size = torch.tensor([width, height], dtype=images.dtype, device=images.device)
    grid = (2 * places + 1) / size - 1
    for scale in torch.unique(scales):
        rows, columns = torch.nonzero(scales == scale, as_tuple=True)
        for ring, sigma in enumerate(layout.RING_SIGMAS):
            chosen = slice(0, 9) if ring == 0 else slice(9, 17)
            blurred = blur(derivatives, _weights(float(scale) * sigma, images))
            for image in torch.unique(rows):
                mine = columns[rows == image]
                sampled = functional.grid_sample(
                    blurred[image][None], grid[image, mine, chosen][None], align_corners=False, padding_mode="zeros"
                )
                out[image, mine, chosen] = sampled[0].permute(1, 2, 0)
    turned = _turn_bins(out, rotations)
    norm: Tensor = torch.linalg.vector_norm(turned, dim=-1, keepdim=True)
    return turned / (norm + PARTIAL_FLOOR)


def _turn_bins(histograms: Tensor, rotations: Tensor) -> Tensor:
    """Histograms relative to a rotated frame: bin b is read at direction ``b + theta / 45 degrees``, interpolated."""
    bins = histograms.shape[-1]
    shift = rotations * (bins / (2 * np.pi))
    whole = shift.floor()
    fraction = (shift - whole)[..., None, None]
    index = torch.arange(bins, device=histograms.device)
    near = (index + whole.long()[..., None]) % bins
    shape = histograms.shape
    first = histograms.gather(-1, near[..., None, :].expand(shape))
    second = histograms.gather(-1, ((near + 1) % bins)[..., None, :].expand(shape))
    return (1 - fraction) * first + fraction * second


def _weights(sigma: float, like: Tensor) -> Tensor:
    return torch.as_tensor(gaussian_weights(sigma), dtype=like.dtype, device=like.device)


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
