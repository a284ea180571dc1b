"""Labelled images for training and evaluation: what they are, and the text that names a set of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SegmentationError, did_you_mean

FORMS = "synthetic[:OPTIONS], sequence:ID, coco:ANNOTATIONS.json[:IMAGES], yolo:DIR"


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and its objects.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        masks: bool ``[K, H, W]``.
        class_names: COCO name of each object.
    """

    rgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    class_names: tuple[str, ...]


class LabelledImages(Protocol):
    """A set of labelled images, decoded or rendered when asked for."""

    @property
    def name(self) -> str:
        """Says what the images are, for records."""
        ...

    @property
    def version(self) -> str:
        """Changes when the content of the images changes under the same name."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> LabelledImage: ...


def open_labelled(text: str) -> LabelledImages:
    """The set that a text names.

    ``synthetic:instances=0-99,frames=4,seed=0,options=0.3`` is frames of rendered sequences (`RenderedFrames`),
    ``sequence:ID`` every frame of one sequence that has masks, ``coco:FILE[:IMAGES]`` a COCO annotation file,
    ``yolo:DIR`` a folder with ``images/`` and ``labels/``.

    Raises:
        SegmentationError: Another form, or the set is not there.
    """
    from .labelled_files import CocoImages, YoloImages
    from .labelled_sequences import RenderedFrames, SequenceFrames

    kind, _, rest = text.partition(":")
    if kind == "synthetic":
        return RenderedFrames.parse(rest)
    if kind == "sequence" and rest:
        return SequenceFrames.open(rest)
    if kind == "coco" and rest:
        annotations, _, images = rest.partition(":")
        return CocoImages(Path(annotations), Path(images) if images else None)
    if kind == "yolo" and rest:
        return YoloImages(Path(rest))
    hint = did_you_mean(kind, ["synthetic", "sequence", "coco", "yolo"])
    raise SegmentationError(f"'{text}' names no set of labelled images; the forms are {FORMS}", hint)
