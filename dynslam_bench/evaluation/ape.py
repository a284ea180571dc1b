"""Absolute pose error (the paper's Eq. 27)."""

import math

import numpy as np
from numpy.typing import ArrayLike

from dynslam_bench.core import EvaluationError
from dynslam_bench.evaluation.comparison import Comparison, compare, hold
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry import Array, Trajectory, associate, se3


def absolute_errors(estimate: Array, ground_truth: Array) -> tuple[Array, Array]:
    """Errors of aligned poses: ``E_i = Q_i^-1 S P_i`` (Eq. 27), Q the truth and ``S P`` the aligned estimate.

    Args:
        estimate: Aligned camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``.

    Returns:
        Length of the translation of E_i in metres ``[N]`` and its rotation angle in degrees
        ``[N]``.
    """
    translation = np.linalg.norm(estimate[:, :3, 3] - ground_truth[:, :3, 3], axis=1)
    return translation, np.rad2deg(se3.rotation_angle(se3.inverse(ground_truth) @ estimate))


def absolute_metrics(comparison: Comparison) -> dict[str, float]:
    """``ate_<statistic>_m`` and ``ape_rot_<statistic>_deg``."""
    translation, rotation = absolute_errors(comparison.aligned, comparison.truth)
    return {
        **metrics_with_prefix("ate", translation, "m"),
        **metrics_with_prefix("ape_rot", rotation, "deg"),
    }


# The seven statistics of an error series.


def statistics(error: Array) -> dict[str, float]:
    """RMSE, mean, median, population standard deviation, minimum, maximum and sum of squares of errors ``[N]``.

    ``rmse**2 == mean**2 + std**2`` holds (a published table that breaks it is wrong). Empty input
    gives an empty dict.
    """
    if not len(error):
        return {}
    sse = float((error * error).sum())
    return {
        "rmse": math.sqrt(sse / len(error)),
        "mean": float(error.mean()),
        "median": float(np.median(error)),
        "std": float(error.std()),
        "min": float(error.min()),
        "max": float(error.max()),
        "sse": sse,
    }


def metrics_with_prefix(prefix: str, error: Array, unit: str) -> dict[str, float]:
    """The statistics under their metric names, e.g. ``ate_rmse_m``; the sum of squares has the unit squared."""
    return {
        f"{prefix}_{name}_{unit}{'2' if name == 'sse' else ''}": value
        for name, value in statistics(error).items()
    }


# The ATE alone, which reports compute thousands of times.


def ate_rmse_m(
    estimate: Trajectory,
    ground_truth: Trajectory,
    protocol: Protocol,
    *,
    held_at: ArrayLike | None = None,
) -> float:
    """The metric ``ate_rmse_m`` in metres, as `evaluate` takes it.

    Args:
        estimate: Estimated poses of the tracked frames.
        ground_truth: True poses.
        protocol: How to evaluate; what it makes of lost frames is left out.
        held_at: Stamps in seconds of all input frames: those that were lost stay at the last
            tracked pose. Without them lost frames take no part.

    Raises:
        EvaluationError: Fewer than two poses have ground truth, or the poses belong to no input
            frames.
    """
    comparison = compare(
        estimate if held_at is None else hold(estimate, held_at), ground_truth, protocol, held_at
    )
    left = comparison.aligned[:, :3, 3] - comparison.truth[:, :3, 3]
    return math.sqrt(float((left * left).sum()) / len(left))


# The static-camera baseline: an error above it says nothing.


def static_camera(
    ground_truth: Trajectory, stamps: ArrayLike | None = None, max_dt: float = 0.02
) -> dict[str, float]:
    """Translational errors of not moving, from the ground truth alone.

    Args:
        ground_truth: True poses.
        stamps: Stamps of the input frames in seconds; only true poses associated with them count.
            None for all.
        max_dt: Tolerance of that association in seconds, strict.

    Returns:
        ``constant_<statistic>_m`` for the best constant position (what an SE(3) or Sim(3) alignment
        leaves) and ``first_<statistic>_m`` for staying at the first pose (what joining the origins
        leaves).

    Raises:
        EvaluationError: No true pose counts.
    """
    positions = ground_truth.positions
    if stamps is not None:
        positions = positions[associate(ground_truth.timestamps, stamps, max_dt)[0]]
    if not len(positions):
        raise EvaluationError(f"none of {len(ground_truth)} true poses belongs to an input frame")
    constant = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    first = np.linalg.norm(positions - positions[0], axis=1)
    return {
        **metrics_with_prefix("constant", constant, "m"),
        **metrics_with_prefix("first", first, "m"),
    }


def static_camera_metrics(comparison: Comparison) -> dict[str, float]:
    """``static_camera_ate_rmse_m``: what a camera that does not move scores under the same alignment."""
    truth = comparison.ground_truth
    protocol = comparison.protocol
    stamps = comparison.input_timestamps
    # without the frames' stamps, or where the protocol takes a part of them: at the associated truth
    if stamps is None or protocol.thins:
        truth = truth.select(np.unique(comparison.truth_index))
        stamps = None
    return {"static_camera_ate_rmse_m": static_camera_rmse_m(truth, stamps, protocol)}


def static_camera_rmse_m(
    ground_truth: Trajectory, stamps: ArrayLike | None, protocol: Protocol
) -> float:
    """The RMSE of `static_camera` in metres that a protocol's alignment leaves."""
    fit = "first" if protocol.alignment in ("none", "origin") else "constant"
    return static_camera(ground_truth, stamps, protocol.max_dt)[f"{fit}_rmse_m"]


def false_motion_metrics(comparison: Comparison) -> dict[str, float]:
    """``false_motion_path_m`` and ``false_motion_max_m``, where the true camera stands still; else nothing.

    They are the length of the estimated path and its largest distance from its first pose.
    Alignment does not change them; where it would fit the scale, they are left out.
    """
    if comparison.protocol.finds_scale or not se3.is_static(comparison.truth):
        return {}
    positions = comparison.aligned[:, :3, 3]
    return {
        "false_motion_path_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "false_motion_max_m": float(np.linalg.norm(positions - positions[0], axis=1).max()),
    }
