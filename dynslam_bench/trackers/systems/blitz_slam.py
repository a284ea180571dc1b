"""Blitz-SLAM (Fan et al. 2022): masks repaired by depth, then a strict epipolar test inside the boxes."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings, DepthBlockSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    UnrepairedSettings,
    composed,
    describe_masks,
    describe_matches,
)


class BlitzSlamSettings(SemanticSystemSettings):
    """Repaired masks and the epipolar test in boxes."""

    segmentation: UnrepairedSettings = UnrepairedSettings(dilation_px=0)
    depth_blocks: DepthBlockSettings = DepthBlockSettings()
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=0.5, test_outside=False)
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(
    ("depth_regions:DepthBlockFilter", "depth_blocks", "segmentation"),
    ("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation"),
)

SPEC = TrackerSpec(
    id="blitz-slam",
    entry_point=f"{__name__}:build",
    label="Blitz-SLAM (our back end)",
    settings=BlitzSlamSettings,
    summary="masks repaired by depth, epipolar test of 0.5 px inside person boxes",
    provenance="faithful-paper",
    ranked=True,
    published_as=("Blitz-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Fan et al., Blitz-SLAM, Pattern Recognition 2022",
    assumptions=(
        describe_masks(BlitzSlamSettings().segmentation),
        describe_matches(BlitzSlamSettings().flow, BlitzSlamSettings().box_epipolar.unmatched),
        "RANSAC of 1 px, 0.99 for the fundamental matrix (not stated), refitted to its inliers",
        "with fewer than 20 matches outside the boxes all kept ones count; its boxes are those of the masks",
        "which classes are movable (not stated)",
        "the residual removal of its mapping is left out: it does not touch the pose",
    ),
)
