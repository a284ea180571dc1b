"""Segmentation networks in ONNX files, run by OpenCV's dnn module (4.x and 5.x) on the CPU.

Three kinds of outputs are understood; `onnx_layout` finds out which of them a network has:

* ``yolo``: boxes with class scores and mask coefficients ``[1, 4 + C + M, N]`` (or transposed, or with an objectness
  score as YOLOv5 has it), or what non-maximum suppression in the network leaves of them,
  ``[1, N, 6 + M]``; and mask prototypes ``[1, M, h, w]``;
* ``semantic``: class logits ``[1, C, h, w]``;
* ``instances``: ``boxes [K, 4]``, ``labels [K]``, ``scores [K]``, ``masks [K, 1, H, W]`` of a torchvision export.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Instances, SegmenterContext
from dynslam_bench.core import SegmentationError, translate_errors
from dynslam_bench.geometry import at_width
from dynslam_bench.segmentation.networks import pinned_threads
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo, read_header
from dynslam_bench.segmentation.networks.onnx_layout import (
    NO_OBJECT,
    Layout,
    assumed_names,
    detect_layout,
)
from dynslam_bench.segmentation.postprocess import boxes_of
from dynslam_bench.segmentation.settings import (
    COCO_NAMES,
    NMS_IOU,
    SegmentationSettings,
    canonical_name,
    check_classes,
)

Float: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
_SCALINGS = {
    "unit": ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0)),
    "symmetric": ((128.0, 128.0, 128.0), (128.0, 128.0, 128.0)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}
"""Mean and divisor of the RGB channels of a 0..255 image."""
PAD = 114
"""Grey level of the borders around a letterboxed image."""
STRIDE = 32
"""An open input size is padded to a multiple of this."""
MIN_COMPONENT_SIDE_PX = 8
"""A part of a semantic map smaller than a square of this side, at an image width of 640, is noise and no object."""
MAX_OBJECTS = 100
"""Objects an image, as torchvision's models have it."""
MAX_CANDIDATES = 1000
"""Detections that enter the suppression."""
OPEN_SIZE = (480, 640)
"""Height and width of the image that a network with an open input size is tried with: those of TUM and Bonn."""
SHARES = 1.5
"""Boxes that lie within so many pixels of the image's corner are shares of its size: such a box covers no pixel."""


class OnnxSegmenter:
    """Runs an ONNX network and decodes its outputs; see `detect_layout` for their layout.

    Args:
        path: The file.
        settings: Classes, thresholds and input scaling.
        threads: Threads OpenCV may use while the network runs.
        floor: Least score of a detection that is returned.

    Raises:
        SegmentationError: The file is missing, damaged, not understood by OpenCV, its outputs fit
            no known layout or several, or none of its classes is a dynamic one.
    """

    def __init__(
        self, path: Path, settings: SegmentationSettings, *, threads: int = 1, floor: float = 0.1
    ) -> None:
        # the size of the input is in the file's header
        self.path = path.expanduser()
        self.settings = settings
        self.threads = threads
        self.floor = floor
        inputs, outputs, metadata = read_header(self.path)
        self._size = _input_size(inputs, self.path)
        # the network
        with translate_errors(
            SegmentationError,
            f"OpenCV {cv2.__version__} cannot load {self.path}",
            "export it with static shapes and plain operators",
            of=(cv2.error, RuntimeError),
        ):
            self._net = cv2.dnn.readNetFromONNX(str(self.path))
        # how its outputs are read, and which of its classes are wanted
        self._input = inputs[0].name
        self.layout = self._find_layout(outputs, metadata)
        self._check_classes(metadata)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled by its arguments: OpenCV's network cannot be, nor be used by two threads."""
        return partial(OnnxSegmenter, threads=self.threads, floor=self.floor), (
            self.path,
            self.settings,
        )

    def segment(self, frame: Frame) -> Instances:
        """The objects of the dynamic classes in the frame.

        Raises:
            SegmentationError: The network cannot run on this image, or gives outputs that do not
                fit its layout.
        """
        # resize to the network's input; an open size is the frame's, rounded up to the stride
        height, width = frame.rgb.shape[:2]
        padded = (-(-height // STRIDE) * STRIDE, -(-width // STRIDE) * STRIDE)
        image, place = fit(
            frame.rgb, self._size_of(padded), keep_aspect=self.layout.kind != "semantic"
        )
        values = self._forward(image, list(self.layout.outputs), self.layout.scaling)
        return decode(self.layout, values, place, self.settings, self.floor)

    def _size_of(self, image: tuple[int, int]) -> tuple[int, int]:
        """Height and width of the network's input; open ones are those of the image."""
        height, width = self._size
        return height or image[0], width or image[1]

    def _find_layout(self, outputs: Sequence[TensorInfo], metadata: Mapping[str, str]) -> Layout:
        """The layout of the outputs; the network runs on a grey image where the file leaves their sizes open."""
        size = self._size_of(OPEN_SIZE)
        names = [output.name for output in outputs]
        available = {str(name) for name in self._net.getUnconnectedOutLayersNames()}
        # older OpenCV names outputs by their layers
        if not set(names) <= available:
            names = sorted(available)
        # sizes that are open are known when the network has run
        declared = [output.name for output in outputs if output.shape and None not in output.shape]
        if names != declared or None in self._size:
            elements = {output.name: output.element for output in outputs}
            values = self._forward(np.full((*size, 3), PAD, np.uint8), names, "unit")
            outputs = [
                TensorInfo(name, value.shape, elements.get(name, ""))
                for name, value in zip(names, values, strict=True)
            ]
        return detect_layout(outputs, metadata, size, str(self.path), self.settings.onnx_layout)

    def _check_classes(self, metadata: Mapping[str, str]) -> None:
        """Raise where no class is a dynamic one; warn of what is assumed of a dynamic one."""
        # one class at least must be a dynamic one
        objects = {
            number: name
            for number, name in self.layout.names.items()
            if canonical_name(name) not in NO_OBJECT
        }
        check_classes(objects.values(), self.settings, str(self.path), "the network")
        # names that are guessed are said
        assumed = assumed_names(self.layout, metadata)
        if assumed:
            warnings.warn(f"{self.path}: {assumed}", stacklevel=2)
        for number in _wanted(self.layout, self.settings):
            name = self.layout.names[number]
            meant = canonical_name(name)
            if meant != name and meant in COCO_NAMES:
                warnings.warn(
                    f"{self.path}: the class '{name}' of the network is taken for '{meant}'",
                    stacklevel=2,
                )

    def _forward(
        self, image: NDArray[np.uint8], names: list[str], usual: str
    ) -> list[NDArray[np.float32]]:
        """The outputs for an image, scaled as the settings say or else as usual."""
        # scale, and reorder to [1, 3, H, W]
        scaling: str = self.settings.onnx_normalisation
        if scaling == "auto":
            scaling = usual
        mean, divisor = _SCALINGS[scaling]
        centred = image.astype(np.float32) - np.array(mean, np.float32)
        scaled = centred / np.array(divisor, np.float32)
        blob: NDArray[np.float32] = np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])
        # run the network on the given number of threads
        with (
            pinned_threads(cv2.getNumThreads, cv2.setNumThreads, self.threads),
            translate_errors(
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
    return OnnxSegmenter(
        Path(context.argument), settings, threads=context.threads, floor=context.floor
    )


@dataclass(frozen=True)
class Placement:
    """Scale and offset of the frame in the network's input: ``x_input = x_frame * scale_x + offset_x``, likewise y.

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


def fit(
    rgb: NDArray[np.uint8], size: tuple[int, int], *, keep_aspect: bool
) -> tuple[NDArray[np.uint8], Placement]:
    """Resize an image to the network's input, with grey borders if the aspect ratio is kept.

    Args:
        rgb: uint8 ``[H, W, 3]``.
        size: Height and width of the input.
        keep_aspect: Letterbox (YOLO) instead of stretching (semantic networks).
    """
    height, width = rgb.shape[:2]
    rows, columns = size
    if keep_aspect:
        ratio = min(size[0] / height, size[1] / width)
        rows = max(1, round(height * ratio))
        columns = max(1, round(width * ratio))
    # in the middle of a grey canvas
    top = (size[0] - rows) // 2
    left = (size[1] - columns) // 2
    canvas = np.full((*size, 3), PAD, np.uint8)
    canvas[top : top + rows, left : left + columns] = cv2.resize(
        rgb, (columns, rows), interpolation=cv2.INTER_LINEAR
    ).reshape(rows, columns, 3)
    place = Placement(
        frame=(height, width),
        input=size,
        scale=(columns / width, rows / height),
        offset=(float(left), float(top)),
    )
    return canvas, place


def _input_size(inputs: Sequence[TensorInfo], path: Path) -> tuple[int | None, int | None]:
    """Height and width of the image that a network takes; None where they are open."""
    if len(inputs) != 1:
        raise SegmentationError(
            f"{path} has {len(inputs)} inputs: {'; '.join(map(str, inputs))}",
            "a segmentation network takes one image",
        )
    # [1, 3, H, W] in this order; sizes may be open
    shape = inputs[0].shape
    channels_last = len(shape) == 4 and shape[3] == 3 and shape[1] != 3
    if channels_last or len(shape) != 4 or shape[1] not in (3, None) or shape[0] not in (1, None):
        raise SegmentationError(f"{path}: the input {inputs[0]} is no image", "expected 1x3xHxW")
    if not inputs[0].is_real:
        raise SegmentationError(
            f"{path}: the input {inputs[0]} takes whole numbers",
            "export it for real numbers: see onnx_normalisation",
        )
    return shape[2], shape[3]


def decode(
    layout: Layout,
    values: Sequence[Float],
    place: Placement,
    settings: SegmentationSettings,
    floor: float,
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
    decoders = {
        "yolo": _decode_yolo,
        "semantic": _decode_semantic,
        "instances": _decode_instances,
    }
    decoder = decoders[layout.kind]
    return decoder(values, layout, place, settings, floor)


def _check_detections(boxes: Float, scores: Float, labels: Float, layout: Layout) -> None:
    """Raise where detections cannot be what the layout says.

    Args:
        boxes: Corners ``[K, 4]`` of those with the least score or more.
        scores: ``[K]``.
        labels: Class numbers ``[K]``.
        layout: Named in the error.
    """
    if not scores.size:
        return
    hint = f"are the outputs really '{layout.id}'? segmentation.onnx_layout names another"
    if float(scores.max()) > 1.001:
        raise SegmentationError(
            f"the network's scores reach {scores.max():.4g}, scores end at 1", hint
        )
    # class numbers must have a name
    least = float(labels.min())
    most = float(labels.max())
    if least < 0 or most > max(layout.names):
        raise SegmentationError(
            f"the network's class numbers lie between {least:.4g} and {most:.4g}, its names are numbered "
            f"{min(layout.names)} to {max(layout.names)}",
            hint,
        )
    # corners that the network gives, not made of centre and size; a single box may be a bad detection
    reversed_corners = (boxes[:, 2:] < boxes[:, :2]).any(axis=1)
    given = layout.suppressed or layout.kind == "instances"
    if given and reversed_corners.mean() > 0.5:
        x0, y0, x1, y1 = boxes[reversed_corners][0].tolist()
        raise SegmentationError(
            f"the network's boxes end before they begin, for example x {x0:.4g} to {x1:.4g}, y {y0:.4g} to {y1:.4g}",
            "corners are expected; " + hint,
        )
    if float(boxes.max()) <= SHARES:
        raise SegmentationError(
            f"the network's boxes reach {boxes.max():.4g}: shares of the image, not pixels",
            "export it with boxes in pixels of the input",
        )


def _decode_yolo(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
    """Objects of YOLO's detections ``[1, 4 + C + M, N]`` or ``[1, N, 6 + M]`` and prototypes ``[1, M, h, w]``."""
    # a detection a row; its mask coefficients begin at `first`
    rows = values[0].reshape(values[0].shape[-2:])
    rows = rows.T if layout.channels_first else rows
    prototypes = values[1].reshape(values[1].shape[-3:])
    first = 6 if layout.suppressed else 4 + layout.objectness + len(layout.names)
    if rows.shape[1] != first + prototypes.shape[0]:
        raise SegmentationError(
            f"the network gives detections of {rows.shape[1]} numbers and {prototypes.shape[0]} prototypes, "
            f"the layout '{layout.id}' of {len(layout.names)} classes has {first + prototypes.shape[0]} numbers"
        )

    # corners, scores and class numbers; those that are kept
    boxes, best, numbers = _corners(rows) if layout.suppressed else _best(rows, first, layout)
    above = best >= floor
    fractions = numbers[numbers != np.rint(numbers)]
    if len(fractions):  # also of low scores: where score and class are swapped all scores may be 0
        raise SegmentationError(
            f"the network gives the class number {fractions[0]:.4g}, class numbers are whole",
            f"detections of '{layout.id}' are corners, score, class, coefficients, in this order; export it so",
        )
    _check_detections(boxes[above], best[above], numbers[above], layout)
    labels = numbers.astype(np.intp)
    keep = _keep(boxes, best, labels, layout, settings, floor)

    # masks: the prototypes weighted by a detection's coefficients, inside its box
    logits = np.tensordot(rows[keep, first:], prototypes, axes=1).astype(np.float32)
    return _paste(
        logits,
        boxes[keep],
        _logit(settings.mask_threshold),
        boxes[keep],
        best[keep],
        labels[keep],
        layout,
        place,
    )


def _corners(rows: Float) -> tuple[Float, Float, Float]:
    """Corners, scores and class numbers of detections that are suppressed already."""
    return rows[:, 0:4], rows[:, 4], rows[:, 5]


def _best(rows: Float, first: int, layout: Layout) -> tuple[Float, Float, Float]:
    """Corners, best scores and their class numbers of detections with centre, size and a score a class."""
    # scores of the classes, times the objectness where there is one
    scores = rows[:, 4 + layout.objectness : first]
    if layout.objectness:
        scores = scores * rows[:, 4:5]
    centre = rows[:, 0:2]
    size = rows[:, 2:4]
    corners = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    return corners, scores.max(axis=1), scores.argmax(axis=1).astype(np.float32)


def _decode_instances(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
    """Objects of boxes ``[K, 4]``, labels ``[K]``, scores ``[K]`` and pasted masks ``[K, 1, H, W]``."""
    # as many of each
    boxes = values[0].reshape(-1, 4)
    labels = np.rint(values[1].reshape(-1)).astype(np.intp)
    scores = values[2].reshape(-1)
    planes = np.zeros((0, *place.input), np.float32)
    if values[3].size:
        planes = values[3].reshape(-1, *values[3].shape[-2:])
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

    # detections that count
    above = scores >= floor
    _check_detections(boxes[above], scores[above], labels[above].astype(np.float32), layout)
    keep = _keep(boxes, scores, labels, layout, settings, floor)

    # the planes cover the whole input
    whole = np.tile(np.array([0, 0, *place.input[::-1]], np.float32), (len(keep), 1))
    planes = planes[keep].astype(np.float32)
    return _paste(
        planes,
        whole,
        settings.mask_threshold,
        boxes[keep],
        scores[keep],
        labels[keep],
        layout,
        place,
    )


def _keep(
    boxes: Float,
    scores: Float,
    labels: NDArray[np.intp],
    layout: Layout,
    settings: SegmentationSettings,
    floor: float,
) -> NDArray[np.intp]:
    """Indices of the wanted detections, best first, that non-maximum suppression within each class keeps.

    Args:
        boxes: Corners ``[N, 4]``, pixels of the input.
        scores: ``[N]``.
        labels: Class numbers ``[N]``.
        layout: Names of the classes, and whether suppression is inside the network.
        settings: Which classes are dynamic.
        floor: Least score.
    """
    # dynamic classes with enough score, the best first
    keep = np.flatnonzero((scores >= floor) & np.isin(labels, _wanted(layout, settings)))
    if not keep.size:
        return keep
    keep = keep[np.argsort(-scores[keep], kind="stable")][:MAX_CANDIDATES]
    if layout.suppressed:
        return keep[:MAX_OBJECTS]
    # suppression within each class: boxes are shifted by class, so that classes do not overlap
    corners = boxes[keep]
    extent = float(corners.max() - min(float(corners.min()), 0.0)) + 1.0
    shifted = corners + labels[keep, None].astype(np.float32) * extent
    sized = np.concatenate([shifted[:, :2], shifted[:, 2:] - shifted[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(
        sized.astype(float).tolist(), scores[keep].astype(float).tolist(), 0.0, NMS_IOU
    )
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
    scale = np.array(place.scale)
    offset = np.array(place.offset)
    masks = np.zeros((len(planes), height, width), bool)
    for mask, plane, window in zip(masks, planes, windows.astype(np.float64), strict=True):
        # the window in pixels of the frame
        x0, y0 = np.maximum(np.floor((window[:2] - offset) / scale), 0).astype(int)
        x1, y1 = np.minimum(np.ceil((window[2:] - offset) / scale), (width, height)).astype(int)
        if x1 <= x0 or y1 <= y0:
            continue
        # pixel centres of the frame's patch -> pixel centres of the plane
        ratio = np.array([plane.shape[1] / place.input[1], plane.shape[0] / place.input[0]])
        first = ((np.array([x0, y0]) + 0.5) * scale + offset) * ratio - 0.5
        to_plane = np.column_stack([np.diag(scale * ratio), first])
        size = (int(x1 - x0), int(y1 - y0))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(plane, to_plane, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        mask[y0:y1, x0:x1] = patch > level
    # boxes in pixels of the frame
    shift = np.tile(offset, 2).astype(np.float32)
    stretch = np.tile(scale, 2).astype(np.float32)
    limits = np.array([width, height] * 2)
    in_frame = np.clip((boxes - shift) / stretch, 0, limits).astype(np.float32)
    names = tuple(canonical_name(layout.names[int(number)]) for number in labels)
    return Instances(masks, in_frame, names, scores.astype(np.float32)).visible()


def _decode_semantic(
    values: Sequence[Float],
    layout: Layout,
    place: Placement,
    settings: SegmentationSettings,
    floor: float,
) -> Instances:
    """Objects of class logits ``[1, C, h, w]``: the connected parts of each dynamic class."""
    logits = values[0].reshape(values[0].shape[-3:])
    if logits.shape[0] <= max(layout.names):
        raise SegmentationError(
            f"the network gives {logits.shape[0]} classes, its names end at {max(layout.names)}"
        )
    # logits at the frame's pixels, by linear interpolation along both axes
    rows, columns = (
        _interpolation(
            logits.shape[1 + axis],
            place.input[axis],
            place.scale[1 - axis],
            place.offset[1 - axis],
            place.frame[axis],
            layout.aligned,
        )
        for axis in (0, 1)
    )
    full = np.matmul(np.matmul(rows, logits), columns.T)
    # margin that the threshold's probability corresponds to
    level = _logit(settings.mask_threshold)
    least_area = at_width(MIN_COMPONENT_SIDE_PX, place.frame[1]) ** 2
    # one object for each large connected part of a class
    masks = [np.zeros((0, *place.frame), bool)]
    names = []
    scores = []
    for number in _wanted(layout, settings):
        # margin over the best other class: > 0 is the arg max
        margin = full[number] - np.delete(full, number, axis=0).max(axis=0)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(
            (margin > level).astype(np.uint8), connectivity=8
        )
        for component in range(1, len(stats)):
            if stats[component, cv2.CC_STAT_AREA] < least_area:
                continue
            # its score is the probability of the mean margin
            mask = labels == component
            score = float(1 / (1 + np.exp(-float(margin[mask].mean()))))
            if score >= floor:
                masks.append(mask[None])
                names.append(canonical_name(layout.names[number]))
                scores.append(score)
    stack = np.concatenate(masks)
    return Instances(stack, boxes_of(stack), tuple(names), np.array(scores, np.float32))


def _interpolation(
    cells: int, length: int, scale: float, offset: float, count: int, aligned: bool
) -> Float:
    """Matrix ``[count, cells]`` of linear interpolation from `cells` logits to `count` frame pixels along one axis.

    Args:
        cells: Logits along the axis.
        length: Pixels of the network's input along it.
        scale: Input pixels in a frame pixel.
        offset: Place of the frame's first pixel in the input.
        count: Frame pixels along the axis.
        aligned: Whether the first and the last cell lie at the input's outermost pixels.
    """
    # where the pixels' centres lie in the input, then among the cells
    at_input = (np.arange(count) + 0.5) * scale + offset - 0.5
    if aligned:
        at = at_input * (cells - 1) / max(length - 1, 1)
    else:
        at = (at_input + 0.5) * cells / length - 0.5
    at = np.clip(at, 0, cells - 1)
    # weights of the two cells around each
    low = np.minimum(np.floor(at).astype(int), max(cells - 2, 0))
    matrix = np.zeros((count, cells), np.float32)
    matrix[np.arange(count), low] = 1 - (at - low)
    matrix[np.arange(count), np.minimum(low + 1, cells - 1)] += (at - low).astype(np.float32)
    return matrix


def _wanted(layout: Layout, settings: SegmentationSettings) -> list[int]:
    """Numbers of the dynamic classes."""
    wanted = settings.class_names()
    return sorted(number for number, name in layout.names.items() if canonical_name(name) in wanted)


def _logit(probability: float) -> float:
    """The value whose sigmoid is a probability."""
    return math.log(probability / (1 - probability))
