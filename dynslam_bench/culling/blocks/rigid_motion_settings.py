"""Settings of the test of rigid motion: limits in the image and in depth."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable

from ..tools.coherence_settings import coherent_share

_ON = {"enabled": [True]}


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
        when=_ON,
        meaning="reprojection distance after the camera's motion above which a point is dynamic",
    )
    threshold_share: float = tunable(
        0.05,
        low=0.0,
        high=0.2,
        limits=(0.0, 1.0),
        when=_ON,
        meaning="added to it, as a share of the flow that the camera's motion explains (rolling shutter)",
    )
    threshold_sigma: float = tunable(
        4.0,
        low=1.0,
        high=12.0,
        scale="log",
        limits=(0.1, 100.0),
        online=True,
        when=_ON,
        meaning="depth difference, in standard deviations of the sensor, above which a point is dynamic",
    )
    min_share: float = coherent_share(_ON)
    memory: float = tunable(
        0.6,
        low=0.0,
        high=0.95,
        limits=(0.0, 0.99),
        when=_ON,
        meaning="how much of a point's motion evidence is carried over from the previous frame",
    )
