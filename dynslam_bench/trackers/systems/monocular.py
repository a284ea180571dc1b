"""What systems without depth have in common."""

from __future__ import annotations

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.slam.monocular_settings import MonocularBackendSettings

from .composition import SemanticSystemSettings, SystemSettings, UnrepairedSettings

BACKEND = "monocular back end: the unit of length is the median depth of the first map, and no loops are closed"
"""What every one of them assumes."""


class MonocularSystemSettings(SystemSettings):
    """A system that never looks at depth."""

    backend: MonocularBackendSettings = MonocularBackendSettings()

    def verify(self) -> None:
        """No loops: what drifts without depth is the scale as well."""
        super().verify()
        if self.backend.loop_closing.enabled:
            raise SettingsError(
                "a monocular system closes no loops, but backend.loop_closing.enabled is true",
                "its scale drifts, and the pose graph corrects poses alone; for loops run an RGB-D system",
            )


class MonocularSemanticSettings(MonocularSystemSettings, SemanticSystemSettings):
    """One with masks, which nothing repairs: that takes depth."""

    segmentation: UnrepairedSettings = UnrepairedSettings()
