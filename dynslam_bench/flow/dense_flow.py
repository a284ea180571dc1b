"""Dense DAISY Filter Flow: superpixel labels, guided-filter aggregation, winner takes all, forward-backward check.

1. Superpixels; one label search per superpixel at its centre, with propagation between adjacent ones (as in `sparse`).
2. Labels are refined photometrically (`refinement`). A label is a similarity and thus sub-pixel exact over its region.
3. For each superpixel, its own label and its neighbours' are tried on every pixel of its bounding box extended by twice
   the filter's radius. The raw costs (Eq. 1) are aggregated by the guided filter (Eq. 2), each pixel takes the label of
   the lowest cost (Eq. 3). This works at half resolution: the orientation maps are no finer.
4. A pixel is valid if the flow of the other direction leads back. The others take an affine motion that is fitted to
   the consistent regions around them, but stay marked as not valid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.flow.degenerate import STATS_NAMES, clean_points, flow_stats, usable_points
from dynslam_bench.flow.matching_cost import (
    MAX_COST,
    CostTables,
    appearance,
    cost_tables,
    descriptor_distance,
    quantised,
    read_descriptor,
    rotate_descriptor,
)
from dynslam_bench.flow.orientation_maps import OrientationMaps, Side
from dynslam_bench.flow.propagation import labels_as_seen, nearest
from dynslam_bench.flow.refinement import BORDER
from dynslam_bench.flow.settings import DaisySettings, DenseFlowSettings, FlowSettings
from dynslam_bench.flow.simd import Bytes, Doubles, Flags, Floats, Ints, Longs
from dynslam_bench.flow.sparse import SparseDaisyFlow

NEIGHBOURS = 9
"""Reliable regions that a regional motion is fitted to."""
SHARE = 0.5
"""A region is reliable if this share of its pixels is consistent."""
SMOOTH_PX = 3.0
"""Consistent pixels this close to the fitted motion take it: a similarity a region cannot follow a slanted plane."""


@dataclass(frozen=True, eq=False)
class DenseFlow:
    """Flow of every pixel.

    Attributes:
        flow: float32 ``[H, W, 2]``, displacement (x, y) in pixels.
        valid: bool ``[H, W]``, consistent with the flow of the other direction.
        cost: float32 ``[H, W]``, aggregated matching cost as a share of the largest possible.
        evaluations: Matching costs computed.
        back: float32 ``[H, W, 2]``, flow of every target pixel to the reference.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    cost: NDArray[np.float32]
    evaluations: int
    back: NDArray[np.float32]


class DenseDaisyFlow:
    """The paper's flow (Eq. 1-3 over every pixel), read at points; see `contracts.flow.FlowEstimator`.

    The field is read at the pixel that contains a point and not interpolated: at the border of a moving object the mean
    of two motions is wrong. A point is valid if its pixel is consistent (`consistency_px`), if its forward-backward
    error is at most `forward_backward_px`, and if its aggregated cost is low. On the processor, whatever the device.

    Args:
        settings: Search, aggregation and checks.
        threads: Over which regions are divided; the result does not depend on it.
    """

    stats_names = STATS_NAMES

    def __init__(self, settings: DenseFlowSettings | None = None, *, threads: int = 1) -> None:
        self._sparse = SparseDaisyFlow(threads=threads)
        self.configure(settings or DenseFlowSettings())

    def configure(self, settings: DenseFlowSettings) -> None:
        """Use other settings from the next pair on."""
        self.settings = settings
        common = {name: getattr(settings, name) for name in DaisySettings.model_fields}
        self._sparse.configure(
            FlowSettings(**common, support=9, support_spacing_px=max(1, settings.superpixel_px // 2))
        )

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._sparse.prepare(gray)

    def track(
        self,
        reference: OrientationMaps,
        target: OrientationMaps,
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`. The guess is not used."""
        cleaned = clean_points(reference.gray, target.gray, points)
        if isinstance(cleaned, FlowResult):
            return cleaned
        clean, usable = cleaned
        dense = self.flow(reference, target, seed=seed)
        pixel = _pixels(clean)
        xy = (clean + dense.flow[pixel]).astype(np.float32)
        cost = dense.cost[pixel]
        valid = usable & dense.valid[pixel] & usable_points(xy, target.gray.shape) & (cost < MAX_COST)
        if self.settings.forward_backward_px > 0:
            ends = np.where(valid[:, None], xy, clean)
            error = np.linalg.norm(ends + dense.back[_pixels(ends)] - clean, axis=1)
            valid &= error <= self.settings.forward_backward_px
        return FlowResult(xy, valid, cost, flow_stats(len(clean), int(valid.sum()), dense.evaluations))

    def flow(self, reference: OrientationMaps, target: OrientationMaps, *, seed: int = 0) -> DenseFlow:
        """Flow of every pixel from the reference to the target."""
        tolerance = self.settings.consistency_px
        forward = _RegionLabels(self.settings, self._sparse, reference, target, seed)
        backward = _RegionLabels(self.settings, self._sparse, target, reference, seed + 1)
        flow, back = forward.flow(), backward.flow()
        if self.settings.second_round:
            forward.try_regional_motion(consistent(flow, back, tolerance))
            backward.try_regional_motion(consistent(back, flow, tolerance))
            flow, back = forward.flow(), backward.flow()
        valid = consistent(flow, back, tolerance)
        fitted = fit_regional_motion(flow, valid, forward.regions, forward.half)
        if fitted is not None:
            flow = fill_and_smooth(flow, valid, fitted)
        return DenseFlow(flow, valid, forward.cost(), forward.evaluations + backward.evaluations, back)


def _pixels(points: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the pixels that contain points inside an image."""
    column, row = np.rint(points).astype(np.intp).T
    return row, column


class _RegionLabels:
    """The labels of one direction; sizes are those of the half-resolution image.

    A label is searched for each region; the region's pixels take the best of it and its neighbours'.
    """

    def __init__(
        self,
        settings: DenseFlowSettings,
        sparse: SparseDaisyFlow,
        reference: OrientationMaps,
        target: OrientationMaps,
        seed: int,
    ) -> None:
        self.settings, self._sparse = settings, sparse
        self._pair = sparse.pair(reference, target)
        self.half = np.ascontiguousarray(reference.framed_half[BORDER:-BORDER, BORDER:-BORDER])
        self.regions = superpixels(self.half, max(2, settings.superpixel_px // 2))
        self.centres = self.regions.centres * 2 + 0.5  # half-resolution pixel i covers 2 i and 2 i + 1
        self._tables = cost_tables(reference.gray.shape, settings.terms)
        self._best = np.full(self.half.shape, np.inf, dtype=np.float32)
        self._winner = np.zeros((*self.half.shape, 4), dtype=np.float32)
        pair, centres = self._pair, self.centres
        neighbours = nearest(centres, sparse.workers.run)
        described = sparse.describe(pair.reference, centres, pair.tables)
        state = sparse.search(described, pair, neighbours, None, seed)
        labels = np.ascontiguousarray(state.flames[:, 0])
        if settings.refinement == "lucas-kanade":
            sparse.refine_together(centres, labels, neighbours, pair)
        self.evaluations = int(state.used.sum())
        near = np.ascontiguousarray(neighbours[:, : settings.candidates - 1])
        self._choose(np.concatenate([labels[:, None], labels_as_seen(centres, labels, near)], axis=1))

    def try_regional_motion(self, valid: NDArray[np.bool_]) -> None:
        """Try, on every region, the motion of the consistent regions around it, as fitted and refined."""
        fitted = fit_regional_motion(self.flow(), valid, self.regions, self.half)
        if fitted is None:
            return
        candidates = [fitted.labels()]
        if self.settings.refinement == "lucas-kanade":
            candidates.append(candidates[0].copy())
            self._sparse.refine(self.centres, candidates[1], self._pair)
        self._choose(np.stack(candidates, axis=1))

    def _choose(self, candidates: NDArray[np.float32]) -> None:
        """Let every pixel take the best of its region's candidates ``[K, C, 4]``, if it beats the label it has."""
        evaluations = np.zeros(len(self.centres), dtype=np.int64)
        regions = (self.regions.members, self.regions.starts, self.centres, candidates)
        sides = (self._pair.reference.side, self._pair.target.side, self._tables)
        guide, radius = self.half.astype(np.float32) / np.float32(255), max(1, self.settings.filter_radius_px // 2)
        smoothing = (guide, radius, np.float32(self.settings.filter_epsilon))
        chosen = (self._best, self._winner, evaluations)
        self._sparse.workers.run(aggregate_and_choose, 0, len(self.centres), *regions, *sides, *smoothing, *chosen)
        self.evaluations += int(evaluations.sum())

    def flow(self) -> NDArray[np.float32]:
        """Displacement of every full-image pixel under the labels chosen so far."""
        height, width = self._pair.reference.gray.shape
        flow = np.empty((height, width, 2), dtype=np.float32)
        self._sparse.workers.run(spread_labels, 0, height, self._winner, self.regions.labels, self.centres, flow)
        return flow

    def cost(self) -> NDArray[np.float32]:
        """Aggregated cost of every full-image pixel, as a share of the largest possible."""
        share = self._best[_half_pixels(self._pair.reference.gray.shape, self.half.shape)]
        return np.asarray(np.clip(share / np.float32(self._tables.ceiling), 0, 1), dtype=np.float32)  # may overshoot


def _half_pixels(shape: tuple[int, ...], half: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Index of the half-resolution pixel of every full-image pixel."""
    return np.ix_(*(np.minimum(np.arange(full) // 2, size - 1) for full, size in zip(shape, half, strict=True)))


def consistent(forward: NDArray[np.float32], backward: NDArray[np.float32], tolerance: float) -> NDArray[np.bool_]:
    """Pixels whose flow, followed by the backward flow where it ends, returns to within `tolerance` pixels."""
    height, width = forward.shape[:2]
    y, x = np.mgrid[:height, :width]
    column, row = np.rint(x + forward[..., 0]).astype(np.int64), np.rint(y + forward[..., 1]).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    back = backward[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return np.asarray(inside & (np.hypot(*np.moveaxis(forward + back, -1, 0)) <= tolerance), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class RegionalMotion:
    """Affine motions of K regions.

    Attributes:
        centres: float64 ``[K, 2]``, full-image pixels.
        spread: float64 ``[K, 1]``, pixels a unit of `motion`.
        motion: float64 ``[K, 3, 2]``, flow at the centre, and its change per unit along x and y.
        region: int64 ``[H * W]``, region of every full-image pixel.
    """

    centres: NDArray[np.float64]
    spread: NDArray[np.float64]
    motion: NDArray[np.float64]
    region: NDArray[np.int64]

    def labels(self) -> NDArray[np.float32]:
        """The similarity nearest to each region's motion at its centre, as labels ``[K, 4]``."""
        slope = self.motion[:, 1:] / self.spread[:, :, None]  # d flow / d (x, y): [K, (x, y), (u, v)]
        a = 1 + 0.5 * (slope[:, 0, 0] + slope[:, 1, 1])
        b = 0.5 * (slope[:, 0, 1] - slope[:, 1, 0])
        s, theta = np.log2(np.maximum(np.hypot(a, b), 0.25)), np.arctan2(b, a)
        return np.column_stack([self.motion[:, 0], s, theta]).astype(np.float32)


def fit_regional_motion(
    flow: NDArray[np.float32], valid: NDArray[np.bool_], regions: Superpixels, guide: NDArray[np.uint8]
) -> RegionalMotion | None:
    """Fit an affine motion to the reliable regions around each region, robustly.

    Args:
        flow: float32 ``[H, W, 2]``.
        valid: bool ``[H, W]``, consistent pixels.
        regions: Superpixels at half resolution.
        guide: uint8 ``[H / 2, W / 2]``, their image; regions of similar grey level count more.

    Returns:
        The motions; None where fewer than three regions are reliable.
    """
    width = valid.shape[1]
    region = regions.labels[_half_pixels(valid.shape, guide.shape)].ravel().astype(np.int64)
    count = len(regions.centres)
    good = valid.ravel()
    pixels = np.maximum(np.bincount(region, minlength=count), 1)
    consistent = np.bincount(region, weights=good, minlength=count)
    reliable = np.flatnonzero((consistent >= SHARE * pixels) & (consistent > 0))
    if len(reliable) < 3:
        return None
    rows = np.flatnonzero(good)
    mean = np.empty((count, 4))  # position and flow of each region's consistent pixels
    columns = (rows % width, rows // width, *flow.reshape(-1, 2)[rows].T)
    for column, values in enumerate(columns):
        mean[:, column] = np.bincount(region[rows], weights=values, minlength=count) / np.maximum(consistent, 1)
    centres = regions.centres.astype(np.float64) * 2 + 0.5
    total = np.bincount(regions.labels.ravel(), weights=guide.ravel(), minlength=count)
    grey = total / np.maximum(np.bincount(regions.labels.ravel(), minlength=count), 1)
    near = min(NEIGHBOURS, len(reliable))
    distance, index = cKDTree(mean[reliable, :2]).query(centres, k=near)
    chosen = reliable[np.asarray(index).reshape(count, near)]
    distance = np.asarray(distance).reshape(count, near)
    spread = np.maximum(distance.mean(axis=1, keepdims=True), 1.0)
    weight = np.exp(-0.5 * (distance / spread) ** 2 - np.abs(grey[chosen] - grey[:, None]) / 20.0) + 1e-6
    offset = (mean[chosen, :2] - centres[:, None]) / spread[..., None]
    basis = np.concatenate([np.ones((count, near, 1)), offset], axis=2)
    values = mean[chosen, 2:]
    motion = np.zeros((count, 3, 2))
    for _ in range(3):  # iteratively reweighted: a foreground region must not bend the background
        weighted = basis * weight[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis
        normal[:, (0, 1, 2), (0, 1, 2)] += weight.sum(axis=1, keepdims=True) * (1e-6, 0.05, 0.05)
        motion = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ values)
        weight = weight / (1 + (np.linalg.norm(values - basis @ motion, axis=2) / 2.0) ** 2)
    return RegionalMotion(centres, spread, motion, region)


def fill_and_smooth(flow: NDArray[np.float32], valid: NDArray[np.bool_], fitted: RegionalMotion) -> NDArray[np.float32]:
    """Replace pixels that are not valid, or lie within `SMOOTH_PX` of it, by the fitted motion."""
    height, width = valid.shape
    r = fitted.region
    at = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    local = ((at - fitted.centres[r]) / fitted.spread[r]).astype(np.float32)
    motion = fitted.motion.astype(np.float32)
    smooth = motion[r, 0] + local[:, :1] * motion[r, 1] + local[:, 1:] * motion[r, 2]
    own = flow.reshape(-1, 2)
    replaced = ~valid.ravel() | (((smooth - own) ** 2).sum(axis=1) < SMOOTH_PX**2)
    return np.where(replaced[:, None], smooth, own).astype(np.float32).reshape(flow.shape)


# ---------------------------------------------------------------------- superpixels


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


# ---------------------------------------------------------------------- aggregation (Eq. 1-3)


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
    descriptors, turned = np.empty(0, dtype=np.uint8), np.empty((4, 136), dtype=np.int32)
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
            ti = raw_costs((u, v, s, theta), centre, corner, size, sides, descriptors, described, turned, raw)
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
    sides: tuple[Side, Side, CostTables], descriptors: Bytes, described: Flags, turned: Ints,
    raw: Floats,
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
        turned: int32 ``[4, 136]``, scratch.
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
                read_descriptor(px, py, reference, tables, turned)
                rotate_descriptor(turned, ti, descriptors, mine)
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
