"""DAISY Filter Flow at sparse points: what SLAM needs of it, without an image of labels.

Per point: a label search over the matching cost (Eq. 1) with propagation between neighbouring points, then sub-pixel
refinement, then the way back.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult

from ..degenerate import STATS_NAMES, empty_result, flow_stats, says_nothing, unseen_result, usable_points
from ..kernels.buffers import BufferPool
from ..kernels.workers import run_stripes
from ..searches.common import SearchState, new_state
from ..searches.propagation import common_motions, label_turns, transported_labels
from ..searches.schedule import PROPAGATING, Phase, Plan, make_plan, phase_runner
from ..settings import FlowSettings
from . import layout
from .consensus import dissenting_labels
from .cost import CostTables, Reference, describe, reference_appearance, side, tables_for
from .maps import OrientationMaps, orientation_maps
from .neighbours import nearest_neighbours
from .refinement import BORDER, coarse_to_fine, similarity_lucas_kanade
from .subpixel import parabola

MOTION_HYPOTHESES = 192
MOTION_TOLERANCE_PX = 5.0
NEIGHBOUR_WINDOW = 40
PARABOLA_STEP_PX = 2.0
COARSE = (7, 3, 2)
"""Radius, margin and warps of the refinement at half resolution."""
FINE_MARGIN, FINE_WARPS, BACK_MARGIN = 2, 2, 3
TOLERANCE_PX = 0.03
MOST_NEIGHBOURS, CONSENSUS_PX, CONSENSUS_MARGIN = 8, 3.0, 0.02


class SparseDaisyFlow:
    """Sparse flow on the processor; see `estimator.FlowEstimator`.

    Args:
        settings: How.
        threads: Over which rows and points are divided; the result does not depend on it.
    """

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self.settings = settings or FlowSettings()
        self.threads = max(1, threads)
        self.pool = ThreadPoolExecutor(self.threads - 1, "flow") if self.threads > 1 else None
        self._buffers = BufferPool()

    def configure(self, settings: FlowSettings) -> None:
        """Put other settings into force from the next call on."""
        self.settings = settings

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return orientation_maps(gray, threads=self.threads, pool=self.pool, buffers=self._buffers)

    def track(
        self,
        reference: OrientationMaps,
        target: OrientationMaps,
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`."""
        points = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 2)
        if not len(points):
            return empty_result()
        if says_nothing(reference.gray, target.gray):
            return unseen_result(points)
        usable = usable_points(points, reference.gray.shape)
        if not usable.all():
            inner = self.track(
                reference, target, points[usable], guess=None if guess is None else guess[usable], seed=seed
            )
            return _scatter(inner, points, usable)
        return self._track(reference, target, points, guess, seed)

    def _track(
        self, reference: OrientationMaps, target: OrientationMaps, points: NDArray[np.float32],
        guess: NDArray[np.float32] | None, seed: int,
    ) -> FlowResult:  # fmt: skip
        settings = self.settings
        tables = tables_for(reference.gray.shape, settings)
        described = self.describe(reference, points, tables)
        neighbours = self.neighbours(points)
        state = self.search(described, reference, target, tables, neighbours, guess, seed)
        labels, cost = state.flames[:, 0].copy(), state.costs[:, 0]
        evaluations = state.used.copy()
        n = len(points)
        if settings.refinement != "none":
            self.parabola(described, labels, target, tables, evaluations)
        valid = (cost < settings.max_cost * tables.ceiling) & (evaluations > 0)
        if settings.refinement == "lucas-kanade":
            correlation = self.refine(points, labels, reference, target)
            if settings.search in PROPAGATING and n > 2:
                self.second_opinion(points, labels, correlation, neighbours, reference, target)
            valid &= correlation > settings.min_correlation
        xy = points + labels[:, :2]
        height, width = target.gray.shape
        valid &= (xy >= 0).all(axis=1) & (xy <= (width - 1, height - 1)).all(axis=1)
        if settings.forward_backward_px > 0:
            going = np.flatnonzero(valid)
            back = self._way_back(points[going], xy[going], labels[going], reference, target)
            valid[going] = back <= settings.forward_backward_px
        stats = flow_stats(n, int(valid.sum()), int(evaluations.sum()))
        return FlowResult(xy, valid, np.asarray(cost / tables.ceiling, dtype=np.float32), stats)

    def describe(self, image: OrientationMaps, points: NDArray[np.float32], tables: CostTables) -> Reference:
        """What the search needs of the reference points: their rotated descriptors and appearance."""
        count, supports = len(points), len(tables.support)
        descriptors = np.empty(count * supports * layout.ROTATIONS * layout.LENGTH, dtype=np.uint8)
        run_stripes(describe, count, self.threads, self.pool, points, side(image), tables, descriptors)
        appearance = np.zeros((count, supports, 2), dtype=np.int32)
        if tables.appearance:
            reference_appearance(points, side(image), tables, appearance)
        return Reference(points, descriptors, appearance)

    def neighbours(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """Indices ``[N, K]`` of the points whose labels the search exchanges; none for searches without propagation."""
        return self.nearest(points) if self.settings.search in PROPAGATING else np.empty((len(points), 0), np.int64)

    def nearest(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """Indices ``[N, K]`` of each point's nearest others."""
        n = len(points)
        count = min(MOST_NEIGHBOURS, n - 1)
        found = np.empty((n, count), dtype=np.int64)
        if count:
            order = np.argsort(points[:, 0], kind="stable")
            run_stripes(nearest_neighbours, n, self.threads, self.pool, points[order], order, NEIGHBOUR_WINDOW, found)
        return found

    def _runner(
        self, plan: Plan, described: Reference, reference: OrientationMaps, target: OrientationMaps,
        tables: CostTables, state: SearchState, seed: int,
    ) -> Phase:  # fmt: skip
        """The function that spends one phase's evaluations on all points."""
        return phase_runner(plan, self.settings, described, side(target), tables, state, seed, self.threads, self.pool)

    def search(
        self, described: Reference, reference: OrientationMaps, target: OrientationMaps, tables: CostTables,
        neighbours: NDArray[np.int64], guess: NDArray[np.float32] | None, seed: int,
    ) -> SearchState:  # fmt: skip
        """The label search alone: phases of `FlowSettings.search` with propagation between them.

        Returns:
            The final state; ``flames[:, 0]`` and ``costs[:, 0]`` are the best labels and their costs.
        """
        settings, points = self.settings, described.points
        n = len(points)
        start = np.zeros((n, 1, 4), dtype=np.float32)  # zero flow, or the motion model's prediction
        if guess is not None:
            offset = np.asarray(guess, dtype=np.float32).reshape(-1, 2) - points
            start[:, 0, :2] = np.where(np.isfinite(offset).all(axis=1, keepdims=True), offset, 0)
        extent = np.array(
            [settings.range_px, settings.range_px, settings.scale_range_octaves,
             np.deg2rad(settings.rotation_range_deg)], dtype=np.float32,
        )  # fmt: skip
        lower, upper = start[:, 0] - extent, start[:, 0] + extent
        plan = make_plan(settings)
        state = new_state(n, plan.population, lower, upper, tables.ceiling)
        state.flames[:, :] = start
        run = self._runner(plan, described, reference, target, tables, state, seed)
        run(0, start if plan.shrink > 0 else _with_zero_flow(start))
        if settings.search in PROPAGATING:
            neighbours = np.ascontiguousarray(neighbours[:, : settings.neighbours])
            motions = np.full((2, 4), np.nan, dtype=np.float32)
            candidates = np.empty((n, neighbours.shape[1] + 2, 4), dtype=np.float32)
            for number in range(1, len(plan.ends)):
                best = state.flames[:, 0].copy()
                if settings.similarity_seeds:
                    common_motions(
                        points, best, state.costs[:, 0].copy(), MOTION_HYPOTHESES, np.float32(MOTION_TOLERANCE_PX),
                        np.uint64(seed + number), motions,
                    )  # fmt: skip
                turns = label_turns(best)
                run_stripes(
                    transported_labels, n, self.threads, self.pool, points, best, turns, neighbours, motions, lower,
                    upper, candidates,
                )  # fmt: skip
                run(number, candidates)
        return state

    def parabola(
        self, described: Reference, labels: NDArray[np.float32], target: OrientationMaps, tables: CostTables,
        evaluations: NDArray[np.int64],
    ) -> None:  # fmt: skip
        """Move labels in place to the lowest point of a parabola through the costs around them; counts evaluations."""
        run_stripes(
            parabola, len(labels), self.threads, self.pool, labels, np.float32(PARABOLA_STEP_PX), described,
            side(target), tables, evaluations,
        )  # fmt: skip

    def refine(
        self, points: NDArray[np.float32], labels: NDArray[np.float32], reference: OrientationMaps,
        target: OrientationMaps,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Refine labels in place at half, then full resolution; returns the windows' correlation ``[N]``."""
        correlation = np.empty(len(points), dtype=np.float32)
        fine = (self.settings.refinement_window_px // 2, FINE_MARGIN, FINE_WARPS)
        run_stripes(
            coarse_to_fine, len(points), self.threads, self.pool, points, labels, reference.framed_half,
            target.framed_half, reference.framed, target.framed, BORDER, COARSE, fine,
            self.settings.refinement_iterations, np.float32(TOLERANCE_PX), correlation,
        )  # fmt: skip
        return correlation

    def second_opinion(
        self, points: NDArray[np.float32], labels: NDArray[np.float32], correlation: NDArray[np.float32],
        neighbours: NDArray[np.int64], reference: OrientationMaps, target: OrientationMaps,
    ) -> None:  # fmt: skip
        """Try what agreeing neighbours, then what most points say, where it contradicts a point's own label.

        The other label is taken where, refined, it looks as good: repetitive textures look alike one period off.
        """
        n = len(points)
        extent = np.full((n, 4), 8.0, dtype=np.float32)
        predictions = np.empty((n, neighbours.shape[1], 4), dtype=np.float32)
        turns, no_motion = label_turns(labels), np.empty((0, 4), np.float32)
        transported_labels(0, n, points, labels, turns, neighbours, no_motion, -extent, extent, predictions)
        alternative = np.empty((n, 4), dtype=np.float32)
        dissents = np.empty(n, dtype=np.bool_)
        dissenting_labels(predictions, labels, np.float32(CONSENSUS_PX), alternative, dissents)
        self._reconsider(points, labels, correlation, alternative, dissents, reference, target)
        if not self.settings.similarity_seeds:
            return
        motions = np.empty((2, 4), dtype=np.float32)
        doubt = np.rint(1000 * (1 - correlation)).astype(np.int64)
        common_motions(points, labels, doubt, MOTION_HYPOTHESES, np.float32(MOTION_TOLERANCE_PX), np.uint64(1), motions)
        predictions = np.empty((n, 2, 4), dtype=np.float32)
        nobody = np.empty((n, 0), np.int64)
        transported_labels(0, n, points, labels, turns, nobody, motions, -extent, extent, predictions)
        alternative = np.ascontiguousarray(predictions[:, 0])
        with np.errstate(invalid="ignore"):
            dissents = np.hypot(*(alternative[:, :2] - labels[:, :2]).T) > CONSENSUS_PX
        self._reconsider(points, labels, correlation, alternative, dissents, reference, target)

    def _reconsider(
        self, points: NDArray[np.float32], labels: NDArray[np.float32], correlation: NDArray[np.float32],
        alternative: NDArray[np.float32], dissents: NDArray[np.bool_], reference: OrientationMaps,
        target: OrientationMaps,
    ) -> None:  # fmt: skip
        chosen = np.flatnonzero(dissents)
        if not len(chosen):
            return
        other = alternative[chosen]
        seen = self.refine(points[chosen], other, reference, target)
        better = seen > correlation[chosen] - CONSENSUS_MARGIN
        labels[chosen[better]], correlation[chosen[better]] = other[better], seen[better]

    def _way_back(
        self, points: NDArray[np.float32], xy: NDArray[np.float32], labels: NDArray[np.float32],
        reference: OrientationMaps, target: OrientationMaps,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Distance in pixels between each point and where the inverse label, refined the other way, takes it."""
        inverse = -labels
        correlation = np.empty(len(points), dtype=np.float32)
        run_stripes(
            similarity_lucas_kanade, len(points), self.threads, self.pool, np.ascontiguousarray(xy), inverse,
            target.framed, reference.framed, BORDER, 1, self.settings.refinement_window_px // 2, BACK_MARGIN, 1,
            self.settings.refinement_iterations, np.float32(TOLERANCE_PX), correlation,
        )  # fmt: skip
        distance: NDArray[np.float32] = np.hypot(*(xy + inverse[:, :2] - points).T)
        return distance


def _with_zero_flow(start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Start labels ``[N, 1, 4]`` and, where they are no zero flow, that too: ``[N, 2, 4]``, NaN means none."""
    zero = np.zeros_like(start)
    zero[~start.any(axis=2)] = np.nan
    return np.concatenate([start, zero], axis=1)


def _scatter(inner: FlowResult, points: NDArray[np.float32], usable: NDArray[np.bool_]) -> FlowResult:
    """Spread the result of the usable points over all."""
    xy, valid = points.copy(), np.zeros(len(points), dtype=np.bool_)
    cost = np.ones(len(points), dtype=np.float32)
    xy[usable], valid[usable], cost[usable] = inner.xy, inner.valid, inner.cost
    return FlowResult(xy, valid, cost, {**inner.stats, "points": float(len(points))})
