"""Frames and sequences: readers, catalogue, download, preprocessing and the synthetic renderer."""

from dynslam_bench.contracts import DatasetSpec, Frame, FrameMasks, MaskSource, Sequence
from dynslam_bench.sequences.catalogue import DATASETS, open_sequence, sequence_ids
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.sequences.view import SequenceView

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
