"""DI-SLAM (Wei et al. 2025): boxes, epipolar test, multi-view geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.guard import GuardSettings
from dynslam_bench.culling.settings import BoxEpipolarSettings, MultiViewSettings
from dynslam_bench.trackers.systems.composition import (
    ObjectSettings,
    PublishedFlowSettings,
    SemanticSystemSettings,
    compose,
    masks_in_words,
    matches_in_words,
)

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class DiSlamSettings(SemanticSystemSettings):
    """The epipolar test with boxes and multi-view depth."""

    segmentation: ObjectSettings = ObjectSettings(confidence=0.1)
    guard: GuardSettings = GuardSettings(min_fraction=0.1)
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=0.2, outside_px=1.0, fit="outside previous")
    multiview: MultiViewSettings = MultiViewSettings(grow=False, min_keyframes=5)
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: DiSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B3 stricter inside boxes, then B4."""
    from dynslam_bench.culling.box_epipolar import BoxEpipolarFilter
    from dynslam_bench.culling.multiview_depth import MultiViewFilter

    filters = [
        BoxEpipolarFilter(settings.box_epipolar, settings.segmentation),
        MultiViewFilter(settings.multiview),
    ]
    return compose(settings, context, filters, settings.flow)


SPEC = TrackerSpec(
    id="di-slam",
    entry_point=f"{__name__}:build",
    label="DI-SLAM (our back end)",
    settings=DiSlamSettings,
    summary="epipolar test of 0.2 px inside and 1 px outside boxes, then multi-view depth",
    provenance="inspired",
    ranked=False,
    published_as=("DI-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Wei et al., DI-SLAM, Applied Sciences 15(8) 4446, 2025",
    assumptions=(
        masks_in_words(DiSlamSettings().segmentation, boxes=True),
        matches_in_words(DiSlamSettings().flow, DiSlamSettings().box_epipolar.unmatched),
        "the published code of SG-SLAM stands in for the epipolar half; that code judges a feature that the flow loses "
        "by the place where it was lost (`unmatched = judge`), and takes distances in the previous image",
        "F is refitted to RANSAC's inliers; with fewer than 20 matches outside the boxes it is fitted to all kept ones",
        "seeds of the multi-view test are grown by 15 px",
        "multi-view depth without growing regions; where fewer than a tenth of the features remain the guard "
        "undoes it first (SG-SLAM restores all)",
    ),
)
