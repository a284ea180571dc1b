"""Segmentation networks in ONNX files, run by OpenCV's dnn module (4.x and 5.x) on the CPU.

Three layouts of outputs are recognised by names and shapes:

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
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Instances, SegmenterContext
from dynslam_bench.core import SegmentationError, raising
from dynslam_bench.segmentation.networks import pinned_threads
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.settings import COCO_IDS, COCO_NAMES, NMS_IOU, VOC_NAMES, SegmentationSettings

Float: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
_SCALINGS = {
    "unit": ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0)),
    "symmetric": ((128.0, 128.0, 128.0), (128.0, 128.0, 128.0)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}
"""Mean and divisor of the RGB channels of a 0..255 image."""
_SEMANTIC_NAMES = {
    len(VOC_NAMES): dict(enumerate(VOC_NAMES)),
    len(COCO_NAMES) + 1: dict(enumerate(("background", *COCO_NAMES))),
    91: {0: "background", **COCO_IDS},
    2: {0: "background", 1: "person"},
}
"""Names of the classes of a semantic network by their number."""
PAD = 114
STRIDE = 32
"""An open input size is padded to a multiple of this."""
MIN_COMPONENT_PX = 64
"""Smaller connected parts of a semantic map are noise and become no object."""
MAX_OBJECTS = 100
"""Objects an image, as torchvision's models have it."""
MAX_CANDIDATES = 1000
"""Detections that enter the suppression."""


class OnnxSegmenter:
    """Runs an ONNX network and decodes its outputs; the layout is found from their names and shapes.

    Args:
        path: The file.
        settings: Classes, thresholds and input scaling.
        threads: Threads OpenCV may use while the network runs.
        floor: Least score of a detection that is returned.

    Raises:
        SegmentationError: The file is missing, damaged, not understood by OpenCV, or its outputs fit no known layout.
    """

    def __init__(self, path: Path, settings: SegmentationSettings, *, threads: int = 1, floor: float = 0.1) -> None:
        self.path, self.settings, self.threads, self.floor = path.expanduser(), settings, threads, floor
        inputs, outputs, metadata = read_header(self.path)
        self._size = _input_size(inputs, self.path)
        with raising(
            SegmentationError,
            f"OpenCV {cv2.__version__} cannot load {self.path}",
            "export it with static shapes and plain operators",
            of=(cv2.error, RuntimeError),
        ):
            self._net = cv2.dnn.readNetFromONNX(str(self.path))
        self._input = inputs[0].name
        self.layout = self._find_layout(outputs, metadata)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled by its arguments: OpenCV's network cannot be, nor be used by two threads."""
        return partial(OnnxSegmenter, threads=self.threads, floor=self.floor), (self.path, self.settings)

    def segment(self, frame: Frame) -> Instances:
        """The objects of the dynamic classes in the frame.

        Raises:
            SegmentationError: The network cannot run on this image, or gives outputs that do not fit its layout.
        """
        height, width = frame.rgb.shape[:2]
        size = self._size or (-(-height // STRIDE) * STRIDE, -(-width // STRIDE) * STRIDE)
        image, place = fit(frame.rgb, size, keep_aspect=self.layout.kind != "semantic")
        values = self._forward(image, list(self.layout.outputs))
        return decode(self.layout, values, place, self.settings, self.floor)

    def _find_layout(self, outputs: Sequence[TensorInfo], metadata: Mapping[str, str]) -> Layout:
        size = self._size or (480, 640)
        names = [output.name for output in outputs]
        available = {str(name) for name in self._net.getUnconnectedOutLayersNames()}
        if not set(names) <= available:  # older OpenCV names outputs by their layers
            names = sorted(available)
        if names != [output.name for output in outputs if output.shape and None not in output.shape]:
            grey = np.full((*size, 3), PAD, np.uint8)
            self.layout = Layout("semantic", tuple(names), {})  # only for the scaling of this image
            values = self._forward(grey, names)
            outputs = [TensorInfo(name, value.shape) for name, value in zip(names, values, strict=True)]
        return detect_layout(outputs, metadata, size, str(self.path))

    def _forward(self, image: NDArray[np.uint8], names: list[str]) -> list[NDArray[np.float32]]:
        scaling: str = self.settings.onnx_normalisation
        if scaling == "auto" and self.layout.kind != "semantic":
            scaling = "unit"  # YOLO as it is; torchvision's export normalises by itself
        elif scaling == "auto":  # TensorFlow's DeepLab; torchvision's models
            scaling = "symmetric" if self.layout.aligned else "imagenet"
        mean, divisor = _SCALINGS[scaling]
        scaled = (image.astype(np.float32) - np.array(mean, np.float32)) / np.array(divisor, np.float32)
        blob: NDArray[np.float32] = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
        with (
            pinned_threads(cv2.getNumThreads, cv2.setNumThreads, self.threads),
            raising(
                SegmentationError,
                f"{self.path} cannot run on a {image.shape[1]}x{image.shape[0]} image",
                f"OpenCV {cv2.__version__}",
                of=(cv2.error, RuntimeError),
            ),
        ):
            self._net.setInput(blob, self._input)
            outputs = self._net.forward(names)
        return [np.asarray(output, np.float32) for output in outputs]


def build(settings: SegmentationSettings, context: SegmenterContext) -> OnnxSegmenter:
    """A network from an ONNX file."""
    return OnnxSegmenter(Path(context.argument), settings, threads=context.threads, floor=context.floor)


@dataclass(frozen=True)
class Placement:
    """Where the frame lies in the network's input: ``x_input = x_frame * scale_x + offset_x``, likewise y.

    Attributes:
        frame: Height and width of the frame.
        input: Height and width of the network's input.
        scale: Along x and y.
        offset: Along x and y, pixels of the input.
    """

    frame: tuple[int, int]
    input: tuple[int, int]
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def fit(rgb: NDArray[np.uint8], size: tuple[int, int], *, keep_aspect: bool) -> tuple[NDArray[np.uint8], Placement]:
    """Resize an image to the network's input, with grey borders if the aspect ratio is kept.

    Args:
        rgb: uint8 ``[H, W, 3]``.
        size: Height and width of the input.
        keep_aspect: Letterbox (YOLO) instead of stretching (semantic networks).
    """
    height, width = rgb.shape[:2]
    ratio = min(size[0] / height, size[1] / width)
    rows, columns = (max(1, round(height * ratio)), max(1, round(width * ratio))) if keep_aspect else size
    top, left = (size[0] - rows) // 2, (size[1] - columns) // 2
    canvas = np.full((*size, 3), PAD, np.uint8)
    canvas[top : top + rows, left : left + columns] = cv2.resize(
        rgb, (columns, rows), interpolation=cv2.INTER_LINEAR
    ).reshape(rows, columns, 3)
    place = Placement((height, width), size, (columns / width, rows / height), (float(left), float(top)))
    return canvas, place


def _input_size(inputs: Sequence[TensorInfo], path: Path) -> tuple[int, int] | None:
    if len(inputs) != 1:
        raise SegmentationError(
            f"{path} has {len(inputs)} inputs: {'; '.join(map(str, inputs))}",
            "a segmentation network takes one image",
        )
    shape = inputs[0].shape
    if len(shape) != 4 or shape[1] not in (3, None) or shape[0] not in (1, None):
        raise SegmentationError(f"{path}: the input {inputs[0]} is no image", "expected 1x3xHxW")
    height, width = shape[2:]
    return None if height is None or width is None else (height, width)


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

    kind: Literal["yolo", "semantic", "instances"]
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
    rank3 = [output for output in outputs if len(output.shape) == 3 and None not in output.shape]
    rank4 = [output for output in outputs if len(output.shape) == 4 and None not in output.shape[1:]]
    if rank3 and rank4 and (yolo := _yolo(rank3[0], rank4[-1], names)):
        return yolo
    reason = "no known layout fits"
    if rank4 and not rank3:
        classes = int(rank4[0].shape[1] or 0)
        labels = names or _SEMANTIC_NAMES.get(classes)
        if labels is not None and classes >= 2:
            return Layout("semantic", (rank4[0].name,), labels, aligned=_aligned(rank4[0].shape[2:], size))
        reason = f"{classes} semantic classes without names in the file's metadata"
    raise SegmentationError(
        f"{where}: the network's outputs are not understood ({reason}): {'; '.join(map(str, outputs)) or 'none'}",
        "known: YOLO-seg [1, 4+C+M, N] with [1, M, h, w], semantic logits [1, C, h, w], "
        "or boxes, labels, scores, masks as torchvision exports them",
    )


def _yolo(detections: TensorInfo, prototypes: TensorInfo, names: dict[int, str] | None) -> Layout | None:
    coefficients = int(prototypes.shape[1] or 0)
    first, second = (int(size or 0) for size in detections.shape[1:])
    for objectness in (0, 1):  # there are far more candidates than channels
        classes = min(first, second) - 4 - objectness - coefficients
        labels = names or {len(COCO_NAMES): dict(enumerate(COCO_NAMES)), 1: {0: "person"}}.get(classes, {})
        if first != second and labels and len(labels) == classes:
            return Layout("yolo", (detections.name, prototypes.name), labels, first < second, objectness)
    return None


def _aligned(cells: Sequence[int | None], size: tuple[int, int]) -> bool:
    return all(
        c is not None and 1 < c < length and (length - 1) % (c - 1) == 0 for c, length in zip(cells, size, strict=True)
    )


def _metadata_names(metadata: Mapping[str, str], where: str) -> dict[int, str] | None:
    if "names" not in metadata:
        return None
    with raising(
        SegmentationError,
        f"{where}: the metadata entry 'names' is not a table of class names",
        of=(ValueError, SyntaxError, TypeError),
    ):
        value = ast.literal_eval(metadata["names"])
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {int(number): str(name) for number, name in pairs}


def decode(
    layout: Layout, values: Sequence[Float], place: Placement, settings: SegmentationSettings, floor: float
) -> Instances:
    """The objects of the dynamic classes in one frame.

    Args:
        layout: How to read `values`.
        values: The outputs named in the layout, in its order.
        place: Where the frame lies in the input.
        settings: Thresholds and classes.
        floor: Least score of a detection that is returned.

    Raises:
        SegmentationError: An output holds NaN or has another shape than the layout says.
    """
    for name, value in zip(layout.outputs, values, strict=True):
        if not np.isfinite(value).all():
            raise SegmentationError(f"the network's output '{name}' holds NaN or infinite values")
    decoder = {"yolo": _decode_yolo, "semantic": _decode_semantic, "instances": _decode_instances}[layout.kind]
    return decoder(values, layout, place, settings, floor)


def _decode_yolo(
    values: Sequence[Float], layout: Layout, place: Placement, settings: SegmentationSettings, floor: float
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
    labels, best = scores.argmax(axis=1), scores.max(axis=1)
    centre, size = rows[:, 0:2], rows[:, 2:4]
    boxes = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    keep = _keep(boxes, best, labels, layout, settings, floor)
    logits = np.tensordot(rows[keep, first + classes :], prototypes, axes=1).astype(np.float32)
    return _paste(
        logits, boxes[keep], _logit(settings.mask_threshold), boxes[keep], best[keep], labels[keep], layout, place
    )


def _decode_instances(
    values: Sequence[Float], layout: Layout, place: Placement, settings: SegmentationSettings, floor: float
) -> Instances:
    boxes = values[0].reshape(-1, 4)
    labels, scores = np.rint(values[1].reshape(-1)).astype(int), values[2].reshape(-1)
    planes = values[3].reshape(-1, *values[3].shape[-2:]) if values[3].size else np.zeros((0, *place.input), np.float32)
    if len({len(boxes), len(labels), len(scores), len(planes)}) != 1:
        raise SegmentationError(
            f"the network's outputs disagree: {len(boxes)} boxes, {len(labels)} labels, {len(scores)} scores, "
            f"{len(planes)} masks"
        )
    if planes.shape[1:] != place.input:
        raise SegmentationError(
            f"the network's masks are {planes.shape[2]}x{planes.shape[1]}, its input {place.input[1]}x{place.input[0]}",
            "masks must be pasted into the whole image, as torchvision's export does",
        )
    keep = _keep(boxes, scores, labels, layout, settings, floor)
    whole = np.tile(np.array([0, 0, *place.input[::-1]], np.float32), (len(keep), 1))
    planes = planes[keep].astype(np.float32)
    return _paste(planes, whole, settings.mask_threshold, boxes[keep], scores[keep], labels[keep], layout, place)


def _keep(
    boxes: Float,
    scores: Float,
    labels: NDArray[np.intp],
    layout: Layout,
    settings: SegmentationSettings,
    floor: float,
) -> NDArray[np.intp]:
    """Indices of the wanted detections that non-maximum suppression within each class keeps, best first."""
    keep = np.flatnonzero((scores >= floor) & np.isin(labels, _wanted(layout, settings)))
    if not keep.size:
        return keep
    keep = keep[np.argsort(-scores[keep], kind="stable")][:MAX_CANDIDATES]
    corners = boxes[keep]
    extent = float(corners.max() - min(float(corners.min()), 0.0)) + 1.0
    shifted = corners + labels[keep, None].astype(np.float32) * extent  # classes do not overlap any more
    sized = np.concatenate([shifted[:, :2], shifted[:, 2:] - shifted[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(sized.astype(float).tolist(), scores[keep].astype(float).tolist(), 0.0, NMS_IOU)
    return keep[np.asarray(kept, np.intp).reshape(-1)][:MAX_OBJECTS]


def _paste(
    planes: Float,
    windows: Float,
    level: float,
    boxes: Float,
    scores: Float,
    labels: NDArray[np.intp],
    layout: Layout,
    place: Placement,
) -> Instances:
    """The objects in frame coordinates, without those of an empty mask.

    Args:
        planes: ``[K, h, w]``, each over the whole input.
        windows: ``[K, 4]``, the part of the input in which each plane is read: x0, y0, x1, y1.
        level: Least value of a mask's pixel.
        boxes: ``[K, 4]`` in pixels of the input.
        scores: ``[K]``.
        labels: Class numbers ``[K]``.
        layout: Names the classes.
        place: Where the frame lies in the input.
    """
    height, width = place.frame
    scale, offset = np.array(place.scale), np.array(place.offset)
    masks = np.zeros((len(planes), height, width), bool)
    for mask, plane, window in zip(masks, planes, windows.astype(np.float64), strict=True):
        x0, y0 = np.maximum(np.floor((window[:2] - offset) / scale), 0).astype(int)
        x1, y1 = np.minimum(np.ceil((window[2:] - offset) / scale), (width, height)).astype(int)
        if x1 <= x0 or y1 <= y0:
            continue
        ratio = np.array([plane.shape[1] / place.input[1], plane.shape[0] / place.input[0]])
        first = ((np.array([x0, y0]) + 0.5) * scale + offset) * ratio - 0.5
        # pixel centres of the frame's patch -> pixel centres of the plane
        to_plane = np.column_stack([np.diag(scale * ratio), first])
        size, flags = (int(x1 - x0), int(y1 - y0)), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(plane, to_plane, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        mask[y0:y1, x0:x1] = patch > level
    shift, stretch = np.tile(offset, 2).astype(np.float32), np.tile(scale, 2).astype(np.float32)
    in_frame = np.clip((boxes - shift) / stretch, 0, np.array([width, height] * 2)).astype(np.float32)
    names = tuple(layout.names[int(number)] for number in labels)
    return Instances(masks, in_frame, names, scores.astype(np.float32)).visible()


def _decode_semantic(
    values: Sequence[Float], layout: Layout, place: Placement, settings: SegmentationSettings, floor: float
) -> Instances:
    logits = values[0].reshape(values[0].shape[-3:])
    if logits.shape[0] < len(layout.names):
        raise SegmentationError(f"the network gives {logits.shape[0]} classes, its layout says {len(layout.names)}")
    rows, columns = (
        _interpolation(
            logits.shape[1 + axis], place.input[axis], place.scale[1 - axis], place.offset[1 - axis],
            place.frame[axis], layout.aligned,
        )
        for axis in (0, 1)
    )  # fmt: skip
    full = np.matmul(np.matmul(rows, logits), columns.T)
    level = _logit(settings.mask_threshold)
    masks, names, scores = [np.zeros((0, *place.frame), bool)], [], []
    for number in _wanted(layout, settings):
        margin = full[number] - np.delete(full, number, axis=0).max(axis=0)  # > 0 is the arg max
        _, labels, stats, _ = cv2.connectedComponentsWithStats((margin > level).astype(np.uint8), connectivity=8)
        for component in range(1, len(stats)):
            if stats[component, cv2.CC_STAT_AREA] < MIN_COMPONENT_PX:
                continue
            mask = labels == component
            score = float(1 / (1 + np.exp(-float(margin[mask].mean()))))
            if score >= floor:
                masks.append(mask[None])
                names.append(layout.names[number])
                scores.append(score)
    stack = np.concatenate(masks)
    return Instances(stack, boxes_of(stack), tuple(names), np.array(scores, np.float32))


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


def _wanted(layout: Layout, settings: SegmentationSettings) -> list[int]:
    """Numbers of the dynamic classes."""
    return sorted(number for number, name in layout.names.items() if name in settings.class_names())


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


# The header of an ONNX file: inputs, outputs, metadata. No dependency, no execution.
#
# An ONNX file is one protocol-buffer message. Only these fields are decoded (field numbers from the public onnx.proto):
# ModelProto.graph = 7, .metadata_props = 14; GraphProto.initializer = 5 (names only), .input = 11, .output = 12;
# ValueInfoProto.name = 1, .type = 2; TypeProto.tensor_type = 1; Tensor.shape = 2; TensorShapeProto.dim = 1;
# Dimension.dim_value = 1.

Fields: TypeAlias = dict[int, list[Any]]
"""Values of a message, each an integer or a memoryview, by field number."""
_NOTHING = memoryview(b"")


@dataclass(frozen=True)
class TensorInfo:
    """Name and shape of an input or output; an open dimension is None."""

    name: str
    shape: tuple[int | None, ...]

    def __str__(self) -> str:
        return f"{self.name} {'x'.join('?' if size is None else str(size) for size in self.shape) or 'scalar'}"


def read_header(path: Path) -> tuple[list[TensorInfo], list[TensorInfo], dict[str, str]]:
    """The inputs, outputs and metadata that an ONNX file declares.

    Raises:
        SegmentationError: The file is missing, truncated or no ONNX model.
    """
    with raising(SegmentationError, f"cannot read the network {path}", "give the path of an .onnx file"):
        data = path.expanduser().read_bytes()
    with raising(
        SegmentationError,
        f"{path} is not an ONNX model ({len(data)} bytes)",
        "the file is truncated or of another format",
        of=(ValueError, IndexError, TypeError, AttributeError),
    ):  # also a field of another type
        model = _fields(memoryview(data))
        graph = _message(model, 7)
        initialised = {_text(_fields(tensor), 8) for tensor in graph.get(5, ())}
        declared, outputs = ([_tensor(_fields(value)) for value in graph.get(number, ())] for number in (11, 12))
        inputs = [tensor for tensor in declared if tensor.name not in initialised]
        metadata = {_text(entry, 1): _text(entry, 2) for entry in map(_fields, model.get(14, ()))}
        if not inputs or not outputs:
            raise ValueError(f"it declares {len(inputs)} inputs and {len(outputs)} outputs")
    return inputs, outputs, metadata


def _tensor(value: Fields) -> TensorInfo:
    shape = _message(_message(_message(value, 2), 1), 2)
    sizes = [_fields(dimension).get(1, [0])[-1] for dimension in shape.get(1, ())]
    return TensorInfo(_text(value, 1), tuple(size if 0 < size < 1 << 62 else None for size in sizes))


def _message(fields: Fields, number: int) -> Fields:
    return _fields(fields.get(number, [_NOTHING])[0])


def _text(fields: Fields, number: int) -> str:
    return str(fields.get(number, [_NOTHING])[0].tobytes().decode())


def _fields(data: memoryview) -> Fields:
    """The values of a message by field number: integers, and the bytes of everything else."""
    fields: Fields = {}
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind not in (0, 1, 2, 5):
            raise ValueError(f"unknown wire type {kind}")
        value, begin = _varint(data, position) if kind in (0, 2) else ({1: 8, 5: 4}[kind], position)
        position = begin if kind == 0 else begin + value
        if position > len(data):
            raise ValueError(f"a field of {value} bytes ends beyond the file")
        fields.setdefault(key >> 3, []).append(value if kind == 0 else data[begin:position])
    return fields


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    """The number that begins at a position, and the position after it."""
    result = 0
    for shift in range(0, 70, 7):
        byte = data[position]
        position += 1
        result |= (byte & 127) << shift
        if byte < 128:
            return result, position
    raise ValueError("a number is longer than ten bytes")
