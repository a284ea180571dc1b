"""Errors over segments of fixed length, as the KITTI odometry benchmark takes them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3

Array = NDArray[np.float64]
STEP = 10


def segment_errors(estimate: Array, ground_truth: Array, lengths_m: Sequence[float]) -> tuple[Array, Array]:
    """Drift over segments that begin at every tenth pose and end where the true path has grown by a length.

    Args:
        estimate: Associated camera-to-world poses ``[N, 4, 4]``.
        ground_truth: True poses ``[N, 4, 4]``.
        lengths_m: Lengths in metres.

    Returns:
        Translational drift in percent ``[K]`` and rotational drift in degrees a metre ``[K]``; empty where the path is
        shorter than the shortest length.
    """
    steps = np.linalg.norm(np.diff(ground_truth[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    first, last, length = [], [], []
    for start in range(0, len(travelled), STEP):
        for wanted in lengths_m:
            end = int(np.searchsorted(travelled, travelled[start] + wanted, side="right"))
            if end < len(travelled):
                first.append(start)
                last.append(end)
                length.append(wanted)
    if not first:
        return np.zeros(0), np.zeros(0)
    true = se3.inverse(ground_truth[first]) @ ground_truth[last]
    estimated = se3.inverse(estimate[first]) @ estimate[last]
    error = se3.inverse(estimated) @ true
    metres = np.array(length)
    translation = np.linalg.norm(error[:, :3, 3], axis=1) / metres * 100
    rotation = np.rad2deg(se3.rotation_angle(error)) / metres
    return translation, rotation
