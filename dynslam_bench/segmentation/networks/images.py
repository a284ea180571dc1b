"""Bring whatever image a caller has into the form that segmenters take."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SegmentationError


def as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """A uint8 ``[H, W, 3]`` image from a grey, RGB or RGBA one of any size.

    Args:
        image: ``[H, W]``, ``[H, W, 1]``, ``[H, W, 3]`` or ``[H, W, 4]`` (alpha is dropped); uint8, uint16 (scaled by
            1/257), bool, or floating point in [0, 1].

    Raises:
        SegmentationError: Another shape, an empty image, another type, or floats outside [0, 1].
    """
    array = np.asarray(image)
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise SegmentationError(
            f"an image of shape {np.shape(image)} cannot be segmented", "expected HxW, HxWx1, HxWx3 or HxWx4"
        )
    if array.shape[2] == 1:
        array = np.repeat(array, 3, axis=2)
    array = array[:, :, :3]
    if array.dtype == np.uint16:
        array = (array // 257).astype(np.uint8)
    elif array.dtype == np.bool_:
        array = array.astype(np.uint8) * 255
    elif np.issubdtype(array.dtype, np.floating):
        low, high = float(array.min()), float(array.max())  # NaN if there is one
        if not (0.0 <= low and high <= 1.0):
            raise SegmentationError(f"a floating-point image has values {low:g}..{high:g}", "expected 0..1, no NaN")
        array = np.rint(array * 255).astype(np.uint8)
    elif array.dtype != np.uint8:
        raise SegmentationError(f"an image of type {array.dtype} cannot be segmented", "expected uint8")
    return np.ascontiguousarray(array)


def check_mask_shape(mask: NDArray[Any], frame_shape: tuple[int, ...], where: str) -> None:
    """Raise if a mask does not have the frame's size.

    Raises:
        SegmentationError: Names both sizes.
    """
    height, width = frame_shape[:2]
    if mask.shape[:2] != (height, width):
        raise SegmentationError(
            f"{where}: the mask is {mask.shape[1]}x{mask.shape[0]}, the frame {width}x{height}",
            "masks must have the frame's size",
        )


def boxes_of(masks: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Tight boxes x0, y0, x1, y1 (x1, y1 exclusive) of bool ``[K, H, W]`` masks; an empty mask gives zeros."""
    boxes = np.zeros((len(masks), 4), np.float32)
    for index, mask in enumerate(masks):
        rows = np.flatnonzero(mask.any(axis=1))
        if rows.size:
            columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
            boxes[index] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes
