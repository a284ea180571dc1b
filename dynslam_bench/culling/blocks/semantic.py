"""B1: drop the features on objects of a-priori dynamic classes (Mask R-CNN as a filter, DynaSLAM's variant N)."""

from __future__ import annotations

import numpy as np

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.pixels import inside
from dynslam_bench.segmentation.masks.postprocess import dynamic_mask, select
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
