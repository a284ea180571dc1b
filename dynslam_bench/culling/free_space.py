"""A point in space that an earlier keyframe saw through lies on something that has moved there since."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import (
    DynamicFilter,
    FilterResult,
    FilterState,
    FrameBundle,
    KeyframeView,
    Need,
    Provenance,
)
from dynslam_bench.culling.ego_motion import coherent, depth_sigma
from dynslam_bench.culling.settings import FreeSpaceSettings
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

PATCH = np.ones((7, 7), np.uint8)
"""Neighbourhood whose smallest depth must lie behind the point: depth edges and pose errors prove nothing."""


class FreeSpaceFilter(DynamicFilter):
    """Drops points that violate the free space of several keyframes.

    Stats: ``dropped``, ``asked`` (keyframes), ``tested`` (points seen by at least one of them).
    """

    name = "free_space"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    provenance: Provenance = "assumed"
    stats_names = ("dropped", "asked", "tested")

    def __init__(self, settings: FreeSpaceSettings) -> None:
        self.settings = settings
        self._nearest: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def reset(self, camera: Camera) -> None:
        """Forget the keyframes of the previous sequence."""
        self._nearest.clear()

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Ask the latest keyframes whether they saw past each point."""
        keep = np.ones(len(frame), dtype=bool)
        oldest = self.settings.max_age_s
        fresh = [view for view in state.keyframes if frame.timestamp - view.timestamp <= oldest]
        keyframes = [view for view in fresh if view.depth is not None][: self.settings.keyframes]
        known = np.flatnonzero(frame.z > 0)
        if state.T_world_pred is None or not keyframes or not len(known):
            return FilterResult.of(keep, {"asked": 0.0, "tested": 0.0})
        points = se3.transform(state.T_world_pred, state.camera.unproject(frame.xy[known], frame.z[known]))
        votes = np.zeros(len(known), dtype=int)
        seen = np.zeros(len(known), dtype=bool)
        for view in keyframes:
            violated, observed = self._saw_past(view, points, state.camera)
            votes += violated
            seen |= observed
        self._forget({id(view.depth) for view in keyframes})
        violating, tested = np.zeros(len(frame), dtype=bool), np.zeros(len(frame), dtype=bool)
        violating[known] = votes >= min(self.settings.min_votes, len(keyframes))
        tested[known] = seen
        keep = ~coherent(violating, tested, frame.keypoints.xy, self.settings.min_share, frame.gray.shape)
        return FilterResult.of(keep, {"asked": float(len(keyframes)), "tested": float(np.count_nonzero(seen))})

    def _saw_past(
        self, view: KeyframeView, points: NDArray[np.float64], camera: Camera
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which world points the keyframe saw past, and which lie in its view at all."""
        local = se3.transform(se3.inverse(view.T_world_cam), points)
        ahead = local[:, 2] > 0.1
        pixels = np.full((len(points), 2), -1.0)
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        column, row = np.rint(pixels.clip(-1, 1e6)).astype(np.intp).T
        observed = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        nearest = self._nearest_depth(view)
        surface = nearest[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
        limit = np.maximum(self.settings.threshold_m, self.settings.threshold_sigma * depth_sigma(surface))
        return observed & (surface > 0) & (surface - local[:, 2] > limit), observed

    def _nearest_depth(self, view: KeyframeView) -> NDArray[np.float32]:
        """Smallest depth around each pixel of the keyframe, 0 where any depth of the patch is missing."""
        assert view.depth is not None
        if id(view.depth) not in self._nearest:  # the image is kept, so that its id stays its own
            self._nearest[id(view.depth)] = view.depth, np.asarray(cv2.erode(view.depth, PATCH), dtype=np.float32)
        return self._nearest[id(view.depth)][1]

    def _forget(self, asked: set[int]) -> None:
        for image in self._nearest.keys() - asked:
            del self._nearest[image]
