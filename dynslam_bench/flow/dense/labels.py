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

from ..daisy.cost import side, tables_for
from ..daisy.maps import OrientationMaps
from ..daisy.refinement import BORDER
from ..daisy.sparse import Pair, SparseDaisyFlow
from ..degenerate import says_nothing
from ..searches.propagation import label_turns, transported_labels
from ..settings import FlowSettings
from .aggregation import aggregate_and_choose, spread_labels
from .fill import fill_and_smooth, fit_regional_motion
from .superpixels import superpixels


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
        if says_nothing(reference.gray, target.gray):
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
