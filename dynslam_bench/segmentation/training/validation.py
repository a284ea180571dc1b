"""Scores of a network on prepared images, as training asks for them now and then."""

from __future__ import annotations

import numpy as np
import torch

from dynslam_bench.evaluation.masks import MaskCounts, compare_masks

from ..networks.mask_rcnn.network import MaskRCNN
from ..networks.mask_rcnn.segmenter import paste
from .prepared import PreparedImages

CONFIDENCE = 0.5


@torch.no_grad()
def validate(network: MaskRCNN, images: PreparedImages, device: str = "cpu") -> dict[str, float]:
    """Scores of a network on prepared images, detections from score 0.5.

    Returns:
        ``iou`` (mean over objects of the best detection's IoU), ``pixel_iou`` (all classes' pixels together) and
        ``recall`` (share of objects with IoU >= 0.5).
    """
    network.eval()
    best: list[float] = []
    counts = MaskCounts()
    for index in range(len(images)):
        example = images[index]
        height, width = example.rgb.shape[:2]
        image = torch.from_numpy(example.rgb).to(device).permute(2, 0, 1).float() / 255
        found = network.detect(image, score=CONFIDENCE)
        boxes, planes = found.boxes.cpu().numpy(), found.masks.float().cpu().numpy()
        labels = found.labels.cpu().numpy()
        masks = [paste(plane, box, height, width, 0.5, exact=True) for plane, box in zip(planes, boxes, strict=True)]
        for truth, label in zip(example.masks, example.labels.tolist(), strict=True):
            alike = [mask for mask, kind in zip(masks, labels.tolist(), strict=True) if kind == label]
            best.append(max((compare_masks(mask, truth).iou or 0.0 for mask in alike), default=0.0))
        union = np.any(masks, axis=0) if masks else np.zeros((height, width), bool)
        counts = counts + compare_masks(union, np.asarray(example.masks.any(axis=0)))
    return {
        "iou": float(np.mean(best)) if best else 0.0,
        "pixel_iou": counts.iou or 0.0,
        "recall": float(np.mean(np.array(best) >= 0.5)) if best else 0.0,
    }
