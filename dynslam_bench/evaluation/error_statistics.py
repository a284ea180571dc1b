"""The seven statistics of an error series."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def statistics(error: NDArray[np.float64]) -> dict[str, float]:
    """RMSE, mean, median, population standard deviation, minimum, maximum and sum of squares of errors ``[N]``.

    ``rmse**2 == mean**2 + std**2`` holds (a published table that breaks it is wrong). Empty input gives an empty dict.
    """
    n = len(error)
    if not n:
        return {}
    ordered = np.sort(error)  # one sort for three of them: reports take thousands of these
    mean, sse = float(error.sum()) / n, float((error * error).sum())
    off = error - mean
    return {
        "rmse": math.sqrt(sse / n),
        "mean": mean,
        "median": 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2]),
        "std": math.sqrt(float((off * off).sum()) / n),
        "min": float(ordered[0]),
        "max": float(ordered[-1]),
        "sse": sse,
    }


def named(prefix: str, error: NDArray[np.float64], unit: str) -> dict[str, float]:
    """The statistics under their metric names, e.g. ``ate_rmse_m``, ..., ``ate_sse_m2``."""
    return {f"{prefix}_{name}_{unit}{'2' if name == 'sse' else ''}": value for name, value in statistics(error).items()}
