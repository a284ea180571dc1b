"""A second opinion for points that contradict their neighbours, e.g. one period off on a repetitive texture."""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.compiled import Scalar, kernel

from ..kernels.arrays import Flags, Floats


@kernel
def dissenting_labels(
    predictions: Floats, labels: Floats, tolerance: Scalar, alternative: Floats, dissents: Flags
) -> None:
    """Find the points about which the neighbours agree among themselves, but not with the point's own label.

    Args:
        predictions: float32 ``[N, K, 4]``, the neighbours' labels as seen from each point; NaN means none.
        labels: float32 ``[N, 4]``, the points' own labels.
        tolerance: Displacements this close agree, pixels.
        alternative: float32 ``[N, 4]``, filled with the prediction on which most neighbours agree.
        dissents: bool ``[N]``, filled: the prediction has more support than the point's own label.
    """
    limit = tolerance * tolerance
    for i in range(len(labels)):
        dissents[i] = False
        own, most, choice = 0, 1, -1
        for k in range(predictions.shape[1]):
            u, v = predictions[i, k, 0], predictions[i, k, 1]
            if not np.isfinite(u + v):
                continue
            du, dv = u - labels[i, 0], v - labels[i, 1]
            if du * du + dv * dv < limit:
                own += 1
            support = 0
            for other in range(predictions.shape[1]):
                du, dv = predictions[i, other, 0] - u, predictions[i, other, 1] - v
                if du * du + dv * dv < limit:
                    support += 1
            if support > most:
                most, choice = support, k
        if choice >= 0 and most > own:
            du, dv = predictions[i, choice, 0] - labels[i, 0], predictions[i, choice, 1] - labels[i, 1]
            if du * du + dv * dv >= limit:
                dissents[i] = True
                for j in range(4):
                    alternative[i, j] = predictions[i, choice, j]
