"""Classes that are not dynamic by themselves: things that people move about."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.segmentation.classes import expand_classes

MOVABLE = (
    "backpack,bed,book,bottle,bowl,cell phone,chair,couch,cup,dining table,handbag,keyboard,laptop,mouse,potted plant,"
    "sports ball,suitcase,teddy bear,tv,umbrella"
)
"""COCO classes that people move about (our assumption; no paper gives a list)."""


def _known_classes(value: str) -> str:
    try:
        expand_classes(value)
    except DynslamError as error:
        raise ValueError(str(error)) from None
    return value


MovableClasses = Annotated[str, AfterValidator(_known_classes)]
"""Comma-separated COCO names or presets, validated."""
