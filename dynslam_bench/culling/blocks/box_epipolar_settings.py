"""Settings of the epipolar test with boxes: one limit inside the boxes, another outside."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Settings, tunable

from ..tools.unmatched import Unmatched


class BoxEpipolarSettings(Settings):
    """B3 with different limits inside and outside the boxes (Blitz-SLAM, SGC-VSLAM, SG-SLAM)."""

    inside_px: float = tunable(
        0.5,
        low=0.1,
        high=3.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a point inside a dynamic box is dropped",
    )
    test_outside: bool = tunable(True, meaning="whether points outside all boxes are tested too")
    outside_px: float = tunable(
        1.0,
        low=0.2,
        high=10.0,
        scale="log",
        limits=(0.01, 1000.0),
        unit="px",
        online=True,
        when={"test_outside": [True]},
        meaning="epipolar distance above which a point outside all boxes is dropped",
    )
    inlier_px: float = tunable(
        1.0, low=0.1, high=3.0, scale="log", limits=(0.01, 20.0), unit="px", meaning="RANSAC's inlier threshold"
    )
    confidence: float = tunable(0.99, low=0.9, high=0.999, limits=(0.5, 0.99999), meaning="RANSAC confidence")
    fit: Literal["outside", "outside previous", "kept"] = tunable(
        "outside",
        meaning="matches that F is fitted to: outside the boxes, outside those of the previous frame (SG-SLAM), "
        "or all that earlier filters kept (those outside the masks)",
    )
    unmatched: Unmatched = tunable(
        "keep",
        meaning="a feature whose flow failed stays, goes, or is judged by the place where it was lost (SG-SLAM's code)",
    )
