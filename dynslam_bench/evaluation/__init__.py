"""Protocol, association, alignment, APE, RPE, coverage and mask quality.

A new metric is a function in `evaluate.METRICS`; its column in reports is one of
`reports.tables.leaderboard`.
"""

from dynslam_bench.evaluation.ape import static_camera
from dynslam_bench.evaluation.compare_protocols import ComparisonRow, compare_protocols
from dynslam_bench.evaluation.comparison import hold
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate, evaluate_files, pose_errors
from dynslam_bench.evaluation.hints import Hint, hints
from dynslam_bench.evaluation.masks import MaskCounts, compare_masks
from dynslam_bench.evaluation.online import OnlineError, OnlineSample
from dynslam_bench.evaluation.protocol import PROTOCOLS, Protocol, RPESpec, get_protocol

__all__ = [
    "PROTOCOLS",
    "ComparisonRow",
    "Evaluation",
    "Hint",
    "MaskCounts",
    "OnlineError",
    "OnlineSample",
    "Protocol",
    "RPESpec",
    "compare_masks",
    "compare_protocols",
    "evaluate",
    "evaluate_files",
    "get_protocol",
    "hints",
    "hold",
    "pose_errors",
    "static_camera",
]
