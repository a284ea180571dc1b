"""The Mask R-CNN as a segmenter: a frame in, objects at the frame's resolution out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Instances, SegmenterContext
from dynslam_bench.core import SegmentationError
from dynslam_bench.segmentation.networks import pinned_threads
from dynslam_bench.segmentation.networks.checkpoints import COCO, embedded_weights, fetch_checkpoint
from dynslam_bench.segmentation.networks.loading import load_network
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.settings import (
    NMS_IOU,
    SegmentationSettings,
    canonical_name,
    check_classes,
)


class MaskRCNNSegmenter:
    """Runs a `MaskRCNN`.

    Args:
        network: In inference mode.
        settings: Classes and thresholds.
        device: ``cpu`` or ``cuda:N``.
        threads: Threads torch may use on the CPU while the network runs.
        floor: Least score of a detection that is returned.
    """

    def __init__(
        self,
        network: MaskRCNN,
        settings: SegmentationSettings,
        *,
        device: str = "cpu",
        threads: int = 1,
        floor: float = 0.1,
    ) -> None:
        self.network = network.eval().fuse().to(device)
        self.settings = settings
        self.device = device
        self.threads = threads
        self.floor = floor

    def __deepcopy__(self, memo: dict[int, Any]) -> MaskRCNNSegmenter:
        """Itself: no frame changes the network."""
        return self

    def segment(self, frame: Frame) -> Instances:
        """The objects of the dynamic classes in the frame; none is an empty result."""
        # float [3, H, W] in [0, 1]
        height, width = frame.rgb.shape[:2]
        with pinned_threads(torch.get_num_threads, torch.set_num_threads, self.threads):
            pixels = torch.from_numpy(np.array(frame.rgb, order="C")).to(self.device)
            image = pixels.permute(2, 0, 1).float() / 255
            detections = self.network.detect(image, score=self.floor, iou=NMS_IOU)
        boxes, labels, scores, planes = (part.cpu().numpy() for part in detections)

        # masks of the dynamic classes; those of the others stay empty and are left out
        config = self.network.config
        wanted = self.settings.class_names()
        threshold = self.settings.mask_threshold
        names = [canonical_name(config.classes[label - 1]) for label in labels]
        masks = np.zeros((len(names), height, width), bool)
        for mask, plane, box, name in zip(masks, planes, boxes, names, strict=True):
            if name in wanted:
                mask[:] = paste(plane, box, height, width, threshold, exact=config.exact_paste)
        instances = Instances(
            masks, boxes.astype(np.float32), tuple(names), scores.astype(np.float32)
        )
        return instances.visible()


def build_embedded(settings: SegmentationSettings, context: SegmenterContext) -> MaskRCNNSegmenter:
    """The small network in this package, at the input size that it was trained with."""
    as_trained = settings.model_copy(update={"network_side": 0})
    return load_segmenter(embedded_weights(), as_trained, context)


def build_coco(settings: SegmentationSettings, context: SegmenterContext) -> MaskRCNNSegmenter:
    """Torchvision's COCO checkpoint, downloaded on first use."""
    return load_segmenter(fetch_checkpoint(COCO), settings, context)


def build_weights(settings: SegmentationSettings, context: SegmenterContext) -> MaskRCNNSegmenter:
    """A Mask R-CNN checkpoint of the user's."""
    return load_segmenter(Path(context.argument), settings, context)


def load_segmenter(
    path: Path, settings: SegmentationSettings, context: SegmenterContext
) -> MaskRCNNSegmenter:
    """The segmenter of a checkpoint file; it works at `settings.network_side` pixels.

    Raises:
        SegmentationError: The file does not fit, the device is missing, or the network knows none
            of the classes.
    """
    if context.device.startswith("cuda") and not torch.cuda.is_available():
        raise SegmentationError(
            f"device '{context.device}' is not available: torch {torch.__version__} sees no GPU"
        )
    # the network must know a dynamic class
    network = load_network(path)
    check_classes(filter(None, network.config.classes), settings, str(path), "the network")
    if settings.network_side > 0:
        network.set_input(settings.network_side)
    return MaskRCNNSegmenter(
        network, settings, device=context.device, threads=context.threads, floor=context.floor
    )


def paste(
    plane: NDArray[np.float32],
    box: NDArray[np.float32],
    height: int,
    width: int,
    threshold: float,
    *,
    exact: bool = False,
) -> NDArray[np.bool_]:
    """A mask predicted inside a box, as a bool ``[H, W]`` mask of the image.

    Args:
        plane: ``[M, M]`` probabilities.
        box: x0, y0, x1, y1 in pixels.
        height: Rows of the image.
        width: Columns of the image.
        threshold: Least probability of a pixel.
        exact: Interpolate at the pixels' centres. Otherwise as in the published models: the mask
            gets a border of one pixel, the box grows by the same share and is cut to whole pixels,
            which shifts edges by up to a pixel.
    """
    mask = np.zeros((height, width), bool)
    if exact:
        _paste_exactly(plane, box, threshold, mask)
        return mask

    # the box grown by the border's share, cut to whole pixels
    side = plane.shape[0]
    centre = (box[:2] + box[2:]) / 2
    half = (box[2:] - box[:2]) / 2 * ((side + 2) / side)
    x0, y0 = np.trunc(centre - half).astype(int).tolist()
    x1, y1 = np.trunc(centre + half).astype(int).tolist()
    size = (max(x1 - x0 + 1, 1), max(y1 - y0 + 1, 1))

    # the plane with its border at that size, as far as it lies in the image
    patch = cv2.resize(np.pad(plane, 1), size, interpolation=cv2.INTER_LINEAR)
    left = max(x0, 0)
    top = max(y0, 0)
    right = min(x1 + 1, width)
    bottom = min(y1 + 1, height)
    if left < right and top < bottom:
        visible = patch[top - y0 : bottom - y0, left - x0 : right - x0]
        mask[top:bottom, left:right] = visible >= threshold
    return mask


def _paste_exactly(
    plane: NDArray[np.float32], box: NDArray[np.float32], threshold: float, mask: NDArray[np.bool_]
) -> None:
    """Set the pixels of an empty mask by interpolation at their centres."""
    # the box in whole pixels of the image
    left = max(math.floor(box[0]), 0)
    top = max(math.floor(box[1]), 0)
    right = min(math.ceil(box[2]), mask.shape[1])
    bottom = min(math.ceil(box[3]), mask.shape[0])
    if left >= right or top >= bottom or box[2] <= box[0] or box[3] <= box[1]:
        return

    # pixel centres of the image -> pixel centres of the plane
    scale = plane.shape[0] / (box[2:] - box[:2])
    to_plane = np.array(
        [
            [scale[0], 0, (left + 0.5 - box[0]) * scale[0] - 0.5],
            [0, scale[1], (top + 0.5 - box[1]) * scale[1] - 0.5],
        ]
    )
    size = (right - left, bottom - top)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(plane, to_plane, size, borderMode=cv2.BORDER_REPLICATE, flags=flags)

    # only pixels whose centres lie in the box
    columns = np.arange(left, right) + 0.5
    rows = np.arange(top, bottom) + 0.5
    row_inside = (rows >= box[1]) & (rows <= box[3])
    column_inside = (columns >= box[0]) & (columns <= box[2])
    inside = row_inside[:, None] & column_inside[None]
    mask[top:bottom, left:right] = (patch >= threshold) & inside
