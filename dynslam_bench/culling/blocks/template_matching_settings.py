"""Settings of template matching: patch, window and the least correlation."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings, tunable


class TemplateSettings(Settings):
    """B13, template matching over a sliding window inside boxes (DynaTM-SLAM; constants are our assumption)."""

    patch_px: int = tunable(11, low=5, high=21, limits=(3, 41), unit="px", meaning="side of the square patch")
    window: int = tunable(5, low=2, high=10, limits=(1, 30), unit="frames", meaning="earlier frames that are searched")
    zncc: float = tunable(
        0.8,
        low=0.5,
        high=0.95,
        limits=(-1.0, 1.0),
        online=True,
        meaning="median correlation below which a point is dropped",
    )
