"""The starvation guard that all filters share: culling must leave enough features for tracking."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynslam_bench.core.settings import Settings, tunable


class GuardSettings(Settings):
    """The starvation guard (SG-SLAM restores all features below 10 %)."""

    min_features: int = tunable(
        60, low=10, high=200, limits=(0, 2000), online=True,
        meaning="fewest keypoints that culling must leave: as many as the back end needs to initialise a map",
    )  # fmt: skip
    min_fraction: float = Field(
        0.05, ge=0.0, le=1.0, description="smallest share of the keypoints that culling must leave"
    )


def restore_starved(verdicts: Sequence[NDArray[np.bool_]], settings: GuardSettings) -> tuple[NDArray[np.bool_], int]:
    """Combine the filters' verdicts, undoing the latest ones while too few features remain.

    The first filter of a system is the most reliable (a semantic mask), the last the least, so the last is undone
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
