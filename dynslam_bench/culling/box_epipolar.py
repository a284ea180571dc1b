"""B3 with boxes: F from the points outside all boxes, different limits inside and outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.matches import Estimator, Matches, f_stats, tested_by_flow
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import BoxEpipolarSettings

MIN_OUTSIDE = 20
"""SG-SLAM takes all matches where fewer than this lie outside the boxes."""


class BoxEpipolarFilter(ObjectRule[BoxEpipolarSettings]):
    """Drops points off their epipolar line, with one limit inside dynamic boxes and another outside.

    Unlike `EpipolarFilter` it has no degeneracy guard: the published systems have none, and fail where F is degenerate.
    The setting ``unmatched`` decides about features whose flow failed. Stats: ``dropped``, ``matches``, ``boxes``,
    ``lost`` (features whose flow failed), ``failed`` (1 where F could not be estimated).
    """

    name = "box_epipolar"
    needs: frozenset[Need] = frozenset({"flow", "boxes", "previous"})
    provenance: Provenance = "faithful-paper"
    stats_names = ("dropped", "matches", "lost", "failed", "f_asked", "f_judged", "boxes")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the flow of this frame's keypoints to the previous image."""
        keep = np.ones(len(frame), dtype=bool)
        flow, matches = state.flow, Matches.by_flow(frame, state)
        boxes = dynamic_boxes(frame, self.segmentation)
        stats = {"matches": 0.0, "lost": 0.0, "failed": 0.0, "boxes": float(len(boxes))}
        if flow is None or matches is None:
            return FilterResult.of(keep, stats | f_stats(asked=False))
        lost = state.keep & ~flow.valid
        stats["lost"] = float(np.count_nonzero(lost))
        if self.settings.unmatched == "drop":
            keep &= ~lost
        tested = tested_by_flow(flow, state.keep, self.settings.unmatched)
        inside = np.asarray(in_boxes(frame.keypoints.xy, boxes).any(axis=0))
        fit = tested & ~self._excluded_from_fit(inside, state)
        if np.count_nonzero(fit) < MIN_OUTSIDE:
            fit = tested
        stats["matches"] = float(np.count_nonzero(fit))
        distance = matches.distances(fit, tested, Estimator(inlier_px=self.settings.inlier_px))
        if distance is None:
            return FilterResult.of(keep, stats | {"failed": 1.0} | f_stats(asked=True))
        outside_px = self.settings.outside_px if self.settings.test_outside else np.inf
        limit = np.where(inside, self.settings.inside_px, outside_px)
        keep[tested] = (distance <= limit)[tested]
        return FilterResult.of(keep, stats | f_stats(asked=True, judged=True))

    def _excluded_from_fit(self, inside: NDArray[np.bool_], state: FilterState) -> NDArray[np.bool_]:
        """Matches that F is not fitted to, bool ``[N]``."""
        if self.settings.fit == "kept":
            return np.zeros(len(inside), dtype=bool)
        if self.settings.fit == "outside" or state.previous is None or state.flow is None:
            return inside
        boxes = dynamic_boxes(state.previous, self.segmentation)
        return np.asarray(in_boxes(np.nan_to_num(state.flow.xy, nan=-1e6), boxes).any(axis=0))
