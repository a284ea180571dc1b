"""B1: drop the features on objects of a-priori dynamic classes (Mask R-CNN as a filter, DynaSLAM's variant N)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.culling.settings import BoxSettings
from dynslam_bench.geometry.camera import Camera, inside
from dynslam_bench.segmentation.postprocess import dynamic_mask, select
from dynslam_bench.segmentation.settings import SegmentationSettings


class SemanticFilter(DynamicFilter):
    """Drops every keypoint on the dilated masks of the dynamic classes.

    Stats: ``dropped``, ``objects`` (of dynamic classes), ``mask_fraction`` (share of the image).
    """

    name = "semantic"
    needs: frozenset[Need] = frozenset({"masks"})
    provenance: Provenance = "faithful-code"
    stats_names = ("dropped", "objects", "mask_fraction")
    group = "segmentation"

    def __init__(self, settings: SegmentationSettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Drop what lies on the masks; without a segmenter, keep all."""
        if frame.instances is None or not len(frame.instances):
            return FilterResult.of(np.ones(len(frame), bool), {"objects": 0.0, "mask_fraction": 0.0})
        mask = frame.mask
        if mask is None:
            mask = dynamic_mask(frame.instances, self.settings, depth=frame.depth)
        keep = ~inside(mask, frame.keypoints.xy)
        stats = {"objects": float(len(select(frame.instances, self.settings))), "mask_fraction": float(mask.mean())}
        return FilterResult.of(keep, stats, mask)


# B2: drop the features inside the boxes of a-priori dynamic classes.


def dynamic_boxes(frame: FrameBundle, settings: SegmentationSettings) -> NDArray[np.float32]:
    """Boxes ``[K, 4]`` of the frame's objects of dynamic classes; none without a segmenter."""
    found: Instances | None = frame.instances
    return np.zeros((0, 4), np.float32) if found is None else select(found, settings).boxes


def in_boxes(xy: NDArray[np.floating], boxes: NDArray[np.floating], margin: float = 0.0) -> NDArray[np.bool_]:
    """Bool ``[K, N]``: which raw pixels ``[N, 2]`` lie in which box ``[K, 4]`` (x0, y0, x1, y1) grown by a margin."""
    x, y = np.asarray(xy)[:, 0], np.asarray(xy)[:, 1]
    x0, y0, x1, y1 = (column[:, None] for column in np.asarray(boxes).reshape(-1, 4).T)
    return np.asarray((x >= x0 - margin) & (x < x1 + margin) & (y >= y0 - margin) & (y < y1 + margin))


class BoxFilter(DynamicFilter):
    """Drops every keypoint inside a dynamic box. Stats: ``dropped``, ``objects``."""

    name = "boxes"
    needs: frozenset[Need] = frozenset({"boxes"})
    provenance: Provenance = "faithful-code"
    stats_names = ("dropped", "objects")

    def __init__(self, settings: BoxSettings, segmentation: SegmentationSettings) -> None:
        self.settings = settings
        self.segmentation = segmentation

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Drop what lies in the boxes."""
        boxes = dynamic_boxes(frame, self.segmentation)
        inside = in_boxes(frame.keypoints.xy, boxes, self.settings.margin_px).any(axis=0)
        return FilterResult.of(~inside, {"objects": float(len(boxes))})
