"""The shared back end alone without depth, in the manner of monocular ORB-SLAM (Mur-Artal et al. 2015)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.trackers.systems.composition import BACKEND, MonocularSystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class UnfilteredMonocularSettings(MonocularSystemSettings):
    """Settings of a system without depth and without any filter."""

    @property
    def unused(self) -> Mapping[str, str]:
        """Where nothing is culled there is nothing to guard."""
        return {"guard": "the system has no filter"}


def build(settings: MonocularSystemSettings, context: TrackerContext) -> SlamPipeline:
    """The shared back end with no filter at all."""
    return compose(settings, context)


SPEC = TrackerSpec(
    id="orb-slam2-mono",
    entry_point=f"{__name__}:build",
    label="ORB-SLAM2 style, monocular (our back end)",
    settings=UnfilteredMonocularSettings,
    summary="the shared back end without depth and without dynamic handling",
    sensors="rgb",
    provenance="own",
    license="MIT (our code; ORB-SLAM2 itself is GPL-3.0 and not used)",
    citation=(
        "Mur-Artal, Montiel and Tardos, ORB-SLAM, IEEE T-RO 2015; Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017"
    ),
    assumptions=(
        BACKEND,
        "features spread by the cells of a grid, not by a quadtree",
        "relocalisation and matching without a bag of words",
        "mapping in step with tracking, in one thread",
        "the rolling shutter of a camera whose readout is known is undone, which ORB-SLAM2 does not do",
    ),
    remarks="the identity filter on our own back end, not the ORB-SLAM2 program",
)
