"""The starvation guard that all filters share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .settings import GuardSettings


def restore_starved(verdicts: Sequence[NDArray[np.bool_]], settings: GuardSettings) -> tuple[NDArray[np.bool_], int]:
    """Combine the filters' verdicts, undoing the latest ones while too few features remain.

    The first filter of a system is its surest (a semantic mask), the last its most speculative, so the last is undone
    first. With every verdict undone all features are kept.

    Args:
        verdicts: bool ``[N]`` a filter, True = keep, in the order of application.
        settings: How many features must remain.

    Returns:
        The combined keep mask ``[N]`` and how many verdicts were undone.
    """
    total = len(verdicts[0]) if verdicts else 0
    needed = min(total, max(settings.min_features, int(np.ceil(settings.min_fraction * total))))
    for undone in range(len(verdicts)):
        keep = np.logical_and.reduce(verdicts[: len(verdicts) - undone])
        if np.count_nonzero(keep) >= needed:
            return keep, undone
    return np.ones(total, dtype=bool), len(verdicts)
