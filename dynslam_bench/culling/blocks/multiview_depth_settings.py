"""Settings of multi-view depth: which keyframes are asked, and what counts as hidden."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable


class MultiViewSettings(Settings):
    """B4 and B5, DynaSLAM's multi-view geometry with region growing."""

    tau_m: float = tunable(
        0.4,
        low=0.1,
        high=1.0,
        scale="log",
        limits=(0.01, 10.0),
        unit="m",
        online=True,
        meaning="depth by which a keyframe's point must be hidden (paper 0.4, code 0.6)",
    )
    order: Literal["nearest", "farthest"] = tunable(
        "nearest", meaning="which keyframes are asked (the paper means nearest, the code takes farthest)"
    )
    references: int = tunable(5, low=1, high=10, limits=(1, 20), meaning="keyframes that are asked")
    min_keyframes: int = tunable(
        1,
        low=1,
        high=10,
        limits=(1, 20),
        meaning="keyframes before the test is active (not stated in the paper; the code waits for 5)",
    )
    max_parallax_deg: float = tunable(
        30.0, low=10.0, high=60.0, limits=(1.0, 180.0), unit="deg", meaning="largest angle between the two views"
    )
    max_variance: float = tunable(
        0.001,
        low=1e-4,
        high=0.1,
        scale="log",
        limits=(0.0, 100.0),
        unit="m^2",
        meaning="largest variance of the depth around the point (rejects depth edges)",
    )
    grow: bool = tunable(True, meaning="grow regions of equal depth from the points that were found (B5)")
    grow_m: float = tunable(
        0.2,
        low=0.05,
        high=0.5,
        limits=(0.0, 5.0),
        unit="m",
        when={"grow": [True]},
        meaning="largest depth difference to the seed within a region",
    )
    dilation_px: int = tunable(
        15, low=0, high=30, limits=(0, 100), unit="px", meaning="radius by which the result is grown"
    )
    border_px: int = tunable(
        0,
        low=0,
        high=30,
        limits=(0, 100),
        unit="px",
        meaning="further radius within which features at the result's border are dropped (15 in the code)",
    )
