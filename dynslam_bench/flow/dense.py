"""Dense DAISY Filter Flow: superpixel labels, guided-filter aggregation, winner takes all, and the way back.

1. Superpixels; one label search per superpixel at its centre, with propagation between adjacent ones (as in `sparse`).
2. Labels are refined photometrically: they are similarities, so that a label is sub-pixel exact over its region.
3. For each superpixel, its own label and its neighbours' are tried on every pixel of its bounding box extended by twice
   the filter's radius; the raw costs (Eq. 1) are aggregated by the guided filter (Eq. 2), each pixel keeps the winner
   (Eq. 3). This works at half resolution: the orientation maps are no finer.
4. A pixel is valid if the flow of the other direction leads back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .checks import same_image
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
from .searches.propagation import transported_labels
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
        searching = self.settings.model_copy(update={"support": 9})
        self._sparse = SparseDaisyFlow(searching, threads=threads)
        self.threads, self._pool = self._sparse.threads, self._sparse.pool

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._sparse.prepare(gray)

    def flow(self, reference: OrientationMaps, target: OrientationMaps, *, seed: int = 0) -> DenseFlow:
        """Flow from the reference to the target; see `DenseFlow`.

        Identical images give zero flow that is not valid, as in the sparse mode.
        """
        height, width = reference.gray.shape
        if same_image(reference.gray, target.gray):
            shape = (height, width)
            return DenseFlow(
                np.zeros((*shape, 2), np.float32), np.zeros(shape, np.bool_), np.zeros(shape, np.float32),
                {"identical": 1.0, "evaluations": 0.0, "valid": 0.0},
            )  # fmt: skip
        flow, cost, evaluations = self._one_way(reference, target, seed)
        valid = np.ones((height, width), dtype=np.bool_)
        if self.settings.forward_backward_px > 0:
            back, _, more = self._one_way(target, reference, seed + 1)
            evaluations += more
            valid = consistent(flow, back, self.settings.dense_forward_backward_px)
        stats = {"evaluations": float(evaluations), "valid": float(valid.sum())}
        return DenseFlow(flow, valid, cost, stats)

    def _one_way(
        self, reference: OrientationMaps, target: OrientationMaps, seed: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
        settings, sparse = self.settings, self._sparse
        height, width = reference.gray.shape
        inner = slice(BORDER, -BORDER)
        half = np.ascontiguousarray(reference.framed_half[inner, inner])
        regions = superpixels(half, max(2, settings.dense_superpixel_px // 2))
        centres = regions.centres * 2 + 0.5  # half-resolution pixel i covers 2 i and 2 i + 1
        tables = tables_for(height, width, sparse.settings)
        neighbours = sparse.neighbours(centres)
        state = sparse.search(sparse.describe(reference, centres, tables), target, tables, neighbours, None, seed)
        labels = np.ascontiguousarray(state.flames[:, 0])
        correlation = sparse.refine(centres, labels, reference, target)
        if neighbours.shape[1] > 1:
            sparse.second_opinion(centres, labels, correlation, neighbours, reference, target)
        candidates = self._candidates(centres, labels, neighbours)
        pixel_tables = tables_for(height, width, settings.model_copy(update={"support": 1}))
        best = np.full(half.shape, np.inf, dtype=np.float32)
        winner = np.zeros((*half.shape, 4), dtype=np.float32)
        guide = half.astype(np.float32) / np.float32(255)
        evaluations = np.zeros(len(centres), dtype=np.int64)
        run_stripes(
            aggregate_and_choose, len(centres), self.threads, self._pool, regions.members, regions.starts, centres,
            candidates, side(reference), side(target), pixel_tables, guide,
            max(1, settings.dense_filter_radius_px // 2), np.float32(settings.dense_filter_epsilon), best, winner,
            evaluations,
        )  # fmt: skip
        flow = np.empty((height, width, 2), dtype=np.float32)
        run_stripes(spread_labels, height, self.threads, self._pool, winner, regions.labels, centres, flow)
        share = np.repeat(np.repeat(best, 2, axis=0), 2, axis=1) / pixel_tables.ceiling
        cost = np.ones((height, width), dtype=np.float32)
        cost[: share.shape[0], : share.shape[1]] = share[:height, :width]
        return flow, cost, int(state.used.sum() + evaluations.sum())

    def _candidates(
        self, centres: NDArray[np.float32], labels: NDArray[np.float32], neighbours: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Each region's own label first, then its neighbours' as seen from its centre: float32 ``[K, C, 4]``."""
        n, most = len(centres), min(self.settings.dense_candidates - 1, neighbours.shape[1])
        seen = np.empty((n, most, 4), dtype=np.float32)
        extent = np.full((n, 4), 8.0, dtype=np.float32)
        transported_labels(
            0, n, centres, labels, neighbours[:, :most], np.empty((0, 4), np.float32), -extent, extent, seen
        )
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
