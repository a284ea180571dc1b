"""DAISY by its definition (Tola, Lepetit, Fua 2010), in floating point, with DAISY Filter Flow's layout.

Rectified directional derivatives, blurred at full resolution with the Gaussian of each ring, sampled bilinearly around
a point on a pattern that is scaled and rotated on demand, each histogram normalised on its own.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from torch import Tensor

from dynslam_bench.flow import layout

PARTIAL_FLOOR = 0.01


def gaussian_weights(sigma: float) -> NDArray[np.float32]:
    """Half of a normalised, sampled Gaussian: weight of the centre, then of each offset; cut at 2.5 sigma."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    weights = np.exp(-0.5 * (np.arange(radius + 1) / sigma) ** 2)
    return np.asarray(weights / (weights[0] + 2 * weights[1:].sum()), dtype=np.float32)


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
