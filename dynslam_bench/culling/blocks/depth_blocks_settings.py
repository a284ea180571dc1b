"""Settings of the depth blocks: where a block ends and when all of it goes."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable

from ..tools.movable import MOVABLE, MovableClasses


class DepthBlockSettings(Settings):
    """B9 as in Blitz-SLAM: masks completed by blocks of continuous depth."""

    edge_m: float = tunable(
        0.1,
        low=0.03,
        high=0.5,
        scale="log",
        limits=(0.001, 10.0),
        unit="m",
        online=True,
        meaning="depth range in a 2x2 block above which it is an edge between blocks (tau 1 and 2)",
    )
    min_share: float = tunable(
        0.25,
        low=0.05,
        high=0.9,
        limits=(0.0, 1.0),
        online=True,
        meaning="share of a block that must lie on the mask for all of it to be taken (tau 3)",
    )
    max_depth_m: float = tunable(
        6.0, low=3.0, high=10.0, limits=(0.1, 1000.0), unit="m", meaning="depth beyond this is not used"
    )
    movable: MovableClasses = MOVABLE
    """Classes that are dynamic while a person touches them: comma-separated COCO names."""
