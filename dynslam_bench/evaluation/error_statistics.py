"""The seven statistics of an error series."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def statistics(error: NDArray[np.float64]) -> dict[str, float]:
    """RMSE, mean, median, population standard deviation, minimum, maximum and sum of squares of errors ``[N]``.

    ``rmse**2 == mean**2 + std**2`` holds (a published table that breaks it is wrong). Empty input gives an empty dict.
    """
    if not len(error):
        return {}
    squared = error**2
    return {
        "rmse": float(np.sqrt(squared.mean())),
        "mean": float(error.mean()),
        "median": float(np.median(error)),
        "std": float(error.std()),
        "min": float(error.min()),
        "max": float(error.max()),
        "sse": float(squared.sum()),
    }


def named(prefix: str, error: NDArray[np.float64], unit: str) -> dict[str, float]:
    """The statistics under their metric names, e.g. ``ate_rmse_m``, ..., ``ate_sse_m2``."""
    return {f"{prefix}_{name}_{unit}{'2' if name == 'sse' else ''}": value for name, value in statistics(error).items()}
