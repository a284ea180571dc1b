"""Settings of the class rule: what is movable, and the three rules' limits."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable

from ..tools.movable import MOVABLE, MovableClasses
from ..tools.unmatched import Unmatched


class ClassRuleSettings(Settings):
    """B15, three rules: class, depth, epipolar line (SEG-SLAM; constants are our assumption)."""

    movable: MovableClasses = MOVABLE
    """Classes that move only at times: comma-separated COCO names."""
    threshold_px: float = tunable(
        1.0,
        low=0.2,
        high=5.0,
        scale="log",
        limits=(0.01, 50.0),
        unit="px",
        online=True,
        meaning="epipolar distance above which a point on a movable object is dropped",
    )
    depth_m: float = tunable(
        0.3,
        low=0.0,
        high=1.0,
        limits=(0.0, 10.0),
        unit="m",
        online=True,
        meaning="a point this near to the depth of a moving object goes with it",
    )
    vote_share: float = tunable(
        0.3, low=0.05, high=1.0, limits=(0.0, 1.0), meaning="share of an object's points that must fail"
    )
    unmatched: Unmatched = tunable(
        "keep", meaning="a feature on a movable object whose flow failed stays, goes, or is judged by where it was lost"
    )
