"""NGD-SLAM's masks: cut the person out of the box by the depth of its middle."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling.semantic import dynamic_boxes
from dynslam_bench.culling.settings import BoxDepthSettings
from dynslam_bench.geometry.camera import Camera, inside
from dynslam_bench.segmentation.postprocess import dilate
from dynslam_bench.segmentation.settings import SegmentationSettings


class BoxDepthFilter(DynamicFilter):
    """Drops the features on the largest connected region at the depth of a box's middle.

    A box with too little depth, or whose region would cover most of the image, is ignored.
    Stats: ``dropped``, ``objects``, ``ignored``, ``mask_fraction``.
    """

    name = "box_depth"
    needs: frozenset[Need] = frozenset({"boxes", "depth"})
    provenance: Provenance = "inspired"
    stats_names = ("dropped", "objects", "ignored", "mask_fraction")

    def __init__(self, settings: BoxDepthSettings, segmentation: SegmentationSettings) -> None:
        self.settings = settings
        self.segmentation = segmentation

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Cut every box out and drop what lies on it."""
        mask = np.zeros(frame.depth.shape, bool)
        depth = np.nan_to_num(frame.depth)
        ignored = 0
        boxes = dynamic_boxes(frame, self.segmentation)
        for box in boxes:
            person = self._cut(box, depth)
            if person is None:
                ignored += 1
            else:
                mask |= person
        mask = dilate(mask, self.settings.dilation_px)
        stats = {"objects": float(len(boxes)), "ignored": float(ignored), "mask_fraction": float(mask.mean())}
        return FilterResult.of(~inside(mask, frame.keypoints.xy), stats, mask)

    def _cut(self, box: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.bool_] | None:
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
