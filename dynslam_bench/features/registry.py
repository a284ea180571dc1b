"""Feature extractors by id: built in or plug-ins (entry-point group ``dynslam_bench.features``)."""

from __future__ import annotations

from dynslam_bench.contracts.features import FeatureSpec
from dynslam_bench.core.plugins import Registry

__all__ = ["FEATURES", "ORB", "FeatureSpec"]

ORB = FeatureSpec(
    id="orb",
    entry_point="dynslam_bench.features.orb:OrbExtractor",
    summary="oriented FAST corners with rotated BRIEF, spread evenly over image and scales",
    license="MIT",
)

FEATURES: Registry[FeatureSpec] = Registry("features", FeatureSpec, lambda: [ORB])
