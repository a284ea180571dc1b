"""DGS-SLAM (Yan et al. 2022): clusters of high residual move, people more readily."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import ResidualSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, composed, describe_masks


class DgsSlamSettings(SemanticSystemSettings):
    """Residual clusters with a semantic prior."""

    segmentation: ObjectSettings = ObjectSettings()
    residual: ResidualSettings = ResidualSettings()


build = composed(("residual_clusters:ResidualFilter", "residual", "segmentation"))

SPEC = TrackerSpec(
    id="dgs-slam",
    entry_point=f"{__name__}:build",
    label="DGS-SLAM (Yan 2022) (our back end)",
    settings=DgsSlamSettings,
    summary="residual clusters of the warped image with a semantic prior",
    provenance="inspired",
    ranked=False,
    published_as=("DGS-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Yan et al., DGS-SLAM, Remote Sensing 14(3) 795, 2022",
    assumptions=(
        describe_masks(DgsSlamSettings().segmentation),
        "the warp: every eighth pixel of the frame goes to the nearest one of the previous image by the motion model's "
        "prediction, before the frame's own pose is known",
        "24 clusters that move with a prior of 0.9 (people) or 0.05, four times the residual where they do",
        "its classes of features with priority in tracking are left out",
        "segmentation on every frame instead of selected ones",
    ),
    remarks="not the Gaussian-splatting DGS-SLAM of Kong et al. 2024",
)
