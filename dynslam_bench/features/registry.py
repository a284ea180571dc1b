"""Feature extractors by id: built in or plug-ins (entry-point group ``dynslam_bench.features``)."""

from __future__ import annotations

from dynslam_bench.contracts.features import FeatureExtractor, FeatureSpec
from dynslam_bench.core.errors import DynslamError, PluginError
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.features.settings import FeatureSettings

__all__ = ["FEATURES", "ORB", "FeatureSpec"]

ORB = FeatureSpec(
    id="orb",
    entry_point="dynslam_bench.features.orb:OrbExtractor",
    summary="oriented FAST corners with rotated BRIEF, spread evenly over image and scales",
    license="MIT",
)

FEATURES: Registry[FeatureSpec] = Registry("features", FeatureSpec, lambda: [ORB])


# From settings to a feature extractor.


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
    factory = load_object(spec.entry_point)
    try:
        extractor = factory(settings)
    except DynslamError:
        raise
    except Exception as error:
        raise PluginError(f"extractor '{spec.id}' cannot be built: {type(error).__name__}: {error}") from error
    if not isinstance(extractor, FeatureExtractor):
        raise PluginError(f"'{spec.entry_point}' gave a {type(extractor).__name__} without extract()")
    return extractor
