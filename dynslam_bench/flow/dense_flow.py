"""Dense DAISY Filter Flow: superpixel labels, guided-filter aggregation, winner takes all, forward-backward check.

1. Superpixels; one label search per superpixel at its centre, with propagation between adjacent ones (as in `sparse`).
2. Labels are refined photometrically (`refinement`). A label is a similarity and thus sub-pixel exact over its region.
3. For each superpixel, its own label and its neighbours' are tried on every pixel of its bounding box extended by the
   filter's radius. The raw costs (Eq. 1) are aggregated by the guided filter (Eq. 2), each pixel
   takes the label of the lowest cost (Eq. 3). This works at half resolution: the orientation maps
   are no finer.
4. A pixel is valid if the flow of the other direction leads back. The others take an affine motion that is fitted to
   the consistent regions around them, but stay marked as not valid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.core.compiled import Scalar, inlined, kernel
from dynslam_bench.core.simd import Bytes, Doubles, Flags, Floats, Ints, Longs, Words
from dynslam_bench.flow import layout
from dynslam_bench.flow.degenerate import STATS_NAMES, clean_points, flow_stats, usable_points
from dynslam_bench.flow.label_search import labels_as_seen, nearest, search_labels
from dynslam_bench.flow.matching_cost import (
    MAX_COST,
    CostTables,
    MatchingCost,
    Reference,
    appearance,
    cost_tables,
    descriptor_distance,
    quantised,
    read_descriptor,
    rotate_descriptor,
)
from dynslam_bench.flow.orientation_maps import ImageArrays, OrientationMaps
from dynslam_bench.flow.refinement import BORDER
from dynslam_bench.flow.settings import DaisySettings, DenseFlowSettings, FlowSettings
from dynslam_bench.flow.sparse import SparseDaisyFlow, image_arrays
from dynslam_bench.geometry import pixel_index

NEIGHBOURS = 9
"""Reliable regions that a regional motion is fitted to."""
SHARE = 0.5
"""A region is reliable if this share of its pixels is consistent."""
SMOOTH_PX = 3.0
"""Consistent pixels this close to the fitted motion take it: a similarity a region cannot follow a slanted plane."""
SAME_PX = 0.5
"""A label is tried on a region only if it moves one of its pixels by more than this from where it is: the maps' cells
are no finer."""


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

    The field is read at the pixel that contains a point and not interpolated: at the border of a
    moving object the mean of two motions is wrong. A point is valid if its pixel is consistent
    (`consistency_px`), if its forward-backward error is at most `forward_backward_px`, and if its
    aggregated cost is low. On the processor, whatever the device.

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
            FlowSettings(
                **common, support=5, support_spacing_px=max(1, settings.superpixel_px // 2)
            )
        )

    def prepare(self, gray: NDArray[np.uint8]) -> DescribedImage:
        """Orientation maps, superpixels and descriptors of a uint8 ``[H, W]`` image."""
        return describe_image(self._sparse.prepare(gray), self.settings, self._sparse)

    def track(
        self,
        reference: DescribedImage,
        target: DescribedImage,
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`. The guess is not used."""
        # flat or tiny images have no flow; unusable points are replaced for the search
        cleaned = clean_points(reference.maps.gray, target.maps.gray, points)
        if isinstance(cleaned, FlowResult):
            return cleaned
        clean, usable = cleaned
        dense = self.flow(reference, target, seed=seed)

        # read the field at the pixels that contain the points
        pixel, _ = pixel_index(clean, target.maps.gray.shape)
        xy = (clean + dense.flow[pixel]).astype(np.float32)
        cost = dense.cost[pixel]
        valid = (
            usable
            & dense.valid[pixel]
            & usable_points(xy, target.maps.gray.shape)
            & (cost < MAX_COST)
        )

        # forward-backward check: follow the backward flow from where each point ends
        if self.settings.forward_backward_px > 0:
            ends = np.where(valid[:, None], xy, clean)
            end_pixel, _ = pixel_index(ends, target.maps.gray.shape)
            error = np.linalg.norm(ends + dense.back[end_pixel] - clean, axis=1)
            valid &= error <= self.settings.forward_backward_px
        return FlowResult(
            xy, valid, cost, flow_stats(len(clean), int(valid.sum()), dense.evaluations)
        )

    def flow(
        self, reference: DescribedImage, target: DescribedImage, *, seed: int = 0
    ) -> DenseFlow:
        """Flow of every pixel from the reference to the target."""
        # 1-3. search, refine and choose labels in both directions
        forward = _RegionLabels(self.settings, self._sparse, reference, target, seed)
        backward = _RegionLabels(self.settings, self._sparse, target, reference, seed + 1)
        flow = forward.flow()
        back = backward.flow()

        # a second round: regions that are not consistent try the motion of those around them
        if self.settings.second_round:
            forward.try_regional_motion(self._consistent(flow, back))
            backward.try_regional_motion(self._consistent(back, flow))
            flow = forward.flow()
            back = backward.flow()

        # 4. keep what the backward flow leads back from; fill the rest with the fitted motion
        valid = self._consistent(flow, back)
        fitted = fit_regional_motion(flow, valid, reference.regions, reference.half)
        if fitted is not None:
            filled = np.empty_like(flow)
            self._sparse.workers.run(
                fill_and_smooth,
                0,
                len(flow),
                flow,
                valid,
                reference.regions.labels,
                reference.centres,
                fitted.astype(np.float32),
                filled,
            )
            flow = filled
        return DenseFlow(
            flow, valid, forward.cost(), forward.evaluations + backward.evaluations, back
        )

    def _consistent(self, forward: Floats, backward: Floats) -> Flags:
        """Flags ``[H, W]`` of the pixels that the backward flow leads back to; see `consistent`."""
        valid = np.empty(forward.shape[:2], dtype=np.bool_)
        tolerance = np.float32(self.settings.consistency_px)
        self._sparse.workers.run(consistent, 0, len(valid), forward, backward, tolerance, valid)
        return valid


@dataclass(frozen=True, eq=False)
class DescribedImage:
    """One image, prepared for both directions and for the next pair; sizes are those of the half-resolution image.

    Attributes:
        maps: Its orientation maps.
        half: uint8 ``[h, w]``, grey levels.
        regions: Its superpixels.
        centres: float32 ``[K, 2]``, their centres, full-image pixels.
        neighbours: int64 ``[K, 8]``, the nearest other regions.
        described: The centres for the label search.
        descriptors: uint64, flat ``[h, w, 17]``, unrotated, a histogram each.
    """

    maps: OrientationMaps
    half: NDArray[np.uint8]
    regions: Superpixels
    centres: NDArray[np.float32]
    neighbours: NDArray[np.int64]
    described: Reference
    descriptors: NDArray[np.uint64]


def describe_image(
    maps: OrientationMaps, settings: DenseFlowSettings, sparse: SparseDaisyFlow
) -> DescribedImage:
    """Compute superpixels and descriptors of an image."""
    # superpixels of the half-resolution image
    half = np.ascontiguousarray(maps.framed_half[BORDER:-BORDER, BORDER:-BORDER])
    regions = superpixels(half, max(2, settings.superpixel_px // 2))
    # half-resolution pixel i covers 2 i and 2 i + 1
    centres = regions.centres * 2 + 0.5
    neighbours = nearest(centres, sparse.workers.run)

    # the unrotated descriptor of every half-resolution pixel
    tables = sparse.pair(maps, maps).tables
    descriptors = np.empty(half.size * layout.HISTOGRAMS, dtype=np.uint64)
    sparse.workers.run(read_descriptors, 0, *half.shape, maps.arrays, tables, descriptors)
    return DescribedImage(
        maps=maps,
        half=half,
        regions=regions,
        centres=centres,
        neighbours=neighbours,
        described=sparse.describe(maps, centres, tables),
        descriptors=descriptors,
    )


class _RegionLabels:
    """The labels of one direction; sizes are those of the half-resolution image.

    A label is searched for each region; the region's pixels take the best of it and its
    neighbours'.
    """

    def __init__(
        self,
        settings: DenseFlowSettings,
        sparse: SparseDaisyFlow,
        reference: DescribedImage,
        target: DescribedImage,
        seed: int,
    ) -> None:
        # no pixel has a label yet
        self.settings = settings
        self._sparse = sparse
        self._image = reference
        self._pair = pair = sparse.pair(reference.maps, target.maps)
        self._tables = cost_tables(reference.maps.gray.shape, settings.terms)
        self._best = np.full(reference.half.shape, np.inf, dtype=np.float32)
        self._winner = np.zeros((*reference.half.shape, 4), dtype=np.float32)

        # search a label for each superpixel at its centre, without a guess
        centres = reference.centres
        neighbours = reference.neighbours
        target_arrays = image_arrays(pair.target, pair.tables)
        matching = MatchingCost(reference.described, target_arrays, pair.tables)
        state = search_labels(sparse.settings, sparse.workers.run, matching, neighbours, None, seed)
        # the best label of each region [R, 4], refined in place
        labels = np.ascontiguousarray(state.flames[:, 0])
        if settings.refinement == "lucas-kanade":
            sparse.refine_together(centres, labels, neighbours, pair)
        self.evaluations = int(state.used.sum())

        # every pixel takes the best of its region's label and its neighbours', [R, candidates, 4]
        near = np.ascontiguousarray(neighbours[:, : settings.candidates - 1])
        candidates = np.concatenate(
            [labels[:, None], labels_as_seen(centres, labels, near)], axis=1
        )
        self._choose(candidates)

    def try_regional_motion(self, valid: NDArray[np.bool_]) -> None:
        """Try, on every region with an inconsistent pixel, the motion of the regions around it, fitted and refined.

        One pixel in four is looked at: those of even rows and columns.
        """
        # regions with a pixel, of those looked at, that is not consistent
        regions = self._image.regions
        (height, width) = self._image.half.shape
        fitted = fit_regional_motion(self.flow(), valid, regions, self._image.half)
        if fitted is None:
            return
        inconsistent = ~valid[: 2 * height : 2, : 2 * width : 2]
        doubtful = np.unique(regions.labels[inconsistent])

        # two candidates a region: the fitted motion's similarity, and the same refined in place
        labels = nearest_similarities(fitted)[doubtful]
        candidates = np.full((len(fitted), 2, 4), np.nan, dtype=np.float32)
        candidates[doubtful, 0] = labels
        if self.settings.refinement == "lucas-kanade":
            self._sparse.refine(self._image.centres[doubtful], labels, self._pair)
            candidates[doubtful, 1] = labels
        self._choose(candidates)

    def _choose(self, candidates: NDArray[np.float32]) -> None:
        """Let every pixel take the best of its region's candidates ``[K, C, 4]``, if it beats the label it has."""
        # regions, images and windows as kernels read them
        image = self._image
        count = len(image.centres)
        regions = RegionArrays(image.regions.members, image.regions.starts, image.centres)
        matching = PixelMatching(
            reference=image_arrays(self._pair.reference, self._tables),
            target=image_arrays(self._pair.target, self._tables),
            tables=self._tables,
            descriptors=image.descriptors,
        )
        aggregation = GuidedFilter(
            guide=image.half.astype(np.float32) / np.float32(255),
            radius=max(1, self.settings.filter_radius_px // 2),
            epsilon=np.float32(self.settings.filter_epsilon),
        )
        chosen = ChosenLabels(self._best, self._winner, np.zeros(count, dtype=np.int64))
        # Eq. 1-3, the regions divided among threads
        self._sparse.workers.run(
            aggregate_and_choose, 0, count, regions, candidates, matching, aggregation, chosen
        )
        self.evaluations += int(chosen.evaluations.sum())

    def flow(self) -> NDArray[np.float32]:
        """Displacement of every full-image pixel under the labels chosen so far."""
        image = self._image
        height, width = image.maps.gray.shape
        flow = np.empty((height, width, 2), dtype=np.float32)
        self._sparse.workers.run(
            spread_labels, 0, height, self._winner, image.regions.labels, image.centres, flow
        )
        return flow

    def cost(self) -> NDArray[np.float32]:
        """Aggregated cost of every full-image pixel, as a share of the largest possible."""
        height, width = self._image.maps.gray.shape
        half_height, half_width = self._image.half.shape
        # the half-resolution pixel of each full-image row and column; an odd last one has none
        rows = np.minimum(np.arange(height) // 2, half_height - 1)
        columns = np.minimum(np.arange(width) // 2, half_width - 1)
        cost = self._best[np.ix_(rows, columns)]
        # the guided filter may overshoot
        share = np.clip(cost / np.float32(self._tables.ceiling), 0, 1)
        return np.asarray(share, dtype=np.float32)


@kernel
def consistent(
    start: int, stop: int, forward: Floats, backward: Floats, tolerance: Scalar, valid: Flags
) -> None:
    """Mark pixels whose flow, followed by the backward flow where it ends, returns to within `tolerance` pixels.

    Args:
        start: First row.
        stop: One past the last.
        forward: float32 ``[H, W, 2]``.
        backward: float32 ``[H, W, 2]``, flow of the other direction.
        tolerance: Pixels.
        valid: bool ``[H, W]``, filled.
    """
    height, width = valid.shape
    limit = tolerance * tolerance
    for y in range(start, stop):
        for x in range(width):
            u = forward[y, x, 0]
            v = forward[y, x, 1]
            # the pixel in which the forward flow ends
            column = np.int64(np.rint(np.float32(x) + u))
            row = np.int64(np.rint(np.float32(y) + v))
            valid[y, x] = False
            if 0 <= column < width and 0 <= row < height:
                # forward and backward flow together, which is 0 if they agree
                dx = u + backward[row, column, 0]
                dy = v + backward[row, column, 1]
                valid[y, x] = dx * dx + dy * dy <= limit


def nearest_similarities(motion: NDArray[np.float64]) -> NDArray[np.float32]:
    """The similarities nearest to affine motions ``[K, 3, 2]`` at their centres, as labels ``[K, 4]``."""
    # the similarity (a, -b; b, a) nearest to the affine map in the Frobenius norm
    a = 1 + 0.5 * (motion[:, 1, 0] + motion[:, 2, 1])
    b = 0.5 * (motion[:, 1, 1] - motion[:, 2, 0])
    # as a label: scale in octaves and rotation in radians
    s = np.log2(np.maximum(np.hypot(a, b), 0.25))
    theta = np.arctan2(b, a)
    return np.column_stack([motion[:, 0], s, theta]).astype(np.float32)


def fit_regional_motion(
    flow: NDArray[np.float32],
    valid: NDArray[np.bool_],
    regions: Superpixels,
    guide: NDArray[np.uint8],
) -> NDArray[np.float64] | None:
    """Fit an affine motion to the reliable regions around each region, robustly.

    Args:
        flow: float32 ``[H, W, 2]``.
        valid: bool ``[H, W]``, consistent pixels.
        regions: Superpixels at half resolution.
        guide: uint8 ``[H / 2, W / 2]``, their image; regions of similar grey level count more.

    Returns:
        float64 ``[K, 3, 2]``, flow at the centre, and its change per pixel along x and y; None
        where fewer than three regions are reliable.
    """
    # regions with enough consistent pixels are reliable
    count = len(regions.centres)
    sums = np.zeros((count, 6))
    sum_regions(flow, valid, regions.labels, sums)
    consistent = sums[:, 1]
    reliable = np.flatnonzero((consistent >= SHARE * np.maximum(sums[:, 0], 1)) & (consistent > 0))
    if len(reliable) < 3:
        return None
    # mean position and mean flow of each region's consistent pixels, [K, 4]
    mean = sums[:, 2:] / np.maximum(consistent, 1)[:, None]
    centres = regions.centres.astype(np.float64) * 2 + 0.5
    region_of_pixel = regions.labels.ravel()
    grey_sum = np.bincount(region_of_pixel, weights=guide.ravel(), minlength=count)
    grey = grey_sum / np.maximum(np.bincount(region_of_pixel, minlength=count), 1)

    # the nearest reliable regions of each, [K, near]
    near = min(NEIGHBOURS, len(reliable))
    distance, index = cKDTree(mean[reliable, :2]).query(centres, k=near)
    chosen = reliable[np.asarray(index).reshape(count, near)]
    distance = np.asarray(distance).reshape(count, near)

    # near regions of a similar grey level weigh most
    spread = np.maximum(distance.mean(axis=1, keepdims=True), 1.0)
    weight = (
        np.exp(-0.5 * (distance / spread) ** 2 - np.abs(grey[chosen] - grey[:, None]) / 20.0) + 1e-6
    )

    # flow = motion^T (1, dx, dy), with offsets in units of `spread`
    offset = (mean[chosen, :2] - centres[:, None]) / spread[..., None]
    basis = np.concatenate([np.ones((count, near, 1)), offset], axis=2)
    values = mean[chosen, 2:]
    motion = np.zeros((count, 3, 2))
    # iteratively reweighted least squares: a foreground region must not bend the background
    for _ in range(3):
        weighted = basis * weight[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis
        # damping: the change along x and y is near zero where the regions do not tell it
        normal[:, (0, 1, 2), (0, 1, 2)] += weight.sum(axis=1, keepdims=True) * (1e-6, 0.05, 0.05)
        motion = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ values)
        weight = weight / (1 + (np.linalg.norm(values - basis @ motion, axis=2) / 2.0) ** 2)
    # back to a change per pixel
    motion[:, 1:] /= spread[:, :, None]
    return motion


@kernel
def sum_regions(flow: Floats, valid: Flags, labels: Ints, sums: Doubles) -> None:
    """Add up pixels, consistent pixels, and their x, y and flow, by region: float64 ``[K, 6]``.

    Args:
        flow: float32 ``[H, W, 2]``, pixels.
        valid: bool ``[H, W]``, consistent pixels.
        labels: int32 ``[H / 2, W / 2]``, `Superpixels.labels`.
        sums: Added to: number of pixels, number of consistent ones, and their sums of x, y, u and
            v.
    """
    # a full-image pixel belongs to the region of its half-resolution pixel
    for y in range(len(valid)):
        row = labels[min(y // 2, len(labels) - 1)]
        for x in range(valid.shape[1]):
            r = row[min(x // 2, len(row) - 1)]
            sums[r, 0] += 1
            if valid[y, x]:
                sums[r, 1] += 1
                sums[r, 2] += x
                sums[r, 3] += y
                sums[r, 4] += flow[y, x, 0]
                sums[r, 5] += flow[y, x, 1]


@kernel
def fill_and_smooth(
    start: int,
    stop: int,
    flow: Floats,
    valid: Flags,
    labels: Ints,
    centres: Floats,
    motion: Floats,
    out: Floats,
) -> None:
    """Copy rows start..stop; pixels not valid, or within `SMOOTH_PX` of it, take their region's fitted motion.

    Args:
        start: First row.
        stop: One past the last.
        flow: float32 ``[H, W, 2]``.
        valid: bool ``[H, W]``, consistent pixels.
        labels: `Superpixels.labels`.
        centres: float32 ``[K, 2]``, full-image pixels.
        motion: float32 ``[K, 3, 2]`` of `fit_regional_motion`.
        out: float32 ``[H, W, 2]``, filled.
    """
    limit = np.float32(SMOOTH_PX**2)
    for y in range(start, stop):
        row = labels[min(y // 2, len(labels) - 1)]
        for x in range(flow.shape[1]):
            r = row[min(x // 2, len(row) - 1)]
            # the fitted motion of the pixel's region at the pixel
            dx = np.float32(x) - centres[r, 0]
            dy = np.float32(y) - centres[r, 1]
            u = motion[r, 0, 0] + dx * motion[r, 1, 0] + dy * motion[r, 2, 0]
            v = motion[r, 0, 1] + dx * motion[r, 1, 1] + dy * motion[r, 2, 1]
            # the pixel's own flow, where it is consistent and differs clearly
            own_u = flow[y, x, 0]
            own_v = flow[y, x, 1]
            replaced = (
                not valid[y, x] or (u - own_u) * (u - own_u) + (v - own_v) * (v - own_v) < limit
            )
            out[y, x, 0] = u if replaced else own_u
            out[y, x, 1] = v if replaced else own_v


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


def superpixels(
    gray: NDArray[np.uint8], size: int, *, compactness: float = 20.0, iterations: int = 4
) -> Superpixels:
    """Divide a uint8 ``[H, W]`` image into regions of about ``size * size`` pixels.

    Args:
        gray: The image.
        size: Side of the initial squares, pixels.
        compactness: Grey levels that weigh as much as a distance of `size`.
        iterations: Iterations of k-means.
    """
    # initial centres (x, y, grey level): those of a grid of squares
    height, width = gray.shape
    rows = max(1, round(height / size))
    columns = max(1, round(width / size))
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    centres = np.zeros((rows * columns, 3), dtype=np.float64)
    centres[:, 0] = np.tile(x, rows)
    centres[:, 1] = np.repeat(y, columns)
    centres[:, 2] = gray[np.rint(centres[:, 1]).astype(int), np.rint(centres[:, 0]).astype(int)]
    # k-means in position and grey level
    labels = np.empty((height, width), dtype=np.int32)
    assign_pixels(gray, centres, size, (size / compactness) ** 2, iterations, labels)

    # list each region's pixels
    flat = labels.reshape(-1)
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=len(centres)))])
    members = np.argsort(flat, kind="stable")
    return Superpixels(labels, centres[:, :2].astype(np.float32), members, starts.astype(np.int64))


@kernel
def assign_pixels(
    gray: Bytes, centres: Doubles, size: int, weight: float, iterations: int, labels: Ints
) -> None:
    """K-means: each centre competes for the pixels within `size` of it; fills `labels`, moves `centres`.

    Args:
        gray: uint8 ``[H, W]``.
        centres: float64 ``[K, 3]``: x, y in pixels, and grey level.
        size: Half side of the window in which a centre competes, pixels.
        weight: Squared pixels that a squared grey level weighs as much as.
        iterations: Rounds of assignment and update.
        labels: int32 ``[H, W]``, filled with each pixel's centre.
    """
    height, width = gray.shape
    distance = np.empty((height, width), dtype=np.float64)
    sums = np.empty((len(centres), 4), dtype=np.float64)
    for _ in range(iterations):
        # assignment: a pixel takes the nearest centre in position and grey level
        distance[:] = np.inf
        labels[:] = -1
        for k in range(len(centres)):
            cx = centres[k, 0]
            cy = centres[k, 1]
            cg = centres[k, 2]
            for y in range(max(0, int(cy - size)), min(height, int(cy + size) + 2)):
                for x in range(max(0, int(cx - size)), min(width, int(cx + size) + 2)):
                    dx = x - cx
                    dy = y - cy
                    dg = gray[y, x] - cg
                    d = dx * dx + dy * dy + weight * dg * dg
                    if d < distance[y, x]:
                        distance[y, x] = d
                        labels[y, x] = k
        # update: sum x, y, grey level and number of each centre's pixels
        sums[:] = 0
        for y in range(height):
            for x in range(width):
                k = labels[y, x]
                # a pixel too far from every centre takes the nearest in position
                if k < 0:
                    best = np.inf
                    for other in range(len(centres)):
                        d = (x - centres[other, 0]) ** 2 + (y - centres[other, 1]) ** 2
                        if d < best:
                            best = d
                            k = other
                    labels[y, x] = k
                sums[k, 0] += x
                sums[k, 1] += y
                sums[k, 2] += gray[y, x]
                sums[k, 3] += 1
        # each centre moves to the mean of its pixels
        for k in range(len(centres)):
            if sums[k, 3] > 0:
                for j in range(3):
                    centres[k, j] = sums[k, j] / sums[k, 3]


# ---------------------------------------------------------------------- aggregation (Eq. 1-3)


@inlined
def box_mean(
    values: Floats, pitch: int, radius: int, share: Floats, line: Floats, out: Floats
) -> None:
    """Means over windows clipped at the edges: columns, then rows, as flat vector code over a framed patch.

    Args:
        values: float32, flat ``[rows * pitch]``, zero in a frame `radius` wide.
        pitch: Numbers a row.
        radius: Radius of the window, pixels.
        share: float32, flat, one over the pixels in each window, zero in the frame.
        line: float32, flat, scratch, zero in the first and last `radius` rows and in the corners.
        out: float32, flat, filled but for the outermost rows.
    """
    # sums over the columns of the windows
    first = radius * pitch
    last = len(values) - radius * pitch
    for k in range(first, last):
        line[k] = values[k]
    for d in range(1, radius + 1):
        for k in range(first, last):
            line[k] += values[k - d * pitch] + values[k + d * pitch]
    # sums of these over the rows, divided by the number of pixels
    for k in range(first, last):
        out[k] = line[k]
    for d in range(1, radius + 1):
        for k in range(first, last):
            out[k] += line[k - d] + line[k + d]
    for k in range(first, last):
        out[k] *= share[k]


@kernel
def frame_patch(
    guide: Floats,
    top: int,
    left: int,
    height: int,
    width: int,
    radius: int,
    patch: Floats,
    work: Floats,
) -> None:
    """Read a patch of the guide and what `filter_patch` needs of it.

    Args:
        guide: float32 ``[h, w]``, grey levels in [0, 1].
        top: First row of the patch.
        left: First column of the patch.
        height: Rows of the patch.
        width: Columns of the patch.
        radius: Radius of the window, pixels.
        patch: float32, flat ``[(height + 2 radius) * (width + 2 radius)]``, the patch in a frame of
            zeros.
        work: float32 ``[8, ...]``, scratch of at least that length; rows 0 to 2: share, mean and
            variance of the guide.
    """
    # rows of the scratch array by name
    pitch = width + 2 * radius
    n = len(patch)
    patch[:] = 0
    work[:, :n] = 0
    share = work[0, :n]
    mean = work[1, :n]
    variance = work[2, :n]
    line = work[3, :n]
    square = work[4, :n]
    # the patch, and one over the number of its pixels in each window
    for y in range(height):
        rows = np.float32(min(y + radius, height - 1) - max(y - radius, 0) + 1)
        at = (y + radius) * pitch + radius
        for x in range(width):
            columns = np.float32(min(x + radius, width - 1) - max(x - radius, 0) + 1)
            patch[at + x] = guide[top + y, left + x]
            share[at + x] = np.float32(1) / (rows * columns)
    # mean, and variance as the mean square less the squared mean
    box_mean(patch, pitch, radius, share, line, mean)
    for k in range(n):
        square[k] = patch[k] * patch[k]
    box_mean(square, pitch, radius, share, line, variance)
    for k in range(n):
        variance[k] = max(variance[k] - mean[k] * mean[k], np.float32(0))


@kernel
def filter_patch(
    patch: Floats, values: Floats, pitch: int, radius: int, epsilon: Scalar, work: Floats
) -> None:
    """The guided filter (He, Sun, Tang 2010): an average of `values` that preserves the edges of the guide, in place.

    Within each ``(2 radius + 1)**2`` window (clipped at the patch's edge) the output is a linear
    function of the guide; overlapping windows are averaged.

    Args:
        patch: float32, flat, the guide of `frame_patch`.
        values: float32, flat, framed as the guide; what is filtered (matching costs).
        pitch: Numbers a row.
        radius: Radius of the window, pixels.
        epsilon: Regularisation, squared grey levels.
        work: float32 ``[8, ...]``, the scratch array that `frame_patch` filled; rows 3 to 6 are
            overwritten.
    """
    # rows of the scratch array by name
    n = len(patch)
    share = work[0, :n]
    mean = work[1, :n]
    variance = work[2, :n]
    line = work[3, :n]
    offset = work[4, :n]
    slope = work[5, :n]
    product = work[6, :n]
    # means of the values, and of guide times values
    box_mean(values, pitch, radius, share, line, offset)
    for k in range(n):
        product[k] = patch[k] * values[k]
    box_mean(product, pitch, radius, share, line, slope)
    # linear regression on the guide in each window: slope a = covariance / (variance + epsilon)
    for k in range(n):
        spread = variance[k] + epsilon
        a = (slope[k] - mean[k] * offset[k]) / spread if spread > 0 else np.float32(0)
        slope[k] = a
        offset[k] -= a * mean[k]
    # average slopes and offsets of the windows that contain a pixel
    box_mean(slope, pitch, radius, share, line, product)
    box_mean(offset, pitch, radius, share, line, slope)
    for k in range(n):
        values[k] = product[k] * patch[k] + slope[k]


@kernel
def read_descriptors(
    start: int, stop: int, columns: int, image: ImageArrays, tables: CostTables, out: Words
) -> None:
    """Fill rows start..stop of ``out``, uint64, flat ``[h, columns, 17]``, with half-resolution pixels' descriptors.

    Args:
        start: First row.
        stop: One past the last row.
        columns: Half-resolution pixels a row.
        image: Orientation maps of the image.
        tables: Tables of the cost, with the sampling pattern.
        out: Filled.
    """
    for y in range(start, stop):
        for x in range(columns):
            # the centre of the half-resolution pixel in the full image
            px = np.float32(2 * x) + np.float32(0.5)
            py = np.float32(2 * y) + np.float32(0.5)
            first = (y * columns + x) * layout.HISTOGRAMS
            read_descriptor(px, py, image, tables, out, first)


Similarity: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
"""Displacement u, v at a centre, and a, b: scale times cosine and sine of the rotation."""

DESCRIPTOR_BYTES = layout.LENGTH
"""Bytes of a descriptor: 17 histograms of eight bins."""


class RegionArrays(NamedTuple):
    """The superpixels as kernels read them.

    Attributes:
        members: int64 ``[h * w]``, `Superpixels.members`.
        starts: int64 ``[K + 1]``, `Superpixels.starts`.
        centres: float32 ``[K, 2]``, full-image pixels.
    """

    members: NDArray[np.int64]
    starts: NDArray[np.int64]
    centres: NDArray[np.float32]


class PixelMatching(NamedTuple):
    """Images, descriptors and tables that give the raw cost (Eq. 1) of a pixel.

    Attributes:
        reference: Orientation maps and grey levels of the reference.
        target: Orientation maps and grey levels of the target.
        tables: Tables of the cost, without support.
        descriptors: `DescribedImage.descriptors` of the reference, unrotated.
    """

    reference: ImageArrays
    target: ImageArrays
    tables: CostTables
    descriptors: NDArray[np.uint64]


class GuidedFilter(NamedTuple):
    """The guided filter by which costs are aggregated (Eq. 2).

    Attributes:
        guide: float32 ``[h, w]``, half-resolution grey levels in [0, 1].
        radius: Radius of the windows, half-resolution pixels.
        epsilon: float32, regularisation, squared grey levels.
    """

    guide: NDArray[np.float32]
    radius: int
    epsilon: Scalar


class ChosenLabels(NamedTuple):
    """The winners so far (Eq. 3), changed in place.

    Attributes:
        best: float32 ``[h, w]``, lowest aggregated cost.
        winner: float32 ``[h, w, 4]``, its label around the region's centre: displacement, and
            ``2**s (cos, sin)``.
        evaluations: int64 ``[K]``, raw costs computed for each region.
    """

    best: NDArray[np.float32]
    winner: NDArray[np.float32]
    evaluations: NDArray[np.int64]


class RotatedDescriptors(NamedTuple):
    """The descriptors of a patch, rotated when a label first needs a rotation.

    Attributes:
        data: uint8, flat ``[13, size, 136]``.
        size: Descriptors a rotation that `data` has room for.
        filled: bool ``[13]``, rotations that `data` holds already.
        scratch: uint64 ``[2, 17]``.
    """

    data: NDArray[np.uint8]
    size: int
    filled: NDArray[np.bool_]
    scratch: NDArray[np.uint64]


@kernel
def aggregate_and_choose(
    start: int,
    stop: int,
    regions: RegionArrays,
    candidates: Floats,
    matching: PixelMatching,
    aggregation: GuidedFilter,
    chosen: ChosenLabels,
) -> None:
    """Raw cost, guided filter and winner takes all (Eq. 1-3) for regions start..stop, at half resolution.

    Args:
        start: First region.
        stop: One past the last.
        regions: The superpixels.
        candidates: float32 ``[K, C, 4]``, labels around the centres; NaN means none.
        matching: Images, tables and descriptors of the raw cost.
        aggregation: Guide and windows of the filter.
        chosen: Changed in place.
    """
    guide = aggregation.guide
    radius = aggregation.radius
    best = chosen.best
    winner = chosen.winner
    rows, columns = guide.shape

    # scratch, made larger when a patch needs more
    size = 0
    data = np.empty(0, dtype=np.uint8)
    filled = np.zeros(layout.ROTATIONS, dtype=np.bool_)
    scratch = np.empty((2, layout.HISTOGRAMS), dtype=np.uint64)
    values = np.empty(0, np.float32)
    patch = np.empty(0, np.float32)
    work = np.empty((8, 0), np.float32)

    for r in range(start, stop):
        if regions.starts[r] == regions.starts[r + 1]:
            continue
        # the patch: the region's bounding box, extended by the filter's radius, in a frame of zeros
        region = regions.members[regions.starts[r] : regions.starts[r + 1]]
        top, left, high, wide = patch_around(region, rows, columns, radius)
        pitch = wide + 2 * radius
        n = (high + 2 * radius) * pitch
        if n > size:
            size = n
            data = np.empty(layout.ROTATIONS * n * DESCRIPTOR_BYTES, dtype=np.uint8)
            values = np.empty(n, np.float32)
            patch = np.empty(n, np.float32)
            work = np.empty((8, n), np.float32)
        filled[:] = False
        framed = False
        centre = (regions.centres[r, 0], regions.centres[r, 1])
        corner = (left, top, wide, high)

        for c in range(candidates.shape[1]):
            # the label as a similarity; one that is missing or changes nothing is left out
            u = candidates[r, c, 0]
            v = candidates[r, c, 1]
            s = candidates[r, c, 2]
            theta = candidates[r, c, 3]
            scale = np.float32(np.exp2(s))
            a = scale * np.float32(np.cos(theta))
            b = scale * np.float32(np.sin(theta))
            if not np.isfinite(u + v + a + b):
                continue
            if not differs((u, v, a, b), centre, region, columns, best, winner):
                continue

            # Eq. 1: raw costs of the patch
            if not framed:
                frame_patch(guide, top, left, high, wide, radius, patch[:n], work)
                values[:n] = 0
                framed = True
            si, ti = quantised(s, theta)
            rotated = RotatedDescriptors(data, size, filled, scratch)
            raw_costs(
                (u, v, a, b),
                (si, ti),
                centre,
                corner,
                radius,
                matching,
                columns,
                rotated,
                values[:n],
            )
            filled[ti] = True
            chosen.evaluations[r] += high * wide

            # Eq. 2: aggregation by the guided filter
            filter_patch(patch[:n], values[:n], pitch, radius, aggregation.epsilon, work)

            # Eq. 3: the region's pixels take the label where its cost is the lowest so far
            first = (radius - top) * pitch + radius - left
            take_where_cheaper((u, v, a, b), region, columns, values, pitch, first, best, winner)


@inlined
def take_where_cheaper(
    label: Similarity,
    region: Longs,
    columns: int,
    values: Floats,
    pitch: int,
    first: int,
    best: Floats,
    winner: Floats,
) -> None:
    """Let the pixels of a region take a label where its aggregated cost is the lowest so far.

    Args:
        label: The label.
        region: int64, flat indices of the region's half-resolution pixels.
        columns: Half-resolution pixels a row.
        values: float32, flat, aggregated costs of the patch around the region.
        pitch: Numbers a row of the patch.
        first: Index in `values` where the image's pixel (0, 0) would lie; may be negative.
        best: `ChosenLabels.best`, changed.
        winner: `ChosenLabels.winner`, changed.
    """
    u, v, a, b = label
    for member in region:
        y = member // columns
        x = member % columns
        cost = values[first + y * pitch + x]
        if cost < best[y, x]:
            best[y, x] = cost
            winner[y, x, 0] = u
            winner[y, x, 1] = v
            winner[y, x, 2] = a
            winner[y, x, 3] = b


@inlined
def differs(
    label: Similarity,
    centre: tuple[Scalar, Scalar],
    region: Longs,
    columns: int,
    best: Floats,
    winner: Floats,
) -> bool:
    """Whether a label moves a pixel of the region by more than `SAME_PX` from where its label so far does.

    Args:
        label: The label that is tried.
        centre: Centre of the region, full-image pixels.
        region: int64, flat indices of the region's half-resolution pixels.
        columns: Half-resolution pixels a row.
        best: `ChosenLabels.best`, infinite where a pixel has no label yet.
        winner: `ChosenLabels.winner`.
    """
    u, v, a, b = label
    limit = np.float32(SAME_PX * SAME_PX)
    for member in region:
        y = member // columns
        x = member % columns
        # it has none so far
        if best[y, x] == np.inf:
            return True
        # difference of the two displacements at the pixel
        dx = np.float32(2 * x) + np.float32(0.5) - centre[0]
        dy = np.float32(2 * y) + np.float32(0.5) - centre[1]
        da = a - winner[y, x, 2]
        db = b - winner[y, x, 3]
        ex = u - winner[y, x, 0] + da * dx - db * dy
        ey = v - winner[y, x, 1] + db * dx + da * dy
        if ex * ex + ey * ey > limit:
            return True
    return False


@inlined
def patch_around(members: Longs, rows: int, columns: int, margin: int) -> tuple[int, int, int, int]:
    """Top, left, height and width of the box around pixels, with a margin, clipped at the image's edge.

    Args:
        members: int64, flat indices of the pixels.
        rows: Rows of the image.
        columns: Columns of the image.
        margin: Pixels around the box.
    """
    # the box around the pixels
    top = rows
    bottom = -1
    left = columns
    right = -1
    for member in members:
        y = member // columns
        x = member % columns
        top = min(top, y)
        bottom = max(bottom, y)
        left = min(left, x)
        right = max(right, x)

    # with the margin, within the image
    top = max(top - margin, 0)
    left = max(left - margin, 0)
    bottom = min(bottom + margin, rows - 1)
    right = min(right + margin, columns - 1)
    return top, left, bottom - top + 1, right - left + 1


@inlined
def raw_costs(
    label: Similarity,
    index: tuple[Scalar, Scalar],
    centre: tuple[Scalar, Scalar],
    patch: tuple[int, int, int, int],
    radius: int,
    matching: PixelMatching,
    columns: int,
    rotated: RotatedDescriptors,
    raw: Floats,
) -> None:
    """Fill `raw` with Eq. 1 of a label around a centre, for every half-resolution pixel of a patch.

    Args:
        label: Displacement at the centre, and scale times cosine and sine of the rotation.
        index: Quantised scale and rotation of the label, from 0.
        centre: Full-image pixels.
        patch: Its left and top, width and height, half-resolution pixels.
        radius: Width of the frame around it in `raw`.
        matching: Images, tables and unrotated descriptors.
        columns: Half-resolution pixels a row of the image.
        rotated: The patch's descriptors; those of a rotation that is not filled yet are written.
        raw: float32, flat ``[(height + 2 radius) * (width + 2 radius)]``, filled inside the frame.
    """
    (u, v, a, b) = label
    (left, top, wide, high) = patch
    (si, ti) = index
    target = matching.target
    tables = matching.tables
    unrotated = matching.descriptors
    height, width = target.gray.shape
    no_rotation = ti == -layout.ANGLE_LOW
    described = unrotated.view(np.uint8) if no_rotation else rotated.data
    for y in range(high):
        for x in range(wide):
            # full-image position of the half-resolution pixel
            px = np.float32(2 * (left + x)) + np.float32(0.5)
            py = np.float32(2 * (top + y)) + np.float32(0.5)

            # where its descriptor lies
            pixel = (top + y) * columns + left + x
            at = pixel * DESCRIPTOR_BYTES
            if not no_rotation:
                at = (ti * rotated.size + y * wide + x) * DESCRIPTOR_BYTES
                if not rotated.filled[ti]:
                    rotate_descriptor(
                        unrotated, pixel * layout.HISTOGRAMS, ti, rotated.scratch, rotated.data, at
                    )

            # where the label moves it in the target
            dx = px - centre[0]
            dy = py - centre[1]
            tx = centre[0] + u + a * dx - b * dy
            ty = centre[1] + v + b * dx + a * dy

            # outside the target the cost is the largest possible
            cost = np.int64(tables.ceiling)
            if tx >= 0 and ty >= 0 and tx <= width - 1 and ty <= height - 1:
                cost = np.int64(descriptor_distance(tx, ty, si, ti, described, at, target, tables))
                # grey level and gradient, the other two terms of Eq. 1
                if tables.appearance:
                    gray, gradient = appearance(target, tx, ty)
                    own_gray, own_gradient = appearance(matching.reference, px, py)
                    cost += tables.intensity[abs(gray - own_gray)]
                    cost += tables.gradient[abs(gradient - own_gradient)]
            raw[(y + radius) * (wide + 2 * radius) + x + radius] = np.float32(cost)


@kernel
def spread_labels(
    start: int, stop: int, winner: Floats, regions: Ints, centres: Floats, flow: Floats
) -> None:
    """Displacement of full-image rows start..stop from the half-resolution labels around the regions' centres.

    Args:
        start: First row of the full image.
        stop: One past the last row.
        winner: float32 ``[h, w, 4]``, `ChosenLabels.winner`.
        regions: int32 ``[h, w]``, `Superpixels.labels`.
        centres: float32 ``[K, 2]`` of the regions, full-image pixels.
        flow: float32 ``[H, W, 2]``, filled.
    """
    for y in range(start, stop):
        # the label of the half-resolution pixel
        row = min(y // 2, winner.shape[0] - 1)
        for x in range(flow.shape[1]):
            column = min(x // 2, winner.shape[1] - 1)
            u, v, a, b = winner[row, column]
            r = regions[row, column]
            # displacement of (dx, dy) from the centre under the similarity
            dx = np.float32(x) - centres[r, 0]
            dy = np.float32(y) - centres[r, 1]
            flow[y, x, 0] = u + a * dx - b * dy - dx
            flow[y, x, 1] = v + b * dx + a * dy - dy
