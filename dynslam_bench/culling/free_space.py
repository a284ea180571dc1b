"""Free-space violation: a point where earlier keyframes measured free space lies on a moving object."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import BaseFilter
from dynslam_bench.culling.ego_motion import depth_sigma
from dynslam_bench.culling.moving_regions import in_moving_region
from dynslam_bench.culling.settings import FreeSpaceSettings
from dynslam_bench.geometry import Camera, at_width, pixel_index, se3

Array = NDArray[np.float64]

KEYFRAMES = 8
"""Number of the latest keyframes that are compared."""
MAX_AGE_S = 10.0
"""Older keyframes are not compared: objects may have been moved for good since."""
MIN_DEPTH_M = 0.1
"""Points nearer than this to a keyframe's camera plane are not tested."""
PATCH_PX = 3
"""Half side, at an image width of 640, of the neighbourhood whose smallest depth must lie behind the point: depth edges
and pose errors are no evidence."""


class FreeSpaceFilter(BaseFilter[FreeSpaceSettings]):
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
        # the newest keyframes that have a depth image
        camera = state.camera
        keyframes: list[tuple[Array, NDArray[np.float32]]] = []
        for view in state.keyframes:
            if frame.timestamp - view.timestamp <= MAX_AGE_S and view.depth is not None:
                keyframes.append((view.T_world_cam, view.depth))
        keyframes = keyframes[:KEYFRAMES]
        xy = frame.keypoints.xy
        rows = np.flatnonzero(frame.z > 0)
        if state.T_world_pred is None or not keyframes or not len(rows):
            return self.verdict(np.ones(len(xy), dtype=bool))

        # points in each keyframe's camera ``[K, N, 3]``, and their pixels there
        poses = np.stack([pose for pose, _ in keyframes])
        world = se3.transform(state.T_world_pred, camera.unproject(frame.xy[rows], frame.z[rows]))
        local = np.stack([se3.transform(pose, world) for pose in se3.inverse(poses)])
        ahead = local[..., 2] > MIN_DEPTH_M
        pixels = np.full((*ahead.shape, 2), -1.0)
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        (row, column), visible = pixel_index(pixels, (camera.height, camera.width))
        observed = ahead & visible

        # depth that each keyframe measured around them, the smallest
        surface = np.empty(ahead.shape, np.float32)
        smallest: dict[int, tuple[Any, Any]] = {}
        for number, (_, depth) in enumerate(keyframes):
            # in a copied episode the id may be another image's
            cached_for, eroded = self._smallest.get(id(depth), (None, None))
            if cached_for is not depth:
                half = max(1, round(at_width(PATCH_PX, camera.width)))
                patch = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
                eroded = cv2.erode(depth, patch)
            smallest[id(depth)] = (depth, eroded)
            surface[number] = eroded[row[number], column[number]]
        self._smallest = smallest

        # a point well in front of the surface lies where there was free space
        limit = np.maximum(
            self.settings.threshold_m, self.settings.threshold_sigma * depth_sigma(surface)
        )
        violated = observed & (surface > 0) & (surface - local[..., 2] > limit)

        # enough keyframes must agree, and enough points around fail too
        votes = np.zeros(len(xy), dtype=int)
        tested = np.zeros(len(xy), dtype=bool)
        votes[rows] = violated.sum(axis=0)
        tested[rows] = observed.any(axis=0)
        violating = votes >= min(self.settings.min_votes, len(keyframes))
        moving = in_moving_region(violating, tested, xy, self.settings.min_share, frame.gray.shape)
        return self.verdict(~moving, asked=len(keyframes), tested=np.count_nonzero(tested))
