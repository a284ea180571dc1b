"""CFP-SLAM (Hu et al. 2022): a static probability weighs each point instead of dropping it."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import ProbabilitySettings
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_dilation,
    describe_links,
    describe_masks,
)


class CfpSlamSettings(SemanticSystemSettings):
    """Compensated masks and the soft moving probability."""

    segmentation: SegmentationSettings = SegmentationSettings(compensate=5, repair="depth", dilation_px=7)
    probability: ProbabilitySettings = ProbabilitySettings(threshold=0.7, soft=True)
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("moving_probability:ProbabilityFilter", "probability", "segmentation"))

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
        describe_masks(CfpSlamSettings().segmentation),
        describe_links(CfpSlamSettings().flow),
        "constant-velocity boxes instead of its Kalman filter",
        "depth repair instead of DBSCAN in the box",
        describe_dilation(CfpSlamSettings().segmentation),
        "a Bayes filter of 0.9 on the masks as static probability, a feature's and not a map point's",
        "greedy association of boxes instead of the Hungarian one",
    ),
)
