"""The ATE alone: what a report takes thousands of times beside the whole evaluation of each run."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.geometry.trajectory import Trajectory

from .alignment import align
from .association import match
from .frames import hold
from .prepare import compared
from .protocol import Protocol


def ate_rmse_m(
    estimate: Trajectory, ground_truth: Trajectory, protocol: Protocol, *, held_at: ArrayLike | None = None
) -> float:
    """The metric ``ate_rmse_m`` in metres, as `evaluate` takes it.

    Args:
        estimate: Estimated poses of the tracked frames.
        ground_truth: True poses.
        protocol: How to evaluate; what it makes of lost frames is left out.
        held_at: Stamps in seconds of all input frames: those that were lost stay at the last tracked pose. Without
            them lost frames take no part.

    Raises:
        EvaluationError: Fewer than two poses have ground truth, or the poses belong to no input frames.
    """
    if held_at is not None:
        estimate = hold(estimate, held_at)
    estimate, ground_truth = compared(estimate, ground_truth, protocol, held_at)
    association = match(estimate, ground_truth, protocol)
    if len(association) < 2:
        raise EvaluationError("only one pose has ground truth")
    matched, true = estimate.T_world_cam[association.estimate], ground_truth.T_world_cam[association.ground_truth]
    left = align(matched, true, protocol.alignment).apply(matched)[:, :3, 3] - true[:, :3, 3]
    return math.sqrt(float((left * left).sum()) / len(left))
