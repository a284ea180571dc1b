"""DAISY Filter Flow at sparse points, as SLAM needs it: no labels are computed for other pixels.

For each point: a label search over the matching cost (Eq. 1) with propagation between neighbouring points, then
sub-pixel refinement, then a forward-backward check.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow import layout
from dynslam_bench.flow.degenerate import STATS_NAMES, clean_points, flow_stats, invalid_result
from dynslam_bench.flow.label_search import PROPAGATING, Phase, Plan, make_plan, phase_runner
from dynslam_bench.flow.matching_cost import (
    MAX_COST,
    CostTables,
    MatchingCosts,
    Reference,
    describe,
    parabola,
    reference_appearance,
    side,
    tables_for,
)
from dynslam_bench.flow.orientation_maps import OrientationMaps, orientation_maps
from dynslam_bench.flow.propagation import (
    common_motions,
    dissenting_labels,
    label_turns,
    nearest_neighbours,
    transported_labels,
)
from dynslam_bench.flow.refinement import Window, similarity_lucas_kanade
from dynslam_bench.flow.search_kernels import SearchState, new_state
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.workers import BufferPool, Workers

VOTE = (192, np.float32(5.0))
"""Pairs of points tried for a common motion, and the distance in pixels at which a point agrees with one."""
NEIGHBOUR_WINDOW = 40
"""Points compared on each side, in the order of x, to find the nearest neighbours."""
PARABOLA_STEP_PX = np.float32(2.0)
COARSE = (7, 3, 2)
"""Radius, margin and warps of the refinement at half resolution."""
FINE_MARGIN, FINE_WARPS, BACK_MARGIN = 2, 2, 3
ITERATIONS = 3
"""Most translation steps a warp of the refinement."""
TOLERANCE_PX = np.float32(0.03)
MOST_NEIGHBOURS, CONSENSUS_PX, CONSENSUS_MARGIN = 8, 3.0, 0.02


class Pair(NamedTuple):
    """Two prepared images, and the tables of their matching cost."""

    reference: OrientationMaps
    target: OrientationMaps
    tables: CostTables


class SparseDaisyFlow:
    """Sparse flow on the processor; see `contracts.flow.FlowEstimator`.

    Args:
        settings: Search, refinement and checks.
        threads: Over which rows and points are divided; the result does not depend on it.
    """

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self.settings = settings or FlowSettings()
        self.workers = Workers(threads)
        self._buffers = BufferPool()

    def __deepcopy__(self, memo: dict[int, Any]) -> SparseDaisyFlow:
        """A flow of the same settings with threads of its own: nothing is stored between frames."""
        return SparseDaisyFlow(self.settings, threads=self.workers.threads)

    def configure(self, settings: FlowSettings) -> None:
        """Use other settings from the next call on."""
        self.settings = settings

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return orientation_maps(gray, self.workers, self._buffers)

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
        cleaned = clean_points(reference.gray, target.gray, points)
        if isinstance(cleaned, FlowResult):
            return cleaned
        clean, usable = cleaned
        if not usable.any():
            return invalid_result(clean, degenerate=False)
        pair = Pair(reference, target, tables_for(reference.gray.shape, self.settings))
        if usable.all():
            return self._track(pair, clean, guess, seed)
        inner = self._track(pair, clean[usable], None if guess is None else guess[usable], seed)
        xy, valid, cost = clean, np.zeros(len(clean), np.bool_), np.ones(len(clean), np.float32)
        xy[usable], valid[usable], cost[usable] = inner.xy, inner.valid, inner.cost
        return FlowResult(xy, valid, cost, {**inner.stats, "points": float(len(clean))})

    def _track(
        self, pair: Pair, points: NDArray[np.float32], guess: NDArray[np.float32] | None, seed: int
    ) -> FlowResult:
        settings = self.settings
        described = self.describe(pair.reference, points, pair.tables)
        neighbours = self.nearest(points)
        state = self.search(described, pair, neighbours, guess, seed)
        labels, cost = state.flames[:, 0].copy(), state.costs[:, 0]
        evaluations = state.used.copy()
        if settings.refinement != "none":
            self.parabola(described, labels, pair, evaluations)
        valid = (cost < MAX_COST * pair.tables.ceiling) & (evaluations > 0)
        if settings.refinement == "lucas-kanade":
            correlation = self.refine(points, labels, pair)
            if settings.search in PROPAGATING and len(points) > 2:
                self.neighbour_consensus(points, labels, correlation, neighbours, pair)
            valid &= correlation > settings.min_correlation
        xy = points + labels[:, :2]
        height, width = pair.target.gray.shape
        valid &= (xy >= 0).all(axis=1) & (xy <= (width - 1, height - 1)).all(axis=1)
        if settings.forward_backward_px > 0:
            rows = np.flatnonzero(valid)
            error = self._forward_backward_error(points[rows], xy[rows], labels[rows], pair)
            valid[rows] = error <= settings.forward_backward_px
        stats = flow_stats(len(points), int(valid.sum()), int(evaluations.sum()))
        return FlowResult(xy, valid, np.asarray(cost / pair.tables.ceiling, dtype=np.float32), stats)

    def describe(self, image: OrientationMaps, points: NDArray[np.float32], tables: CostTables) -> Reference:
        """What the search needs of the reference points: their rotated descriptors and appearance."""
        count, supports = len(points), len(tables.support)
        descriptors = np.empty(count * supports * layout.ROTATIONS * layout.LENGTH, dtype=np.uint8)
        self.workers.run(describe, count, points, side(image), tables, descriptors)
        appearance = np.zeros((count, supports, 2), dtype=np.int32)
        if tables.appearance:
            reference_appearance(points, side(image), tables, appearance)
        return Reference(points, descriptors, appearance)

    def nearest(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """Indices ``[N, K]`` of each point's nearest others."""
        n = len(points)
        neighbours = np.empty((n, min(MOST_NEIGHBOURS, n - 1)), dtype=np.int64)
        if n > 1:
            order = np.argsort(points[:, 0], kind="stable")
            self.workers.run(nearest_neighbours, n, points[order], order, NEIGHBOUR_WINDOW, neighbours)
        return neighbours

    def _runner(self, plan: Plan, described: Reference, pair: Pair, state: SearchState, seed: int) -> Phase:
        """The function that spends one phase's evaluations on all points."""
        costs = MatchingCosts(described, side(pair.target), pair.tables)
        return phase_runner(plan, self.settings, costs, state, seed, self.workers)

    def search(
        self,
        described: Reference,
        pair: Pair,
        neighbours: NDArray[np.int64],
        guess: NDArray[np.float32] | None,
        seed: int,
    ) -> SearchState:
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
        rotation = np.deg2rad(settings.rotation_range_deg)
        extent = np.array([settings.range_px, settings.range_px, settings.scale_range_octaves, rotation], np.float32)
        lower, upper = start[:, 0] - extent, start[:, 0] + extent
        plan = make_plan(settings)
        state = new_state(n, plan.population, lower, upper, pair.tables.ceiling)
        state.flames[:, :] = start
        run = self._runner(plan, described, pair, state, seed)
        run(0, start if plan.shrink > 0 else _with_zero_flow(start))
        if settings.search in PROPAGATING:
            neighbours = np.ascontiguousarray(neighbours[:, : settings.neighbours])
            motions = np.full((2, 4), np.nan, dtype=np.float32)
            candidates = np.empty((n, neighbours.shape[1] + 2, 4), dtype=np.float32)
            for number in range(1, len(plan.ends)):
                best = state.flames[:, 0].copy()
                if settings.similarity_seeds:
                    common_motions(points, best, state.costs[:, 0].copy(), *VOTE, np.uint64(seed + number), motions)
                sources = (points, best, label_turns(best), neighbours, motions)
                self.workers.run(transported_labels, n, *sources, lower, upper, candidates)
                run(number, candidates)
        return state

    def parabola(
        self, described: Reference, labels: NDArray[np.float32], pair: Pair, evaluations: NDArray[np.int64]
    ) -> None:
        """Move labels in place to the lowest point of a parabola through the costs around them; counts evaluations."""
        costs = (described, side(pair.target), pair.tables)
        self.workers.run(parabola, len(labels), labels, PARABOLA_STEP_PX, *costs, evaluations)

    def refine(self, points: NDArray[np.float32], labels: NDArray[np.float32], pair: Pair) -> NDArray[np.float32]:
        """Refine labels in place at half, then full resolution; returns the windows' correlation ``[N]``."""
        reference, target = pair.reference, pair.target
        self._align(
            points, labels, reference.framed_half, target.framed_half, Window(2, *COARSE, ITERATIONS, TOLERANCE_PX)
        )
        window = self._window(FINE_MARGIN, FINE_WARPS)
        return self._align(points, labels, reference.framed, target.framed, window)

    def _window(self, margin: int, warps: int) -> Window:
        """The window at full resolution."""
        return Window(1, self.settings.refinement_window_px // 2, margin, warps, ITERATIONS, TOLERANCE_PX)

    def _align(
        self,
        points: NDArray[np.float32],
        labels: NDArray[np.float32],
        template: NDArray[np.uint8],
        target: NDArray[np.uint8],
        window: Window,
    ) -> NDArray[np.float32]:
        correlation = np.empty(len(points), dtype=np.float32)
        self.workers.run(similarity_lucas_kanade, len(points), points, labels, template, target, window, correlation)
        return correlation

    def neighbour_consensus(
        self,
        points: NDArray[np.float32],
        labels: NDArray[np.float32],
        correlation: NDArray[np.float32],
        neighbours: NDArray[np.int64],
        pair: Pair,
    ) -> None:
        """Try the label of agreeing neighbours, then the common motion, where it contradicts a point's own label.

        The other label is taken where its refined correlation is as high: repetitive textures match one period off.
        """
        n = len(points)
        extent = np.full((n, 4), 8.0, dtype=np.float32)
        turns, no_motion = label_turns(labels), np.empty((0, 4), np.float32)
        predictions = np.empty((n, neighbours.shape[1], 4), dtype=np.float32)
        transported_labels(0, n, points, labels, turns, neighbours, no_motion, -extent, extent, predictions)
        alternative, dissents = np.empty((n, 4), dtype=np.float32), np.empty(n, dtype=np.bool_)
        dissenting_labels(predictions, labels, np.float32(CONSENSUS_PX), alternative, dissents)
        self._take_better(points, labels, correlation, alternative, dissents, pair)
        if not self.settings.similarity_seeds:
            return
        motions = np.empty((2, 4), dtype=np.float32)
        doubt = np.rint(1000 * (1 - correlation)).astype(np.int64)
        common_motions(points, labels, doubt, *VOTE, np.uint64(1), motions)
        predictions = np.empty((n, 2, 4), dtype=np.float32)
        no_neighbours = np.empty((n, 0), np.int64)
        transported_labels(0, n, points, labels, turns, no_neighbours, motions, -extent, extent, predictions)
        alternative = np.ascontiguousarray(predictions[:, 0])
        with np.errstate(invalid="ignore"):
            dissents = np.hypot(*(alternative[:, :2] - labels[:, :2]).T) > CONSENSUS_PX
        self._take_better(points, labels, correlation, alternative, dissents, pair)

    def _take_better(
        self,
        points: NDArray[np.float32],
        labels: NDArray[np.float32],
        correlation: NDArray[np.float32],
        alternative: NDArray[np.float32],
        dissents: NDArray[np.bool_],
        pair: Pair,
    ) -> None:
        """Replace labels in place where the alternative, refined, correlates as well."""
        rows = np.flatnonzero(dissents)
        if not len(rows):
            return
        other = alternative[rows]
        other_correlation = self.refine(points[rows], other, pair)
        better = other_correlation > correlation[rows] - CONSENSUS_MARGIN
        labels[rows[better]], correlation[rows[better]] = other[better], other_correlation[better]

    def _forward_backward_error(
        self, points: NDArray[np.float32], xy: NDArray[np.float32], labels: NDArray[np.float32], pair: Pair
    ) -> NDArray[np.float32]:
        """Distance in pixels between each point and the end of its inverse label, refined in the other direction."""
        inverse, ends = -labels, np.ascontiguousarray(xy)
        self._align(ends, inverse, pair.target.framed, pair.reference.framed, self._window(BACK_MARGIN, 1))
        distance: NDArray[np.float32] = np.hypot(*(xy + inverse[:, :2] - points).T)
        return distance


def _with_zero_flow(start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Start labels ``[N, 1, 4]`` and, where they are no zero flow, that too: ``[N, 2, 4]``, NaN means none."""
    zero = np.zeros_like(start)
    zero[~start.any(axis=2)] = np.nan
    return np.concatenate([start, zero], axis=1)
