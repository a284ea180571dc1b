"""DAISY Filter Flow at sparse points, as SLAM needs it: no labels are computed for other pixels.

For each point: a label search over the matching cost (Eq. 1) with propagation between neighbouring
points, then sub-pixel refinement, then a forward-backward check.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow import layout
from dynslam_bench.flow.degenerate import (
    STATS_NAMES,
    clean_points,
    flow_stats,
    invalid_result,
    usable_points,
)
from dynslam_bench.flow.label_search import (
    STRATEGIES,
    common_motions,
    dissenting_labels,
    labels_as_seen,
    nearest,
    parabola,
    search_labels,
)
from dynslam_bench.flow.matching_cost import (
    MAX_COST,
    CostTables,
    MatchingCost,
    Reference,
    cost_tables,
    describe,
)
from dynslam_bench.flow.orientation_maps import (
    Buffers,
    ImageArrays,
    OrientationMaps,
    orientation_maps,
)
from dynslam_bench.flow.refinement import Window, similarity_lucas_kanade
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.flow.workers import Workers

PARABOLA_STEP_PX = np.float32(2.0)
"""Distance of the costs through which the parabola of the first sub-pixel step is laid."""
COARSE = Window(step=2, radius=7, margin=3, warps=2)
"""The refinement at half resolution."""
BACKWARD_MARGIN = 3
"""Largest translation within one warp of the forward-backward check, pixels."""
CONSENSUS_PX = 3.0
"""Displacements this close agree, pixels."""
CONSENSUS_MARGIN = 0.02
"""A label that neighbours agree on is taken if its correlation is lower by less than this."""
COSTS_PER_CORRELATION = 1000
"""Correlations become whole-number costs in this many steps, to rank points for the common motions."""


class ImagePair(NamedTuple):
    """Two prepared images, and the tables of their matching cost."""

    reference: OrientationMaps
    target: OrientationMaps
    tables: CostTables


def image_arrays(image: OrientationMaps, tables: CostTables) -> ImageArrays:
    """The image's arrays for the kernels, with gradients where the terms of Eq. 1 need them."""
    return image.arrays_with_gradients if tables.appearance else image.arrays


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
        self._buffers: Buffers = []

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled by its settings: threads cannot be, and nothing is stored between frames."""
        return partial(SparseDaisyFlow, threads=self.workers.threads), (self.settings,)

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
        xy, usable = cleaned
        if not usable.any():
            return invalid_result(xy, degenerate=False)
        settings = self.settings
        points = xy[usable]
        if guess is not None:
            guess = np.asarray(guess, dtype=np.float32).reshape(-1, 2)[usable]

        # search a label for each point, with propagation between neighbours
        pair = self.pair(reference, target)
        matching = self.matching(pair, points)
        neighbours = nearest(points, self.workers.run)
        state = search_labels(settings, self.workers.run, matching, neighbours, guess, seed)
        labels = state.flames[:, 0].copy()
        cost = state.costs[:, 0]
        evaluations = state.used
        ceiling = pair.tables.ceiling

        # refine it to sub-pixels: a parabola through the costs, then Lucas-Kanade
        if settings.refinement == "lucas-kanade":
            self.workers.run(
                parabola, 0, len(points), labels, PARABOLA_STEP_PX, matching, evaluations
            )
        good = (cost < MAX_COST * ceiling) & (evaluations > 0)
        if settings.refinement == "lucas-kanade":
            correlation = self.refine_together(points, labels, neighbours, pair)
            good &= correlation > settings.min_correlation

        # check it: back to the reference, and inside the image
        ends = points + labels[:, :2]
        if settings.forward_backward_px > 0:
            rows = np.flatnonzero(good)
            error = self.forward_backward_error(points[rows], labels[rows], pair)
            good[rows] = error <= settings.forward_backward_px
        good &= usable_points(ends, target.gray.shape)

        # the result of all points, those that could not be used included
        valid = np.zeros(len(xy), np.bool_)
        share = np.ones(len(xy), np.float32)
        xy[usable] = ends
        valid[usable] = good
        share[usable] = cost / ceiling
        stats = flow_stats(len(xy), int(good.sum()), int(evaluations.sum()))
        return FlowResult(xy, valid, share, stats)

    def pair(self, reference: OrientationMaps, target: OrientationMaps) -> ImagePair:
        """Two images with the tables of the settings' terms and support of Eq. 1."""
        settings = self.settings
        shape = reference.gray.shape
        return ImagePair(
            reference,
            target,
            cost_tables(shape, settings.terms, settings.support, settings.support_spacing_px),
        )

    def matching(self, pair: ImagePair, points: NDArray[np.float32]) -> MatchingCost:
        """The matching cost of labels at points ``[N, 2]`` of the reference."""
        described = self.describe(pair.reference, points, pair.tables)
        return MatchingCost(described, image_arrays(pair.target, pair.tables), pair.tables)

    def forward_backward_error(
        self, points: NDArray[np.float32], labels: NDArray[np.float32], pair: ImagePair
    ) -> NDArray[np.float32]:
        """Distance in pixels ``[N]`` from each point to where its end in the target is refined back to.

        Args:
            points: ``[N, 2]``, full-image pixels of the reference.
            labels: ``[N, 4]``: dx, dy (pixels), log2 of the scale, rotation (radians).
            pair: The reference and the target.
        """
        count = len(points)
        # back from each end: target and reference swapped. The label's inverse is its negative, and the
        # kernel refines it in place
        ends = points + labels[:, :2]
        inverse = -labels
        window = Window(1, self.settings.refinement_window_px // 2, margin=BACKWARD_MARGIN, warps=1)
        unused_correlation = np.empty(count, np.float32)
        images = (pair.target.framed, pair.reference.framed)
        self.workers.run(
            similarity_lucas_kanade, 0, count, ends, inverse, *images, window, unused_correlation
        )
        error: NDArray[np.float32] = np.hypot(*(ends + inverse[:, :2] - points).T)
        return error

    def describe(
        self, image: OrientationMaps, points: NDArray[np.float32], tables: CostTables
    ) -> Reference:
        """Describe the reference points for the search: rotated descriptors and appearance."""
        count = len(points)
        supports = len(tables.support)
        descriptors = np.empty(count * supports * layout.ROTATIONS * layout.LENGTH, dtype=np.uint8)
        appearance = np.zeros((count, supports, 2), dtype=np.int32)
        arrays = image_arrays(image, tables)
        self.workers.run(describe, 0, count, points, arrays, tables, descriptors, appearance)
        return Reference(points, descriptors, appearance)

    def refine_together(
        self,
        points: NDArray[np.float32],
        labels: NDArray[np.float32],
        neighbours: NDArray[np.int64],
        pair: ImagePair,
    ) -> NDArray[np.float32]:
        """Refine labels in place; where neighbours agree on another one, try that. Returns the correlation ``[N]``.

        The label of agreeing neighbours, then the common motion, is taken where it contradicts a
        point's own label and its refined correlation is as high: repetitive textures match one
        period off.
        """
        correlation = self.refine(points, labels, pair)
        if not STRATEGIES[self.settings.search].propagates or len(points) < 3:
            return correlation

        # what neighbours agree on
        predictions = labels_as_seen(points, labels, neighbours)
        alternative, dissents = dissenting_labels(predictions, labels, np.float32(CONSENSUS_PX))
        self._take_better(points, labels, correlation, alternative, dissents, pair)

        if self.settings.similarity_seeds:
            # the motion that most points share; without one it is NaN, and no point dissents
            costs = np.rint(COSTS_PER_CORRELATION * (1 - correlation)).astype(np.int64)
            motions = common_motions(points, labels, costs, 1)
            no_neighbours = np.empty((len(points), 0), np.int64)
            alternative = labels_as_seen(points, labels, no_neighbours, motions)[:, 0]
            with np.errstate(invalid="ignore"):
                distance = np.hypot(*(alternative[:, :2] - labels[:, :2]).T)
                dissents = distance > CONSENSUS_PX
            self._take_better(points, labels, correlation, alternative, dissents, pair)
        return correlation

    def _take_better(
        self,
        points: NDArray[np.float32],
        labels: NDArray[np.float32],
        correlation: NDArray[np.float32],
        alternative: NDArray[np.float32],
        dissents: NDArray[np.bool_],
        pair: ImagePair,
    ) -> None:
        """Replace labels and correlations in place where the alternative, refined, correlates as well.

        Args:
            points: ``[N, 2]``.
            labels: ``[N, 4]``.
            correlation: ``[N]``, of the refined labels.
            alternative: ``[N, 4]``, other labels.
            dissents: bool ``[N]``, where the alternative is tried.
            pair: The images.
        """
        rows = np.flatnonzero(dissents)
        if not len(rows):
            return
        other = alternative[rows]
        other_correlation = self.refine(points[rows], other, pair)
        better = other_correlation > correlation[rows] - CONSENSUS_MARGIN
        labels[rows[better]] = other[better]
        correlation[rows[better]] = other_correlation[better]

    def refine(
        self, points: NDArray[np.float32], labels: NDArray[np.float32], pair: ImagePair
    ) -> NDArray[np.float32]:
        """Refine labels in place at half, then full resolution; returns the windows' correlation ``[N]``."""
        # half resolution, then full
        reference = pair.reference
        target = pair.target
        correlation = np.empty(len(points), dtype=np.float32)
        arguments = (similarity_lucas_kanade, 0, len(points), points, labels)
        self.workers.run(*arguments, reference.framed_half, target.framed_half, COARSE, correlation)
        window = Window(1, self.settings.refinement_window_px // 2, margin=2, warps=2)
        self.workers.run(*arguments, reference.framed, target.framed, window, correlation)
        return correlation
