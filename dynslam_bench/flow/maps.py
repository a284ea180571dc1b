"""Convolved orientation maps for the processor: what DAISY needs of one image, computed once a frame.

Eight rectified directional derivatives are blurred in a cascade of seven Gaussians. Maps of small Gaussians are kept at
half, of large ones at quarter resolution; each histogram is normalised on its own (partial normalisation) and stored as
eight adjacent bytes, so that one descriptor histogram is one 64-bit load. `daisy.py` is the float reference.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import layout
from ._jit import kernel
from .refinement import BORDER, pad_image
from .workers import run_stripes

NORM_FLOOR = 0.01 * 255.0
"""Added to a histogram's norm before dividing, so that flat regions stay near zero (0.01 for images in [0, 1])."""


class MapGeometry(NamedTuple):
    """Where each level lies in the flat histogram array.

    Attributes:
        base: int64 ``[LEVELS]``, index of each level's first histogram (the corner of its margin).
        stride: int64 ``[LEVELS]``, histograms a row, margins included.
        shift: int64 ``[LEVELS]``, quarter pixels to map pixels: ``index = (position + bias) >> shift``.
        bias: int64 ``[LEVELS]``, rounding and margin.
        total: Number of histograms.
    """

    base: NDArray[np.int64]
    stride: NDArray[np.int64]
    shift: NDArray[np.int64]
    bias: NDArray[np.int64]
    total: int


@dataclass(frozen=True, eq=False)
class OrientationMaps:
    """One prepared image.

    Attributes:
        gray: uint8 ``[H, W]``, the image.
        framed: uint8 ``[H + 96, W + 96]``, the image with its edges repeated (`refinement.BORDER`).
        framed_half: uint8 ``[H / 2 + 96, W / 2 + 96]``, its mean over 2 x 2 pixels, likewise.
        histograms: uint8 ``[total, 8]``, all levels; a unit-norm histogram has Euclidean length 255.
        geometry: How to index them.
    """

    gray: NDArray[np.uint8]
    framed: NDArray[np.uint8]
    framed_half: NDArray[np.uint8]
    histograms: NDArray[np.uint8]
    geometry: MapGeometry


@lru_cache(maxsize=16)
def map_geometry(height: int, width: int) -> MapGeometry:
    """The arrangement of the seven levels for an image size in pixels."""
    base, stride, shift, bias, total = [], [], [], [], 0
    for step in layout.LEVEL_STEPS:
        rows, columns = _level_shape(height, width, step)
        margin = layout.MARGIN // step
        base.append(total)
        stride.append(columns + 2 * margin)
        # full-image x (pixel centres at integers) falls into map pixel floor((x + 0.5) / step)
        shift.append(int(np.log2(step * layout.SUBPIXEL)))
        bias.append(layout.SUBPIXEL // 2 + margin * step * layout.SUBPIXEL)
        total += (rows + 2 * margin) * (columns + 2 * margin)
    return MapGeometry(
        np.asarray(base, dtype=np.int64), np.asarray(stride, dtype=np.int64), np.asarray(shift, dtype=np.int64),
        np.asarray(bias, dtype=np.int64), total,
    )  # fmt: skip


def orientation_maps(
    gray: NDArray[np.uint8], *, threads: int = 1, pool: ThreadPoolExecutor | None = None
) -> OrientationMaps:
    """Compute the maps of a uint8 ``[H, W]`` image; the result does not depend on the number of threads."""
    gray = np.ascontiguousarray(gray)
    height, width = gray.shape
    geometry = map_geometry(height, width)
    histograms = np.zeros((geometry.total, layout.BINS), dtype=np.uint8)
    rows, columns = _level_shape(height, width, 2)
    half = np.empty((rows, columns), dtype=np.uint8)
    exact = np.empty((rows, columns), dtype=np.float32)
    run_stripes(_halve, rows, threads, pool, gray, exact, half)
    source = np.empty((rows, columns * layout.BINS), dtype=np.float32)
    run_stripes(_directional_derivatives, rows, threads, pool, exact, source)
    sigma, step = 0.0, 2
    for level, (wanted, level_step) in enumerate(zip(layout.LEVEL_SIGMAS, layout.LEVEL_STEPS, strict=True)):
        if level_step != step:
            rows, columns = _level_shape(height, width, level_step)
            smaller = np.empty((rows, columns * layout.BINS), dtype=np.float32)
            run_stripes(_halve_histograms, rows, threads, pool, source, smaller)
            sigma, step, source = (sigma**2 + 0.25 * step**2) ** 0.5, level_step, smaller
        target = np.empty_like(source)
        weights = gaussian_weights((wanted**2 - sigma**2) ** 0.5 / step)
        margin = layout.MARGIN // step
        first = int(geometry.base[level]) + margin * int(geometry.stride[level]) + margin
        run_stripes(
            _blur_and_quantise, rows, threads, pool, source, target, weights, histograms.reshape(-1), first,
            int(geometry.stride[level]), np.float32(NORM_FLOOR),
        )  # fmt: skip
        source, sigma = target, wanted
    return OrientationMaps(gray, framed(gray), framed(half), histograms, geometry)


def half_image(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Rounded mean over 2 x 2 pixels of a uint8 ``[H, W]`` image."""
    rows, columns = _level_shape(gray.shape[0], gray.shape[1], 2)
    half, exact = np.empty((rows, columns), dtype=np.uint8), np.empty((rows, columns), dtype=np.float32)
    _halve(0, rows, gray, exact, half)
    return half


def framed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with `refinement.BORDER` pixels of repeated edge around it."""
    out = np.empty((image.shape[0] + 2 * BORDER, image.shape[1] + 2 * BORDER), dtype=np.uint8)
    pad_image(image, BORDER, out)
    return out


@lru_cache(maxsize=64)
def gaussian_weights(sigma: float) -> NDArray[np.float32]:
    """Half of a normalised, sampled Gaussian: weight of the centre, then of each offset; cut at 2.5 sigma."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    weights = np.exp(-0.5 * (np.arange(radius + 1) / sigma) ** 2)
    return np.asarray(weights / (weights[0] + 2 * weights[1:].sum()), dtype=np.float32)


def _level_shape(height: int, width: int, step: int) -> tuple[int, int]:
    for _ in range(int(np.log2(step))):
        height, width = max(1, height // 2), max(1, width // 2)
    return height, width


@kernel
def _halve(start, stop, gray, exact, rounded):  # type: ignore[no-untyped-def]
    """Mean of 2 x 2 pixels."""
    height, width = gray.shape
    quarter = np.float32(0.25)
    for y in range(start, stop):
        upper = gray[min(2 * y, height - 1)]
        lower = gray[min(2 * y + 1, height - 1)]
        for x in range(exact.shape[1]):
            right = min(2 * x + 1, width - 1)
            total = np.int32(upper[2 * x]) + np.int32(upper[right]) + np.int32(lower[2 * x]) + np.int32(lower[right])
            exact[y, x] = np.float32(total) * quarter
            rounded[y, x] = np.uint8((total + 2) >> 2)


@kernel
def _directional_derivatives(start, stop, half, out):  # type: ignore[no-untyped-def]
    """Rectified derivatives along eight directions, grey levels a full-image pixel, eight adjacent floats a pixel."""
    height, width = half.shape
    diagonal = np.float32(np.sqrt(0.5))
    scale = np.float32(0.25)
    zero = np.float32(0)
    for y in range(start, stop):
        above, below, here = half[max(y - 1, 0)], half[min(y + 1, height - 1)], half[y]
        for x in range(width):
            gx = (here[min(x + 1, width - 1)] - here[max(x - 1, 0)]) * scale
            gy = (below[x] - above[x]) * scale
            up = (gx + gy) * diagonal
            down = (gy - gx) * diagonal
            o = 8 * x
            out[y, o] = max(gx, zero)
            out[y, o + 1] = max(up, zero)
            out[y, o + 2] = max(gy, zero)
            out[y, o + 3] = max(down, zero)
            out[y, o + 4] = max(-gx, zero)
            out[y, o + 5] = max(-up, zero)
            out[y, o + 6] = max(-gy, zero)
            out[y, o + 7] = max(-down, zero)


@kernel
def _halve_histograms(start, stop, source, target):  # type: ignore[no-untyped-def]
    """Mean of 2 x 2 histograms of eight bins."""
    quarter = np.float32(0.25)
    rows, columns = source.shape[0], source.shape[1] // 8
    for y in range(start, stop):
        upper, lower = source[min(2 * y, rows - 1)], source[min(2 * y + 1, rows - 1)]
        for x in range(target.shape[1] // 8):
            left, right = 16 * x, 8 * min(2 * x + 1, columns - 1)
            for b in range(8):
                target[y, 8 * x + b] = (
                    (upper[left + b] + upper[right + b]) + (lower[left + b] + lower[right + b])
                ) * quarter


@kernel
def _blur_and_quantise(start, stop, source, target, weights, histograms, first, stride, floor):  # type: ignore[no-untyped-def]
    """Separable Gaussian of interleaved rows (edges repeated), and its partially normalised bytes."""
    rows, length = source.shape
    radius = len(weights) - 1
    pad = 8 * radius
    line = np.empty(length + 2 * pad, dtype=np.float32)
    middle = line[pad : pad + length]
    gains = np.empty(length // 8, dtype=np.float32)
    full, half = np.float32(255.0), np.float32(0.5)
    for y in range(start, stop):
        here = source[y]
        w = weights[0]
        for i in range(length):
            middle[i] = w * here[i]
        for t in range(1, radius + 1):
            above, below = source[max(y - t, 0)], source[min(y + t, rows - 1)]
            w = weights[t]
            for i in range(length):
                middle[i] += w * (above[i] + below[i])
        for t in range(radius):
            for b in range(8):
                line[8 * t + b] = middle[b]
                line[pad + length + 8 * t + b] = middle[length - 8 + b]
        out = target[y]
        w = weights[0]
        for i in range(length):
            out[i] = w * middle[i]
        for t in range(1, radius + 1):
            left = line[pad - 8 * t : pad - 8 * t + length]
            right = line[pad + 8 * t : pad + 8 * t + length]
            w = weights[t]
            for i in range(length):
                out[i] += w * (left[i] + right[i])
        for x in range(length // 8):
            h = out[8 * x : 8 * x + 8]
            squares = ((h[0] * h[0] + h[1] * h[1]) + (h[2] * h[2] + h[3] * h[3])) + (
                (h[4] * h[4] + h[5] * h[5]) + (h[6] * h[6] + h[7] * h[7])
            )
            gains[x] = squares
        for x in range(length // 8):
            gains[x] = full / (np.sqrt(gains[x]) + floor)
        for x in range(length // 8):
            gain = gains[x]
            for b in range(8):
                line[8 * x + b] = gain
        row = 8 * (first + y * stride)
        cells = histograms[row : row + length]
        for i in range(length):
            cells[i] = np.uint8(np.int32(out[i] * line[i] + half))
