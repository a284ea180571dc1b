"""The shared back end alone, in the manner of ORB-SLAM2 (Mur-Artal and Tardos 2017), RGB-D.

No dynamic handling beyond the robust kernel and the chi-square tests of the pose optimiser.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.trackers.systems.composition import SystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class UnfilteredSettings(SystemSettings):
    """Settings of a system without any filter."""

    @property
    def unused(self) -> Mapping[str, str]:
        """Where nothing is culled there is nothing to guard."""
        return {"guard": "the system has no filter"}


def build(settings: SystemSettings, context: TrackerContext) -> SlamPipeline:
    """The shared back end with no filter at all."""
    return compose(settings, context)


SPEC = TrackerSpec(
    id="orb-slam2",
    entry_point=f"{__name__}:build",
    label="ORB-SLAM2 style (our back end)",
    settings=UnfilteredSettings,
    summary="the shared RGB-D back end without dynamic handling: the reference of every ratio",
    provenance="own",
    published_as=("ORB-SLAM2",),
    license="MIT (our code; ORB-SLAM2 itself is GPL-3.0 and not used)",
    citation="Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017",
    assumptions=(
        "no loop closing unless asked for (backend.loop_closing.enabled), and no global bundle adjustment",
        "features spread by the cells of a grid, not by a quadtree",
        "relocalisation and matching without a bag of words",
        "mapping in step with tracking, in one thread",
        "the rolling shutter of a camera whose readout is known is undone, which ORB-SLAM2 does not do",
    ),
    remarks="the identity filter on our own back end, not the ORB-SLAM2 program",
)
