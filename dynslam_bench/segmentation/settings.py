"""Settings of the segmentation stage: where masks come from, what counts as dynamic, how masks are cleaned and when."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import field_validator

from dynslam_bench.core.errors import DynslamError, did_you_mean
from dynslam_bench.core.settings import Settings, tunable

from .classes import expand_classes

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
