"""B9 as in Blitz-SLAM: masks completed by the blocks of continuous depth that they cover."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.settings import DepthBlockSettings
from dynslam_bench.geometry.camera import inside
from dynslam_bench.segmentation.postprocess import dilate, select


class DepthBlockFilter(ObjectRule[DepthBlockSettings]):
    """Drops the features on the masks of people, completed by depth, and on movable objects that they touch.

    The depth image is divided into blocks along its edges. A block of which enough lies on the mask is added to the
    mask as a whole. A person in front of a wall is a block; a person on a floor forms one block with the floor.
    Stats: ``dropped``, ``objects``, ``touched`` (movable objects that a person touches), ``blocks`` (added as a
    whole), ``mask_fraction``.
    """

    name = "depth_blocks"
    needs: frozenset[Need] = frozenset({"masks", "depth"})
    provenance: Provenance = "faithful-paper"
    stats_names = ("dropped", "objects", "touched", "blocks", "mask_fraction")

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
        """People and the movable objects whose masks touch theirs, bool ``[H, W]``, and how many of each."""
        people = select(instances, self.segmentation)
        mask = people.union()
        movable = select(instances, self.segmentation.model_copy(update={"classes": self.settings.movable}))
        neighbourhood = dilate(mask, 1) if len(movable) else mask
        touched = [other for other in movable.masks if (other & neighbourhood).any() and (other & ~mask).any()]
        return np.logical_or.reduce([mask, *touched]), float(len(people)), float(len(touched))


def covered_blocks(
    mask: NDArray[np.bool_], depth: NDArray[np.float32], settings: DepthBlockSettings
) -> tuple[NDArray[np.bool_], float]:
    """The blocks of continuous depth of which a mask covers enough.

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
    whole[0] = False  # label 0: edges and pixels without depth
    return np.asarray(whole[label]), float(np.count_nonzero(whole))
