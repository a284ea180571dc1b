"""Class names and numbers of the data sets that segmentation networks are trained on, and named sets of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Literal

from pydantic import field_validator

from dynslam_bench.core.errors import DynslamError, SegmentationError, did_you_mean
from dynslam_bench.core.settings import Settings, tunable

COCO_NAMES: tuple[str, ...] = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow",
    "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee",
    "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard",
    "tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard",
    "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
"""The 80 object classes of COCO in order; YOLO networks number them from 0."""

_COCO_GAPS = frozenset({12, 26, 29, 30, 45, 66, 68, 69, 71, 83})
"""Category ids of 1..90 that the 2014 / 2017 releases of COCO do not use."""

COCO_IDS: dict[int, str] = dict(
    zip((number for number in range(1, 91) if number not in _COCO_GAPS), COCO_NAMES, strict=True)
)
"""COCO category id (1..90 with gaps, as torchvision's detection networks number them) to name; 0 is background."""

VOC_NAMES: tuple[str, ...] = (
    "background", "airplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow",
    "dining table", "dog", "horse", "motorcycle", "person", "potted plant", "sheep", "couch", "train", "tv",
)  # fmt: skip
"""The 21 labels of Pascal VOC in order, under their COCO names."""

DYNASLAM_NAMES: tuple[str, ...] = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "bird", "cat", "dog",
    "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe",
)  # fmt: skip
"""The classes that DynaSLAM (Bescos et al. 2018) holds for movable of their own accord."""

PRESETS: dict[str, tuple[str, ...]] = {"person": ("person",), "dynaslam19": DYNASLAM_NAMES, "all": COCO_NAMES}
"""Named class sets; a preset's name may stand wherever a class name may."""


def expand_classes(names: str | Iterable[str]) -> frozenset[str]:
    """The COCO names meant by a comma-separated list (or an iterable) of class names and presets.

    Raises:
        SegmentationError: A name is neither a COCO class nor a preset (with a did-you-mean), or there is none.
    """
    parts = [part.strip() for part in (names.split(",") if isinstance(names, str) else names)]
    found: set[str] = set()
    for part in filter(None, parts):
        if part in PRESETS:
            found.update(PRESETS[part])
        elif part in COCO_NAMES:
            found.add(part)
        else:
            raise SegmentationError(f"unknown class '{part}'", did_you_mean(part, [*PRESETS, *COCO_NAMES]))
    if not found:
        raise SegmentationError("the list of classes is empty", "for example person or dynaslam19")
    return frozenset(found)


# Settings of the segmentation stage: where masks come from, what counts as dynamic, how masks are cleaned and when.

PLAIN_SOURCES = ("auto", "none", "oracle", "oracle-classes", "embedded", "coco")
PREFIXED_SOURCES = ("onnx", "recorded", "weights", "plugin")
FORMS = "auto, none, oracle, oracle-classes, embedded, coco, onnx:PATH, recorded:DIR, weights:PATH, plugin:ID"


class SegmentationSettings(Settings):
    """Everything that decides which pixels are held for dynamic because of what they show.

    `source` is one of ``auto`` (the embedded network on ``synthetic/*``, else the COCO checkpoint if it
    was fetched), ``none``,
    ``oracle`` (exact masks, also of whatever else moves), ``oracle-classes`` (exact masks of the classes alone),
    ``embedded``, ``coco``, ``onnx:PATH``, ``recorded:DIR``, ``weights:PATH`` (a Mask R-CNN checkpoint: torchvision's or
    our own) and ``plugin:ID``. `classes` is a comma-separated list of COCO names and
    presets (``person``, ``dynaslam19``, ``all``).

    Pixel quantities are pixels of the input frame. `dilation_px` is the *radius* of the elliptic structuring element:
    15 grows a mask by 15 pixels on every side (an element of 31 x 31 pixels, as in DynaSLAM).
    """

    source: str = "auto"
    """Where masks come from."""
    classes: str = tunable(
        "person",
        choices=("person", "dynaslam19"),
        meaning="classes held for dynamic: comma-separated COCO names or presets (person, dynaslam19, all)",
    )
    confidence: float = tunable(
        0.3, low=0.1, high=0.9, limits=(0.01, 1.0), online=True, meaning="detections with a lower score are ignored"
    )
    mask_threshold: float = tunable(
        0.5, low=0.2, high=0.8, limits=(0.01, 0.99), meaning="probability above which a pixel belongs to a mask"
    )
    nms_iou: float = tunable(
        0.5, low=0.3, high=0.8, limits=(0.0, 1.0), meaning="overlap of two boxes above which the weaker one is dropped"
    )
    dilation_px: int = tunable(
        15, low=0, high=30, limits=(0, 200), unit="px", online=True,
        meaning="radius by which masks are grown (ellipse of 2r + 1 pixels)",
    )  # fmt: skip
    min_area_px: int = tunable(
        0, low=0, high=2000, limits=(0, None), unit="px", online=True, meaning="smaller masks are ignored"
    )
    schedule: Literal["every", "every_nth", "keyframes"] = tunable(
        "every", meaning="frames on which the segmenter runs; in between masks are carried along by optical flow"
    )
    n: int = tunable(
        3, low=2, high=10, limits=(1, None), unit="frames", online=True, when={"schedule": ["every_nth"]},
        meaning="the segmenter runs on every n-th frame",
    )  # fmt: skip
    max_carry: int = tunable(
        10, low=3, high=30, limits=(1, None), unit="frames", online=True, when={"schedule": ["keyframes"]},
        meaning="frames after which the segmenter runs even without a keyframe",
    )  # fmt: skip
    crowded_share: float = tunable(
        1.0, low=0.3, high=1.0, limits=(0.0, 1.0), online=True, when={"schedule": ["every_nth", "keyframes"]},
        meaning="where masks (not grown) cover more than this share of the view, every frame is segmented; 1 = off",
    )  # fmt: skip
    carry: Literal["dis", "sparse"] = tunable(
        "dis",
        when={"schedule": ["every_nth", "keyframes"]},
        meaning="flow that carries masks: dense (DIS) or a similarity of tracked corners a mask",
    )
    compensate: int = tunable(
        3, low=0, high=10, limits=(0, None), unit="frames", online=True,
        meaning="missed detections are bridged for so many segmented frames (constant-velocity box); 0 = off",
    )  # fmt: skip
    repair: Literal["none", "fill", "depth"] = tunable(
        "none", meaning="mask repair: none, fill holes, or fill holes and fit the border to depth edges"
    )
    repair_depth_m: float = tunable(
        0.2, low=0.05, high=0.5, limits=(0.0, 10.0), unit="m", online=True, when={"repair": ["depth"]},
        meaning="depth step between a mask and a pixel at its border above which the pixel is not part of it",
    )  # fmt: skip
    repair_band_px: int = tunable(
        8, low=2, high=20, limits=(1, 100), unit="px", when={"repair": ["depth"]},
        meaning="width of the border in which depth decides, on both sides of the mask's edge",
    )  # fmt: skip
    outside_share: float = tunable(
        0.3, low=0.0, high=1.0, limits=(0.0, 1.0), online=True,
        meaning="share of n_features that must lie outside the masks; where fewer do, n_features are sought there too",
    )  # fmt: skip
    network_side: int = tunable(
        480,
        low=240,
        high=800,
        limits=(0, 2000),
        unit="px",
        meaning="shorter side of the input of coco and weights networks; 0 = as they were trained",
    )
    onnx_normalisation: Literal["auto", "unit", "symmetric", "imagenet"] = "auto"
    """Input scaling of an ONNX network: [0, 1], [-1, 1], ImageNet's statistics, or what its kind usually takes."""

    @field_validator("source")
    @classmethod
    def _known_source(cls, value: str) -> str:
        if value in PLAIN_SOURCES:
            return value
        prefix, separator, argument = value.partition(":")
        if separator and prefix in PREFIXED_SOURCES:
            if not argument.strip():
                raise ValueError(f"'{prefix}:' needs {'an id' if prefix == 'plugin' else 'a path'} after the colon")
            return value
        hint = did_you_mean(prefix, [*PLAIN_SOURCES, *(f"{name}:" for name in PREFIXED_SOURCES)])
        raise ValueError(f"not one of {FORMS}" + (f"; {hint}" if hint.startswith("did") else ""))

    @field_validator("classes", mode="before")
    @classmethod
    def _known_classes(cls, value: Any) -> Any:
        if isinstance(value, str) and value.lstrip().startswith("["):  # a list as JSON, e.g. of --set
            try:
                value = json.loads(value)
            except (ValueError, RecursionError):
                raise ValueError("a list of class names is no valid JSON") from None
        if isinstance(value, (list, tuple, set, frozenset)):
            if not all(isinstance(part, str) for part in value):
                raise ValueError("a list of class names holds text only")
            value = ",".join(value)
        if isinstance(value, str):
            try:
                expand_classes(value)
            except DynslamError as error:
                raise ValueError(str(error)) from None
        return value

    @property
    def idle(self) -> str:
        """Without a source nothing here has an effect."""
        return "segmentation.source is 'none'" if self.source == "none" else ""

    @property
    def unused(self) -> Mapping[str, str]:
        """What no network is asked for: exact masks are certain, and only some networks take another size of input."""
        kind = self.source.partition(":")[0]
        exact = ("confidence", "mask_threshold", "nms_iou", "network_side")
        fields = {
            "oracle": exact,
            "oracle-classes": exact,
            "recorded": ("mask_threshold", "nms_iou", "network_side"),
            "embedded": ("network_side", "classes"),  # it knows people alone
            "onnx": ("network_side",),
        }
        return dict.fromkeys(fields.get(kind, ()), f"segmentation.source is {self.source!r}")

    def class_names(self) -> frozenset[str]:
        """The COCO names of the classes held for dynamic."""
        return expand_classes(self.classes)
