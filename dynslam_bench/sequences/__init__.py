"""Frames and sequences: readers, catalogue, download, preprocessing and the synthetic renderer."""

from dynslam_bench.contracts.sequence import Frame, FrameMasks, MaskSource, Sequence

from .catalogue import open_sequence, sequence_ids
from .published.datasets import DATASETS, DatasetSpec
from .settings import PreprocessingSettings
from .view import SequenceView

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
