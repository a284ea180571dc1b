"""Dense DAISY Filter Flow: superpixel labels, guided-filter aggregation, winner takes all, and the way back.

1. Superpixels; one label search per superpixel at its centre, with propagation between adjacent ones (as in `sparse`).
2. Labels are refined photometrically: they are similarities, so that a label is sub-pixel exact over its region.
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

from ._jit import kernel
from .checks import says_nothing
from .fill import fill_and_smooth, fit_regional_motion
from .guided_filter import filter_patch
from .maps import OrientationMaps
from .matching import (
    appearance,
    describe_once,
    descriptor_distance,
    quantised,
    side,
    tables_for,
)
from .refinement import BORDER
from .searches.propagation import label_turns, transported_labels
from .settings import FlowSettings
from .sparse import SparseDaisyFlow
from .superpixels import superpixels
from .workers import run_stripes


@dataclass(frozen=True, eq=False)
class DenseFlow:
    """Flow of every pixel.

    Attributes:
        flow: float32 ``[H, W, 2]``, displacement (x, y) in pixels.
        valid: bool ``[H, W]``, consistent with the flow of the other direction (all True where that is not checked).
        cost: float32 ``[H, W]``, aggregated matching cost as a share of the largest possible.
        stats: Diagnostics.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    cost: NDArray[np.float32]
    stats: dict[str, float]


class DenseDaisyFlow:
    """Dense DAISY Filter Flow on the processor.

    Args:
        settings: How; `FlowSettings.dense_*` are its own.
        threads: Over which regions are divided; the result does not depend on it.
    """

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self.settings = settings or FlowSettings()
        searching = self.settings.model_copy(
            update={
                "support": 9,
                "support_spacing_px": max(1, self.settings.dense_superpixel_px // 2),
                "range_px": self.settings.dense_range_px,
                "budget": self.settings.dense_budget,
                "sweeps": self.settings.dense_sweeps,
            }
        )
        self._sparse = SparseDaisyFlow(searching, threads=threads)

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._sparse.prepare(gray)

    def flow(self, reference: OrientationMaps, target: OrientationMaps, *, seed: int = 0) -> DenseFlow:
        """Flow from the reference to the target; see `DenseFlow`.

        Identical images and images without texture give zero flow that is not valid, as in the sparse mode; the stat
        ``degenerate`` is 1 then.
        """
        height, width = reference.gray.shape
        if says_nothing(reference.gray, target.gray):
            shape = (height, width)
            return DenseFlow(
                np.zeros((*shape, 2), np.float32), np.zeros(shape, np.bool_), np.zeros(shape, np.float32),
                {"evaluations": 0.0, "valid": 0.0, "degenerate": 1.0},
            )  # fmt: skip
        forward = self._one_way(reference, target, seed)
        valid = np.ones((height, width), dtype=np.bool_)
        rounds = [forward]
        if self.settings.dense_forward_backward_px > 0:
            backward = self._one_way(target, reference, seed + 1)
            rounds = [forward, backward]
            tolerance = self.settings.dense_forward_backward_px
            flows = forward.flow(), backward.flow()
            if self.settings.dense_second_round:
                forward.again(consistent(*flows, tolerance))
                backward.again(consistent(*flows[::-1], tolerance))
                flows = forward.flow(), backward.flow()
            valid = consistent(*flows, tolerance)
            fitted = fit_regional_motion(flows[0], valid, forward.regions, forward.half)
            flow = flows[0] if fitted is None else fill_and_smooth(flows[0], valid, fitted)
        else:
            flow = forward.flow()
        evaluations = float(sum(r.evaluations for r in rounds))
        stats = {"evaluations": evaluations, "valid": float(valid.sum()), "degenerate": 0.0}
        return DenseFlow(flow, valid, forward.cost(), stats)

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
        self._reference, self._target = reference, target
        self.half = np.ascontiguousarray(reference.framed_half[BORDER:-BORDER, BORDER:-BORDER])
        self.regions = superpixels(self.half, max(2, settings.dense_superpixel_px // 2))
        self.centres = self.regions.centres * 2 + 0.5  # half-resolution pixel i covers 2 i and 2 i + 1
        self.evaluations = 0
        self._tables = tables_for(reference.gray.shape, settings.model_copy(update={"support": 1}))
        self._best = np.full(self.half.shape, np.inf, dtype=np.float32)
        self._winner = np.zeros((*self.half.shape, 4), dtype=np.float32)

    def found(self, seed: int) -> None:
        """Search a label for each region and let its pixels choose among it and the neighbours'."""
        sparse, reference, target = self._sparse, self._reference, self._target
        tables = tables_for(reference.gray.shape, sparse.settings)
        neighbours = sparse.neighbours(self.centres)
        described = sparse.describe(reference, self.centres, tables)
        state = sparse.search(described, reference, target, tables, neighbours, None, seed)
        self.evaluations += int(state.used.sum())
        labels = np.ascontiguousarray(state.flames[:, 0])
        correlation = sparse.refine(self.centres, labels, reference, target)
        if neighbours.shape[1] > 1:
            sparse.second_opinion(self.centres, labels, correlation, neighbours, reference, target)
        self._choose(self._candidates(labels, neighbours))

    def again(self, valid: NDArray[np.bool_]) -> None:
        """Try, on every region, the motion that consistent regions around it suggest, as it is and refined."""
        fitted = fit_regional_motion(self.flow(), valid, self.regions, self.half)
        if fitted is None:
            return
        suggested = fitted.labels()
        refined = suggested.copy()
        self._sparse.refine(self.centres, refined, self._reference, self._target)
        self._choose(np.stack([suggested, refined], axis=1))

    def _choose(self, candidates: NDArray[np.float32]) -> None:
        evaluations = np.zeros(len(self.centres), dtype=np.int64)
        run_stripes(
            aggregate_and_choose, len(self.centres), self._sparse.threads, self._sparse.pool, self.regions.members,
            self.regions.starts, self.centres, candidates, side(self._reference), side(self._target), self._tables,
            self.half.astype(np.float32) / np.float32(255), max(1, self.settings.dense_filter_radius_px // 2),
            np.float32(self.settings.dense_filter_epsilon), self._best, self._winner, evaluations,
        )  # fmt: skip
        self.evaluations += int(evaluations.sum())

    def flow(self) -> NDArray[np.float32]:
        """Displacement of every full-image pixel under the labels chosen so far."""
        height, width = self._reference.gray.shape
        flow = np.empty((height, width, 2), dtype=np.float32)
        run_stripes(
            spread_labels, height, self._sparse.threads, self._sparse.pool, self._winner, self.regions.labels,
            self.centres, flow,
        )  # fmt: skip
        return flow

    def cost(self) -> NDArray[np.float32]:
        """Aggregated cost of every full-image pixel, as a share of the largest possible."""
        height, width = self._reference.gray.shape
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


@kernel
def aggregate_and_choose(  # type: ignore[no-untyped-def]
    start, stop, members, starts, centres, candidates, reference, target, tables, guide, radius, epsilon, best, winner,
    evaluations,
):  # fmt: skip
    """Raw cost, guided filter and winner takes all (Eq. 1-3) for regions start..stop, at half resolution.

    Args:
        start: First region.
        stop: One past the last.
        members: `Superpixels.members`.
        starts: `Superpixels.starts`.
        centres: float32 ``[K, 2]``, full-image pixels.
        candidates: float32 ``[K, C, 4]``, labels around the centres; NaN means none.
        reference: `matching.Side`.
        target: `matching.Side`.
        tables: `matching.CostTables` without support.
        guide: float32 ``[h, w]``, half-resolution grey levels in [0, 1].
        radius: Of the guided filter, half-resolution pixels.
        epsilon: Of the guided filter.
        best: float32 ``[h, w]``, lowest aggregated cost, changed in place.
        winner: float32 ``[h, w, 4]``, its label around the region's centre.
        evaluations: int64 ``[K]``, raw costs computed.
    """
    rows, columns = guide.shape
    height, width = target.gray.shape
    descriptors = np.empty(0, dtype=np.uint8)
    size = 0
    described = np.zeros(13, dtype=np.bool_)
    raw = np.empty(0, dtype=np.float32)
    patch_guide, filtered, work = np.empty(0, dtype=np.float32), np.empty(0, np.float32), np.empty((6, 0), np.float32)
    for r in range(start, stop):
        if starts[r] == starts[r + 1]:
            continue
        top, bottom, left, right = rows, -1, columns, -1
        for k in range(starts[r], starts[r + 1]):
            y, x = members[k] // columns, members[k] % columns
            top, bottom, left, right = min(top, y), max(bottom, y), min(left, x), max(right, x)
        top, left = max(top - 2 * radius, 0), max(left - 2 * radius, 0)
        bottom, right = min(bottom + 2 * radius, rows - 1), min(right + 2 * radius, columns - 1)
        high, wide = bottom - top + 1, right - left + 1
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
                    dx, dy = px - centres[r, 0], py - centres[r, 1]
                    tx, ty = centres[r, 0] + u + a * dx - b * dy, centres[r, 1] + v + b * dx + a * dy
                    cost = np.int64(tables.ceiling)
                    if tx >= 0 and ty >= 0 and tx <= width - 1 and ty <= height - 1:
                        cost = np.int64(descriptor_distance(tx, ty, si, ti, mine, descriptors, target, tables))
                        if tables.appearance:
                            gray, gradient = appearance(target.gray, tx, ty)
                            own_gray, own_gradient = appearance(reference.gray, px, py)
                            cost += tables.intensity[abs(gray - own_gray)]
                            cost += tables.gradient[min(abs(gradient - own_gradient), 255)]
                    raw[k] = np.float32(cost)
            described[ti] = True
            evaluations[r] += n
            filter_patch(patch_guide[:n], raw[:n], high, wide, radius, epsilon, work, filtered[:n])
            for k in range(starts[r], starts[r + 1]):
                y, x = members[k] // columns, members[k] % columns
                cost = filtered[(y - top) * wide + x - left]
                if cost < best[y, x]:
                    best[y, x] = cost
                    winner[y, x, 0], winner[y, x, 1], winner[y, x, 2], winner[y, x, 3] = u, v, s, theta


@kernel
def spread_labels(start, stop, winner, regions, centres, flow):  # type: ignore[no-untyped-def]
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
