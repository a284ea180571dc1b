"""Feature extractors by id: built in or plug-ins (entry-point group ``dynslam_bench.features``)."""

from __future__ import annotations

from dataclasses import dataclass

from dynslam_bench.core.plugins import Registry


@dataclass(frozen=True)
class FeatureSpec:
    """Announces a feature extractor; importable without torch or OpenCV.

    Attributes:
        id: Name that `FeatureSettings.extractor` takes.
        entry_point: ``"module:factory"``; called as ``factory(settings: FeatureSettings)``, returns a
            `FeatureExtractor`.
        summary: One line.
        descriptor_bytes: Length of a descriptor, packed bits compared by Hamming distance.
        license: SPDX id or remark.
    """

    id: str
    entry_point: str
    summary: str = ""
    descriptor_bytes: int = 32
    license: str = ""


ORB = FeatureSpec(
    id="orb",
    entry_point="dynslam_bench.features.orb:OrbExtractor",
    summary="oriented FAST corners with rotated BRIEF, spread evenly over image and scales",
    license="MIT",
)

FEATURES: Registry[FeatureSpec] = Registry("features", FeatureSpec, lambda: [ORB])
