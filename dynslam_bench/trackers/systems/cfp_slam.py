"""CFP-SLAM (Hu et al. 2022): a static probability weighs each point instead of dropping it."""

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


class CfpSlamSettings(SemanticSystemSettings):
    """Compensated masks and the soft moving probability."""

    segmentation: SegmentationSettings = SegmentationSettings(compensate=5, repair="depth", dilation_px=7)
    probability: ProbabilitySettings = ProbabilitySettings(threshold=0.7, soft=True)
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: CfpSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B10, B8 as a weight of the optimiser."""
    from dynslam_bench.culling.moving_probability import ProbabilityFilter

    return compose(settings, context, [ProbabilityFilter(settings.probability, settings.segmentation)], settings.flow)


SPEC = TrackerSpec(
    id="cfp-slam",
    entry_point=f"{__name__}:build",
    label="CFP-SLAM (our back end)",
    settings=CfpSlamSettings,
    summary="static probability as weight of the pose optimiser, points below 0.3 dropped",
    provenance="inspired",
    ranked=False,
    published_as=("CFP-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Hu et al., CFP-SLAM, IROS 2022",
    assumptions=(
        masks_in_words(CfpSlamSettings().segmentation),
        links_in_words(CfpSlamSettings().flow),
        "constant-velocity boxes instead of its Kalman filter",
        "depth repair instead of DBSCAN in the box",
        grown_in_words(CfpSlamSettings().segmentation),
        "a Bayes filter of 0.9 on the masks as static probability, a feature's and not a map point's",
        "greedy association of boxes instead of the Hungarian one",
    ),
)
