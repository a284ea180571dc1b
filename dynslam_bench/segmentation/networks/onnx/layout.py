"""Recognise a segmentation network by the names and shapes of its outputs.

Three layouts are known:

* ``yolo``: boxes with class scores and mask coefficients ``[1, 4 + C + M, N]`` (or transposed, or with an objectness
  score as YOLOv5 has it) and mask prototypes ``[1, M, h, w]``;
* ``semantic``: class logits ``[1, C, h, w]``;
* ``instances``: ``boxes [K, 4]``, ``labels [K]``, ``scores [K]``, ``masks [K, 1, H, W]`` of a torchvision export.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from dynslam_bench.core.errors import SegmentationError

from ...classes import COCO_IDS, COCO_NAMES, VOC_NAMES
from .header import TensorInfo

Kind = Literal["yolo", "semantic", "instances"]


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
        SegmentationError: No known layout fits, or the class names cannot be told; lists the outputs.
    """
    names = _metadata_names(metadata, where)
    by_name = {output.name.lower(): output for output in outputs}
    if {"boxes", "labels", "scores", "masks"} <= set(by_name):
        order = tuple(by_name[key].name for key in ("boxes", "labels", "scores", "masks"))
        return Layout("instances", order, names or COCO_IDS)
    rank3 = [output for output in outputs if len(output.shape) == 3 and _known(output.shape)]
    rank4 = [output for output in outputs if len(output.shape) == 4 and _known(output.shape[1:])]
    if rank3 and rank4:
        found = _yolo(rank3, rank4, names)
        if found is not None:
            return found
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
            labels = names if names is not None and len(names) == classes else None
            if labels is None and names is None and classes == len(COCO_NAMES):
                labels = dict(enumerate(COCO_NAMES))
            if labels is None and names is None and classes == 1:
                labels = {0: "person"}
            if labels is not None:
                return Layout("yolo", (detections.name, prototypes.name), labels, channels_first, objectness)
    return None


def _known(shape: Sequence[int | None]) -> bool:
    return all(size is not None for size in shape)


def _aligned(cells: Sequence[int | None], size: tuple[int, int]) -> bool:
    return all(
        c is not None and 1 < c < length and (length - 1) % (c - 1) == 0 for c, length in zip(cells, size, strict=True)
    )


def _semantic_names(classes: int) -> dict[int, str] | None:
    if classes == len(VOC_NAMES):
        return dict(enumerate(VOC_NAMES))
    if classes == len(COCO_NAMES) + 1:
        return {0: "background", **{number + 1: name for number, name in enumerate(COCO_NAMES)}}
    if classes == 91:
        return {0: "background", **COCO_IDS}
    return {0: "background", 1: "person"} if classes == 2 else None


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
    found = "; ".join(map(str, outputs)) or "none"
    return SegmentationError(
        f"{where}: the network's outputs are not understood ({reason}): {found}",
        "known: YOLO-seg [1, 4+C+M, N] with [1, M, h, w], semantic logits [1, C, h, w], "
        "or boxes, labels, scores, masks as torchvision exports them",
    )
