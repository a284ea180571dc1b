"""Layouts of the outputs of ONNX networks, detected by the file's metadata first, then by exact shapes.

Sizes of different layouts may coincide: detections of a network with two classes have as many
channels before non-maximum suppression (a score a class) as after it (the best score and its
class). So every layout that the outputs fit is listed, the metadata and the number of rows exclude
some, and what still fits two layouts is refused.

C is the number of classes, M that of mask coefficients, N that of detections.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from dynslam_bench.core import SegmentationError, translate_errors
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo
from dynslam_bench.segmentation.settings import COCO_IDS, COCO_NAMES, VOC_NAMES, canonical_name

KNOWN = (
    "known: YOLO-seg [1, 4+C+M, N] or, after suppression, [1, N, 6+M], with prototypes [1, M, h, w]; semantic logits "
    "[1, C, h, w]; boxes, labels, scores, masks as torchvision exports them"
)
"""The layouts that are read, for messages."""
_YOLO_NAMES = {len(COCO_NAMES): dict(enumerate(COCO_NAMES)), 1: {0: "person"}}
"""Names of the classes of a YOLO network without names, by their number."""
_SEMANTIC_NAMES = {
    len(VOC_NAMES): dict(enumerate(VOC_NAMES)),
    len(COCO_NAMES) + 1: dict(enumerate(("background", *COCO_NAMES))),
    91: {0: "background", **COCO_IDS},
    2: {0: "background", 1: "person"},
}
"""Names of the classes of a semantic network without names, by their number."""
NO_OBJECT = frozenset({"", "background", "n/a"})
"""Names, as `canonical_name` writes them, of what is no object."""
MOST_CLASSES = 1 << 16
"""Numbers of classes lie below it."""
_TASKS = {
    "segment": ("yolo", "instances"),
    "semantic": ("semantic",),
    "detect": (),
    "pose": (),
    "obb": (),
    "classify": (),
}
"""Ultralytics' tasks, and the kinds of layouts whose masks they give."""
_STRIDES = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32))
"""Strides of the grids of YOLO networks: of most, of those named P6 and of those named P2."""
_ANCHORS = 3
"""Detections a cell of a YOLO network with objectness; those without have one."""


@dataclass(frozen=True)
class Layout:
    """The layout of a network's outputs: how they are read.

    Attributes:
        kind: Which decoder.
        outputs: Names of the outputs that the decoder takes, in its order.
        names: Class number to name, as the file spells it.
        channels_first: ``yolo`` only: detections lie along the last axis.
        objectness: ``yolo`` only: 1 if an objectness score precedes the class scores.
        suppressed: ``yolo`` only: corners, the best score and its class in place of centre, size
            and class scores; overlapping detections are left out already.
        aligned: ``semantic`` only: the corners of the logits are the corners of the input.
        scaling: Input scaling that such a network takes; see ``onnx_normalisation``.
    """

    kind: Literal["yolo", "semantic", "instances"]
    outputs: tuple[str, ...]
    names: Mapping[int, str]
    channels_first: bool = True
    objectness: int = 0
    suppressed: bool = False
    aligned: bool = False
    scaling: Literal["unit", "symmetric", "imagenet"] = "unit"

    @property
    def id(self) -> str:
        """The layout's name in the setting ``onnx_layout``."""
        if self.suppressed:
            return "yolo-nms"
        if self.objectness:
            return "yolo-objectness"
        return "semantic-aligned" if self.aligned else self.kind


@dataclass(frozen=True)
class Metadata:
    """Metadata of a network's file.

    Attributes:
        names: Class number to name; None where the file names no classes.
        numbered: Whether the file gives the classes' numbers; a mere list leaves open where
            counting begins.
        suppressed: Whether overlapping detections are left out inside the network; None where the
            file does not say.
        task: Ultralytics' task, a key of `_TASKS`; empty for another one or none.
    """

    names: Mapping[int, str] | None = None
    numbered: bool = False
    suppressed: bool | None = None
    task: str = ""


@dataclass(frozen=True)
class _Fit:
    """A layout that the outputs fit.

    Attributes:
        layout: Without names if nothing names the classes.
        text: The layout with its numbers, for messages.
        rows: Detections; 0 for other networks.
        channels_last: The planes are ``[1, h, w, C]``, which no decoder takes.
    """

    layout: Layout
    text: str
    rows: int = 0
    channels_last: bool = False


def read_metadata(metadata: Mapping[str, str], where: str) -> Metadata:
    """Read the entries ``names``, ``end2end``, ``args`` and ``task``, as Ultralytics' exporters write them.

    Args:
        metadata: The file's metadata.
        where: The file, for the error.

    Raises:
        SegmentationError: ``names`` is no table of class names, or ``end2end`` neither true nor
            false.
    """
    # names: a table, or a list
    names: dict[int, str] | None = None
    value: Any = None
    if "names" in metadata:
        with translate_errors(
            SegmentationError,
            f"{where}: the metadata entry 'names' is not a table of class names",
            "expected {0: 'person', ...}",
            of=(ValueError, SyntaxError, TypeError, OverflowError, MemoryError, RecursionError),
        ):
            value = ast.literal_eval(metadata["names"])
            if not isinstance(value, (dict, list, tuple)):
                raise ValueError(f"it is a {type(value).__name__}")
            pairs = value.items() if isinstance(value, dict) else enumerate(value)
            names = {int(number): str(name) for number, name in pairs}
            if any(not 0 <= number < MOST_CLASSES for number in names):
                raise ValueError(f"a number is not between 0 and {MOST_CLASSES - 1}")

    # suppression inside the network: end2end, or the exporter's argument nms
    inside = metadata.get("end2end", "").strip().casefold()
    if inside not in ("", "true", "false"):
        raise SegmentationError(
            f"{where}: the metadata entry 'end2end' is '{inside[:100]}'", "expected True or False"
        )
    arguments: Any = None
    # other exporters write other things there
    with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
        arguments = ast.literal_eval(metadata.get("args", ""))
    suppressed = None if not inside else inside == "true"
    if isinstance(arguments, dict) and "nms" in arguments:
        suppressed = bool(suppressed or arguments["nms"])
    task = metadata.get("task", "").strip().casefold()
    return Metadata(names, isinstance(value, dict), suppressed, task if task in _TASKS else "")


def detect_layout(
    outputs: Sequence[TensorInfo],
    metadata: Mapping[str, str],
    size: tuple[int, int],
    where: str,
    asked: str = "auto",
) -> Layout:
    """Detect the layout of a network's outputs.

    Args:
        outputs: Names, shapes and types.
        metadata: The file's metadata.
        size: Height and width of the network's input.
        where: The file, for the error.
        asked: The setting ``onnx_layout``: ``auto``, or the layout's `Layout.id`.

    Raises:
        SegmentationError: No known layout fits, two fit, the metadata contradict the shapes, or the
            class names are not known; lists the outputs.
    """
    facts = read_metadata(metadata, where)
    listed = "; ".join(map(str, outputs)) or "none"
    if asked == "auto" and facts.task and not _TASKS[facts.task]:
        raise SegmentationError(
            f"{where}: the metadata say 'task' = {facts.task}: such a network gives no masks; its outputs: {listed}",
            "export a network for segmentation, of YOLO one whose name ends with -seg",
        )

    # every layout that the shapes allow
    fits = [
        *_instances(outputs, facts),
        *_yolo(outputs, facts, size),
        *_semantic(outputs, facts, size),
    ]
    shapes_allow = [fit for fit in fits if not fit.channels_last]

    # without those that the user, the metadata or the number of rows exclude
    if asked != "auto":
        fits = [fit for fit in shapes_allow if fit.layout.id == asked]
        # layouts without class names are of no use where others have them
        fits = [fit for fit in fits if fit.layout.names] or fits
    else:
        fits = [fit for fit in fits if _agrees(fit, facts)]
    fits = _by_rows(fits, size)

    if not fits:
        raise _not_understood(outputs, shapes_allow, facts, where, asked)
    if len(fits) > 1:
        raise _ambiguous(fits, facts, where, listed)
    if fits[0].channels_last:
        raise SegmentationError(
            f"{where}: the outputs {listed} fit {fits[0].text} alone, whose channels come last",
            "export it with channels first",
        )
    layout = fits[0].layout
    if not layout.names:
        raise SegmentationError(
            f"{where}: the outputs {listed} fit {fits[0].text}, whose classes have no names",
            "the metadata entry 'names' of the file must give them: {0: 'person', ...}",
        )
    return layout


def _agrees(fit: _Fit, facts: Metadata) -> bool:
    """Whether the metadata allow a layout that the shapes allow."""
    layout = fit.layout
    if facts.task and layout.kind not in _TASKS[facts.task]:
        return False
    if fit.channels_last and facts.task:
        # Ultralytics exports ONNX with channels first
        return False
    if layout.kind != "yolo":
        return True
    if layout.objectness and (facts.task or facts.suppressed is not None):
        # YOLOv5's exporter, whose networks have it, writes neither entry
        return False
    return facts.suppressed is None or layout.suppressed == facts.suppressed


def _by_rows(fits: list[_Fit], size: tuple[int, int]) -> list[_Fit]:
    """Without the layouts that the number of detections excludes, where it is exactly that of a YOLO network's grid."""
    cells = {
        sum(-(-size[0] // stride) * -(-size[1] // stride) for stride in strides)
        for strides in _STRIDES
    }
    anchored = [
        fit
        for fit in fits
        if fit.layout.objectness and fit.rows in {_ANCHORS * count for count in cells}
    ]
    if anchored:
        # no network without anchors has so many, and suppression does not leave so many
        return anchored
    raw = [fit for fit in fits if fit.layout.kind == "yolo" and not fit.layout.suppressed]
    exact = [fit for fit in raw if not fit.layout.objectness and fit.rows in cells]
    if exact:
        # suppression may leave as many
        return [fit for fit in fits if fit in exact or fit not in raw]
    return fits


def _instances(outputs: Sequence[TensorInfo], facts: Metadata) -> Iterator[_Fit]:
    """Boxes ``[K, 4]``, labels ``[K]``, scores ``[K]``, masks ``[K, 1, H, W]``, told by their names."""
    by_name = {output.name.lower(): output for output in outputs}
    if not {"boxes", "labels", "scores", "masks"} <= by_name.keys():
        return
    if by_name["boxes"].shape[-1:] not in ((4,), (None,)):
        return
    order = tuple(by_name[key].name for key in ("boxes", "labels", "scores", "masks"))
    names = COCO_IDS if facts.names is None else facts.names
    first = canonical_name(names.get(0, ""))
    if facts.names is None or facts.numbered or first in NO_OBJECT:
        yield _Fit(Layout("instances", order, names), "'instances'")
        return
    # a list does not say whether label 1 is its first or its second name
    later = {number + 1: name for number, name in names.items()}
    yield _Fit(Layout("instances", order, names), f"'instances' with label 0 for '{first}'")
    yield _Fit(Layout("instances", order, later), f"'instances' with label 1 for '{first}'")


def _yolo(outputs: Sequence[TensorInfo], facts: Metadata, size: tuple[int, int]) -> Iterator[_Fit]:
    """Detections with mask coefficients, and prototypes: every pair of outputs that may be these two."""
    for detections in _of_rank(outputs, 3):
        for prototypes in _of_rank(outputs, 4):
            names = (detections.name, prototypes.name)
            for coefficients, plane, last in _planes(prototypes):
                if _whole_stride(plane, size):
                    first, second = (int(length or 0) for length in detections.shape[1:])
                    yield from _detections(
                        names, first, second, coefficients, facts, channels_last=last
                    )


def _detections(
    outputs: tuple[str, str],
    first: int,
    second: int,
    coefficients: int,
    facts: Metadata,
    *,
    channels_last: bool,
) -> Iterator[_Fit]:
    """Layouts that fit detections of shape ``[1, first, second]`` with so many mask coefficients."""
    last = f"M = {coefficients}" + (" and prototypes [1, h, w, M]" if channels_last else "")
    for channels_first, channels, rows in ((True, first, second), (False, second, first)):
        # a score a class, with or without objectness before them
        for objectness in (0, 1):
            classes = channels - 4 - objectness - coefficients
            names = _YOLO_NAMES.get(classes, {}) if facts.names is None else facts.names
            # without names: any number, but then detections are more than the numbers of one
            if names or facts.names is not None:
                possible = _counts(names, classes)
            else:
                possible = rows > channels
            if classes >= 1 and rows >= 1 and possible:
                layout = Layout("yolo", outputs, names, channels_first, objectness)
                width = f"{4 + objectness}+C+M"
                shape = f"[1, {width}, N]" if channels_first else f"[1, N, {width}]"
                text = f"'{layout.id}' {shape} with C = {classes}, {last}"
                yield _Fit(layout, text, rows, channels_last)
        # corners, best score, its class: no exporter writes this along the last axis
        names = {} if facts.names is None else facts.names
        if not channels_first and channels == 6 + coefficients and _counts(names, len(names)):
            layout = Layout("yolo", outputs, names, channels_first=False, suppressed=True)
            yield _Fit(layout, f"'{layout.id}' [1, N, 6+M] with {last}", rows, channels_last)


def _semantic(
    outputs: Sequence[TensorInfo], facts: Metadata, size: tuple[int, int]
) -> Iterator[_Fit]:
    """Logits of classes in planes; a label map may stand beside them, detections may not."""
    planes = _of_rank(outputs, 4)
    maps = {size, *(output.shape[2:] for output in planes)}
    if any(output.shape[1:] not in maps for output in _of_rank(outputs, 3)):
        return
    # torchvision's auxiliary head serves training
    if {"out", "aux"} <= {output.name for output in planes}:
        planes = [output for output in planes if output.name != "aux"]
    for output in planes:
        readings = []
        for classes, plane, last in _planes(output):
            names = _SEMANTIC_NAMES.get(classes, {}) if facts.names is None else facts.names
            # the background may have no name
            if classes >= 2 and names and _counts({0: "", **names}, classes):
                readings.append((classes, plane, last, names))
        # of two orders of the axes, the one whose planes have the shape of the image
        fitting = [reading for reading in readings if _any_stride(reading[1], size)]
        for classes, plane, last, names in fitting or readings:
            for aligned in _alignments(plane, size):
                scaling = _usual_scaling(facts, aligned=aligned)
                layout = Layout("semantic", (output.name,), names, aligned=aligned, scaling=scaling)
                shape = "[1, h, w, C]" if last else "[1, C, h, w]"
                text = f"'{layout.id}' {shape} with C = {classes} in output {output.name}"
                yield _Fit(layout, text, channels_last=last)


def _usual_scaling(facts: Metadata, *, aligned: bool) -> Literal["unit", "symmetric", "imagenet"]:
    """Input scaling of most semantic networks of such an exporter."""
    # by the exporter: Ultralytics' networks, TensorFlow's DeepLab, torchvision's models
    if facts.task:
        return "unit"
    return "symmetric" if aligned else "imagenet"


def _of_rank(outputs: Iterable[TensorInfo], rank: int) -> list[TensorInfo]:
    """Outputs of real numbers for one image, whose sizes are known."""
    real = [output for output in outputs if output.is_real and len(output.shape) == rank]
    return [
        output for output in real if None not in output.shape[1:] and output.shape[0] in (1, None)
    ]


def _counts(names: Mapping[int, str], classes: int) -> bool:
    """Whether so many classes are numbered from 0."""
    return len(names) == classes and all(number in names for number in range(classes))


def _planes(output: TensorInfo) -> Iterator[tuple[int, tuple[int, int], bool]]:
    """Channels, height and width, and whether the channels come last: both readings of a shape of four sizes."""
    _, first, second, third = (int(length or 0) for length in output.shape)
    yield first, (second, third), False
    yield third, (first, second), True


def _whole_stride(plane: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether each cell of a plane covers the same square of pixels of the image, without a rest."""
    height, width = plane
    if not (height and width) or size[0] % height or size[1] % width:
        return False
    return size[0] // height == size[1] // width


def _any_stride(plane: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a plane is the image at one stride, rounded up or down."""
    for stride in range(1, 65):
        down = (size[0] // stride, size[1] // stride)
        up = (-(-size[0] // stride), -(-size[1] // stride))
        if plane in (down, up):
            return True
    return False


def _alignments(plane: tuple[int, int], size: tuple[int, int]) -> tuple[bool, ...]:
    """Whether the corners of logits may be the corners of the input: no, yes, or both where the sizes allow both."""
    height, width = plane
    rows, columns = size
    if not (1 < height < rows and 1 < width < columns):
        return (False,)
    down, down_rest = divmod(rows - 1, height - 1)
    across, across_rest = divmod(columns - 1, width - 1)
    if down_rest or across_rest or down != across:
        return (False,)
    return (False, True) if _whole_stride(plane, size) else (True,)


def _ambiguous(fits: Sequence[_Fit], facts: Metadata, where: str, listed: str) -> SegmentationError:
    """The error for outputs that fit several layouts: names them, and what decides."""
    ids = {fit.layout.id for fit in fits}
    usable = dict.fromkeys(
        fit.layout.id for fit in fits if fit.layout.names and not fit.channels_last
    )
    texts = " and ".join(fit.text for fit in fits)

    # what would decide between them
    cures = []
    if facts.names is None and fits[0].layout.kind == "yolo":
        cures.append(
            "the metadata entry 'names' of the file tells how many classes there are: {0: 'person', ...}"
        )
    if usable and (len(ids) > 1 or any(fit.channels_last for fit in fits)):
        cures.append(
            " or ".join(f"--set segmentation.onnx_layout={name}" for name in usable) + " decides"
        )
    elif len({fit.layout.outputs for fit in fits}) > 1:
        cures.append("export one of the outputs alone")
    elif fits[0].layout.kind == "instances":
        cures.append("number the classes in the metadata entry 'names': {1: 'person', ...}")
    elif not cures:
        cures.append("export it for images of another size")
    if len({fit.layout.suppressed for fit in fits}) > 1:
        cures.append(
            "so does the metadata entry 'end2end' of the file: True with suppression inside, else False"
        )
    return SegmentationError(
        f"{where}: the outputs {listed} fit {len(fits)} layouts: {texts}", "; ".join(cures)
    )


def _not_understood(
    outputs: Sequence[TensorInfo],
    shapes_allow: Sequence[_Fit],
    facts: Metadata,
    where: str,
    asked: str,
) -> SegmentationError:
    """The error for outputs that fit no layout, or only some that the metadata or the user exclude."""
    # layouts that the metadata or the user exclude
    listed = "; ".join(map(str, outputs)) or "none"
    said = _said(facts)
    if shapes_allow:
        texts = " or ".join(fit.text for fit in shapes_allow)
        ids = dict.fromkeys(fit.layout.id for fit in shapes_allow)
        cure = " or ".join(f"--set segmentation.onnx_layout={name}" for name in ids)
        reason = f"the metadata say {said}"
        if asked != "auto":
            reason = f"segmentation.onnx_layout is {asked}"
        return SegmentationError(
            f"{where}: {reason}, but the outputs {listed} fit {texts}",
            f"if the shapes are right: {cure}",
        )

    # no layout: what may be the reason
    reasons = ["no known layout fits"]
    if said:
        reasons.append(f"the metadata say {said}")
    planes = _of_rank(outputs, 4)
    maps = [output for output in outputs if len(output.shape) in (3, 4)]
    if any(not output.is_real for output in maps):
        reasons.append("an output holds class numbers: export the scores, without arg max")
    if len(planes) == len(outputs) and any(output.shape[1] == 1 for output in planes):
        reasons.append("one channel may hold logits or probabilities")
    elif len(planes) == len(outputs) and facts.names is None and planes:
        reasons.append(
            f"{planes[0].shape[1]} semantic classes without names in the file's metadata"
        )
    return SegmentationError(
        f"{where}: the network's outputs are not understood ({'; '.join(reasons)}): {listed}", KNOWN
    )


def _said(facts: Metadata) -> str:
    """Summarise the metadata for a message; empty if they say nothing."""
    parts = []
    if facts.suppressed is not None:
        inside = "that suppression is inside (end2end, nms)"
        parts.append(inside if facts.suppressed else "that none is suppressed")
    if facts.task:
        parts.append(f"'task' = {facts.task}")
    if facts.names is not None:
        numbers = f" numbered {min(facts.names)} to {max(facts.names)}" if facts.names else ""
        parts.append(f"{len(facts.names)} classes{numbers}")
    return ", ".join(parts)


def assumed_names(layout: Layout, metadata: Mapping[str, str]) -> str:
    """Describe the names assumed where the file does not name its one or two classes; empty where it does."""
    if "names" in metadata or len(layout.names) > 2:
        return ""
    taken = [f"class {number} is taken for {name}" for number, name in layout.names.items()]
    return f"the file names no classes, {', '.join(taken)}"
