"""OPF-SLAM: named in the paper without a citation; nobody knows what it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import EpipolarSettings
from dynslam_bench.trackers.systems.composition import PublishedFlowSettings, SystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class OpfSlamSettings(SystemSettings):
    """Lucas-Kanade and the epipolar test."""

    epipolar: EpipolarSettings = EpipolarSettings(
        min_parallax_px=0.0, parallax_share=0.0, homography_share=1.0, min_share=0.0, max_contradiction=1.0
    )
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: OpfSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B3 alone, without semantics and without a degeneracy guard."""
    from dynslam_bench.culling.epipolar import EpipolarFilter

    return compose(settings, context, [EpipolarFilter(settings.epipolar)], settings.flow)


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
