"""DI-SLAM (Wei et al. 2025): boxes, epipolar test, multi-view geometry."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings, GuardSettings, MultiViewSettings
from dynslam_bench.trackers.systems.composition import (
    ObjectSettings,
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_masks,
    describe_matches,
)


class DiSlamSettings(SemanticSystemSettings):
    """The epipolar test with boxes and multi-view depth."""

    segmentation: ObjectSettings = ObjectSettings(confidence=0.1)
    guard: GuardSettings = GuardSettings(min_fraction=0.1)
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=0.2, outside_px=1.0, fit="outside previous")
    multiview: MultiViewSettings = MultiViewSettings(grow=False, min_keyframes=5)
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(
    ("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation"), ("multiview_depth:MultiViewFilter", "multiview")
)

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
        describe_masks(DiSlamSettings().segmentation, boxes=True),
        describe_matches(DiSlamSettings().flow, DiSlamSettings().box_epipolar.unmatched),
        "the published code of SG-SLAM stands in for the epipolar half; that code judges a feature that the flow loses "
        "by the place where it was lost (`unmatched = judge`), and takes distances in the previous image",
        "F is refitted to RANSAC's inliers; with fewer than 20 matches outside the boxes it is fitted to all kept ones",
        "seeds of the multi-view test are grown by 15 px",
        "multi-view depth without growing regions; where fewer than a tenth of the features remain the guard "
        "undoes it first (SG-SLAM restores all)",
    ),
)
