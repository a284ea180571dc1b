"""Outputs of segmentation networks: their layout, recognised by names and shapes, and their decoding.

Three layouts are known:

* ``yolo``: boxes with class scores and mask coefficients ``[1, 4 + C + M, N]`` (or transposed, or with an objectness
  score as YOLOv5 has it) and mask prototypes ``[1, M, h, w]``;
* ``semantic``: class logits ``[1, C, h, w]``;
* ``instances``: ``boxes [K, 4]``, ``labels [K]``, ``scores [K]``, ``masks [K, 1, H, W]`` of a torchvision export.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo
from dynslam_bench.segmentation.postprocess import boxes_of, pick
from dynslam_bench.segmentation.settings import COCO_IDS, COCO_NAMES, NMS_IOU, VOC_NAMES, SegmentationSettings

Float: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
Kind = Literal["yolo", "semantic", "instances"]
MIN_COMPONENT_PX = 64
"""Smaller connected parts of a semantic map are noise and become no object."""
MAX_OBJECTS = 100
"""Objects an image, as torchvision's models have it."""
MAX_CANDIDATES = 1000
"""Detections of a YOLO network that enter the suppression."""


@dataclass(frozen=True)
class Layout:
    """How to read a network's outputs.

    Attributes:
        kind: Which decoder.
        outputs: Names of the outputs that the decoder takes, in its order.
        names: Class number to COCO name.
        channels_first: ``yolo`` only: detections lie along the last axis.
        objectness: ``yolo`` only: 1 if an objectness score precedes the class scores.
        aligned: ``semantic`` only: the corners of the logits are the corners of the input.
    """

    kind: Kind
    outputs: tuple[str, ...]
    names: Mapping[int, str]
    channels_first: bool = True
    objectness: int = 0
    aligned: bool = False


def detect_layout(
    outputs: Sequence[TensorInfo], metadata: Mapping[str, str], size: tuple[int, int], where: str
) -> Layout:
    """Which layout these outputs have.

    Args:
        outputs: Names and shapes.
        metadata: The file's metadata; ``names`` may map class numbers to names.
        size: Height and width of the network's input.
        where: The file, for the error.

    Raises:
        SegmentationError: No known layout fits, or the class names are not known; lists the outputs.
    """
    names = _metadata_names(metadata, where)
    by_name = {output.name.lower(): output for output in outputs}
    if {"boxes", "labels", "scores", "masks"} <= set(by_name):
        order = tuple(by_name[key].name for key in ("boxes", "labels", "scores", "masks"))
        return Layout("instances", order, names or COCO_IDS)
    rank3 = [output for output in outputs if len(output.shape) == 3 and _known(output.shape)]
    rank4 = [output for output in outputs if len(output.shape) == 4 and _known(output.shape[1:])]
    if rank3 and rank4:
        yolo = _yolo(rank3, rank4, names)
        if yolo is not None:
            return yolo
    if rank4 and not rank3:
        full = max(rank4, key=lambda output: (output is rank4[0], math.prod(s or 1 for s in output.shape[1:])))
        classes = int(full.shape[1] or 0)
        labels = names or _semantic_names(classes)
        if labels is not None and classes >= 2:
            return Layout("semantic", (full.name,), labels, aligned=_aligned(full.shape[2:], size))
        raise _unknown(outputs, where, f"{classes} semantic classes without names in the file's metadata")
    raise _unknown(outputs, where, "no known layout fits")


def _yolo(rank3: list[TensorInfo], rank4: list[TensorInfo], names: dict[int, str] | None) -> Layout | None:
    detections, prototypes = rank3[0], rank4[-1]
    coefficients = int(prototypes.shape[1] or 0)
    sizes = [int(size or 0) for size in detections.shape[1:]]
    for channels_first, channels in ((True, sizes[0]), (False, sizes[1])):
        if channels >= max(sizes):
            continue  # there are far more candidates than channels
        for objectness in (0, 1):
            classes = channels - 4 - objectness - coefficients
            usual = {len(COCO_NAMES): dict(enumerate(COCO_NAMES)), 1: {0: "person"}}
            labels = usual.get(classes) if names is None else names
            if labels is not None and len(labels) == classes:
                return Layout("yolo", (detections.name, prototypes.name), labels, channels_first, objectness)
    return None


def _known(shape: Sequence[int | None]) -> bool:
    return all(size is not None for size in shape)


def _aligned(cells: Sequence[int | None], size: tuple[int, int]) -> bool:
    return all(
        c is not None and 1 < c < length and (length - 1) % (c - 1) == 0 for c, length in zip(cells, size, strict=True)
    )


def _semantic_names(classes: int) -> dict[int, str] | None:
    usual = {
        len(VOC_NAMES): dict(enumerate(VOC_NAMES)),
        len(COCO_NAMES) + 1: dict(enumerate(("background", *COCO_NAMES))),
        91: {0: "background", **COCO_IDS},
        2: {0: "background", 1: "person"},
    }
    return usual.get(classes)


def _metadata_names(metadata: Mapping[str, str], where: str) -> dict[int, str] | None:
    if "names" not in metadata:
        return None
    try:
        value = ast.literal_eval(metadata["names"])
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {int(number): str(name) for number, name in pairs}
    except (ValueError, SyntaxError, TypeError) as error:
        raise SegmentationError(
            f"{where}: the metadata entry 'names' is not a table of class names: {error}"
        ) from error


def _unknown(outputs: Sequence[TensorInfo], where: str, reason: str) -> SegmentationError:
    return SegmentationError(
        f"{where}: the network's outputs are not understood ({reason}): {'; '.join(map(str, outputs)) or 'none'}",
        "known: YOLO-seg [1, 4+C+M, N] with [1, M, h, w], semantic logits [1, C, h, w], "
        "or boxes, labels, scores, masks as torchvision exports them",
    )


@dataclass(frozen=True)
class Placement:
    """Where the frame lies in the network's input: ``x_input = x_frame * scale_x + offset_x``, likewise y."""

    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float
    input_width: int
    input_height: int


def paste_plane(mask: NDArray[np.bool_], plane: Float, corner: Float, place: Placement, level: float) -> None:
    """Sample a prototype mask (a plane over the whole input) at the frame's pixels inside the box."""
    left, top, right, bottom = (float(value) for value in corner)
    x0 = max(0, math.floor((left - place.offset_x) / place.scale_x))
    y0 = max(0, math.floor((top - place.offset_y) / place.scale_y))
    x1 = min(mask.shape[1], math.ceil((right - place.offset_x) / place.scale_x))
    y1 = min(mask.shape[0], math.ceil((bottom - place.offset_y) / place.scale_y))
    if x1 <= x0 or y1 <= y0:
        return
    ratio_x, ratio_y = plane.shape[1] / place.input_width, plane.shape[0] / place.input_height
    first_x = ((x0 + 0.5) * place.scale_x + place.offset_x) * ratio_x - 0.5
    first_y = ((y0 + 0.5) * place.scale_y + place.offset_y) * ratio_y - 0.5
    # pixel centres of the frame's patch -> pixel centres of the plane
    to_plane = np.array([[place.scale_x * ratio_x, 0, first_x], [0, place.scale_y * ratio_y, first_y]])
    size, flags = (x1 - x0, y1 - y0), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(plane, to_plane, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    mask[y0:y1, x0:x1] = patch > level


def assemble(masks: NDArray[np.bool_], corners: Float, names: list[str], scores: Float, place: Placement) -> Instances:
    """Instances in frame coordinates, without objects of an empty mask."""
    visible = np.asarray(masks.any(axis=(1, 2)))
    shift = np.array([place.offset_x, place.offset_y] * 2, np.float32)
    scale = np.array([place.scale_x, place.scale_y] * 2, np.float32)
    boxes = np.clip((corners - shift) / scale, 0, np.array([masks.shape[2], masks.shape[1]] * 2)).astype(np.float32)
    instances = Instances(masks, boxes, tuple(names), scores.astype(np.float32))
    return pick(instances, visible)


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
    return decoder(values, layout, place, height, width, settings, floor)


def _decode_yolo(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    height: int,
    width: int,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
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
    keep = keep[np.argsort(-best[keep], kind="stable")][:MAX_CANDIDATES]
    centre, size = rows[keep, 0:2], rows[keep, 2:4]
    corners = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    chosen = _nms(corners, best[keep], label[keep])[:MAX_OBJECTS]
    keep, corners = keep[chosen], corners[chosen]
    if not keep.size:
        return Instances.empty(height, width)
    logits = np.tensordot(rows[keep, first + classes :], prototypes, axes=1).astype(np.float32)
    masks = np.zeros((len(keep), height, width), bool)
    level = _logit(settings.mask_threshold)
    for mask, plane, corner in zip(masks, logits, corners, strict=True):
        paste_plane(mask, plane, corner, place, level)
    return assemble(masks, corners, [layout.names[int(k)] for k in label[keep]], best[keep], place)


def _decode_semantic(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    height: int,
    width: int,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
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


def _decode_instances(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    height: int,
    width: int,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
    boxes = values[0].reshape(-1, 4)
    labels, scores = np.rint(values[1].reshape(-1)).astype(int), values[2].reshape(-1)
    nothing = np.zeros((0, height, width), np.float32)
    planes = values[3].reshape(-1, *values[3].shape[-2:]) if values[3].size else nothing
    counts = {len(boxes), len(labels), len(scores), len(planes)}
    if len(counts) != 1:
        raise SegmentationError(
            f"the network's outputs disagree: {len(boxes)} boxes, {len(labels)} labels, {len(scores)} scores, "
            f"{len(planes)} masks"
        )
    if len(planes) and planes.shape[1:] != (place.input_height, place.input_width):
        raise SegmentationError(
            f"the network's masks are {planes.shape[2]}x{planes.shape[1]}, its input {place.input_width}x"
            f"{place.input_height}",
            "masks must be pasted into the whole image, as torchvision's export does",
        )
    wanted = _wanted(layout.names, settings.class_names())
    keep = np.flatnonzero((scores >= floor) & np.isin(labels, list(wanted)))
    keep = keep[_nms(boxes[keep], scores[keep], labels[keep])][:MAX_OBJECTS]
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


def _nms(corners: Float, scores: Float, labels: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices kept by non-maximum suppression within each class, best first."""
    if not len(corners):
        return np.zeros(0, np.intp)
    extent = float(corners.max() - min(float(corners.min()), 0.0)) + 1.0
    shifted = corners + labels[:, None].astype(np.float32) * extent  # classes do not overlap any more
    boxes = np.concatenate([shifted[:, :2], shifted[:, 2:] - shifted[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(boxes.astype(float).tolist(), scores.astype(float).tolist(), 0.0, NMS_IOU)
    return np.asarray(kept, np.intp).reshape(-1)


def _wanted(names: Mapping[int, str], classes: Collection[str]) -> set[int]:
    return {number for number, name in names.items() if name in classes}


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))
