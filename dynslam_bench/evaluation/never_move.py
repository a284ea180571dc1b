"""The error of a camera that never moves: the reference below which an error says nothing."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.geometry.association import associate
from dynslam_bench.geometry.trajectory import Trajectory

from .error_statistics import statistics


def never_move(ground_truth: Trajectory, stamps: ArrayLike | None = None, max_dt: float = 0.02) -> dict[str, float]:
    """Translational errors of not moving, from the ground truth alone.

    Args:
        ground_truth: True poses.
        stamps: Stamps of the input frames in seconds; only true poses associated with them count. None for all.
        max_dt: Tolerance of that association in seconds, strict.

    Returns:
        ``constant_<statistic>_m`` for the best constant position (what an SE(3) or Sim(3) alignment leaves) and
        ``first_<statistic>_m`` for staying at the first pose (what joining the origins leaves).

    Raises:
        EvaluationError: No true pose counts.
    """
    positions = ground_truth.positions
    if stamps is not None:
        index, _ = associate(ground_truth.timestamps, stamps, max_dt)
        positions = positions[index]
    if not len(positions):
        raise EvaluationError(f"none of {len(ground_truth)} true poses belongs to an input frame")
    return dict(_errors(positions.tobytes()))


@lru_cache(maxsize=8)
def _errors(where: bytes) -> dict[str, float]:
    """`never_move` of positions, once for all runs on one sequence."""
    positions = np.frombuffer(where).reshape(-1, 3)
    constant = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    first = np.linalg.norm(positions - positions[0], axis=1)
    return {
        f"{name}_{key}_{'m2' if key == 'sse' else 'm'}": value
        for name, error in (("constant", constant), ("first", first))
        for key, value in statistics(error).items()
    }
