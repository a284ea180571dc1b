"""Why a plug-in is not available."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Ailment:
    """A plug-in that cannot be used.

    Attributes:
        kind: ``trackers``, ``segmenters``, ``features``, ``flow`` or ``sequences``.
        name: Its id, or where it should have come from.
        reason: What went wrong, or what to install.
    """

    kind: str
    name: str
    reason: str


def diagnose() -> list[Ailment]:
    """All plug-ins of all kinds that failed to load, and trackers that lack a package."""
    from dynslam_bench.features.registry import FEATURES
    from dynslam_bench.flow.registry import FLOWS
    from dynslam_bench.segmentation.registry import SEGMENTERS
    from dynslam_bench.sequences.published.datasets import DATASETS
    from dynslam_bench.trackers.registry import TRACKERS

    found = [
        Ailment(registry.kind, failure.source, failure.reason)
        for registry in (TRACKERS, SEGMENTERS, FEATURES, FLOWS, DATASETS)
        for failure in registry.failures()
    ]
    for tracker in TRACKERS.all():
        found += [Ailment("trackers", tracker.spec.id, f"needs {hint}") for hint in tracker.spec.missing()]
    return found
