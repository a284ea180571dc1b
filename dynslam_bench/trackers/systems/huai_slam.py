"""Huai et al. (Sensors 2025): missed masks bridged, split by depth, moving probability of keypoints."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import ProbabilitySettings
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    compose,
    grown_in_words,
    links_in_words,
    masks_in_words,
)

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class HuaiSlamSettings(SemanticSystemSettings):
    """Compensated masks and the moving probability."""

    segmentation: SegmentationSettings = SegmentationSettings(
        compensate=5, repair="depth", repair_depth_m=0.33, dilation_px=7
    )
    probability: ProbabilitySettings = ProbabilitySettings()
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: HuaiSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B10, depth-split masks, B8."""
    from dynslam_bench.culling.moving_probability import ProbabilityFilter

    return compose(settings, context, [ProbabilityFilter(settings.probability, settings.segmentation)], settings.flow)


SPEC = TrackerSpec(
    id="huai-slam",
    entry_point=f"{__name__}:build",
    label="Huai et al. 2025 (our back end)",
    settings=HuaiSlamSettings,
    summary="bridges missed masks, splits them by depth, accumulates a moving probability",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Huai et al., Sensors 25(6) 1696, 2025",
    assumptions=(
        masks_in_words(HuaiSlamSettings().segmentation),
        links_in_words(HuaiSlamSettings().flow),
        grown_in_words(HuaiSlamSettings().segmentation),
        "Bayes filter of 0.9; greedy association of constant-velocity boxes",
        "masks are fitted to depth at their border, within 0.33 m, and not cut by it as a whole",
    ),
)
