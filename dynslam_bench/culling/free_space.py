"""Free-space violation: a point where earlier keyframes measured free space lies on a moving object."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, KeyframeView, Need, Provenance
from dynslam_bench.culling import Rule
from dynslam_bench.culling.ego_motion import coherent, depth_sigma
from dynslam_bench.culling.settings import FreeSpaceSettings
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

KEYFRAMES = 8
"""Number of the latest keyframes that are compared."""
MAX_AGE_S = 10.0
"""Older keyframes are not compared: objects may have been moved for good since."""
PATCH = np.ones((7, 7), np.uint8)
"""Neighbourhood whose smallest depth must lie behind the point: depth edges and pose errors are no evidence."""


class FreeSpaceFilter(Rule[FreeSpaceSettings]):
    """Drops points that violate the free space of several keyframes.

    Stats: ``dropped``, ``asked`` (keyframes compared), ``tested`` (points in the view of at least one of them).
    """

    name = "free_space"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    provenance: Provenance = "assumed"
    stats_names = ("dropped", "asked", "tested")

    def __init__(self, settings: FreeSpaceSettings) -> None:
        super().__init__(settings)
        self._nearest: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def reset(self, camera: Camera) -> None:
        """Forget the keyframes of the previous sequence."""
        self._nearest.clear()

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Count for each point the keyframes that measured beyond it."""
        recent = [view for view in state.keyframes if frame.timestamp - view.timestamp <= MAX_AGE_S]
        keyframes = [view for view in recent if view.depth is not None][:KEYFRAMES]
        xy, rows = frame.keypoints.xy, np.flatnonzero(frame.z > 0)
        if state.T_world_pred is None or not keyframes or not len(rows):
            return self.verdict(np.ones(len(xy), dtype=bool))
        points = se3.transform(state.T_world_pred, state.camera.unproject(frame.xy[rows], frame.z[rows]))
        votes, tested = np.zeros(len(xy), dtype=int), np.zeros(len(xy), dtype=bool)
        for view in keyframes:
            violated, observed = self._violations(view, points, state.camera)
            votes[rows] += violated
            tested[rows] |= observed
        compared = {id(view.depth) for view in keyframes}
        self._nearest = {image: depths for image, depths in self._nearest.items() if image in compared}
        violating = votes >= min(self.settings.min_votes, len(keyframes))
        moving = coherent(violating, tested, xy, self.settings.min_share, frame.gray.shape)
        return self.verdict(~moving, asked=len(keyframes), tested=np.count_nonzero(tested))

    def _violations(
        self, view: KeyframeView, points: NDArray[np.float64], camera: Camera
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which world points lie in front of the surface that the keyframe measured, and which lie in its view."""
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
        if id(view.depth) not in self._nearest:  # the image is stored too, so that its id cannot be reused
            self._nearest[id(view.depth)] = view.depth, np.asarray(cv2.erode(view.depth, PATCH), dtype=np.float32)
        return self._nearest[id(view.depth)][1]
