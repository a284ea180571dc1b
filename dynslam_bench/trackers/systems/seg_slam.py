"""SEG-SLAM (Cong et al. 2024): three rules: class, depth, epipolar line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.culling.baseline_settings import ClassRuleSettings
from dynslam_bench.flow.settings import FlowSettings

from ..protocol import TrackerContext, TrackerSpec
from .composition import SemanticSystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class SegSlamSettings(SemanticSystemSettings):
    """The class rule."""

    class_rule: ClassRuleSettings = ClassRuleSettings()
    flow: FlowSettings = FlowSettings(method="lucas-kanade")


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
    assumptions=("0.3 m, 1 px, 30 % of an object's points",),
)
