"""Narrow images are enlarged before features are extracted from them (Lowe, 2004, Section 3.3: doubled).

FAST, BRIEF and the back end's thresholds are made for images of VGA's width. In a narrower image a
descriptor covers more of the scene, fewer features fit, the border without any is wider, and a
corner is located to a pixel that is larger. Enlarged to that width, an image of 320x240 gives poses
as exact as one of 640x480.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Keypoints
from dynslam_bench.geometry import feature_scale


def enlarged(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image ``[H, W]`` that features are extracted from: as it is, or enlarged if it is narrow."""
    # wide enough already
    if feature_scale(gray.shape[1]) == 1:
        return gray
    return np.asarray(
        cv2.resize(gray, _enlarged_size(gray), interpolation=cv2.INTER_CUBIC), np.uint8
    )


def enlarged_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask ``[H, W]`` of the size of the `enlarged` image."""
    if feature_scale(mask.shape[1]) == 1:
        return mask
    size = _enlarged_size(mask)
    return np.asarray(
        cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    )


def in_given_image(keypoints: Keypoints, given: NDArray[np.uint8]) -> Keypoints:
    """Keypoints of the `enlarged` image in pixels of the one that was given."""
    if feature_scale(given.shape[1]) == 1:
        return keypoints
    # the centres of the first pixels differ, their outer edges do not
    size = np.array(given.shape[::-1], np.float32)
    xy = (keypoints.xy + 0.5) * (size / _enlarged_size(given)) - 0.5
    return replace(keypoints, xy=xy.astype(np.float32))


def _enlarged_size(image: NDArray[np.generic]) -> tuple[int, int]:
    """Width and height of a narrow image after enlarging."""
    height, width = image.shape
    scale = feature_scale(width)
    return round(width / scale), max(1, round(height / scale))
