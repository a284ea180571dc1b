"""B9 as in Blitz-SLAM: masks completed by the blocks of continuous depth that they cover."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.culling.settings import DepthBlockSettings
from dynslam_bench.geometry.camera import Camera, inside
from dynslam_bench.segmentation.postprocess import dilate, select
from dynslam_bench.segmentation.settings import SegmentationSettings


class DepthBlockFilter(DynamicFilter):
    """Drops the features on the masks of people, completed by depth, and on movable things that they touch.

    The depth image is cut into blocks along its edges; a block that lies to a good part on the mask belongs to it as
    a whole. A person who stands on a floor is one block with it and gains nothing, one before a wall does.
    Stats: ``dropped``, ``objects``, ``touched`` (movable things that a person touches), ``blocks`` (taken as a
    whole), ``mask_fraction``.
    """

    name = "depth_blocks"
    needs: frozenset[Need] = frozenset({"masks", "depth"})
    provenance: Provenance = "faithful-paper"
    stats_names = ("dropped", "objects", "touched", "blocks", "mask_fraction")

    def __init__(self, settings: DepthBlockSettings, segmentation: SegmentationSettings) -> None:
        self.settings = settings
        self.segmentation = segmentation

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Complete the masks and drop what lies on them."""
        stats = dict.fromkeys(("objects", "touched", "blocks", "mask_fraction"), 0.0)
        if frame.instances is None or not len(frame.instances):
            return FilterResult.of(np.ones(len(frame), dtype=bool), stats)
        mask, stats["objects"], stats["touched"] = self._semantic_mask(frame.instances)
        if mask.any():
            whole, stats["blocks"] = covered_blocks(mask, frame.depth, self.settings)
            mask = dilate(mask | whole, self.segmentation.dilation_px)
        stats["mask_fraction"] = float(mask.mean())
        return FilterResult.of(~inside(mask, frame.keypoints.xy), stats, mask)

    def _semantic_mask(self, instances: Instances) -> tuple[NDArray[np.bool_], float, float]:
        """People and the movable things whose masks touch theirs, bool ``[H, W]``, and how many of each."""
        people = select(instances, self.segmentation)
        mask = people.union()
        movable = select(instances, self.segmentation.model_copy(update={"classes": self.settings.movable}))
        reach = dilate(mask, 1) if len(movable) else mask
        touched = [each for each in movable.masks if (each & reach).any() and (each & ~mask).any()]
        return np.logical_or.reduce([mask, *touched]), float(len(people)), float(len(touched))


def covered_blocks(
    mask: NDArray[np.bool_], depth: NDArray[np.float32], settings: DepthBlockSettings
) -> tuple[NDArray[np.bool_], float]:
    """The blocks of continuous depth that a mask covers to a good part.

    Args:
        mask: Bool ``[H, W]``.
        depth: float32 ``[H, W]`` metres, 0 or not finite where missing.
        settings: Depth range, step at an edge and the share that must be covered.

    Returns:
        Bool ``[H, W]`` of the pixels in such blocks, and the number of blocks.
    """
    z = np.nan_to_num(np.asarray(depth, np.float32), posinf=0.0, neginf=0.0)
    valid = (z > 0) & (z <= settings.max_depth_m)
    z = np.where(valid, z, 0).astype(np.float32)
    square = np.ones((2, 2), np.uint8)
    edge = cv2.dilate(z, square) - cv2.erode(z, square) > settings.edge_m
    count, label = cv2.connectedComponents((valid & ~edge).view(np.uint8), connectivity=4)
    size = np.bincount(label.ravel(), minlength=count)
    covered = np.bincount(label[mask], minlength=count)
    whole = covered >= np.maximum(settings.min_share * size, 1)
    whole[0] = False  # the edges themselves, and what has no depth
    return np.asarray(whole[label]), float(np.count_nonzero(whole))
