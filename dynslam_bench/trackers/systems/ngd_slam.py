"""NGD-SLAM (Zhang et al. 2024): boxes cut out by depth, propagated between detections."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.culling.baseline_settings import BoxDepthSettings
from dynslam_bench.segmentation.settings import SegmentationSettings

from ..protocol import TrackerContext, TrackerSpec
from .composition import SemanticSystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class NgdSlamSettings(SemanticSystemSettings):
    """Depth masks of boxes."""

    segmentation: SegmentationSettings = SegmentationSettings(schedule="every_nth", n=3, carry="sparse")
    box_depth: BoxDepthSettings = BoxDepthSettings()


def build(settings: NgdSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B2 cut out by depth; B10 between detections."""
    from dynslam_bench.culling.box_depth import BoxDepthFilter

    return compose(settings, context, [BoxDepthFilter(settings.box_depth, settings.segmentation)])


SPEC = TrackerSpec(
    id="ngd-slam",
    entry_point=f"{__name__}:build",
    label="NGD-SLAM (our back end)",
    settings=NgdSlamSettings,
    summary="cuts people out of their boxes by depth, detects on every third frame",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Zhang et al., NGD-SLAM, arXiv 2405.07392",
    assumptions=(
        "detection on every third frame stands in for its asynchronous detector",
        "masks are carried by our sparse flow, not by its clustering of corners",
    ),
)
