"""Frames and sequences: readers, catalogue, download, preprocessing and the synthetic renderer."""

from .catalogue import open_sequence, sequence_ids
from .datasets import DATASETS, DatasetSpec
from .frame import Frame, FrameMasks, MaskSource, Sequence, SequenceView
from .settings import PreprocessingSettings

__all__ = [
    "DATASETS",
    "DatasetSpec",
    "Frame",
    "FrameMasks",
    "MaskSource",
    "PreprocessingSettings",
    "Sequence",
    "SequenceView",
    "open_sequence",
    "sequence_ids",
]
