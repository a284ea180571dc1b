"""Settings of the test of free space: which keyframes are asked, and by how much they must have seen past a point."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable

from ..tools.coherence_settings import coherent_share

_ON = {"enabled": [True]}


class FreeSpaceSettings(Settings):
    """The free-space test: a point where an earlier keyframe saw through is on something that moved there.

    Not in the paper, an extension for RGB-D; the reverse of DynaSLAM's multi-view test (block B4), which asks whether
    what a keyframe saw is gone.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    keyframes: int = tunable(8, low=2, high=20, when=_ON, meaning="how many of the latest keyframes are asked")
    threshold_m: float = tunable(
        0.15,
        low=0.05,
        high=0.6,
        scale="log",
        limits=(0.01, 5.0),
        unit="m",
        online=True,
        when=_ON,
        meaning="least depth by which the keyframe must have seen past the point",
    )
    threshold_sigma: float = tunable(
        5.0,
        low=2.0,
        high=12.0,
        limits=(0.0, 100.0),
        online=True,
        when=_ON,
        meaning="the same, in standard deviations of the sensor at that depth",
    )
    min_votes: int = tunable(
        2, low=1, high=5, online=True, when=_ON, meaning="keyframes that must have seen past the point"
    )
    min_share: float = coherent_share(_ON)
    max_age_s: float = tunable(
        10.0,
        low=2.0,
        high=60.0,
        scale="log",
        limits=(0.1, 1e4),
        unit="s",
        when=_ON,
        meaning="keyframes older than this are not asked: what they saw may have been moved for good",
    )
