"""Feature extractors by id: built in or plug-ins (entry-point group ``dynslam_bench.features``)."""

from __future__ import annotations

from dynslam_bench.contracts.features import FeatureExtractor, FeatureSpec
from dynslam_bench.core.errors import PluginError
from dynslam_bench.core.plugins import Registry, build_plugin
from dynslam_bench.features.settings import FeatureSettings

__all__ = ["FEATURES", "ORB", "FeatureSpec"]

ORB = FeatureSpec(
    id="orb",
    entry_point="dynslam_bench.features.orb:OrbExtractor",
    summary="oriented FAST corners with rotated BRIEF, spread evenly over image and scales",
    license="MIT",
)

FEATURES: Registry[FeatureSpec] = Registry("features", FeatureSpec, lambda: [ORB])


def build_extractor(settings: FeatureSettings | None = None) -> FeatureExtractor:
    """Load and construct the extractor that the settings name.

    Args:
        settings: Which extractor, and its settings; None for the defaults.

    Raises:
        PluginError: No such extractor, or it cannot be built or is no `FeatureExtractor`.
        SettingsError: The extractor refuses the settings.
    """
    settings = settings or FeatureSettings()
    spec = FEATURES.get(settings.extractor)
    return build_plugin("extractor", spec, FeatureExtractor, PluginError, lambda build: build(settings))  # type: ignore[type-abstract]
