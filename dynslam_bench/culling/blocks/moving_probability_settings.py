"""Settings of the moving probability: how evidence is accumulated."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable


class ProbabilitySettings(Settings):
    """B8, moving probability of tracked features (RDS-SLAM's Bayes filter, Detect-SLAM's moving average)."""

    rule: Literal["bayes", "average"] = tunable("bayes", meaning="how evidence is accumulated")
    hit: float = tunable(
        0.9,
        low=0.6,
        high=0.99,
        limits=(0.5, 0.999),
        when={"rule": ["bayes"]},
        meaning="probability that a moving point lies on a mask, and a static one off it",
    )
    rate: float = tunable(
        0.3, low=0.05, high=0.9, limits=(0.01, 1.0), when={"rule": ["average"]}, meaning="weight of the new observation"
    )
    threshold: float = tunable(
        0.5, low=0.3, high=0.9, limits=(0.0, 1.0), online=True, meaning="probability above which a point is dropped"
    )
    soft: bool = tunable(False, meaning="weigh the kept points by their static probability (CFP-SLAM)")
    link_px: float = tunable(
        2.5,
        low=1.0,
        high=6.0,
        limits=(0.1, 50.0),
        unit="px",
        meaning="how near its flow must end to an earlier feature",
    )
    expand_px: float = tunable(
        0.0,
        low=0.0,
        high=60.0,
        limits=(0.0, 500.0),
        unit="px",
        meaning="reach of matching point expansion: new features take after near ones that are sure; 0 = off",
    )
