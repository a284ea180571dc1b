"""The matching cost (Eq. 1) of labels at sparse points, for the processor.

A label is ``(u, v, s, theta)``: displacement in pixels, log2 scale, rotation in radians. It maps
the neighbourhood of a point p by ``p' = p + (u, v) + 2**s R(theta) (q - p)``. The target is sampled
at the label's scale and rotation; the rotation of the *bins* is applied to the reference
descriptor, once for each of the 13 quantised angles.

Costs are whole numbers (255 = Euclidean length of a histogram), so that they do not depend on
summation order, vector width or device.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.core.simd import Bytes, Floats, Ints, Longs, Words
from dynslam_bench.flow import layout
from dynslam_bench.flow.descriptor_vectors import descriptor_sum
from dynslam_bench.flow.orientation_maps import ImageArrays

OUTSIDE = 1 << 20
"""Cost of a label that leaves the target image."""
MAX_COST = 0.75
"""Share of the largest cost above which a point is not valid."""
TRUNCATION = 0.882
"""t of Eq. 1: largest L1 distance of one histogram of unit norm (not stated in the paper)."""
INTENSITY = (55.0, 7 / 255)
"""alpha and t1 of Eq. 1, for images in [0, 1] (not stated in the paper)."""
GRADIENT = (190.0, 2 / 255)
"""beta and t2 of Eq. 1, for images in [0, 1] (not stated in the paper)."""
SUPPORT = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Points around p over which the cost may be summed: the first one, five (a cross) or nine (a square)."""

Label: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
"""Displacement u, v in pixels, log2 of the scale, rotation in radians."""


class CostTables(NamedTuple):
    """Tables of the cost that depend on the image size and the weights only.

    Attributes:
        samples: int32 ``[scales, ROTATIONS, 4, 17]``, byte offset of each histogram from the
            centre's cell, for the four half-cell positions (2 * lower half + right half) of the
            centre within its cell.
        ring0: int64 ``[scales, 4]``, base, stride, shift, bias of the centre's and first ring's
            level.
        ring1: int64 ``[scales, 4]``, of the second ring's level.
        truncation: Largest cost of one histogram (t of Eq. 1, times 255).
        intensity: int32 ``[256]``, cost of an absolute grey-level difference:
            ``alpha * min(d, t1)``.
        gradient: int32 ``[256]``, cost of an absolute difference of gradient magnitudes:
            ``beta * min(d, t2)``.
        appearance: Whether either of the two is not zero.
        support: int64 ``[S, 2]``, points around p over which the cost is summed, pixels.
        ceiling: Largest cost of a label inside the image.
    """

    samples: NDArray[np.int32]
    ring0: NDArray[np.int64]
    ring1: NDArray[np.int64]
    truncation: int
    intensity: NDArray[np.int32]
    gradient: NDArray[np.int32]
    appearance: bool
    support: NDArray[np.int64]
    ceiling: int


class Reference(NamedTuple):
    """The points of the reference image and their descriptors.

    Attributes:
        points: float32 ``[N, 2]``.
        descriptors: uint8, flat ``[N, S, ROTATIONS, 136]`` of `describe`.
        appearance: int32 ``[N, S, 2]``, grey level and gradient magnitude at the support.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    appearance: NDArray[np.int32]


class MatchingCost(NamedTuple):
    """All that the cost of a label at a point depends on (`label_cost`).

    Attributes:
        reference: The points.
        target: The image that they are searched in.
        tables: Cost tables for the image size and the weights of Eq. 1, see `cost_tables`.
    """

    reference: Reference
    target: ImageArrays
    tables: CostTables


@lru_cache(maxsize=32)
def cost_tables(
    shape: tuple[int, int], terms: int = 1, support: int = 1, spacing: int = 4
) -> CostTables:
    """Tables for an image size and the terms and support of Eq. 1.

    Args:
        shape: Image height and width in pixels.
        terms: 1 for the descriptors' term alone, 3 for grey level and gradient too.
        support: Number of points around p (1, 5 for a cross, 9 for a square).
        spacing: Distance between these points, pixels.
    """
    offsets, ring_level = layout.sampling_table()
    geometry = layout.map_geometry(*shape)
    per_level = np.stack([geometry.base, geometry.stride, geometry.shift, geometry.bias], axis=1)

    # level of each histogram, [scales, 17]
    level = np.repeat(ring_level, (9, 8), axis=1)

    # byte offset of each histogram; the axes are [scale, rotation, quarter of the centre's cell, histogram, xy]
    steps = np.asarray(layout.LEVEL_STEPS)[level][:, None, None, :, None]
    quarters = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    centres = quarters[None, None, :, None, :]
    displacements = offsets[:, :, None] / (layout.SUBPIXEL * steps)
    cells = np.floor(centres + displacements).astype(np.int64)
    columns = cells[..., 0]
    rows = cells[..., 1]
    strides = geometry.stride[level][:, None, None, :]
    samples = layout.BINS * (rows * strides + columns)

    # truncated linear penalties; an image's cost is 0 where the term does not count
    difference = np.arange(256) / 255.0
    has_appearance = terms == 3
    intensity = truncated_penalty(difference, *INTENSITY, has_appearance)
    gradient = truncated_penalty(difference, *GRADIENT, has_appearance)
    truncation = round(TRUNCATION * 255)
    ceiling = support * (
        layout.HISTOGRAMS * truncation + int(intensity.max()) + int(gradient.max())
    )
    return CostTables(
        samples=samples.astype(np.int32),
        ring0=per_level[ring_level[:, 0]],
        ring1=per_level[ring_level[:, 1]],
        truncation=truncation,
        intensity=intensity,
        gradient=gradient,
        appearance=has_appearance,
        support=np.asarray(SUPPORT[:support], dtype=np.int64) * spacing,
        ceiling=ceiling,
    )


def truncated_penalty(
    difference: NDArray[np.float64], weight: float, limit: float, counts: bool
) -> NDArray[np.int32]:
    """``weight * min(difference, limit)`` in 255ths, int32; 0 for a term that does not count."""
    return np.rint(255 * weight * np.minimum(difference, limit) * counts).astype(np.int32)


@inlined
def cell_of(x: Scalar, y: Scalar, level: Longs) -> tuple[Scalar, Scalar]:
    """Byte offset of the map cell that holds a full-image position, and the quarter of the cell it lies in.

    `level` is a row of `CostTables.ring0` or `ring1`: base, stride, shift, bias. A cell is
    ``2**shift`` quarter pixels wide.
    """
    base = level[0]
    stride = level[1]
    shift = level[2]
    bias = level[3]
    # the position in quarter pixels, then in half cells
    xq = np.int64(x * np.float32(4) + np.float32(0.5)) + bias
    yq = np.int64(y * np.float32(4) + np.float32(0.5)) + bias
    xh = xq >> (shift - 1)
    yh = yq >> (shift - 1)
    # the cell, eight bytes each, and the half in which the position lies on either axis
    cell = base + (yh >> 1) * stride + (xh >> 1)
    return 8 * cell, 2 * (yh & 1) + (xh & 1)


@inlined
def read_descriptor(
    x: Scalar, y: Scalar, image: ImageArrays, tables: CostTables, out: Words, first: int
) -> None:
    """Write the unrotated descriptor of a position: 17 histograms, a number each, of `out` from `first` on.

    Args:
        x: Column, full-image pixels.
        y: Row, full-image pixels.
        image: Orientation maps of the image.
        tables: Tables of the cost, with the sampling pattern.
        out: uint64, a histogram of eight bytes each.
        first: Index of the first histogram.
    """
    neutral = -layout.SCALE_LOW
    straight = -layout.ANGLE_LOW
    histograms = image.histograms.view(np.uint64)
    near, near_quarter = cell_of(x, y, tables.ring0[neutral])
    far, far_quarter = cell_of(x, y, tables.ring1[neutral])
    # bytes to histograms: eight bytes each
    near_samples = tables.samples[neutral, straight, near_quarter]
    far_samples = tables.samples[neutral, straight, far_quarter]
    for k in range(9):
        out[first + k] = histograms[(near + near_samples[k]) >> 3]
    for k in range(9, 17):
        out[first + k] = histograms[(far + far_samples[k]) >> 3]


@inlined
def rotate_descriptor(
    descriptor: Words, at: int, a: int, shifted: Words, out: Bytes, first: int
) -> None:
    """Write a descriptor for rotation index `a`: 136 bytes of `out` from `first` on.

    Args:
        descriptor: Unrotated, 17 numbers from `at` on.
        at: Where it begins.
        a: Index of the rotation, 0 to 12 in steps of 7.5 degrees, 6 for none.
        shifted: uint64 ``[2, 17]``, scratch.
        out: Flat uint8 array.
        first: Index in it.
    """
    # bin b of the histogram rotated by theta is the unrotated one's at b - theta / 45 degrees;
    # a step of the rotation is a sixth of a bin
    sixths = a - 6
    whole = sixths // 6
    # weights of the two bins between which it lies, in 1026ths: 171 a sixth
    far_weight = np.int32((sixths - 6 * whole) * 171)
    near_weight = np.int32(1026) - far_weight
    # histograms shifted by whole bins: 64-bit rotations by bytes
    for bin_ in range(2):
        left = np.uint64(8 * (whole + bin_) & 63)
        right = np.uint64(-8 * (whole + bin_) & 63)
        for k in range(17):
            shifted[bin_, k] = descriptor[at + k] << left | descriptor[at + k] >> right
    near = shifted[0].view(np.uint8)
    far = shifted[1].view(np.uint8)
    rotated = out[first : first + 136]
    for b in range(136):
        rotated[b] = np.uint8((near_weight * near[b] + far_weight * far[b] + np.int32(512)) >> 10)


@kernel
def describe(
    start: int,
    stop: int,
    points: Floats,
    image: ImageArrays,
    tables: CostTables,
    out: Bytes,
    appearances: Ints,
) -> None:
    """Reference descriptors of points, with their bins rotated by each quantised angle, and their appearance.

    Args:
        start: First point.
        stop: One past the last point.
        points: float32 ``[N, 2]``.
        image: `ImageArrays` of the reference.
        tables: `CostTables`.
        out: uint8, flat ``[N, S, ROTATIONS, 17 * 8]``.
        appearances: int32 ``[N, S, 2]``, filled with grey levels and gradient magnitudes where the
            terms need them.
    """
    height, width = image.gray.shape
    descriptor = np.empty(17, dtype=np.uint64)
    shifted = np.empty((2, 17), dtype=np.uint64)
    supports = len(tables.support)
    for i in range(start, stop):
        for q in range(supports):
            # the point of the support, moved into the image
            x = clamped(points[i, 0] + np.float32(tables.support[q, 0]), width)
            y = clamped(points[i, 1] + np.float32(tables.support[q, 1]), height)
            read_descriptor(x, y, image, tables, descriptor, 0)
            for a in range(13):
                place = ((i * supports + q) * 13 + a) * 136
                rotate_descriptor(descriptor, 0, a, shifted, out, place)
            if tables.appearance:
                appearances[i, q, 0], appearances[i, q, 1] = appearance(image, x, y)


@inlined
def clamped(coordinate: Scalar, size: int) -> Scalar:
    """A coordinate moved into an image of `size` pixels, float32."""
    return min(max(coordinate, np.float32(0)), np.float32(size - 1))


@inlined
def descriptor_distance(
    x: Scalar,
    y: Scalar,
    si: int,
    ti: int,
    descriptor: Bytes,
    first: int,
    target: ImageArrays,
    tables: CostTables,
) -> Scalar:
    """First term of Eq. 1: the truncated distance of a descriptor to the target's at a position.

    Args:
        x: Column in the target, pixels.
        y: Row in the target, pixels.
        si: Index of the scale at which the target is sampled.
        ti: Index of the rotation at which it is sampled.
        descriptor: Flat uint8 array, with bins rotated by that rotation.
        first: Index of the first of its 136 bytes.
        target: The image.
        tables: `CostTables`.
    """
    near, near_quarter = cell_of(x, y, tables.ring0[si])
    far, far_quarter = cell_of(x, y, tables.ring1[si])
    row = 4 * (si * layout.ROTATIONS + ti)
    near_row = row + near_quarter
    far_row = row + far_quarter
    return descriptor_sum(
        target.histograms,
        tables.samples,
        near_row,
        far_row,
        near,
        far,
        descriptor,
        first,
        tables.truncation,
    )


@inlined
def quantised(s: Scalar, theta: Scalar) -> tuple[Scalar, Scalar]:
    """Indices of the nearest scale and rotation of `layout`, from log2 of the scale and the rotation in radians."""
    # steps of a quarter of an octave, and of 7.5 degrees
    si = np.int64(np.floor(s * np.float32(4) + np.float32(0.5))) - layout.SCALE_LOW
    steps = theta * np.float32(7.639437268410976)
    ti = np.int64(np.floor(steps + np.float32(0.5))) - layout.ANGLE_LOW
    return min(max(si, 0), 9), min(max(ti, 0), 12)


@inlined
def label_cost(i: int, label: Label, matching: MatchingCost, bound: Scalar) -> Scalar:
    """Eq. 1 of one label at point i, summed over the support; may stop early once `bound` is reached.

    Args:
        i: Index of the point.
        label: `Label`.
        matching: `MatchingCost`.
        bound: A cost from which on the exact value does not matter.

    Returns:
        int64; `OUTSIDE` for a label that leaves the target.
    """
    u, v, s, theta = label
    reference, target, tables = matching
    height, width = target.gray.shape
    cx = reference.points[i, 0] + u
    cy = reference.points[i, 1] + v
    if not (cx >= 0 and cy >= 0 and cx <= width - 1 and cy <= height - 1):
        return np.int64(OUTSIDE)
    si, ti = quantised(s, theta)
    supports = len(tables.support)
    total = np.int64(0)
    # the similarity that moves the support: [[c, -n], [n, c]]
    c = np.float32(0)
    n = np.float32(0)
    if supports > 1:
        scale = np.float32(np.exp2(s))
        c = np.cos(theta) * scale
        n = np.sin(theta) * scale
    for q in range(supports):
        tx = cx
        ty = cy
        if q > 0:
            dx = np.float32(tables.support[q, 0])
            dy = np.float32(tables.support[q, 1])
            tx = clamped(cx + c * dx - n * dy, width)
            ty = clamped(cy + n * dx + c * dy, height)
        # the reference descriptor whose bins are rotated by the label's angle
        own = ((i * supports + q) * 13 + ti) * 136
        total += descriptor_distance(tx, ty, si, ti, reference.descriptors, own, target, tables)
        if tables.appearance:
            gray, gradient = appearance(target, tx, ty)
            total += tables.intensity[abs(gray - reference.appearance[i, q, 0])]
            total += tables.gradient[min(abs(gradient - reference.appearance[i, q, 1]), 255)]
        if total >= bound:
            return total
    return total


@inlined
def appearance(image: ImageArrays, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """Grey level and gradient magnitude at the pixel nearest to a position."""
    height, width = image.gray.shape
    column = min(max(np.int64(x + np.float32(0.5)), 0), width - 1)
    row = min(max(np.int64(y + np.float32(0.5)), 0), height - 1)
    return np.int64(image.gray[row, column]), np.int64(image.gradients[row, column])
