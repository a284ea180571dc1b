"""NGD-SLAM (Zhang et al. 2024): boxes cut out by depth, propagated between detections."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxDepthSettings, ReseedingSettings
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, composed, describe_masks


class NgdSlamSettings(SemanticSystemSettings):
    """Depth masks of boxes, and half as many features again to choose the static ones from."""

    features: FeatureSettings = FeatureSettings(n_features=1500)
    segmentation: ObjectSettings = ObjectSettings(schedule="every_nth", n=3, carry="sparse")
    box_depth: BoxDepthSettings = BoxDepthSettings()
    reseeding: ReseedingSettings = ReseedingSettings(budget=1000)


build = composed(
    ("depth_regions:BoxDepthFilter", "box_depth", "segmentation"),
    ("reseeding:ReseedingFilter", "reseeding", "features"),
)

SPEC = TrackerSpec(
    id="ngd-slam",
    entry_point=f"{__name__}:build",
    label="NGD-SLAM (our back end)",
    settings=NgdSlamSettings,
    summary="cuts people out of their boxes by depth, detects on every third frame",
    provenance="inspired",
    ranked=False,
    published_as=("NGD-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Zhang et al., NGD-SLAM, arXiv 2405.07392",
    assumptions=(
        describe_masks(NgdSlamSettings().segmentation, boxes=True),
        "detection on every third frame stands in for its asynchronous detector",
        "masks are carried by our sparse flow, not by its clustering of corners",
        "its tracking of static corners with a PnP of its own between keyframes is left out",
        "a person's depth is the median in the box alone (its code adds a second order statistic)",
        "at most 1,000 of its 1,500 features are used, so that others have as many",
    ),
)
