"""Dense DAISY Filter Flow: superpixel labels, guided-filter aggregation, winner takes all, and the way back.

1. Superpixels; one label search per superpixel at its centre, with propagation between adjacent ones (as in `sparse`).
2. Labels are refined photometrically (`refinement`): they are similarities, so that a label is sub-pixel exact over its
   region.
3. For each superpixel, its own label and its neighbours' are tried on every pixel of its bounding box extended by twice
   the filter's radius; the raw costs (Eq. 1) are aggregated by the guided filter (Eq. 2), each pixel keeps the winner
   (Eq. 3). This works at half resolution: the orientation maps are no finer.
4. A pixel is valid if the flow of the other direction leads back; the others get an affine motion fitted to consistent
   regions around them, but stay marked as not valid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow.degenerate import STATS_NAMES, flow_stats, is_degenerate, request, usable_points
from dynslam_bench.flow.dense_kernels import Superpixels, aggregate_and_choose, spread_labels, superpixels
from dynslam_bench.flow.matching_cost import side, tables_for
from dynslam_bench.flow.orientation_maps import OrientationMaps
from dynslam_bench.flow.propagation import label_turns, transported_labels
from dynslam_bench.flow.refinement import BORDER
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.sparse import Pair, SparseDaisyFlow


@dataclass(frozen=True, eq=False)
class DenseFlow:
    """Flow of every pixel.

    Attributes:
        flow: float32 ``[H, W, 2]``, displacement (x, y) in pixels.
        valid: bool ``[H, W]``, consistent with the flow of the other direction (all True where that is not checked).
        cost: float32 ``[H, W]``, aggregated matching cost as a share of the largest possible.
        stats: Diagnostics.
        back: float32 ``[H, W, 2]``, flow of every target pixel to the reference; None where it was not computed.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    cost: NDArray[np.float32]
    stats: dict[str, float]
    back: NDArray[np.float32] | None = None


class DenseDaisyFlow:
    """Dense DAISY Filter Flow on the processor.

    Args:
        settings: How; `FlowSettings.dense_*` are its own.
        threads: Over which regions are divided; the result does not depend on it.
    """

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self._sparse = SparseDaisyFlow(threads=threads)
        self.configure(settings or FlowSettings())

    def configure(self, settings: FlowSettings) -> None:
        """Work by these settings from the next pair on."""
        self.settings = settings
        self._sparse.settings = settings.model_copy(
            update={
                "support": 9,
                "support_spacing_px": max(1, settings.dense_superpixel_px // 2),
                "range_px": settings.dense_range_px,
                "budget": settings.dense_budget,
                "sweeps": settings.dense_sweeps,
            }
        )

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._sparse.prepare(gray)

    def flow(self, reference: OrientationMaps, target: OrientationMaps, *, seed: int = 0) -> DenseFlow:
        """Flow from the reference to the target; see `DenseFlow`.

        Identical images and images without texture give zero flow that is not valid, as in the sparse mode; the stat
        ``degenerate`` is 1 then.
        """
        height, width = reference.gray.shape
        if is_degenerate(reference.gray, target.gray):
            shape = (height, width)
            return DenseFlow(
                np.zeros((*shape, 2), np.float32),
                np.zeros(shape, np.bool_),
                np.zeros(shape, np.float32),
                {"evaluations": 0.0, "valid": 0.0, "degenerate": 1.0},
            )
        forward = self._one_way(reference, target, seed)
        valid = np.ones((height, width), dtype=np.bool_)
        rounds, back = [forward], None
        if self.settings.dense_forward_backward_px > 0:
            backward = self._one_way(target, reference, seed + 1)
            rounds = [forward, backward]
            tolerance = self.settings.dense_forward_backward_px
            flows = forward.flow(), backward.flow()
            if self.settings.dense_second_round:
                forward.again(consistent(*flows, tolerance))
                backward.again(consistent(*flows[::-1], tolerance))
                flows = forward.flow(), backward.flow()
            valid, back = consistent(*flows, tolerance), flows[1]
            fitted = fit_regional_motion(flows[0], valid, forward.regions, forward.half)
            flow = flows[0] if fitted is None else fill_and_smooth(flows[0], valid, fitted)
        else:
            flow = forward.flow()
        evaluations = float(sum(r.evaluations for r in rounds))
        stats = {"evaluations": evaluations, "valid": float(valid.sum()), "degenerate": 0.0}
        return DenseFlow(flow, valid, forward.cost(), stats, back)

    def _one_way(self, reference: OrientationMaps, target: OrientationMaps, seed: int) -> _OneWay:
        one_way = _OneWay(self.settings, self._sparse, reference, target)
        one_way.found(seed)
        return one_way


class _OneWay:
    """The labels of one direction while they are improved; the sizes are those of the half-resolution image."""

    def __init__(
        self, settings: FlowSettings, sparse: SparseDaisyFlow, reference: OrientationMaps, target: OrientationMaps
    ) -> None:
        self.settings, self._sparse = settings, sparse
        self._pair = Pair(reference, target, tables_for(reference.gray.shape, sparse.settings))
        self.half = np.ascontiguousarray(reference.framed_half[BORDER:-BORDER, BORDER:-BORDER])
        self.regions = superpixels(self.half, max(2, settings.dense_superpixel_px // 2))
        self.centres = self.regions.centres * 2 + 0.5  # half-resolution pixel i covers 2 i and 2 i + 1
        self.evaluations = 0
        self._tables = tables_for(reference.gray.shape, settings.model_copy(update={"support": 1}))
        self._best = np.full(self.half.shape, np.inf, dtype=np.float32)
        self._winner = np.zeros((*self.half.shape, 4), dtype=np.float32)

    def found(self, seed: int) -> None:
        """Search a label for each region and let its pixels choose among it and the neighbours'."""
        sparse, pair = self._sparse, self._pair
        near = sparse.nearest(self.centres)
        neighbours = sparse.neighbours(self.centres)
        described = sparse.describe(pair.reference, self.centres, pair.tables)
        state = sparse.search(described, pair, neighbours, None, seed)
        labels = np.ascontiguousarray(state.flames[:, 0])
        if self.settings.refinement == "lucas-kanade":
            correlation = sparse.refine(self.centres, labels, pair)
            if neighbours.shape[1] > 1:
                sparse.second_opinion(self.centres, labels, correlation, neighbours, pair)
        elif self.settings.refinement == "parabola":
            sparse.parabola(described, labels, pair, state.used)
        self.evaluations += int(state.used.sum())
        self._choose(self._candidates(labels, near))

    def again(self, valid: NDArray[np.bool_]) -> None:
        """Try, on every region, the motion that consistent regions around it suggest, as it is and refined."""
        fitted = fit_regional_motion(self.flow(), valid, self.regions, self.half)
        if fitted is None:
            return
        suggested = fitted.labels()
        if self.settings.refinement != "lucas-kanade":
            self._choose(np.ascontiguousarray(suggested[:, None]))
            return
        refined = suggested.copy()
        self._sparse.refine(self.centres, refined, self._pair)
        self._choose(np.stack([suggested, refined], axis=1))

    def _choose(self, candidates: NDArray[np.float32]) -> None:
        evaluations = np.zeros(len(self.centres), dtype=np.int64)
        shape = (self.regions.members, self.regions.starts, self.centres, candidates)
        sides = (side(self._pair.reference), side(self._pair.target), self._tables)
        guide, radius = self.half.astype(np.float32) / np.float32(255), self.settings.dense_filter_radius_px
        smoothing = (guide, max(1, radius // 2), np.float32(self.settings.dense_filter_epsilon))
        chosen = (self._best, self._winner, evaluations)
        self._sparse.stripes(aggregate_and_choose, len(self.centres), *shape, *sides, *smoothing, *chosen)
        self.evaluations += int(evaluations.sum())

    def flow(self) -> NDArray[np.float32]:
        """Displacement of every full-image pixel under the labels chosen so far."""
        height, width = self._pair.reference.gray.shape
        flow = np.empty((height, width, 2), dtype=np.float32)
        self._sparse.stripes(spread_labels, height, self._winner, self.regions.labels, self.centres, flow)
        return flow

    def cost(self) -> NDArray[np.float32]:
        """Aggregated cost of every full-image pixel, as a share of the largest possible."""
        height, width = self._pair.reference.gray.shape
        y = np.minimum(np.arange(height) // 2, self.half.shape[0] - 1)
        x = np.minimum(np.arange(width) // 2, self.half.shape[1] - 1)
        share = self._best[np.ix_(y, x)] / np.float32(self._tables.ceiling)
        return np.asarray(np.clip(share, 0, 1), dtype=np.float32)  # the filter may overshoot

    def _candidates(self, labels: NDArray[np.float32], neighbours: NDArray[np.int64]) -> NDArray[np.float32]:
        """Each region's own label first, then its neighbours' as seen from its centre: float32 ``[K, C, 4]``."""
        n, most = len(labels), min(self.settings.dense_candidates - 1, neighbours.shape[1])
        seen = np.empty((n, most, 4), dtype=np.float32)
        extent = np.full((n, 4), 8.0, dtype=np.float32)
        near = np.ascontiguousarray(neighbours[:, :most])
        no_motion = np.empty((0, 4), dtype=np.float32)
        transported_labels(0, n, self.centres, labels, label_turns(labels), near, no_motion, -extent, extent, seen)
        return np.concatenate([labels[:, None], seen], axis=1)


def consistent(forward: NDArray[np.float32], backward: NDArray[np.float32], tolerance: float) -> NDArray[np.bool_]:
    """Pixels whose flow, followed by the backward flow where it ends, returns to within `tolerance` pixels."""
    height, width = forward.shape[:2]
    y, x = np.mgrid[:height, :width]
    column, row = np.rint(x + forward[..., 0]).astype(np.int64), np.rint(y + forward[..., 1]).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    back = backward[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return np.asarray(inside & (np.hypot(*np.moveaxis(forward + back, -1, 0)) <= tolerance), dtype=np.bool_)


# Dense DAISY Filter Flow behind the interface of all flows: the field of every pixel, read at the points.


class DensePointFlow:
    """The paper's flow (Eq. 1-3 over every pixel), read at the points; see `contracts.flow.FlowEstimator`.

    The field is read at the pixel that a point lies in, never between two: across the border of a moving thing a mean
    of two motions is nobody's. A point is valid if its pixel is (`dense_forward_backward_px`), if its way back ends
    within `forward_backward_px`, and if its aggregated cost is below `max_cost`. On the processor, whatever the device.

    Args:
        settings: How.
        threads: Over which regions are divided; the result does not depend on it.
    """

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self._dense = DenseDaisyFlow(settings or FlowSettings(mode="dense"), threads=threads)

    @property
    def settings(self) -> FlowSettings:
        """The settings in force."""
        return self._dense.settings

    @settings.setter
    def settings(self, settings: FlowSettings) -> None:
        self.configure(settings)

    def configure(self, settings: FlowSettings) -> None:
        """Work by these settings from the next pair on."""
        self._dense.configure(settings)

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._dense.prepare(gray)

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
        asked = request(reference.gray, target.gray, points)
        if isinstance(asked, FlowResult):
            return asked
        clean, usable = asked
        dense = self._dense.flow(reference, target, seed=seed)
        column, row = _pixels(clean)
        xy = (clean + dense.flow[row, column]).astype(np.float32)
        cost = dense.cost[row, column]
        valid = usable & dense.valid[row, column] & usable_points(xy, target.gray.shape)
        valid &= cost < self.settings.max_cost
        if self.settings.forward_backward_px > 0 and dense.back is not None:
            ends = np.where(valid[:, None], xy, clean)
            column, row = _pixels(ends)
            distance = np.linalg.norm(ends + dense.back[row, column] - clean, axis=1)
            valid &= distance <= self.settings.forward_backward_px
        stats = flow_stats(len(clean), int(valid.sum()), int(dense.stats["evaluations"]))
        return FlowResult(xy, valid, cost, stats)


def _pixels(points: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Column and row of the pixels that points inside an image lie in."""
    column, row = np.rint(points).astype(np.intp).T
    return column, row


# What consistent regions say about the regions around them: affine motions, fitted and read at every pixel.

NEIGHBOURS = 9
SHARE = 0.5
"""A region is reliable if this share of its pixels is consistent."""
SMOOTH_PX = 3.0
"""Consistent pixels this close to the fitted motion take it: a similarity a region cannot follow a slanted plane."""


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
    height, width = valid.shape
    y, x = np.minimum(np.arange(height) // 2, guide.shape[0] - 1), np.minimum(np.arange(width) // 2, guide.shape[1] - 1)
    region = regions.labels[np.ix_(y, x)].ravel().astype(np.int64)
    count = len(regions.centres)
    good = valid.ravel()
    pixels = np.maximum(np.bincount(region, minlength=count), 1)
    consistent = np.bincount(region, weights=good, minlength=count)
    reliable = np.flatnonzero((consistent >= SHARE * pixels) & (consistent > 0))
    if len(reliable) < 3:
        return None
    kept = np.flatnonzero(good)
    mean = np.empty((count, 4))  # position and flow of each region's consistent pixels
    columns = (kept % width, kept // width, *flow.reshape(-1, 2)[kept].T)
    for column, values in enumerate(columns):
        mean[:, column] = np.bincount(region[kept], weights=values, minlength=count) / np.maximum(consistent, 1)
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
        residual = np.linalg.norm(values - basis @ motion, axis=2)
        weight = weight / (1 + (residual / 2.0) ** 2)
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
    difference = smooth - own
    replaced = ~valid.ravel() | ((difference**2).sum(axis=1) < SMOOTH_PX**2)
    return np.where(replaced[:, None], smooth, own).astype(np.float32).reshape(flow.shape)
