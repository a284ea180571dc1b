"""SOF-SLAM (Cui and Ma 2019): F from static-labelled points, tested on movable things; people go."""

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


class SofSlamSettings(SemanticSystemSettings):
    """The class rule without its depth part."""

    class_rule: ClassRuleSettings = ClassRuleSettings(movable="chair,tv", depth_m=0.0, vote_share=1.0)
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: SofSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B1 on people, B3 on movable things with F from the rest."""
    from dynslam_bench.culling.class_rule import ClassRuleFilter

    return compose(settings, context, [ClassRuleFilter(settings.class_rule, settings.segmentation)], settings.flow)


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
        masks_in_words(SofSlamSettings().segmentation),
        matches_in_words(SofSlamSettings().flow, SofSlamSettings().class_rule.unmatched),
        grown_in_words(SofSlamSettings().segmentation),
        "potentially dynamic are chairs and monitors (the class list is not public)",
        "RANSAC 1 px, 0.99, refitted to its inliers; distance 1 px",
    ),
)
