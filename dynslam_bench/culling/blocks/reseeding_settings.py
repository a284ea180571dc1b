"""Settings of re-seeding: the budget."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class ReseedingSettings(Settings):
    """B12, re-seeding (NGD-SLAM, Crowd-SLAM): how many of the features that culling left are used at most.

    The extractor has to seek more than these (`features.n_features`, 1.5 times as many in NGD-SLAM); where it does
    not, nothing is left out.
    """

    budget: int = tunable(
        1000,
        low=300,
        high=2000,
        limits=(1, 20000),
        scale="log",
        online=True,
        meaning="features used at most after culling; features.n_features must be larger",
    )
