"""Settings of the moving vote: corners, F and the vote."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class MovingVoteSettings(Settings):
    """B3 and B11 as in DS-SLAM's code: one vote for all people."""

    corners: int = tunable(1000, low=200, high=2000, limits=(8, 10000), meaning="Harris corners that are tracked")
    sad_limit: int = tunable(2120, low=500, high=5000, limits=(1, 10**6), meaning="largest 3x3 sum of differences")
    inlier_px: float = tunable(
        0.1, low=0.05, high=1.0, scale="log", limits=(0.01, 10.0), unit="px", meaning="RANSAC's inlier threshold"
    )
    threshold_px: float = tunable(
        1.0,
        low=0.3,
        high=3.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a corner moves",
    )
    radius_px: int = tunable(
        15,
        low=0,
        high=30,
        limits=(0, 200),
        unit="px",
        meaning="a moving corner this near to a person makes people move",
    )
    min_votes: int = tunable(1, low=1, high=20, limits=(1, 1000), online=True, meaning="moving corners that it takes")
