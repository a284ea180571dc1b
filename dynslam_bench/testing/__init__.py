"""Conformance checks for the authors of plug-ins.

Each ``check_*`` raises a `ConformanceError` that names what was found and its likely cause; each ``*_report`` runs the
same checks and returns the outcome of every one.
"""

from .filter import check_filter, filter_report, filter_scene
from .isolated import isolated_tracker_report
from .report import Check, ConformanceError, ConformanceReport
from .scenes import CornerSequence, hard_frames
from .segmenter import check_segmenter, segmenter_report
from .sequence import check_sequence, sequence_report
from .tracker import check_tracker, tracker_report

__all__ = [
    "Check",
    "ConformanceError",
    "ConformanceReport",
    "CornerSequence",
    "check_filter",
    "check_segmenter",
    "check_sequence",
    "check_tracker",
    "filter_report",
    "filter_scene",
    "hard_frames",
    "isolated_tracker_report",
    "segmenter_report",
    "sequence_report",
    "tracker_report",
]
