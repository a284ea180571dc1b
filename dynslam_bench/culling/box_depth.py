"""NGD-SLAM's masks: the person is the region of the box at the depth of its middle."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.semantic import dynamic_boxes
from dynslam_bench.culling.settings import BoxDepthSettings
from dynslam_bench.geometry.camera import inside
from dynslam_bench.segmentation.postprocess import dilate


class BoxDepthFilter(ObjectRule[BoxDepthSettings]):
    """Drops the features on the largest connected region at the depth of a box's middle.

    A box with too little depth, or whose region would cover most of the image, is ignored.
    Stats: ``dropped``, ``objects``, ``ignored``, ``mask_fraction``.
    """

    name = "box_depth"
    needs: frozenset[Need] = frozenset({"boxes", "depth"})
    provenance: Provenance = "inspired"
    stats_names = ("dropped", "objects", "ignored", "mask_fraction")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Segment the person in every box and drop the features on them."""
        depth = np.nan_to_num(frame.depth)
        boxes = dynamic_boxes(frame, self.segmentation)
        people = [mask for mask in (self._segment(box, depth) for box in boxes) if mask is not None]
        mask = dilate(np.logical_or.reduce([np.zeros(depth.shape, bool), *people]), self.settings.dilation_px)
        ignored = float(len(boxes) - len(people))
        stats = {"objects": float(len(boxes)), "ignored": ignored, "mask_fraction": float(mask.mean())}
        return FilterResult.of(~inside(mask, frame.keypoints.xy), stats, mask)

    def _segment(self, box: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.bool_] | None:
        """The mask ``[H, W]`` of the person in a box; None where the box is ignored."""
        height, width = depth.shape
        x0, y0, x1, y1 = box.astype(np.float64)
        shrink_x, shrink_y = (1 - self.settings.core) / 2 * (x1 - x0), (1 - self.settings.core) / 2 * (y1 - y0)
        core = depth[_span(y0 + shrink_y, y1 - shrink_y, height), _span(x0 + shrink_x, x1 - shrink_x, width)]
        valid = core[core > 0]
        if not core.size or len(valid) < max(self.settings.min_valid * core.size, 1):
            return None
        margin = self.settings.margin_px
        rows, columns = _span(y0 - margin, y1 + margin, height), _span(x0 - margin, x1 + margin, width)
        window = depth[rows, columns]
        near = (window > 0) & (np.abs(window - np.median(valid)) <= self.settings.depth_m)
        count, label, stats, _ = cv2.connectedComponentsWithStats(near.astype(np.uint8), connectivity=8)
        if count < 2:
            return None
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        person = np.zeros(depth.shape, bool)
        person[rows, columns] = label == largest
        return person if person.mean() <= self.settings.max_cover else None


def _span(low: float, high: float, size: int) -> slice:
    return slice(int(np.clip(low, 0, size)), int(np.clip(np.ceil(high), 0, size)))
