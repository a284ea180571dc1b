"""OPF-SLAM: named in the paper without a citation; nobody knows what it is."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import EpipolarSettings
from dynslam_bench.trackers.systems.composition import PublishedFlowSettings, SystemSettings, composed


class OpfSlamSettings(SystemSettings):
    """Lucas-Kanade and the epipolar test."""

    epipolar: EpipolarSettings = EpipolarSettings(
        min_parallax_px=0.0, parallax_share=0.0, homography_share=1.0, min_share=0.0, max_contradiction=1.0
    )
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(("epipolar:EpipolarFilter", "epipolar"))

SPEC = TrackerSpec(
    id="opf-slam",
    entry_point=f"{__name__}:build",
    label="OPF-SLAM (our back end)",
    settings=OpfSlamSettings,
    summary="Lucas-Kanade flow, fundamental matrix, epipolar test; no semantics",
    provenance="assumed",
    ranked=False,
    published_as=("OPF-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="unknown: the paper gives no reference",
    assumptions=("everything: the name alone is known",),
    remarks="perhaps OFM-SLAM or the optical-flow system of Chen et al. 2022 is meant",
)
