"""From instances to the dynamic pixels: selection, repair, dilation. Pure functions."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Instances
from dynslam_bench.geometry import at_width
from dynslam_bench.segmentation.settings import REPAIR_BAND_PX, SegmentationSettings, expand_classes

HOLE_RADIUS_PX = 3
"""Radius of the closing that fills small gaps (MOR-SLAM's morphological step; the radius is this project's), at a width
of 640."""


def boxes_of(masks: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Tight boxes x0, y0, x1, y1 (x1, y1 exclusive) of bool ``[K, H, W]`` masks; an empty mask gives zeros."""
    # x0, y0, width, height of each
    rectangles = [cv2.boundingRect(mask.view(np.uint8)) for mask in masks]
    boxes = np.array(rectangles, np.float32).reshape(-1, 4)
    boxes[:, 2:] += boxes[:, :2]
    return boxes


def dynamic_objects(
    instances: Instances, settings: SegmentationSettings, also: frozenset[str] = frozenset()
) -> NDArray[np.bool_]:
    """Flags ``[K]`` of objects that count: confident, and of a dynamic class or one of `also`, or known to move."""
    # by class, or by what is known of the object's motion
    names = expand_classes(settings.classes) | also
    wanted = np.array([name in names for name in instances.class_names], dtype=bool)
    if instances.moving is not None:
        wanted |= instances.moving
    return np.asarray(wanted & (instances.scores >= settings.confidence))


def select(
    instances: Instances, settings: SegmentationSettings, also: frozenset[str] = frozenset()
) -> Instances:
    """The objects that count, see `dynamic_objects`."""
    return instances.select(dynamic_objects(instances, settings, also))


def dynamic_mask(
    instances: Instances, settings: SegmentationSettings, depth: NDArray[np.float32] | None = None
) -> NDArray[np.bool_]:
    """The dynamic pixels.

    Args:
        instances: The objects that the segmenter returned.
        settings: Classes, confidence, repair and dilation.
        depth: float32 ``[H, W]`` metres, 0 missing, of the masks' size, for ``repair = depth``;
            None fills holes only.

    Returns:
        Bool ``[H, W]``; all false without dynamic objects.
    """
    masks = instances.masks[dynamic_objects(instances, settings)]
    if settings.repair == "depth" and len(masks):
        masks = np.array([repair(mask, depth, settings.repair_depth_m) for mask in masks])
    union = masks.any(axis=0)
    return dilate(np.asarray(union), at_width(settings.dilation_px, union.shape[1]))


def dilate(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Grow a bool ``[H, W]`` mask by a disc of `radius` pixels of this mask.

    A pixel is set if a set pixel lies within `radius` of it (Euclidean distance between pixel
    centres). For radius 15, DynaSLAM's 31 x 31 ellipse approximates this disc.
    """
    part = region(mask, math.ceil(radius) + 1)
    if radius <= 0 or part is None:
        return mask
    # distance to the nearest set pixel, within the mask's box
    grown = mask.copy()
    distance = cv2.distanceTransform(
        (~mask[part]).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    grown[part] = distance <= radius + 1e-3
    return grown


def repair(
    mask: NDArray[np.bool_], depth: NDArray[np.float32] | None, step_m: float
) -> NDArray[np.bool_]:
    """Fill the holes of one object's mask; with depth, also fit its border to the depth edges.

    Within `REPAIR_BAND_PX` (at the image's width) of the mask's edge, a pixel with valid depth belongs to the object if
    its depth is within `step_m` of the mean depth of the object's core nearby. This is mask repair
    by depth fusion as in Blitz-SLAM and MOR-SLAM; band and local mean are assumptions. Pixels
    without depth stay as they are.
    """
    width = mask.shape[1]
    part = region(mask, math.ceil(at_width(REPAIR_BAND_PX + HOLE_RADIUS_PX, width)) + 1)
    if part is None:
        return mask
    patch = fill_holes(mask[part], max(1, round(at_width(HOLE_RADIUS_PX, width))))
    if depth is not None:
        band = at_width(REPAIR_BAND_PX, width)
        patch = _fit_to_depth(patch, np.asarray(depth[part], np.float32), step_m, band)
    repaired = mask.copy()
    repaired[part] = patch
    return repaired


def fill_holes(mask: NDArray[np.bool_], radius: int = HOLE_RADIUS_PX) -> NDArray[np.bool_]:
    """Close gaps of up to `radius` pixels and fill the background that the mask encloses."""
    # close gaps; a margin keeps the element inside the image
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    padded = np.pad(mask, radius + 1).view(np.uint8)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, element)
    # background that is not connected with the padding's is enclosed
    count, labels = cv2.connectedComponents(1 - closed, connectivity=4)
    filled = closed.astype(bool) if count <= 1 else labels != labels[0, 0]
    inner = slice(radius + 1, -(radius + 1))
    return np.asarray(filled[inner, inner] | mask)


def _fit_to_depth(
    mask: NDArray[np.bool_], depth: NDArray[np.float32], step_m: float, band: float
) -> NDArray[np.bool_]:
    """The second step of `repair`: decide the pixels of the `band` by the core's mean depth around them."""
    # the object's core: valid depth, away from the edge
    valid = np.isfinite(depth) & (depth > 0)
    inside = cv2.distanceTransform(np.pad(mask, 1).view(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    outside = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 3)
    core = mask & valid & (inside > min(band, float(inside.max()) / 2))
    if np.count_nonzero(core) < 20:
        return mask

    # local mean of the core's depth
    side = 4 * round(band) + 1
    window = (side, side)
    weight = cv2.boxFilter(
        core.astype(np.float32), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    total = cv2.boxFilter(
        np.where(core, depth, 0).astype(np.float32),
        -1,
        window,
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )

    # pixels on both sides of the edge belong to the object where their depth is near that mean
    judged = valid & (weight >= 1) & (inside <= band) & (outside <= band) & ~core
    near = np.abs(depth - total / np.maximum(weight, 1)) <= step_m
    return np.asarray(np.where(judged, near, mask))


def region(mask: NDArray[np.bool_], margin: int) -> tuple[slice, slice] | None:
    """The mask's bounding box grown by a margin, as slices of rows and columns; None for an empty mask."""
    x0, y0, x1, y1 = (int(value) for value in boxes_of(mask[None])[0])
    if x1 == 0:
        return None
    rows = slice(max(0, y0 - margin), min(mask.shape[0], y1 + margin))
    return rows, slice(max(0, x0 - margin), min(mask.shape[1], x1 + margin))
