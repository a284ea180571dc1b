"""B1: drop the features on objects of a-priori dynamic classes (DynaSLAM's variant N); boxes of such objects."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import BaseFilter
from dynslam_bench.geometry import inside
from dynslam_bench.segmentation.postprocess import dynamic_mask, dynamic_objects, select
from dynslam_bench.segmentation.settings import SegmentationSettings


class SemanticFilter(BaseFilter[SegmentationSettings]):
    """Drops every keypoint on the dilated masks of the dynamic classes.

    Stats: ``dropped``, ``objects`` (of dynamic classes), ``mask_fraction`` (share of the image).
    """

    name = "semantic"
    needs: frozenset[Need] = frozenset({"masks"})
    stats_names = ("dropped", "objects", "mask_fraction")
    group = "segmentation"

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Drop what lies on the masks; without a segmenter, keep all."""
        if frame.instances is None or not frame.instances.class_names:
            return self.verdict(np.ones(len(frame.xy), bool))
        objects = np.count_nonzero(dynamic_objects(frame.instances, self.settings))
        # the frame has the mask already if the pipeline made one
        mask = frame.mask
        if mask is None:
            mask = dynamic_mask(frame.instances, self.settings, frame.depth)
        return self.verdict(
            ~inside(mask, frame.keypoints.xy), mask, objects=objects, mask_fraction=mask.mean()
        )


# B2: drop the features inside the boxes of a-priori dynamic classes.


def dynamic_boxes(frame: FrameBundle, settings: SegmentationSettings) -> NDArray[np.float32]:
    """Boxes ``[K, 4]`` of the frame's objects of dynamic classes; none without a segmenter."""
    if frame.instances is None:
        return np.zeros((0, 4), np.float32)
    return select(frame.instances, settings).boxes


def in_boxes(xy: NDArray[np.floating], boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Bool ``[K, N]``: which raw pixels ``[N, 2]`` lie in which box ``[K, 4]`` (x0, y0, x1, y1)."""
    x = np.asarray(xy)[:, 0]
    y = np.asarray(xy)[:, 1]
    x0, y0, x1, y1 = (column[:, None] for column in np.asarray(boxes).reshape(-1, 4).T)
    return np.asarray((x >= x0) & (x < x1) & (y >= y0) & (y < y1))
