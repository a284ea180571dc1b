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

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow.degenerate import STATS_NAMES, clean_points, flow_stats, is_degenerate, usable_points
from dynslam_bench.flow.dense_kernels import Superpixels, aggregate_and_choose, spread_labels, superpixels
from dynslam_bench.flow.matching_cost import MAX_COST, cost_tables
from dynslam_bench.flow.orientation_maps import OrientationMaps
from dynslam_bench.flow.propagation import labels_as_seen, nearest
from dynslam_bench.flow.refinement import BORDER
from dynslam_bench.flow.settings import DaisySettings, DenseFlowSettings, FlowSettings
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
        stats: Diagnostics.
        back: float32 ``[H, W, 2]``, flow of every target pixel to the reference.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    cost: NDArray[np.float32]
    stats: dict[str, float]
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
        return FlowResult(xy, valid, cost, flow_stats(len(clean), int(valid.sum()), int(dense.stats["evaluations"])))

    def flow(self, reference: OrientationMaps, target: OrientationMaps, *, seed: int = 0) -> DenseFlow:
        """Flow of every pixel from the reference to the target.

        Degenerate images give zero flow that is not valid, as in the sparse flow; the stat ``degenerate`` is 1 then.
        """
        shape = reference.gray.shape
        if is_degenerate(reference.gray, target.gray):
            stats = {"evaluations": 0.0, "valid": 0.0, "degenerate": 1.0}
            zero = np.zeros((*shape, 2), np.float32)
            return DenseFlow(zero, np.zeros(shape, np.bool_), np.zeros(shape, np.float32), stats, zero)
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
        evaluations = forward.evaluations + backward.evaluations
        stats = {"evaluations": float(evaluations), "valid": float(valid.sum()), "degenerate": 0.0}
        return DenseFlow(flow, valid, forward.cost(), stats, back)


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
