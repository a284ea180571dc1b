"""ORB-SLAM2 (Mur-Artal and Tardos 2017), RGB-D: no dynamic handling beyond RANSAC and the robust kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..protocol import TrackerContext, TrackerSpec
from .composition import SystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


def build(settings: SystemSettings, context: TrackerContext) -> SlamPipeline:
    """The shared back end with no filter at all."""
    return compose(settings, context)


SPEC = TrackerSpec(
    id="orb-slam2",
    entry_point=f"{__name__}:build",
    label="ORB-SLAM2 (our back end)",
    settings=SystemSettings,
    summary="the shared RGB-D back end without dynamic handling: the reference of every ratio",
    provenance="faithful-code",
    published_as=("ORB-SLAM2",),
    license="MIT (our code; ORB-SLAM2 itself is GPL-3.0 and not used)",
    citation="Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017",
    remarks="the identity filter on our back end, not the ORB-SLAM2 program",
)
