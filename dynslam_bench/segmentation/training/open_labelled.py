"""The text that names a set of labelled images, and the set."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import SegmentationError, did_you_mean

from .labelled import LabelledImages
from .labelled_files import CocoImages, YoloImages
from .labelled_sequences import RenderedFrames, SequenceFrames

FORMS = "synthetic[:OPTIONS], sequence:ID, coco:ANNOTATIONS.json[:IMAGES], yolo:DIR"


def open_labelled(text: str) -> LabelledImages:
    """The set that a text names.

    ``synthetic:instances=0-99,frames=4,seed=0,options=0.3`` is frames of rendered sequences (`RenderedFrames`),
    ``sequence:ID`` every frame of one sequence that has masks, ``coco:FILE[:IMAGES]`` a COCO annotation file,
    ``yolo:DIR`` a folder with ``images/`` and ``labels/``.

    Raises:
        SegmentationError: Another form, or the set is not there.
    """
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
