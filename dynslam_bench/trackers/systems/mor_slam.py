"""MOR-SLAM (Yao et al. 2023): repaired masks, F from outside them, epipolar test."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_masks,
    describe_matches,
)


class MorSlamSettings(SemanticSystemSettings):
    """Repaired masks and the epipolar test."""

    segmentation: SegmentationSettings = SegmentationSettings(repair="depth", repair_depth_m=0.1, dilation_px=0)
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=1.0, outside_px=1.0, fit="kept")
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(
    ("semantic:SemanticFilter", "segmentation"), ("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation")
)

SPEC = TrackerSpec(
    id="mor-slam",
    entry_point=f"{__name__}:build",
    label="MOR-SLAM (our back end)",
    settings=MorSlamSettings,
    summary="masks repaired by closing and depth, then the epipolar test",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Yao et al., MOR-SLAM, Mathematics 11(19) 4037, 2023",
    assumptions=(
        describe_masks(MorSlamSettings().segmentation),
        describe_matches(MorSlamSettings().flow, MorSlamSettings().box_epipolar.unmatched),
        "closing of 7 px, depth step 0.1 m, epipolar threshold 1 px; RANSAC 1 px, 0.99, refitted to its inliers",
        "depth decides within 8 px of a mask's border; holes inside are filled whatever their depth",
    ),
)
