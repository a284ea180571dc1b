"""Huai et al. (Sensors 2025): missed masks bridged, split by depth, moving probability of keypoints."""

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


class HuaiSlamSettings(SemanticSystemSettings):
    """Compensated masks and the moving probability."""

    segmentation: SegmentationSettings = SegmentationSettings(
        compensate=5, repair="depth", repair_depth_m=0.33, dilation_px=7
    )
    probability: ProbabilitySettings = ProbabilitySettings()
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("moving_probability:ProbabilityFilter", "probability", "segmentation"))

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
        describe_masks(HuaiSlamSettings().segmentation),
        describe_links(HuaiSlamSettings().flow),
        describe_dilation(HuaiSlamSettings().segmentation),
        "Bayes filter of 0.9; greedy association of constant-velocity boxes",
        "masks are fitted to depth at their border, within 0.33 m, and not cut by it as a whole",
    ),
)
