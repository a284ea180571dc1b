"""Class names and numbers of the data sets that segmentation networks are trained on, and named sets of them."""

from __future__ import annotations

from collections.abc import Iterable

from dynslam_bench.core.errors import SegmentationError, did_you_mean

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
