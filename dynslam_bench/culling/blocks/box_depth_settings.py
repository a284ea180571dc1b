"""Settings of the masks cut out of boxes by depth: how a person is cut out of a box."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class BoxDepthSettings(Settings):
    """NGD-SLAM's masks: a person is what lies at the depth of the middle of the box."""

    depth_m: float = tunable(
        0.33, low=0.1, high=1.0, limits=(0.01, 10.0), unit="m", online=True, meaning="half the depth range of a person"
    )
    margin_px: int = tunable(30, low=0, high=60, limits=(0, 200), unit="px", meaning="how far the box is enlarged")
    core: float = tunable(
        0.7, low=0.3, high=1.0, limits=(0.1, 1.0), meaning="share of the box, around its middle, that gives the depth"
    )
    min_valid: float = tunable(
        0.7, low=0.0, high=0.95, limits=(0.0, 1.0), meaning="share of the core that must have depth"
    )
    max_cover: float = tunable(
        0.8, low=0.3, high=1.0, limits=(0.0, 1.0), meaning="a mask that covers more of the image is ignored"
    )
    dilation_px: int = tunable(3, low=0, high=20, limits=(0, 100), unit="px", meaning="radius by which masks are grown")
