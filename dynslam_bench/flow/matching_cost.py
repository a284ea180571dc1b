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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.core.simd import Bytes, Floats, Ints, Longs, Words, descriptor_sum
from dynslam_bench.flow import layout
from dynslam_bench.flow.orientation_maps import Side

OUTSIDE = 1 << 20
"""Cost of a label that leaves the target image."""
MAX_COST = 0.75
"""Share of the largest cost above which a point is not valid."""
TRUNCATION = 0.882
"""t of Eq. 1: largest L1 distance of one histogram of unit norm (not stated in the paper)."""
INTENSITY = (55.0, 7 / 255)
"""alpha and t1 of Eq. 1, for images in [0, 1] (not stated in the paper)."""
GRADIENT = (190.0, 2 / 255)
"""beta and t2 of Eq. 1, likewise."""


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
    """The points as the kernels see them.

    Attributes:
        points: float32 ``[N, 2]``.
        descriptors: uint8, flat ``[N, S, ROTATIONS, 136]`` of `describe`.
        appearance: int32 ``[N, S, 2]``, grey level and gradient magnitude at the support.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    appearance: NDArray[np.int32]


@lru_cache(maxsize=32)
def cost_tables(
    shape: tuple[int, int], terms: int = 1, support: int = 1, spacing: int = 4
) -> CostTables:
    """Tables for an image size and the terms and support of Eq. 1.

    Args:
        shape: Image height and width in pixels.
        terms: 1 for the descriptors' term alone, 3 for grey level and gradient too.
        support: Number of points around p (1, 5 for a cross, 9 for a square).
        spacing: Their distance in pixels.
    """
    offsets, ring_level = layout.sampling_table()
    geometry = layout.map_geometry(*shape)
    per_level = np.stack([geometry.base, geometry.stride, geometry.shift, geometry.bias], axis=1)
    level = np.repeat(ring_level, (9, 8), axis=1)  # [scales, 17]
    steps = np.asarray(layout.LEVEL_STEPS)[level][:, None, None, :, None]
    half_cell = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])[
        None, None, :, None, :
    ]
    cells = np.floor(half_cell + offsets[:, :, None] / (layout.SUBPIXEL * steps)).astype(np.int64)
    samples = 8 * (cells[..., 1] * geometry.stride[level][:, None, None, :] + cells[..., 0])
    grey = np.arange(256) / 255.0
    square = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)][
        :support
    ]
    intensity, gradient = (
        np.rint(255 * weight * np.minimum(grey, limit) * (terms == 3)).astype(np.int32)
        for weight, limit in (INTENSITY, GRADIENT)
    )
    limit = round(TRUNCATION * 255)
    return CostTables(
        samples.astype(np.int32),
        per_level[ring_level[:, 0]],
        per_level[ring_level[:, 1]],
        limit,
        intensity,
        gradient,
        terms == 3,
        np.asarray(square, dtype=np.int64) * spacing,
        support * (layout.HISTOGRAMS * limit + int(intensity.max()) + int(gradient.max())),
    )


@inlined
def cell_of(x: Scalar, y: Scalar, level: Longs) -> tuple[Scalar, Scalar]:
    """Byte offset of the map cell that holds a full-image position, and the quarter of the cell it lies in."""
    xq = np.int64(x * np.float32(4) + np.float32(0.5)) + level[3]
    yq = np.int64(y * np.float32(4) + np.float32(0.5)) + level[3]
    finer = level[2] - 1
    xh = xq >> finer
    yh = yq >> finer
    return 8 * (level[0] + (yh >> 1) * level[1] + (xh >> 1)), 2 * (yh & 1) + (xh & 1)


@inlined
def read_descriptor(
    x: Scalar, y: Scalar, image: Side, tables: CostTables, out: Words, first: int
) -> None:
    """Write the unrotated descriptor of a position: 17 histograms, a number each, of `out` from `first` on."""
    neutral = -layout.SCALE_LOW
    straight = -layout.ANGLE_LOW
    histograms = image.histograms.view(np.uint64)
    near, near_phase = cell_of(x, y, tables.ring0[neutral])
    far, far_phase = cell_of(x, y, tables.ring1[neutral])
    for k in range(9):
        out[first + k] = histograms[(near + tables.samples[neutral, straight, near_phase, k]) >> 3]
    for k in range(9, 17):
        out[first + k] = histograms[(far + tables.samples[neutral, straight, far_phase, k]) >> 3]


@inlined
def rotate_descriptor(
    descriptor: Words, at: int, a: int, turned: Words, out: Bytes, first: int
) -> None:
    """Write a descriptor for rotation index `a`: 136 bytes of `out` from `first` on.

    Args:
        descriptor: Unrotated, 17 numbers from `at` on.
        at: Where it begins.
        a: Index of the rotation.
        turned: uint64 ``[2, 17]``, scratch.
        out: Flat uint8 array.
        first: Index in it.
    """
    # bin b of the histogram rotated by theta is the unrotated one's at b - theta / 45 degrees
    sixths = a - 6
    whole = sixths // 6
    far_weight = np.int32((sixths - 6 * whole) * 171)  # 1026 / 6
    near_weight = np.int32(1026) - far_weight
    for turn in range(2):
        left = np.uint64(8 * (whole + turn) & 63)
        right = np.uint64(-8 * (whole + turn) & 63)
        for k in range(17):
            turned[turn, k] = descriptor[at + k] << left | descriptor[at + k] >> right
    near = turned[0].view(np.uint8)
    far = turned[1].view(np.uint8)
    rotated = out[first : first + 136]
    for b in range(136):
        rotated[b] = np.uint8((near_weight * near[b] + far_weight * far[b] + np.int32(512)) >> 10)


@kernel
def describe(
    start: int,
    stop: int,
    points: Floats,
    image: Side,
    tables: CostTables,
    out: Bytes,
    appearances: Ints,
) -> None:
    """Reference descriptors of points, with their bins rotated by each quantised angle, and their appearance.

    Args:
        start: First point.
        stop: One past the last point.
        points: float32 ``[N, 2]``.
        image: `Side` of the reference.
        tables: `CostTables`.
        out: uint8, flat ``[N, S, ROTATIONS, 17 * 8]``.
        appearances: int32 ``[N, S, 2]``, filled with grey levels and gradient magnitudes where the
            terms need them.
    """
    height, width = image.gray.shape
    descriptor = np.empty(17, dtype=np.uint64)
    turned = np.empty((2, 17), dtype=np.uint64)
    supports = len(tables.support)
    for i in range(start, stop):
        for q in range(supports):
            x = min(
                max(points[i, 0] + np.float32(tables.support[q, 0]), np.float32(0)),
                np.float32(width - 1),
            )
            y = min(
                max(points[i, 1] + np.float32(tables.support[q, 1]), np.float32(0)),
                np.float32(height - 1),
            )
            read_descriptor(x, y, image, tables, descriptor, 0)
            for a in range(13):
                rotate_descriptor(
                    descriptor, 0, a, turned, out, ((i * supports + q) * 13 + a) * 136
                )
            if tables.appearance:
                appearances[i, q, 0], appearances[i, q, 1] = appearance(image, x, y)


@inlined
def descriptor_distance(
    x: Scalar,
    y: Scalar,
    si: int,
    ti: int,
    mine: int,
    descriptor: Bytes,
    target: Side,
    tables: CostTables,
) -> Scalar:
    """First term of Eq. 1: truncated distance of 136 bytes at `mine` to the target at (x, y), scale si, rotation ti."""
    near, near_phase = cell_of(x, y, tables.ring0[si])
    far, far_phase = cell_of(x, y, tables.ring1[si])
    row = 4 * (si * layout.ROTATIONS + ti)
    theirs = target.histograms
    near_row = row + near_phase
    far_row = row + far_phase
    return descriptor_sum(
        theirs, tables.samples, near_row, far_row, near, far, descriptor, mine, tables.truncation
    )


@inlined
def quantised(s: Scalar, theta: Scalar) -> tuple[Scalar, Scalar]:
    """Scale and rotation index of a label."""
    si = np.int64(np.floor(s * np.float32(4) + np.float32(0.5))) - layout.SCALE_LOW
    ti = (
        np.int64(np.floor(theta * np.float32(7.639437268410976) + np.float32(0.5)))
        - layout.ANGLE_LOW
    )
    return min(max(si, 0), 9), min(max(ti, 0), 12)


@inlined
def label_cost(
    i: int, u: Scalar, v: Scalar, s: Scalar, theta: Scalar, reference: Reference, target: Side, tables: CostTables,
    bound: Scalar,
) -> Scalar:  # fmt: skip
    """Eq. 1 of one label at point i, summed over the support; may stop early once `bound` is reached.

    Args:
        i: Index of the point.
        u: Displacement, pixels.
        v: Displacement, pixels.
        s: Log2 of the scale.
        theta: Rotation, radians.
        reference: `Reference`.
        target: `Side` of the target.
        tables: `CostTables`.
        bound: A cost from which on the exact value does not matter.
    """
    height, width = target.gray.shape
    cx = reference.points[i, 0] + u
    cy = reference.points[i, 1] + v
    if not (cx >= 0 and cy >= 0 and cx <= width - 1 and cy <= height - 1):
        return np.int64(OUTSIDE)
    si, ti = quantised(s, theta)
    supports = len(tables.support)
    total = np.int64(0)
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
            tx = min(max(cx + c * dx - n * dy, np.float32(0)), np.float32(width - 1))
            ty = min(max(cy + n * dx + c * dy, np.float32(0)), np.float32(height - 1))
        mine = ((i * supports + q) * 13 + ti) * 136
        total += descriptor_distance(tx, ty, si, ti, mine, reference.descriptors, target, tables)
        if tables.appearance:
            gray, gradient = appearance(target, tx, ty)
            total += tables.intensity[abs(gray - reference.appearance[i, q, 0])]
            total += tables.gradient[min(abs(gradient - reference.appearance[i, q, 1]), 255)]
        if total >= bound:
            return total
    return total


@inlined
def appearance(image: Side, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """Grey level and gradient magnitude at the pixel nearest to a position."""
    height, width = image.gray.shape
    column = min(max(np.int64(x + np.float32(0.5)), 0), width - 1)
    row = min(max(np.int64(y + np.float32(0.5)), 0), height - 1)
    return np.int64(image.gray[row, column]), np.int64(image.gradients[row, column])
