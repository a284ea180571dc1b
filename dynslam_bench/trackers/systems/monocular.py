"""What systems without depth have in common."""

from __future__ import annotations

from dynslam_bench.slam.monocular_settings import MonocularBackendSettings

from .composition import SemanticSystemSettings, SystemSettings, UnrepairedSettings

BACKEND = (
    "monocular back end: the unit of length is the median depth of the first map; "
    "no loop closing unless asked for (backend.loop_closing.enabled)"
)
"""What every one of them assumes."""


class MonocularSystemSettings(SystemSettings):
    """A system that never looks at depth."""

    backend: MonocularBackendSettings = MonocularBackendSettings()


class MonocularSemanticSettings(MonocularSystemSettings, SemanticSystemSettings):
    """One with masks, which nothing repairs: that takes depth."""

    segmentation: UnrepairedSettings = UnrepairedSettings()
