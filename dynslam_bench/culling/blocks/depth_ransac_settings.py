"""Settings of the depth RANSAC: what counts as like depth."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class DepthRansacSettings(Settings):
    """B6, YOLO-SLAM's depth RANSAC inside boxes."""

    variance_m2: float = tunable(
        0.43,
        low=0.01,
        high=1.0,
        scale="log",
        limits=(1e-4, 100.0),
        unit="m^2",
        online=True,
        meaning="largest depth variance of the set that is taken for the person",
    )
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.9999), meaning="sets the number of draws")
    max_draws: int = tunable(50, low=10, high=200, limits=(1, 1000), meaning="most draws a box")
