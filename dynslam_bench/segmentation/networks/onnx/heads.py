"""Decode the outputs of segmentation networks. Pure functions on arrays; nothing here runs a network."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.core.errors import SegmentationError

from ...settings import SegmentationSettings
from ..images import boxes_of
from .layout import Layout
from .placement import Float, Placement, assemble, paste_plane

MIN_COMPONENT_PX = 64
"""Smaller connected parts of a semantic map are noise and become no object."""
MAX_OBJECTS = 100


class _Asked(NamedTuple):
    """What is wanted of the outputs; see `decode`."""

    layout: Layout
    place: Placement
    height: int
    width: int
    settings: SegmentationSettings
    floor: float


def decode(
    layout: Layout,
    values: Sequence[Float],
    place: Placement,
    height: int,
    width: int,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
    """The objects of the dynamic classes in one frame.

    Args:
        layout: How to read `values`.
        values: The outputs named in the layout, in its order.
        place: Where the frame lies in the input.
        height: Of the frame.
        width: Of the frame.
        settings: Thresholds and classes.
        floor: Least score of a detection that is returned.

    Raises:
        SegmentationError: An output holds NaN or has another shape than the layout says.
    """
    for name, value in zip(layout.outputs, values, strict=True):
        if not np.isfinite(value).all():
            raise SegmentationError(f"the network's output '{name}' holds NaN or infinite values")
    decoder = {"yolo": _decode_yolo, "semantic": _decode_semantic, "instances": _decode_instances}[layout.kind]
    return decoder(values, _Asked(layout, place, height, width, settings, floor))


def _decode_yolo(values: Sequence[Float], asked: _Asked) -> Instances:
    layout, place, height, width, settings, floor = asked
    rows = values[0].reshape(values[0].shape[-2:])
    rows = rows.T if layout.channels_first else rows
    prototypes = values[1].reshape(values[1].shape[-3:])
    first = 4 + layout.objectness
    classes = rows.shape[1] - first - prototypes.shape[0]
    if classes != len(layout.names):
        raise SegmentationError(f"the network gives {classes} class scores, its layout says {len(layout.names)}")
    scores = rows[:, first : first + classes]
    if layout.objectness:
        scores = scores * rows[:, 4:5]
    label, best = scores.argmax(axis=1), scores.max(axis=1)
    wanted = _wanted(layout.names, settings.class_names())
    keep = np.flatnonzero((best >= floor) & np.isin(label, list(wanted)))
    keep = keep[np.argsort(-best[keep], kind="stable")][:1000]
    centre, size = rows[keep, 0:2], rows[keep, 2:4]
    corners = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    chosen = _nms(corners, best[keep], label[keep], settings.nms_iou)[:MAX_OBJECTS]
    keep, corners = keep[chosen], corners[chosen]
    if not keep.size:
        return Instances.empty(height, width)
    logits = np.tensordot(rows[keep, first + classes :], prototypes, axes=1).astype(np.float32)
    masks = np.zeros((len(keep), height, width), bool)
    level = _logit(settings.mask_threshold)
    for mask, plane, corner in zip(masks, logits, corners, strict=True):
        paste_plane(mask, plane, corner, place, level)
    return assemble(masks, corners, [layout.names[int(k)] for k in label[keep]], best[keep], place)


def _decode_semantic(values: Sequence[Float], asked: _Asked) -> Instances:
    layout, place, height, width, settings, floor = asked
    logits = values[0].reshape(values[0].shape[-3:])
    if logits.shape[0] < len(layout.names):
        raise SegmentationError(f"the network gives {logits.shape[0]} classes, its layout says {len(layout.names)}")
    rows = _interpolation(logits.shape[1], place.input_height, place.scale_y, place.offset_y, height, layout.aligned)
    columns = _interpolation(logits.shape[2], place.input_width, place.scale_x, place.offset_x, width, layout.aligned)
    full = np.matmul(np.matmul(rows, logits), columns.T)
    level = _logit(settings.mask_threshold)
    masks: list[NDArray[np.bool_]] = []
    names: list[str] = []
    scores: list[float] = []
    for number in sorted(_wanted(layout.names, settings.class_names())):
        others = np.delete(full, number, axis=0).max(axis=0)
        margin = full[number] - others  # > 0 is the arg max
        _, labels, stats, _ = cv2.connectedComponentsWithStats((margin > level).astype(np.uint8), connectivity=8)
        for component in range(1, len(stats)):
            if stats[component, cv2.CC_STAT_AREA] < MIN_COMPONENT_PX:
                continue
            mask = labels == component
            score = float(1 / (1 + np.exp(-float(margin[mask].mean()))))
            if score >= floor:
                masks.append(mask)
                names.append(layout.names[number])
                scores.append(score)
    if not masks:
        return Instances.empty(height, width)
    stack = np.stack(masks)
    return Instances(stack, boxes_of(stack), tuple(names), np.array(scores, np.float32))


def _decode_instances(values: Sequence[Float], asked: _Asked) -> Instances:
    layout, place, height, width, settings, floor = asked
    boxes = values[0].reshape(-1, 4)
    labels, scores = np.rint(values[1].reshape(-1)).astype(int), values[2].reshape(-1)
    nothing = np.zeros((0, height, width), np.float32)
    planes = values[3].reshape(-1, *values[3].shape[-2:]) if values[3].size else nothing
    counts = {len(boxes), len(labels), len(scores), len(planes)}
    if len(counts) != 1:
        found = f"{len(boxes)} boxes, {len(labels)} labels, {len(scores)} scores, {len(planes)} masks"
        raise SegmentationError(f"the network's outputs disagree: {found}")
    if len(planes) and planes.shape[1:] != (place.input_height, place.input_width):
        raise SegmentationError(
            f"the network's masks are {planes.shape[2]}x{planes.shape[1]}, its input {place.input_width}x"
            f"{place.input_height}",
            "masks must be pasted into the whole image, as torchvision's export does",
        )
    wanted = _wanted(layout.names, settings.class_names())
    keep = np.flatnonzero((scores >= floor) & np.isin(labels, list(wanted)))
    keep = keep[_nms(boxes[keep], scores[keep], labels[keep], settings.nms_iou)][:MAX_OBJECTS]
    if not keep.size:
        return Instances.empty(height, width)
    masks = np.zeros((len(keep), height, width), bool)
    whole = np.array([0, 0, place.input_width, place.input_height], np.float32)
    for mask, plane in zip(masks, planes[keep].astype(np.float32), strict=True):
        paste_plane(mask, plane, whole, place, settings.mask_threshold)
    return assemble(masks, boxes[keep], [layout.names[int(k)] for k in labels[keep]], scores[keep], place)


def _interpolation(cells: int, length: int, scale: float, offset: float, count: int, aligned: bool) -> Float:
    """Matrix ``[count, cells]`` of linear interpolation from `cells` logits to `count` frame pixels along one axis."""
    at_input = (np.arange(count) + 0.5) * scale + offset - 0.5
    at = at_input * (cells - 1) / max(length - 1, 1) if aligned else (at_input + 0.5) * cells / length - 0.5
    at = np.clip(at, 0, cells - 1)
    low = np.minimum(np.floor(at).astype(int), max(cells - 2, 0))
    matrix = np.zeros((count, cells), np.float32)
    matrix[np.arange(count), low] = 1 - (at - low)
    matrix[np.arange(count), np.minimum(low + 1, cells - 1)] += (at - low).astype(np.float32)
    return matrix


def _nms(corners: Float, scores: Float, labels: NDArray[np.intp], iou: float) -> NDArray[np.intp]:
    """Indices kept by non-maximum suppression within each class, best first."""
    if not len(corners):
        return np.zeros(0, np.intp)
    extent = float(corners.max() - min(float(corners.min()), 0.0)) + 1.0
    shifted = corners + labels[:, None].astype(np.float32) * extent  # classes do not overlap any more
    boxes = np.concatenate([shifted[:, :2], shifted[:, 2:] - shifted[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(boxes.astype(float).tolist(), scores.astype(float).tolist(), 0.0, iou)
    return np.asarray(kept, np.intp).reshape(-1)


def _wanted(names: Mapping[int, str], classes: Collection[str]) -> set[int]:
    return {number for number, name in names.items() if name in classes}


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))
