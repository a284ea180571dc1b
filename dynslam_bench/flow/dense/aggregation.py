"""Aggregation and choice of labels: raw cost (Eq. 1), guided filter (Eq. 2), winner takes all (Eq. 3), compiled."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from dynslam_bench.core.compiled import Scalar, inlined, kernel

from ..daisy.cost import CostTables, Side, appearance, describe_once, descriptor_distance, quantised
from ..kernels.arrays import Bytes, Flags, Floats, Ints, Longs
from .guided_filter import filter_patch

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
        reference: `cost.Side`.
        target: `cost.Side`.
        tables: `cost.CostTables` without support.
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
def patch_around(members: Longs, rows: int, columns: int, room: int) -> tuple[int, int, int, int]:
    """Top, left, height and width of the box around pixels, with `room` on every side as far as the image goes."""
    top, bottom, left, right = rows, -1, columns, -1
    for member in members:
        y, x = member // columns, member % columns
        top, bottom, left, right = min(top, y), max(bottom, y), min(left, x), max(right, x)
    top, left = max(top - room, 0), max(left - room, 0)
    bottom, right = min(bottom + room, rows - 1), min(right + room, columns - 1)
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
