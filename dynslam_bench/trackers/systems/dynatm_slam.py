"""DynaTM-SLAM (Zhong et al. 2024): template matching over a window inside boxes."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import TemplateSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, composed, describe_masks


class DynaTmSlamSettings(SemanticSystemSettings):
    """Boxes and template matching."""

    segmentation: ObjectSettings = ObjectSettings()
    template: TemplateSettings = TemplateSettings()


build = composed(("template_matching:TemplateFilter", "template", "segmentation"))

SPEC = TrackerSpec(
    id="dynatm-slam",
    entry_point=f"{__name__}:build",
    label="DynaTM-SLAM (our back end)",
    settings=DynaTmSlamSettings,
    summary="inside boxes, keeps what is found where the camera's motion predicts it",
    provenance="inspired",
    ranked=False,
    published_as=("DynaTM-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Zhong et al., DynaTM-SLAM, Robotics and Autonomous Systems 174, 2024",
    assumptions=(
        describe_masks(DynaTmSlamSettings().segmentation, boxes=True),
        "patch, window and correlation threshold; the patch is shifted, not warped",
        "a feature in a box without depth or history goes with the box",
        "no object constraints in bundle adjustment",
    ),
)
