"""Carry masks from one image to the next by optical flow. Pure functions."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.segmentation.postprocess import boxes_of, region

Gray = NDArray[np.uint8]
WORK_SIDE = 240
"""Dense flow is computed on images whose shorter side is this many pixels."""
CORNERS = 40
"""Corners that are tracked on each object in sparse mode."""
LEAST_CORNERS = 6
ROUND_TRIP_PX = 1.0
"""Largest forward-backward error of a corner that is used."""


def dense_flow(previous: Gray, current: Gray) -> NDArray[np.float32]:
    """Dense flow from the previous image to the current one, by DIS (Kroeger et al. 2016).

    Args:
        previous: uint8 ``[H, W]``.
        current: uint8 ``[H, W]``.

    Returns:
        float32 ``[h, w, 2]`` at the reduced size and in its pixels.
    """
    height, width = current.shape
    ratio = min(1.0, WORK_SIDE / min(height, width))
    size = (max(16, round(width * ratio)), max(16, round(height * ratio)))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (previous, current)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(1)
    return np.asarray(dis.calc(small[0], small[1], np.zeros((size[1], size[0], 2), np.float32)), np.float32)


def object_flow(mask: NDArray[np.bool_], flow: NDArray[np.float32]) -> NDArray[np.float32]:
    """The flow of one object, smoothed and continued beyond its edge.

    Dense flow blurs across the edge of a moving object and would leave a trail of its mask. Only the flow inside the
    object is used; its local means are continued outwards.

    Args:
        mask: bool ``[h, w]``.
        flow: float32 ``[h, w, 2]``.
    """
    core = cv2.erode(mask.view(np.uint8), np.ones((7, 7), np.uint8)).astype(np.float32)
    if np.count_nonzero(core) < 0.2 * np.count_nonzero(mask):
        core = mask.astype(np.float32)
    inside = flow[core > 0]
    field = np.broadcast_to(np.median(inside, axis=0), flow.shape).astype(np.float32)
    for window in (61, 15):
        kernel = (window, window)
        weight = cv2.boxFilter(core, -1, kernel, normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(flow * core[:, :, None], -1, kernel, normalize=False, borderType=cv2.BORDER_CONSTANT)
        near = np.asarray(weight >= 8)
        field = np.where(near[:, :, None], total / np.maximum(weight, 1)[:, :, None], field).astype(np.float32)
    return field


def push_mask(mask: NDArray[np.bool_], field: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Move a mask along a smooth flow.

    Args:
        mask: bool ``[H, W]``.
        field: Flow ``[h, w, 2]`` from the mask's image to the next, in its own pixels; a smaller field is interpolated.

    Returns:
        Bool ``[H, W]``; an object that the image's edge cuts is continued when it moves in.
    """
    height, width = mask.shape
    rows, columns = np.mgrid[: field.shape[0], : field.shape[1]].astype(np.float32)
    back = field  # the flow at the place a pixel came from: x = x' - f(x), by fixed-point iteration
    for _ in range(3):
        back = np.asarray(
            cv2.remap(
                field, columns - back[:, :, 0], rows - back[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            ),
            np.float32,
        )
    full = back * np.array([width / field.shape[1], height / field.shape[0]], np.float32)
    if field.shape[:2] != (height, width):
        full = np.asarray(cv2.resize(full, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    at_x = np.arange(width, dtype=np.float32)[None] - full[:, :, 0]
    at_y = np.arange(height, dtype=np.float32)[:, None] - full[:, :, 1]
    moved = cv2.remap(
        mask.view(np.uint8) * np.uint8(255), at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(np.asarray(moved) >= 128)


def carry_dense(instances: Instances, previous: Gray, current: Gray) -> Instances:
    """The objects of the previous image in the current one, moved by dense flow; lost objects are left out."""
    if not len(instances):
        return instances
    flow = dense_flow(previous, current)
    return _moved(instances, [_carry_object(mask, flow) for mask in instances.masks])


def _carry_object(mask: NDArray[np.bool_], flow: NDArray[np.float32]) -> NDArray[np.bool_]:
    """One object's moved mask, computed in a window around the object only."""
    moved, (height, width) = np.zeros_like(mask), flow.shape[:2]
    step_y, step_x = mask.shape[0] / height, mask.shape[1] / width
    small = cv2.resize(mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    inside = region(small, 0)
    if inside is None:
        return moved
    part = region(small, 4 + int(np.ceil(min(float(np.abs(flow[inside]).max()), max(height, width)))))
    assert part is not None
    field = object_flow(np.ascontiguousarray(small[part]), np.ascontiguousarray(flow[part]))
    rows, columns = part
    whole = (
        slice(round(rows.start * step_y), round(rows.stop * step_y)),
        slice(round(columns.start * step_x), round(columns.stop * step_x)),
    )
    moved[whole] = push_mask(np.ascontiguousarray(mask[whole]), field)
    return moved


def carry_sparse(instances: Instances, previous: Gray, current: Gray) -> Instances:
    """The objects of the previous image in the current one, each moved by the similarity of its tracked corners.

    Corners on each object are tracked there and back by pyramidal Lucas-Kanade; RANSAC fits a similarity. An object
    with fewer than six consistent corners keeps its place.
    """
    motions = [_similarity(mask, previous, current) for mask in instances.masks]
    pairs = zip(instances.masks, motions, strict=True)
    return _moved(instances, [mask if motion is None else _warp(mask, motion) for mask, motion in pairs])


def shift_mask(mask: NDArray[np.bool_], dx: float, dy: float, scale: float = 1.0) -> NDArray[np.bool_]:
    """A mask moved by whole and part pixels and scaled about its box' centre."""
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return mask
    centre = np.array([(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2])
    move = np.array([[scale, 0, centre[0] * (1 - scale) + dx], [0, scale, centre[1] * (1 - scale) + dy]])
    return _warp(mask, move)


def _warp(mask: NDArray[np.bool_], motion: NDArray[np.float64]) -> NDArray[np.bool_]:
    moved = cv2.warpAffine(mask.view(np.uint8) * np.uint8(255), motion, mask.shape[::-1], flags=cv2.INTER_LINEAR)
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
        corners.reshape(-1, 2)[consistent],
        there.reshape(-1, 2)[consistent],
        method=cv2.RANSAC,
        ransacReprojThreshold=2.0,
    )
    return None if motion is None else np.asarray(motion, np.float64)


def _moved(instances: Instances, masks: list[NDArray[np.bool_]]) -> Instances:
    """The same objects under new masks, without those that left the image."""
    stack = np.array(masks, bool).reshape(instances.masks.shape)
    return replace(instances, masks=stack, boxes=boxes_of(stack)).visible()
