"""Carry masks from one image to the next by optical flow. Pure functions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .images import boxes_of
from .instances import Instances
from .postprocess import pick

Gray = NDArray[np.uint8]
WORK_SIDE = 240
"""Dense flow is computed on images whose shorter side is this many pixels."""
CORNERS = 40
"""Corners that are tracked on each object in sparse mode."""
LEAST_CORNERS = 6
ROUND_TRIP_PX = 1.0
"""A corner that does not come back to within this distance is not trusted."""


def dense_backward_flow(previous: Gray, current: Gray) -> NDArray[np.float32]:
    """For every pixel of the current image its displacement to the previous one, by DIS (Kroeger et al. 2016).

    Args:
        previous: uint8 ``[H, W]``.
        current: uint8 ``[H, W]``.

    Returns:
        float32 ``[h, w, 2]`` at the reduced size, in pixels of the full size.
    """
    height, width = current.shape
    ratio = min(1.0, WORK_SIDE / min(height, width))
    size = (max(16, round(width * ratio)), max(16, round(height * ratio)))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (current, previous)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(1)
    flow = dis.calc(small[0], small[1], np.zeros((size[1], size[0], 2), np.float32))
    return np.asarray(flow * np.array([width / size[0], height / size[1]], np.float32), np.float32)


def warp_masks(masks: NDArray[np.bool_], flow: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Masks ``[K, H, W]`` of the previous image, as they lie in the current one.

    Args:
        masks: Of the previous image.
        flow: Backward flow ``[h, w, 2]`` in pixels of the full size; a smaller field is interpolated.

    Returns:
        Bool ``[K, H, W]``; what comes from outside the previous image is not part of a mask.
    """
    if not len(masks):
        return masks
    height, width = masks.shape[1:]
    if flow.shape[:2] != (height, width):
        flow = np.asarray(cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    columns = np.arange(width, dtype=np.float32)[None] + flow[:, :, 0]
    rows = np.arange(height, dtype=np.float32)[:, None] + flow[:, :, 1]
    fixed = cv2.convertMaps(columns, rows, cv2.CV_16SC2)
    moved = [cv2.remap(mask.view(np.uint8) * np.uint8(255), fixed[0], fixed[1], cv2.INTER_LINEAR) for mask in masks]
    return np.asarray(np.stack(moved) >= 128)


def carry_dense(found: Instances, previous: Gray, current: Gray) -> Instances:
    """The objects of the previous image in the current one, moved by dense flow; lost objects are left out."""
    if not len(found):
        return found
    return _moved(found, warp_masks(found.masks, dense_backward_flow(previous, current)))


def carry_sparse(found: Instances, previous: Gray, current: Gray) -> Instances:
    """The objects of the previous image in the current one, each moved by the similarity of its tracked corners.

    Corners on each object are tracked there and back by pyramidal Lucas-Kanade; RANSAC fits a similarity. An object
    with fewer than six consistent corners keeps its place.
    """
    if not len(found):
        return found
    height, width = current.shape
    masks = found.masks.copy()
    for index, mask in enumerate(found.masks):
        motion = _similarity(mask, previous, current)
        if motion is not None:
            moved = cv2.warpAffine(mask.view(np.uint8) * np.uint8(255), motion, (width, height), flags=cv2.INTER_LINEAR)
            masks[index] = np.asarray(moved) >= 128
    return _moved(found, masks)


def shift_mask(mask: NDArray[np.bool_], dx: float, dy: float, scale: float = 1.0) -> NDArray[np.bool_]:
    """A mask moved by whole and part pixels and scaled about its box' centre."""
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return mask
    centre = np.array([(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2])
    move = np.array([[scale, 0, centre[0] * (1 - scale) + dx], [0, scale, centre[1] * (1 - scale) + dy]])
    moved = cv2.warpAffine(mask.view(np.uint8) * np.uint8(255), move, (mask.shape[1], mask.shape[0]))
    return np.asarray(np.asarray(moved) >= 128)


def _similarity(mask: NDArray[np.bool_], previous: Gray, current: Gray) -> NDArray[np.float64] | None:
    corners = cv2.goodFeaturesToTrack(previous, CORNERS, 0.01, 5, mask=mask.view(np.uint8))
    if corners is None or len(corners) < LEAST_CORNERS:
        return None
    there, ok, _ = cv2.calcOpticalFlowPyrLK(previous, current, corners, np.empty_like(corners))
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(current, previous, there, np.empty_like(corners))
    consistent = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) <= ROUND_TRIP_PX
    consistent &= (ok.reshape(-1) > 0) & (ok_back.reshape(-1) > 0)
    if np.count_nonzero(consistent) < LEAST_CORNERS:
        return None
    motion, _ = cv2.estimateAffinePartial2D(
        corners.reshape(-1, 2)[consistent], there.reshape(-1, 2)[consistent], method=cv2.RANSAC,
        ransacReprojThreshold=2.0,
    )  # fmt: skip
    return None if motion is None else np.asarray(motion, np.float64)


def _moved(found: Instances, masks: NDArray[np.bool_]) -> Instances:
    """The same objects under new masks, without those that left the image."""
    moved = Instances(masks, boxes_of(masks), found.class_names, found.scores, found.moving)
    return pick(moved, np.asarray(masks.any(axis=(1, 2))))
