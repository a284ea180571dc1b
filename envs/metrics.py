"""The metrics of an episode under a protocol."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation.evaluate import evaluate
from dynslam_bench.evaluation.frames import tracked_frames
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory


def episode_metrics(
    protocol: Protocol,
    trajectory: Trajectory,
    timestamps: NDArray[np.float64],
    ground_truth: Trajectory | None,
) -> dict[str, float]:
    """Plain floats by name; what is not defined is left out.

    Args:
        protocol: How to evaluate.
        trajectory: Poses of the tracked frames, online or final: coverage is that of what is scored.
        timestamps: Stamps in seconds of all frames that were due, tracked or not.
        ground_truth: True poses; None leaves only the coverage and the counts.

    Returns:
        ``coverage``, ``frames``, ``tracked_frames`` and the metrics of `evaluate` (``ate_rmse_m``, ...); these are
        missing if there is no ground truth or the protocol finds nothing to evaluate.
    """
    frames = len(timestamps)
    try:
        tracked = int(tracked_frames(trajectory, timestamps).sum())
    except EvaluationError:  # a final trajectory whose poses are of no frame
        tracked = 0
    counts = {
        "coverage": tracked / frames if frames else 0.0,
        "frames": float(frames),
        "tracked_frames": float(tracked),
    }
    if ground_truth is None:
        return counts
    try:
        evaluation = evaluate(trajectory, ground_truth, protocol, input_timestamps=timestamps)
    except EvaluationError:  # too little was tracked; the coverage says so
        return counts
    return counts | {name: float(value) for name, value in evaluation.metrics.items() if math.isfinite(value)}
