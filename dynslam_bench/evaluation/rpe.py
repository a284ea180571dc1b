"""Relative pose error (the paper's Eq. 26)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.association import nearest_gap
from dynslam_bench.geometry.trajectory import Trajectory

from .pairs import closest, select_pairs
from .protocol import RPESpec

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class RelativeErrors:
    """Errors over pairs of poses.

    Attributes:
        pairs: Indices of the poses of each pair ``[P, 2]``.
        translation_m: Length of the translation of E in metres ``[P]``.
        rotation_deg: Rotation angle of E in degrees ``[P]``.
        dropped: Pairs left out because one of their poses had no ground truth.
    """

    pairs: Index
    translation_m: Array
    rotation_deg: Array
    dropped: int = 0


def tum_relative_errors(
    estimate: Trajectory, ground_truth: Trajectory, spec: RPESpec, *, scale: float = 1.0
) -> RelativeErrors:
    """RPE as TUM's ``evaluate_rpe.py`` takes it.

    Pairs are chosen on the whole estimate. Each pose is compared with the true pose nearest in time; a pair takes part
    if both lie within twice the median interval of the ground truth (not within the tolerance of the ATE). With
    ``A = P_i^-1 P_j`` estimated and ``B = Q_i^-1 Q_j`` true the error is ``E = A B^-1``; its rotation angle equals
    that of the paper's ``E = B^-1 A`` (Eq. 26), its translation differs by a rotation of its parts.

    Args:
        estimate: Estimated camera-to-world poses; need not be aligned.
        ground_truth: True poses.
        spec: A ``tum-fixed`` or ``tum-random`` selection.
        scale: Factor applied to the estimate's relative translations.
    """
    pairs = select_pairs(estimate.timestamps, estimate.T_world_cam, spec)
    nearest = closest(ground_truth.timestamps, estimate.timestamps)
    covered = _covered(estimate.timestamps.tobytes(), ground_truth.timestamps.tobytes())
    kept = pairs[covered[pairs[:, 0]] & covered[pairs[:, 1]]]
    estimated = _relative(estimate.T_world_cam, kept)
    estimated[:, :3, 3] *= scale
    back = _true_steps_back(ground_truth.T_world_cam.tobytes(), nearest[kept].tobytes())
    return _errors(kept, estimated @ back, dropped=len(pairs) - len(kept))


@lru_cache(maxsize=8)
def _true_steps_back(ground_truth: bytes, pairs: bytes) -> Array:
    """Inverse steps ``[P, 4, 4]`` between true poses, once for all runs on one sequence; nobody may write into it."""
    steps = _relative(np.frombuffer(ground_truth).reshape(-1, 4, 4), np.frombuffer(pairs, np.intp).reshape(-1, 2))
    back = se3.inverse(steps)
    back.flags.writeable = False
    return back


@lru_cache(maxsize=256)
def _covered(estimate: bytes, ground_truth: bytes) -> NDArray[np.bool_]:
    """Which stamps have a true pose near enough; once for equal stamps, so nobody may write into it."""
    truth = np.frombuffer(ground_truth)
    intervals = np.diff(truth)
    tolerance = 2 * float(np.median(intervals)) if len(intervals) else 0.0
    covered: NDArray[np.bool_] = np.asarray(nearest_gap(np.frombuffer(estimate), truth) <= tolerance)
    covered.flags.writeable = False
    return covered


def evo_relative_errors(stamps: Array, estimate: Array, ground_truth: Array, spec: RPESpec) -> RelativeErrors:
    """RPE as evo takes it: ``E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` (Eq. 26) over pairs of associated poses.

    Args:
        stamps: Seconds ``[N]``, of the estimate.
        estimate: Associated (and aligned) camera-to-world poses ``[N, 4, 4]``; the pairs are chosen on them.
        ground_truth: Their counterparts ``[N, 4, 4]``.
        spec: A ``consecutive`` or ``all`` selection.
    """
    pairs = select_pairs(stamps, estimate, spec)
    return _errors(pairs, se3.inverse(_relative(ground_truth, pairs)) @ _relative(estimate, pairs))


def _relative(poses: Array, pairs: Index) -> Array:
    return np.asarray(se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]])


def _errors(pairs: Index, error: Array, dropped: int = 0) -> RelativeErrors:
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    rotation = np.rad2deg(se3.rotation_angle(error)) if len(error) else np.zeros(0)
    return RelativeErrors(pairs, translation, rotation, dropped)
