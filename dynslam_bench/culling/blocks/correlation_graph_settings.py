"""Settings of the correlation graph: window, noise and the cut."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable


class CorrelationSettings(Settings):
    """B7, Dai et al.'s point correlations on a Delaunay graph."""

    window: int = tunable(
        8, low=2, high=20, limits=(1, 60), unit="frames", meaning="largest age of the observation that is compared"
    )
    settled: int = tunable(
        4, low=1, high=10, limits=(1, 60), unit="frames", meaning="age from which a point's edges make up components"
    )
    quantile: float = tunable(
        0.95, low=0.8, high=0.999, limits=(0.5, 0.99999), online=True, meaning="chi-square quantile that cuts an edge"
    )
    pixel_sigma: float = tunable(
        1.0, low=0.3, high=3.0, scale="log", limits=(0.01, 20.0), unit="px", meaning="standard deviation of a keypoint"
    )
    largest: Literal["volume", "count"] = tunable(
        "volume", meaning="which component is static: the one with the largest volume, or with the most points"
    )
