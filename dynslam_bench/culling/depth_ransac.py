"""B6: YOLO-SLAM's depth RANSAC: the person is the largest set of features of similar depth in a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.core.seeding import stream
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import DepthRansacSettings

MIN_POINTS = 3


def person_set(z: NDArray[np.floating], settings: DepthRansacSettings, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The largest set of features whose depth variance stays below the limit.

    From each drawn pair, the set grows by the nearest depths while its variance stays below the limit. The paper
    does not state the order; nearest first gives the largest set from that pair.

    Args:
        z: Depths ``[N]`` of the features in one box, metres, all valid.
        settings: Variance limit and number of draws.
        rng: Source of the draws.

    Returns:
        Bool ``[N]``.
    """
    count = len(z)
    best = np.zeros(count, dtype=bool)
    if count < MIN_POINTS:
        return best
    draws = settings.max_draws
    drawn = 0
    while drawn < draws:
        drawn += 1
        pair = rng.choice(count, 2, replace=False)
        order = np.argsort(np.abs(z - z[pair].mean()), kind="stable")
        order = np.concatenate([pair, order[~np.isin(order, pair)]])
        chosen = z[order].astype(np.float64)
        n = np.arange(1, count + 1)
        variance = np.cumsum(chosen**2) / n - np.square(np.cumsum(chosen) / n)
        size = int(np.argmax(variance >= settings.variance_m2)) if (variance >= settings.variance_m2).any() else count
        if size > np.count_nonzero(best):
            best = np.zeros(count, dtype=bool)
            best[order[:size]] = True
            share = size / count
            needed = np.log(1 - settings.confidence) / np.log(max(1 - share**2, 1e-12)) if share < 1 else 0
            draws = min(draws, max(drawn, int(np.ceil(needed))))
    return best


class DepthRansacFilter(ObjectRule[DepthRansacSettings]):
    """Drops, in each dynamic box, the largest set of features of similar depth; keeps the rest of the box.

    Stats: ``dropped``, ``objects``, ``in_boxes``.
    """

    name = "depth_ransac"
    needs: frozenset[Need] = frozenset({"boxes", "depth"})
    provenance: Provenance = "faithful-paper"
    stats_names = ("dropped", "objects", "in_boxes")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Find the person among the features of every box; features without depth are dropped too."""
        keep = np.ones(len(frame), dtype=bool)
        boxes = dynamic_boxes(frame, self.segmentation)
        member = in_boxes(frame.keypoints.xy, boxes)
        for number, in_box in enumerate(member):
            measured = np.flatnonzero(in_box & (frame.z > 0))
            person = person_set(frame.z[measured], self.settings, stream(state.seed, self.name, number))
            keep[measured[person]] = False
            keep[in_box & ~(frame.z > 0)] = False
        boxed = np.count_nonzero(member.any(axis=0))
        return FilterResult.of(keep, {"objects": float(len(boxes)), "in_boxes": float(boxed)})
