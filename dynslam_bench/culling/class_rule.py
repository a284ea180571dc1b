"""B15: three rules in one: class, depth, epipolar line (SEG-SLAM)."""

from __future__ import annotations

import numpy as np

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.matches import Estimator, Flags, Matches, f_stats, tested_by_flow
from dynslam_bench.culling.settings import ClassRuleSettings
from dynslam_bench.geometry.camera import inside
from dynslam_bench.segmentation.postprocess import dynamic_mask, select


class ClassRuleFilter(ObjectRule[ClassRuleSettings]):
    """Drops all points on people, and those points on movable objects that fail the epipolar or the depth rule.

    The setting ``unmatched`` decides about a feature on a movable object whose flow failed.
    Stats: ``dropped``, ``on_people``, ``on_movable``, ``moving_objects``, ``lost`` (features whose flow failed).
    """

    name = "class_rule"
    needs: frozenset[Need] = frozenset({"masks", "flow", "previous", "depth"})
    provenance: Provenance = "inspired"
    stats_names = ("dropped", "on_people", "on_movable", "moving_objects", "lost", "f_asked", "f_judged")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Drop by class first, then test movable objects by geometry."""
        keep = np.ones(len(frame), dtype=bool)
        stats = dict.fromkeys(("on_people", "on_movable", "moving_objects", "lost"), 0.0)
        matches = Matches.by_flow(frame, state)
        if frame.instances is None or not len(frame.instances):
            return FilterResult.of(keep, stats | f_stats(asked=matches is not None))
        people = dynamic_mask(frame.instances, self.segmentation, frame.depth)
        keep &= ~inside(people, frame.keypoints.xy)
        stats["on_people"] = float(np.count_nonzero(~keep))
        movable = select(frame.instances, self.segmentation.model_copy(update={"classes": self.settings.movable}))
        lost = np.zeros(len(frame), dtype=bool)
        if matches is not None and state.flow is not None:
            lost = state.keep & ~state.flow.valid
        stats["lost"] = float(np.count_nonzero(lost))
        static = keep & ~inside(movable.union(), frame.keypoints.xy)
        off_line, tested = self._off_line(matches, state, static)
        stats |= f_stats(asked=matches is not None, judged=bool(tested.any()))
        for mask in movable.masks:
            on_object = inside(mask, frame.keypoints.xy) & keep
            stats["on_movable"] += float(np.count_nonzero(on_object))
            voters = on_object & tested
            drop = on_object & (off_line | lost) if self.settings.unmatched == "drop" else on_object & off_line
            if voters.any() and off_line[voters].mean() >= self.settings.vote_share:
                stats["moving_objects"] += 1.0
                depth = frame.depth[mask]
                depth = depth[np.isfinite(depth) & (depth > 0)]
                if len(depth):
                    drop |= on_object & (np.abs(frame.z - np.median(depth)) < self.settings.depth_m)
            keep &= ~drop
        return FilterResult.of(keep, stats, people)

    def _off_line(self, matches: Matches | None, state: FilterState, static: Flags) -> tuple[Flags, Flags]:
        """Which points fail the epipolar test with F of the static-labelled ones, and which were tested at all."""
        none = np.zeros(len(static), dtype=bool)
        if matches is None or state.flow is None:
            return none, none
        tested = tested_by_flow(state.flow, state.keep, self.settings.unmatched)
        distance = matches.distances(tested & static, tested, Estimator())
        return (none, none) if distance is None else (distance > self.settings.threshold_px, tested)
