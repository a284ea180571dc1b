"""Absolute pose error (the paper's Eq. 27)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

Array = NDArray[np.float64]


def absolute_errors(estimate: Array, ground_truth: Array) -> tuple[Array, Array]:
    """Errors of aligned poses: ``E_i = Q_i^-1 S P_i`` (Eq. 27), Q the truth and ``S P`` the aligned estimate.

    Args:
        estimate: Aligned camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``.

    Returns:
        Length of the translation of E_i in metres ``[N]`` and its rotation angle in degrees ``[N]``.
    """
    translation = np.linalg.norm(estimate[:, :3, 3] - ground_truth[:, :3, 3], axis=1)
    rotation = np.rad2deg(se3.rotation_angle(se3.inverse(ground_truth) @ estimate))
    return translation, rotation
