"""Settings of the test of rigid motion: limits in the image and in depth."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class RigidMotionSettings(Settings):
    """The depth-consistency test: does the point move with the camera's rigid motion, in 3-D?

    It sees what the epipolar test cannot: motion along epipolar lines, and any motion while the camera only rotates
    or stands still. Not in the paper, an extension for RGB-D.
    """

    enabled: bool = tunable(True, meaning="whether the test runs")
    threshold_px: float = tunable(
        2.5,
        low=0.5,
        high=10.0,
        scale="log",
        limits=(0.05, 100.0),
        unit="px",
        online=True,
        when={"enabled": [True]},
        meaning="reprojection distance after the camera's motion above which a point is dynamic",
    )
    threshold_share: float = tunable(
        0.05,
        low=0.0,
        high=0.2,
        limits=(0.0, 1.0),
        when={"enabled": [True]},
        meaning="added to it, as a share of the flow that the camera's motion explains (rolling shutter)",
    )
    threshold_sigma: float = tunable(
        4.0,
        low=1.0,
        high=12.0,
        scale="log",
        limits=(0.1, 100.0),
        online=True,
        when={"enabled": [True]},
        meaning="depth difference, in standard deviations of the sensor, above which a point is dynamic",
    )
    min_share: float = tunable(
        0.4,
        low=0.0,
        high=0.8,
        limits=(0.0, 1.0),
        online=True,
        when={"enabled": [True]},
        meaning="share of the tested points around a failing one that must fail too; 0 takes every failure for motion",
    )
    memory: float = tunable(
        0.6,
        low=0.0,
        high=0.95,
        limits=(0.0, 0.99),
        when={"enabled": [True]},
        meaning="how much of a point's motion evidence is carried over from the previous frame",
    )
