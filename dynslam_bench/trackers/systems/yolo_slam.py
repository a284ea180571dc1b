"""YOLO-SLAM (Wu et al. 2022): depth RANSAC among the features of a person's box."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import DepthRansacSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, composed, describe_masks


class YoloSlamSettings(SemanticSystemSettings):
    """Boxes and the depth RANSAC."""

    segmentation: ObjectSettings = ObjectSettings()
    depth_ransac: DepthRansacSettings = DepthRansacSettings()


build = composed(("depth_regions:DepthRansacFilter", "depth_ransac", "segmentation"))

SPEC = TrackerSpec(
    id="yolo-slam",
    entry_point=f"{__name__}:build",
    label="YOLO-SLAM (our back end)",
    settings=YoloSlamSettings,
    summary="drops, in a person's box, the largest set of features of like depth",
    provenance="faithful-paper",
    ranked=True,
    published_as=("YOLO-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Wu et al., YOLO-SLAM, Neural Computing and Applications 2022",
    assumptions=(
        "the set grows by the nearest depth first (order not stated); 0.43 is taken in square metres",
        "features of a box without depth go with the person",
        "RANSAC draws at most 50 pairs for a probability of 0.99; a box with fewer than three depths keeps all",
        describe_masks(YoloSlamSettings().segmentation, boxes=True),
    ),
)
