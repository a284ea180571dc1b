"""Settings of the residual clusters: clusters, residual and prior."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class ResidualSettings(Settings):
    """B14, residuals of image clusters with a semantic prior (DGS-SLAM of Yan 2022; constants are our assumption)."""

    clusters: int = tunable(24, low=8, high=48, limits=(2, 200), meaning="clusters of image position and depth")
    depth_weight: float = tunable(
        2.0,
        low=0.2,
        high=10.0,
        scale="log",
        limits=(0.0, 100.0),
        meaning="weight of the relative depth residual beside the intensity residual",
    )
    prior: float = tunable(
        0.9, low=0.5, high=0.99, limits=(0.01, 0.999), meaning="prior probability that a person's cluster moves"
    )
    threshold: float = tunable(
        0.5, low=0.2, high=0.9, limits=(0.0, 1.0), online=True, meaning="posterior above which a cluster is dynamic"
    )
