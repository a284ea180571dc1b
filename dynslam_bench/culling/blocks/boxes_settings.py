"""Settings of box removal: how far they are enlarged."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class BoxSettings(Settings):
    """B2, box removal (Crowd-SLAM, YOLO-SLAM's detection half)."""

    margin_px: int = tunable(
        0, low=0, high=30, limits=(0, 200), unit="px", online=True, meaning="how far boxes are enlarged on every side"
    )
