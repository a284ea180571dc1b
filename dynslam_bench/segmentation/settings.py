"""Settings of the segmentation stage, and the class names of COCO and Pascal VOC.

The settings say where masks come from, which classes are dynamic, how masks are cleaned and on
which frames the segmenter runs.
"""

import shlex
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from dynslam_bench.core import SegmentationError, did_you_mean
from dynslam_bench.core.settings import Settings, tunable

COCO_NAMES: tuple[str, ...] = (
    "person",
    "bicycle",
    "car",
    "motorcycle",
    "airplane",
    "bus",
    "train",
    "truck",
    "boat",
    "traffic light",
    "fire hydrant",
    "stop sign",
    "parking meter",
    "bench",
    "bird",
    "cat",
    "dog",
    "horse",
    "sheep",
    "cow",
    "elephant",
    "bear",
    "zebra",
    "giraffe",
    "backpack",
    "umbrella",
    "handbag",
    "tie",
    "suitcase",
    "frisbee",
    "skis",
    "snowboard",
    "sports ball",
    "kite",
    "baseball bat",
    "baseball glove",
    "skateboard",
    "surfboard",
    "tennis racket",
    "bottle",
    "wine glass",
    "cup",
    "fork",
    "knife",
    "spoon",
    "bowl",
    "banana",
    "apple",
    "sandwich",
    "orange",
    "broccoli",
    "carrot",
    "hot dog",
    "pizza",
    "donut",
    "cake",
    "chair",
    "couch",
    "potted plant",
    "bed",
    "dining table",
    "toilet",
    "tv",
    "laptop",
    "mouse",
    "remote",
    "keyboard",
    "cell phone",
    "microwave",
    "oven",
    "toaster",
    "sink",
    "refrigerator",
    "book",
    "clock",
    "vase",
    "scissors",
    "teddy bear",
    "hair drier",
    "toothbrush",
)
"""The 80 object classes of COCO in order; YOLO networks number them from 0."""

_COCO_GAPS = frozenset({12, 26, 29, 30, 45, 66, 68, 69, 71, 83})
"""Category ids of 1..90 that the 2014 / 2017 releases of COCO do not use."""

COCO_IDS: dict[int, str] = dict(
    zip((number for number in range(1, 91) if number not in _COCO_GAPS), COCO_NAMES, strict=True)
)
"""COCO category id (1..90 with gaps, as torchvision's detection networks number them) to name; 0 is background."""

VOC_NAMES: tuple[str, ...] = (
    "background",
    "airplane",
    "bicycle",
    "bird",
    "boat",
    "bottle",
    "bus",
    "car",
    "cat",
    "chair",
    "cow",
    "dining table",
    "dog",
    "horse",
    "motorcycle",
    "person",
    "potted plant",
    "sheep",
    "couch",
    "train",
    "tv",
)
"""The 21 labels of Pascal VOC in order, under their COCO names."""

DYNASLAM_NAMES: tuple[str, ...] = (
    "person",
    "bicycle",
    "car",
    "motorcycle",
    "airplane",
    "bus",
    "train",
    "truck",
    "boat",
    "bird",
    "cat",
    "dog",
    "horse",
    "sheep",
    "cow",
    "elephant",
    "bear",
    "zebra",
    "giraffe",
)
"""The classes that DynaSLAM (Bescos et al. 2018) holds for movable of their own accord."""

PRESETS: dict[str, tuple[str, ...]] = {
    "person": ("person",),
    "dynaslam19": DYNASLAM_NAMES,
    "all": COCO_NAMES,
}
"""Named class sets; a preset's name may stand wherever a class name may."""


PEOPLE = ("person", "people", "pedestrian", "human", "man", "woman", "child")
"""Words in the names of classes of people: such a class is the example where none of the classes is a dynamic one."""
CLASSES_SHOWN = 12
"""Classes that an error lists; the rest is counted."""


@cache
def canonical_name(name: str) -> str:
    """A class name as names are compared: in lower case, ``_`` as a space, of synonyms between commas the first."""
    return " ".join(name.partition(",")[0].replace("_", " ").split()).casefold()


@cache
def expand_classes(names: str) -> frozenset[str]:
    """The class names meant by a comma-separated list of class names and presets, as `canonical_name` writes them.

    Raises:
        SegmentationError: There is none.
    """
    parts = filter(None, map(canonical_name, names.split(",")))
    classes = frozenset(name for part in parts for name in PRESETS.get(part, (part,)))
    if not classes:
        raise SegmentationError("the list of classes is empty", "for example person or dynaslam19")
    return classes


def expand_coco_classes(names: str) -> frozenset[str]:
    """`expand_classes` where all of them must be COCO's.

    Raises:
        SegmentationError: A name is neither a COCO class nor a preset (with a did-you-mean), or
            there is none.
    """
    classes = expand_classes(names)
    for name in sorted(classes.difference(COCO_NAMES)):
        raise SegmentationError(
            f"unknown class '{name}'", did_you_mean(name, [*PRESETS, *COCO_NAMES])
        )
    return classes


def check_classes(
    known: Iterable[str], settings: "SegmentationSettings", where: str, whose: str
) -> None:
    """Raise where the dynamic classes select nothing among those that a source of masks knows.

    Args:
        known: The names of its classes, without the background.
        settings: Settings whose `classes` are the dynamic ones.
        where: The source's file, folder or sequence, for the error.
        whose: What the classes are of, e.g. ``the network``.

    Raises:
        SegmentationError: None of the classes is a dynamic one, or a name that is no COCO name is
            none of them.
    """
    # names that are neither COCO's nor the source's
    names = list(dict.fromkeys(known))
    spelled = {canonical_name(name) for name in names}
    asked = settings.class_names()
    for name in sorted(asked - spelled - set(COCO_NAMES)):
        raise SegmentationError(
            f"{where}: {whose} has no class '{name}'", did_you_mean(name, spelled)
        )
    if asked & spelled:
        return

    # none is a dynamic one: name an example, people first
    people = [name for name in names if any(word in canonical_name(name) for word in PEOPLE)]
    example = canonical_name([*people, *names, "person"][0])
    shown = ", ".join(names[:CLASSES_SHOWN])
    more = f" and {len(names) - CLASSES_SHOWN} more" if len(names) > CLASSES_SHOWN else ""
    raise SegmentationError(
        f"{where}: none of the {len(names)} classes of {whose} is among the dynamic ones: {settings.classes}",
        f"it has {shown or 'none'}{more}; name the dynamic ones, for example: "
        f"--set {shlex.quote(f'segmentation.classes={example}')}",
    )


def _joined(value: Any) -> str:
    """A list of names as a comma-separated text; empty for what is neither list nor text."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return value if isinstance(value, str) else ""


def _coco_classes(value: Any) -> str:
    """Names as a comma-separated text.

    Raises:
        ValueError: One of them is none of COCO's, or there is none.
    """
    text = _joined(value)
    try:
        expand_coco_classes(text)
    except SegmentationError as error:
        raise ValueError(str(error)) from None
    return text


ClassList = Annotated[str, BeforeValidator(_coco_classes)]
"""Comma-separated COCO names or presets, validated; a list of names is taken as well."""
PLAIN_SOURCES = ("auto", "none", "oracle", "oracle-classes", "embedded", "coco", "selfie")
"""Sources that are named alone."""
PREFIXED_SOURCES = ("onnx", "tflite", "recorded", "weights", "plugin")
"""Sources that are named with a path or an id behind a colon."""
COCO_SOURCES = ("auto", "none", "embedded", "coco", "selfie")
"""Sources whose classes are COCO's; the others may bring names of their own."""
# all forms of a source, for errors
FORMS = (
    "auto, none, oracle, oracle-classes, embedded, coco, selfie, onnx:PATH, tflite:PATH, recorded:DIR, "
    "weights:PATH, plugin:ID"
)
NMS_IOU = 0.5
"""Overlap of two boxes of one class above which the weaker one is dropped: torchvision's and YOLO's value."""
MAX_CARRY = 10
"""Frames after which the schedule ``keyframes`` segments without a keyframe: carried masks drift."""
REPAIR_BAND_PX = 8
"""Width of the border, on both sides of a mask's edge, in which depth decides, at an image width of 640; wider than the
networks' errors."""
AT_640 = "px at width 640"
"""Unit of the size of a region in the image: it is scaled with the image's width."""


class SegmentationSettings(Settings):
    """Settings of the semantic stage: which pixels are dynamic because of what they show.

    `dilation_px` is the *radius* of the structuring element at an image width of 640 pixels, and
    is scaled with the width: 15 grows a mask by 15 pixels on every side (an element of 31 x 31
    pixels, as in DynaSLAM), and by 7.5 pixels where the image is 320 pixels wide.
    """

    source: str = "auto"
    """Source of masks: ``auto`` (the embedded network on ``synthetic/*``, else the COCO checkpoint if it was
    fetched), ``none``, ``oracle`` (exact masks, also of whatever else moves), ``oracle-classes``
    (exact masks of the classes alone), ``embedded``, ``coco``, ``selfie`` (MediaPipe's small
    network of people indoors), ``onnx:PATH``, ``tflite:PATH`` (probability maps), ``recorded:DIR``,
    ``weights:PATH`` (a Mask R-CNN checkpoint:
    torchvision's or this project's) or ``plugin:ID``."""
    classes: str = Field(
        "person",
        description="dynamic classes: comma-separated names or presets (person, dynaslam19, all)",
    )
    confidence: float = tunable(
        0.3,
        low=0.1,
        high=0.9,
        limits=(0.01, 1.0),
        online=True,
        meaning="detections with a lower score are ignored",
    )
    mask_threshold: float = tunable(
        0.5,
        low=0.2,
        high=0.8,
        limits=(0.01, 0.99),
        meaning="probability above which a pixel belongs to a mask",
    )
    map_threshold: float = tunable(
        0.2,
        low=0.1,
        high=0.6,
        limits=(0.01, 0.99),
        meaning="networks of probability maps (selfie, tflite): probability above which a pixel is masked",
    )
    map_decay: float = tunable(
        0.3,
        low=0.0,
        high=0.9,
        limits=(0.0, 1.0),
        meaning="networks of probability maps: weight of the frame before's map, carried by flow; 0 = off",
    )
    dilation_px: int = tunable(
        15,
        low=0,
        high=30,
        limits=(0, 200),
        unit=AT_640,
        online=True,
        meaning="radius by which masks are grown; scaled with the image's width",
    )
    schedule: Literal["every", "every_nth", "keyframes", "async"] = tunable(
        "every",
        online=True,
        meaning="frames on which the segmenter runs; optical flow carries the masks between them",
    )
    n: int = Field(
        3, ge=1, description="schedule every_nth: the segmenter runs on every n-th frame"
    )
    latency_s: float = Field(
        0.1,
        ge=0,
        le=10,
        description="schedule async: masks come so many seconds after a frame; 0: when they are done, not repeatable",
    )
    crowded_share: float = Field(
        1.0,
        ge=0,
        le=1,
        description="share of the view under masks above which every frame is segmented; 1 = off",
    )
    carry: Literal["dis", "sparse"] = Field(
        "dis",
        description="flow that carries masks: dense (DIS) or a similarity of tracked corners a mask",
    )
    compensate: int = tunable(
        3,
        low=0,
        high=10,
        limits=(0, None),
        unit="frames",
        online=True,
        meaning="segmented frames for which a missed detection is bridged (constant-velocity box); 0 = off",
    )
    repair: Literal["none", "depth"] = Field(
        "none", description="mask repair: none, or fill holes and fit the border to depth edges"
    )
    repair_depth_m: float = Field(
        0.2,
        ge=0,
        le=10,
        description="repair: depth step in metres from a mask to a pixel outside of it",
    )
    outside_share: float = tunable(
        0.3,
        low=0.0,
        high=1.0,
        limits=(0.0, 1.0),
        online=True,
        meaning="least share of n_features outside the masks; with fewer, n_features are extracted there as well",
    )
    network_side: int = Field(
        480,
        ge=0,
        le=2000,
        description="shorter input side in pixels of coco and weights networks; 0 = as trained",
    )
    onnx_normalisation: Literal["auto", "unit", "symmetric", "imagenet"] = "auto"
    """Input scaling of an ONNX network: [0, 1], [-1, 1], ImageNet's statistics, or what its kind usually takes."""
    onnx_layout: Literal[
        "auto", "yolo", "yolo-objectness", "yolo-nms", "semantic", "semantic-aligned", "instances"
    ] = "auto"
    """Layout of an ONNX network's outputs, where the file's metadata and the shapes leave it open."""

    @field_validator("source")
    @classmethod
    def _known_source(cls, value: str) -> str:
        """Refuse a source that does not exist, or lacks the argument behind its colon."""
        prefix, _, argument = value.partition(":")
        if value in PLAIN_SOURCES or (prefix in PREFIXED_SOURCES and argument.strip()):
            return value
        if prefix in PREFIXED_SOURCES:
            wanted = "an id" if prefix == "plugin" else "a path"
            raise ValueError(f"'{prefix}:' needs {wanted} after the colon")
        hint = did_you_mean(prefix, [*PLAIN_SOURCES, *(f"{name}:" for name in PREFIXED_SOURCES)])
        raise ValueError(f"not one of {FORMS}" + (f"; {hint}" if hint.startswith("did") else ""))

    @field_validator("classes", mode="before")
    @classmethod
    def _known_classes(cls, value: Any, info: ValidationInfo) -> str:
        """Names that are not COCO's are compared with those of the source, when it is known what it finds."""
        if info.data.get("source", "auto") in COCO_SOURCES:
            return _coco_classes(value)
        text = _joined(value)
        try:
            expand_classes(text)
        except SegmentationError as error:
            raise ValueError(str(error)) from None
        return text

    @property
    def unused(self) -> Mapping[str, str]:
        """Tunable fields without effect: exact masks have no scores, recorded masks no probabilities."""
        maps = ("map_threshold", "map_decay")
        fields: dict[str, tuple[str, ...]] = {
            "none": tuple(type(self).model_fields.keys() - {"source"}),
            "oracle": ("confidence", "mask_threshold", *maps),
            "oracle-classes": ("confidence", "mask_threshold", *maps),
            "recorded": ("mask_threshold", *maps),
            "embedded": maps,
            "coco": maps,
            "onnx": maps,
            "weights": maps,
            "plugin": maps,
            "selfie": ("mask_threshold",),
            "tflite": ("mask_threshold",),
        }
        kind = self.source.partition(":")[0]
        return dict.fromkeys(fields.get(kind, ()), f"segmentation.source is {self.source!r}")

    def class_names(self) -> frozenset[str]:
        """The names of the dynamic classes, as `canonical_name` writes them."""
        return expand_classes(self.classes)
