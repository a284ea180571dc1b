"""Free-space violation: a point where earlier keyframes measured free space lies on a moving object."""

from typing import Any

import cv2
import numpy as np

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import Rule
from dynslam_bench.culling.ego_motion import depth_sigma, failing_regions
from dynslam_bench.culling.settings import FreeSpaceSettings
from dynslam_bench.geometry import Camera, pixel_index, se3

KEYFRAMES = 8
"""Number of the latest keyframes that are compared."""
MAX_AGE_S = 10.0
"""Older keyframes are not compared: objects may have been moved for good since."""
PATCH = np.ones((7, 7), np.uint8)
"""Neighbourhood whose smallest depth must lie behind the point: depth edges and pose errors are no evidence."""


class FreeSpaceFilter(Rule[FreeSpaceSettings]):
    """Drops points that violate the free space of several keyframes.

    Stats: ``dropped``, ``asked`` (keyframes compared), ``tested`` (points in the view of at least
    one of them).
    """

    name = "free_space"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    stats_names = ("dropped", "asked", "tested")

    def reset(self, camera: Camera | None = None) -> None:
        """Forget the keyframes of the previous sequence."""
        self._smallest: dict[int, tuple[Any, Any]] = {}

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Count for each point the keyframes that measured beyond it."""
        camera = state.camera
        recent = [v for v in state.keyframes if frame.timestamp - v.timestamp <= MAX_AGE_S]
        keyframes = [(v.T_world_cam, v.depth) for v in recent if v.depth is not None][:KEYFRAMES]
        xy = frame.keypoints.xy
        rows = np.flatnonzero(frame.z > 0)
        if state.T_world_pred is None or not keyframes or not len(rows):
            return self.verdict(np.ones(len(xy), dtype=bool))
        poses = np.stack([pose for pose, _ in keyframes])
        world = se3.transform(state.T_world_pred, camera.unproject(frame.xy[rows], frame.z[rows]))
        local = np.stack(list(map(se3.transform, se3.inverse(poses), [world] * len(poses))))
        ahead = local[..., 2] > 0.1
        pixels = np.full((*ahead.shape, 2), -1.0)
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        at, visible = pixel_index(pixels, (camera.height, camera.width))
        observed = ahead & visible
        surface = np.empty(ahead.shape, np.float32)
        smallest = {}
        for number, (_, depth) in enumerate(keyframes):
            # in a copied episode the id may be another image's
            kept = self._smallest.get(id(depth), (None, None))
            smallest[id(depth)] = kept if kept[0] is depth else (depth, cv2.erode(depth, PATCH))
            surface[number] = smallest[id(depth)][1][at[0][number], at[1][number]]
        self._smallest = smallest
        limit = np.maximum(
            self.settings.threshold_m, self.settings.threshold_sigma * depth_sigma(surface)
        )
        violated = observed & (surface > 0) & (surface - local[..., 2] > limit)
        votes = np.zeros(len(xy), dtype=int)
        tested = np.zeros(len(xy), dtype=bool)
        votes[rows], tested[rows] = violated.sum(axis=0), observed.any(axis=0)
        violating = votes >= min(self.settings.min_votes, len(keyframes))
        moving = failing_regions(violating, tested, xy, self.settings.min_share, frame.gray.shape)
        return self.verdict(~moving, asked=len(keyframes), tested=np.count_nonzero(tested))
