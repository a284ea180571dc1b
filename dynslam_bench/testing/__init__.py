"""Conformance checks for the authors of plug-ins.

Each ``check_*`` raises a `ConformanceError` that names the fault and its likely cause; each
``*_report`` runs the same checks and returns the outcome of every one. `pytest_plugin` makes tests
of them.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.testing.filter import check_filter, filter_report, filter_scene
    from dynslam_bench.testing.images import (
        check_features,
        check_flow,
        check_segmenter,
        features_report,
        flow_report,
        segmenter_report,
    )
    from dynslam_bench.testing.isolated import isolated_tracker_report
    from dynslam_bench.testing.report import Check, ConformanceError, ConformanceReport
    from dynslam_bench.testing.scenes import CornerSequence, TurningSequence, hard_frames
    from dynslam_bench.testing.sequence import check_sequence, sequence_report
    from dynslam_bench.testing.tracker import check_tracker, tracker_report

_HOMES = {
    "check_features": "images",
    "check_filter": "filter",
    "check_flow": "images",
    "check_segmenter": "images",
    "check_sequence": "sequence",
    "check_tracker": "tracker",
    "Check": "report",
    "ConformanceError": "report",
    "ConformanceReport": "report",
    "CornerSequence": "scenes",
    "TurningSequence": "scenes",
    "features_report": "images",
    "filter_report": "filter",
    "filter_scene": "filter",
    "flow_report": "images",
    "hard_frames": "scenes",
    "isolated_tracker_report": "isolated",
    "segmenter_report": "images",
    "sequence_report": "sequence",
    "tracker_report": "tracker",
}

__all__ = [
    "Check",
    "ConformanceError",
    "ConformanceReport",
    "CornerSequence",
    "TurningSequence",
    "check_features",
    "check_filter",
    "check_flow",
    "check_segmenter",
    "check_sequence",
    "check_tracker",
    "features_report",
    "filter_report",
    "filter_scene",
    "flow_report",
    "hard_frames",
    "isolated_tracker_report",
    "segmenter_report",
    "sequence_report",
    "tracker_report",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for: pytest reads this package wherever the distribution is installed."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
