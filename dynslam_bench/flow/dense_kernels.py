"""Kernels of the dense flow: superpixels, guided filter (Eq. 2), raw costs (Eq. 1) and winner takes all (Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.flow.matching_cost import CostTables, appearance, describe_once, descriptor_distance, quantised
from dynslam_bench.flow.orientation_maps import Side
from dynslam_bench.flow.simd import Bytes, Doubles, Flags, Floats, Ints, Longs


@dataclass(frozen=True, eq=False)
class Superpixels:
    """A division of an image into K regions, by simplified SLIC (Achanta et al. 2012).

    Attributes:
        labels: int32 ``[H, W]``, region of every pixel.
        centres: float32 ``[K, 2]``, mean position of each region, pixels.
        members: int64 ``[H * W]``, flat pixel indices ordered by region.
        starts: int64 ``[K + 1]``, where each region's members begin.
    """

    labels: NDArray[np.int32]
    centres: NDArray[np.float32]
    members: NDArray[np.int64]
    starts: NDArray[np.int64]


def superpixels(gray: NDArray[np.uint8], size: int, *, compactness: float = 20.0, iterations: int = 4) -> Superpixels:
    """Divide a uint8 ``[H, W]`` image into regions of about ``size * size`` pixels.

    Args:
        gray: The image.
        size: Side of the initial squares, pixels.
        compactness: Grey levels that weigh as much as a distance of `size`.
        iterations: Of k-means.
    """
    height, width = gray.shape
    rows, columns = max(1, round(height / size)), max(1, round(width / size))
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    centres = np.zeros((rows * columns, 3), dtype=np.float64)
    centres[:, 0], centres[:, 1] = np.tile(x, rows), np.repeat(y, columns)
    centres[:, 2] = gray[np.rint(centres[:, 1]).astype(int), np.rint(centres[:, 0]).astype(int)]
    labels = np.empty((height, width), dtype=np.int32)
    assign_pixels(gray, centres, size, (size / compactness) ** 2, iterations, labels)
    flat = labels.reshape(-1)
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=len(centres)))])
    members = np.argsort(flat, kind="stable")
    return Superpixels(labels, centres[:, :2].astype(np.float32), members, starts.astype(np.int64))


@kernel
def assign_pixels(gray: Bytes, centres: Doubles, size: int, weight: float, iterations: int, labels: Ints) -> None:
    """K-means: each centre competes for the pixels within `size` of it; fills `labels`, moves `centres`."""
    height, width = gray.shape
    distance = np.empty((height, width), dtype=np.float64)
    sums = np.empty((len(centres), 4), dtype=np.float64)
    for _ in range(iterations):
        distance[:] = np.inf
        labels[:] = -1
        for k in range(len(centres)):
            cx, cy, cg = centres[k, 0], centres[k, 1], centres[k, 2]
            for y in range(max(0, int(cy - size)), min(height, int(cy + size) + 2)):
                for x in range(max(0, int(cx - size)), min(width, int(cx + size) + 2)):
                    dx, dy, dg = x - cx, y - cy, gray[y, x] - cg
                    d = dx * dx + dy * dy + weight * dg * dg
                    if d < distance[y, x]:
                        distance[y, x], labels[y, x] = d, k
        sums[:] = 0
        for y in range(height):
            for x in range(width):
                k = labels[y, x]
                if k < 0:  # too far from every centre: the nearest in position
                    best = np.inf
                    for other in range(len(centres)):
                        d = (x - centres[other, 0]) ** 2 + (y - centres[other, 1]) ** 2
                        if d < best:
                            best, k = d, other
                    labels[y, x] = k
                sums[k, 0] += x
                sums[k, 1] += y
                sums[k, 2] += gray[y, x]
                sums[k, 3] += 1
        for k in range(len(centres)):
            if sums[k, 3] > 0:
                for j in range(3):
                    centres[k, j] = sums[k, j] / sums[k, 3]


@kernel
def filter_patch(
    guide: Floats, values: Floats, height: int, width: int, radius: int, epsilon: Scalar, work: Floats, out: Floats
) -> None:
    """The guided filter (He, Sun, Tang 2010): an average of `values` that preserves the edges of `guide`.

    Within each ``(2 radius + 1)**2`` window (clipped at the image's edge) the output is a linear function of the guide;
    overlapping windows are averaged.

    Args:
        guide: float32, flat ``[height * width]``, grey levels in [0, 1].
        values: float32, flat, what is filtered (matching costs).
        height: Of the image.
        width: Of the image.
        radius: Of the window, pixels.
        epsilon: Regularisation, squared grey levels.
        work: float32 ``[6, height * width]``, scratch.
        out: float32, flat, filled.
    """
    n = height * width
    mean_guide, mean_value = work[0, :n], work[1, :n]
    product, square, line = work[2, :n], work[3, :n], work[4, :n]
    box_mean(guide, height, width, radius, line, mean_guide)
    box_mean(values, height, width, radius, line, mean_value)
    for k in range(n):
        out[k] = guide[k] * values[k]
    box_mean(out, height, width, radius, line, product)
    for k in range(n):
        out[k] = guide[k] * guide[k]
    box_mean(out, height, width, radius, line, square)
    slope, offset = product, square
    for k in range(n):
        spread = max(square[k] - mean_guide[k] * mean_guide[k], np.float32(0)) + epsilon
        a = (product[k] - mean_guide[k] * mean_value[k]) / spread if spread > 0 else np.float32(0)
        slope[k] = a
        offset[k] = mean_value[k] - a * mean_guide[k]
    box_mean(slope, height, width, radius, line, mean_guide)
    box_mean(offset, height, width, radius, line, mean_value)
    for k in range(n):
        out[k] = mean_guide[k] * guide[k] + mean_value[k]


@inlined
def box_mean(values: Floats, height: int, width: int, radius: int, line: Floats, out: Floats) -> None:
    """Mean over the window clipped at the edges; columns first (vectorised), then running sums along rows."""
    for y in range(height):
        low, high = max(y - radius, 0), min(y + radius, height - 1)
        row = line[y * width : (y + 1) * width]
        first = values[low * width : (low + 1) * width]
        for x in range(width):
            row[x] = first[x]
        for other in range(low + 1, high + 1):
            more = values[other * width : (other + 1) * width]
            for x in range(width):
                row[x] += more[x]
        count = np.float32(high - low + 1)
        total = np.float32(0)
        for x in range(min(radius, width)):
            total += row[x]
        for x in range(width):
            if x + radius < width:
                total += row[x + radius]
            if x - radius - 1 >= 0:
                total -= row[x - radius - 1]
            columns = np.float32(min(x + radius, width - 1) - max(x - radius, 0) + 1)
            out[y * width + x] = total / (count * columns)


Label: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
"""Displacement, log2 of the scale, rotation."""


@kernel
def aggregate_and_choose(
    start: int, stop: int, members: Longs, starts: Longs, centres: Floats, candidates: Floats, reference: Side,
    target: Side, tables: CostTables, guide: Floats, radius: int, epsilon: Scalar, best: Floats, winner: Floats,
    evaluations: Longs,
) -> None:  # fmt: skip
    """Raw cost, guided filter and winner takes all (Eq. 1-3) for regions start..stop, at half resolution.

    Args:
        start: First region.
        stop: One past the last.
        members: `Superpixels.members`.
        starts: `Superpixels.starts`.
        centres: float32 ``[K, 2]``, full-image pixels.
        candidates: float32 ``[K, C, 4]``, labels around the centres; NaN means none.
        reference: `orientation_maps.Side`.
        target: `orientation_maps.Side`.
        tables: `matching_cost.CostTables` without support.
        guide: float32 ``[h, w]``, half-resolution grey levels in [0, 1].
        radius: Of the guided filter, half-resolution pixels.
        epsilon: Of the guided filter.
        best: float32 ``[h, w]``, lowest aggregated cost, changed in place.
        winner: float32 ``[h, w, 4]``, its label around the region's centre.
        evaluations: int64 ``[K]``, raw costs computed.
    """
    rows, columns = guide.shape
    descriptors = np.empty(0, dtype=np.uint8)
    size = 0
    described = np.zeros(13, dtype=np.bool_)
    raw = np.empty(0, dtype=np.float32)
    patch_guide, filtered, work = np.empty(0, dtype=np.float32), np.empty(0, np.float32), np.empty((6, 0), np.float32)
    for r in range(start, stop):
        if starts[r] == starts[r + 1]:
            continue
        top, left, high, wide = patch_around(members[starts[r] : starts[r + 1]], rows, columns, 2 * radius)
        n = high * wide
        if n > size:
            size = n
            descriptors = np.empty(13 * n * 136, dtype=np.uint8)
            raw, patch_guide, filtered = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
            work = np.empty((6, n), np.float32)
        described[:] = False
        for y in range(high):
            for x in range(wide):
                patch_guide[y * wide + x] = guide[top + y, left + x]
        for c in range(candidates.shape[1]):
            u, v, s, theta = candidates[r, c, 0], candidates[r, c, 1], candidates[r, c, 2], candidates[r, c, 3]
            if not np.isfinite(u + v + s + theta):
                continue
            centre, corner = (centres[r, 0], centres[r, 1]), (left, top, wide, high)
            sides = (reference, target, tables)
            ti = raw_costs((u, v, s, theta), centre, corner, size, sides, descriptors, described, raw)
            described[ti] = True
            evaluations[r] += n
            filter_patch(patch_guide[:n], raw[:n], high, wide, radius, epsilon, work, filtered[:n])
            for k in range(starts[r], starts[r + 1]):
                y, x = members[k] // columns, members[k] % columns
                cost = filtered[(y - top) * wide + x - left]
                if cost < best[y, x]:
                    best[y, x] = cost
                    winner[y, x, 0], winner[y, x, 1], winner[y, x, 2], winner[y, x, 3] = u, v, s, theta


@inlined
def patch_around(members: Longs, rows: int, columns: int, margin: int) -> tuple[int, int, int, int]:
    """Top, left, height and width of the box around pixels, with a margin, clipped at the image's edge."""
    top, bottom, left, right = rows, -1, columns, -1
    for member in members:
        y, x = member // columns, member % columns
        top, bottom, left, right = min(top, y), max(bottom, y), min(left, x), max(right, x)
    top, left = max(top - margin, 0), max(left - margin, 0)
    bottom, right = min(bottom + margin, rows - 1), min(right + margin, columns - 1)
    return top, left, bottom - top + 1, right - left + 1


@inlined
def raw_costs(
    label: Label, centre: tuple[Scalar, Scalar], patch: tuple[int, int, int, int], size: int,
    sides: tuple[Side, Side, CostTables], descriptors: Bytes, described: Flags, raw: Floats,
) -> Scalar:  # fmt: skip
    """Fill `raw` with Eq. 1 of a label around a centre, for every half-resolution pixel of a patch.

    Args:
        label: Displacement, scale and rotation at the centre.
        centre: Full-image pixels.
        patch: Its left and top, width and height, half-resolution pixels.
        size: Descriptors a rotation that `descriptors` has room for.
        sides: Reference, target and tables.
        descriptors: uint8, flat ``[13, size, 136]``, filled for rotations that are not `described` yet.
        described: bool ``[13]``.
        raw: float32, flat ``[height * width]`` of the patch, filled.

    Returns:
        The index of the label's rotation.
    """
    (u, v, s, theta), (left, top, wide, high), (reference, target, tables) = label, patch, sides
    height, width = target.gray.shape
    si, ti = quantised(s, theta)
    scale = np.float32(np.exp2(s))
    a, b = scale * np.float32(np.cos(theta)), scale * np.float32(np.sin(theta))
    for y in range(high):
        for x in range(wide):
            k = y * wide + x
            px, py = np.float32(2 * (left + x)) + np.float32(0.5), np.float32(2 * (top + y)) + np.float32(0.5)
            mine = (ti * size + k) * 136
            if not described[ti]:
                describe_once(px, py, ti, reference, tables, descriptors, mine)
            dx, dy = px - centre[0], py - centre[1]
            tx, ty = centre[0] + u + a * dx - b * dy, centre[1] + v + b * dx + a * dy
            cost = np.int64(tables.ceiling)
            if tx >= 0 and ty >= 0 and tx <= width - 1 and ty <= height - 1:
                cost = np.int64(descriptor_distance(tx, ty, si, ti, mine, descriptors, target, tables))
                if tables.appearance:
                    gray, gradient = appearance(target.gray, tx, ty)
                    own_gray, own_gradient = appearance(reference.gray, px, py)
                    cost += tables.intensity[abs(gray - own_gray)]
                    cost += tables.gradient[min(abs(gradient - own_gradient), 255)]
            raw[k] = np.float32(cost)
    return ti


@kernel
def spread_labels(start: int, stop: int, winner: Floats, regions: Ints, centres: Floats, flow: Floats) -> None:
    """Displacement of full-image rows start..stop from the half-resolution labels around the regions' centres."""
    for y in range(start, stop):
        row = min(y // 2, winner.shape[0] - 1)
        for x in range(flow.shape[1]):
            column = min(x // 2, winner.shape[1] - 1)
            u, v, s, theta = winner[row, column]
            r = regions[row, column]
            scale = np.float32(np.exp2(s))
            a, b = scale * np.float32(np.cos(theta)), scale * np.float32(np.sin(theta))
            dx, dy = np.float32(x) - centres[r, 0], np.float32(y) - centres[r, 1]
            flow[y, x, 0] = u + a * dx - b * dy - dx
            flow[y, x, 1] = v + b * dx + a * dy - dy
