"""SOF-SLAM (Cui and Ma 2019): F from static-labelled points, tested on movable things; people go."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import ClassRuleSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_dilation,
    describe_masks,
    describe_matches,
)


class SofSlamSettings(SemanticSystemSettings):
    """The class rule without its depth part."""

    class_rule: ClassRuleSettings = ClassRuleSettings(movable="chair,tv", depth_m=0.0, vote_share=1.0)
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("epipolar:ClassRuleFilter", "class_rule", "segmentation"))

SPEC = TrackerSpec(
    id="sof-slam",
    entry_point=f"{__name__}:build",
    label="SOF-SLAM (our back end)",
    settings=SofSlamSettings,
    summary="people go, movable things are tested against the epipolar line",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Cui and Ma, SOF-SLAM, IEEE Access 2019",
    assumptions=(
        describe_masks(SofSlamSettings().segmentation),
        describe_matches(SofSlamSettings().flow, SofSlamSettings().class_rule.unmatched),
        describe_dilation(SofSlamSettings().segmentation),
        "potentially dynamic are chairs and monitors (the class list is not public)",
        "RANSAC 1 px, 0.99, refitted to its inliers; distance 1 px",
    ),
)
