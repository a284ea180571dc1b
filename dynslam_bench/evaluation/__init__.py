"""Protocol, association, alignment, APE, RPE, coverage and mask quality."""

from .compare_protocols import ComparisonRow, compare_protocols
from .evaluate import Evaluation, evaluate, evaluate_files, pose_errors
from .frames import common_frames, coverage, hold
from .hint_tracks import Hint
from .hints import hints
from .masks import MaskCounts, compare_masks
from .never_move import never_move
from .online import OnlineError, OnlineSample
from .protocol import PROTOCOLS, Protocol, RPESpec, get_protocol

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
    "common_frames",
    "compare_masks",
    "compare_protocols",
    "coverage",
    "evaluate",
    "evaluate_files",
    "get_protocol",
    "hints",
    "hold",
    "never_move",
    "pose_errors",
]
