"""SGC-VSLAM (Yang et al. 2020): F from the points outside the boxes, the test for all."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings
from dynslam_bench.trackers.systems.composition import (
    ObjectSettings,
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_masks,
    describe_matches,
)


class SgcSlamSettings(SemanticSystemSettings):
    """The epipolar test with boxes."""

    segmentation: ObjectSettings = ObjectSettings()
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=1.0, outside_px=1.0)
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation"))

SPEC = TrackerSpec(
    id="sgc-slam",
    entry_point=f"{__name__}:build",
    label="SGC-VSLAM (our back end)",
    settings=SgcSlamSettings,
    summary="epipolar test of all points with F from outside the person boxes",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Yang et al., SGC-VSLAM, Sensors 2020",
    assumptions=(
        describe_masks(SgcSlamSettings().segmentation, boxes=True),
        describe_matches(SgcSlamSettings().flow, SgcSlamSettings().box_epipolar.unmatched),
        "RANSAC 1 px, 0.99, refitted to its inliers; distance 1 px",
        "with fewer than 20 matches outside the boxes F is fitted to all kept ones",
        "its improved quadtree of features is left out",
    ),
)
