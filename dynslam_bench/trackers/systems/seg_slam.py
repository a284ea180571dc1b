"""SEG-SLAM (Cong et al. 2024): three rules: class, depth, epipolar line."""

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


class SegSlamSettings(SemanticSystemSettings):
    """The class rule."""

    class_rule: ClassRuleSettings = ClassRuleSettings()
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("epipolar:ClassRuleFilter", "class_rule", "segmentation"))

SPEC = TrackerSpec(
    id="seg-slam",
    entry_point=f"{__name__}:build",
    label="SEG-SLAM (our back end)",
    settings=SegSlamSettings,
    summary="people go; movable things by epipolar line and depth",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Cong et al., SEG-SLAM, Sensors 24(7) 2102, 2024",
    assumptions=(
        describe_masks(SegSlamSettings().segmentation),
        describe_matches(SegSlamSettings().flow, SegSlamSettings().class_rule.unmatched),
        describe_dilation(SegSlamSettings().segmentation),
        "0.3 m, 1 px (RANSAC 1 px, 0.99, refitted to its inliers), 30 % of an object's points",
    ),
)
