"""SEG-SLAM (Cong et al. 2024): three rules: class, depth, epipolar line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import ClassRuleSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    compose,
    grown_in_words,
    masks_in_words,
    matches_in_words,
)

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class SegSlamSettings(SemanticSystemSettings):
    """The class rule."""

    class_rule: ClassRuleSettings = ClassRuleSettings()
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: SegSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B1 and B15."""
    from dynslam_bench.culling.class_rule import ClassRuleFilter

    return compose(settings, context, [ClassRuleFilter(settings.class_rule, settings.segmentation)], settings.flow)


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
        masks_in_words(SegSlamSettings().segmentation),
        matches_in_words(SegSlamSettings().flow, SegSlamSettings().class_rule.unmatched),
        grown_in_words(SegSlamSettings().segmentation),
        "0.3 m, 1 px (RANSAC 1 px, 0.99, refitted to its inliers), 30 % of an object's points",
    ),
)
