"""Dai et al. (TPAMI 2020): point correlations on a Delaunay graph, no semantics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.culling.baseline_settings import CorrelationSettings
from dynslam_bench.flow.settings import FlowSettings

from ..protocol import TrackerContext, TrackerSpec
from .composition import SystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class DaiSlamSettings(SystemSettings):
    """The correlation graph on Lucas-Kanade tracks."""

    correlation: CorrelationSettings = CorrelationSettings()
    flow: FlowSettings = FlowSettings(method="lucas-kanade")


def build(settings: DaiSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B7 in the front end."""
    from dynslam_bench.culling.correlation_graph import CorrelationFilter

    return compose(settings, context, [CorrelationFilter(settings.correlation)], settings.flow)


SPEC = TrackerSpec(
    id="dai-slam",
    entry_point=f"{__name__}:build",
    label="Dai et al. (our back end)",
    settings=DaiSlamSettings,
    summary="cuts inconsistent edges of a Delaunay graph, keeps the largest rigid component",
    provenance="faithful-paper",
    ranked=True,
    published_as=("Dai et al. DSLAM",),
    license="MIT (re-implemented from the description)",
    citation="Dai et al., RGB-D SLAM in Dynamic Environments Using Point Correlations, TPAMI 2020",
    assumptions=(
        "only the front end's graph, against the observation a window of frames ago",
        "the static part is the component of the largest volume, as in the back end of the paper",
        "no Huber step on the correlations; what is not tracked through the window is never judged",
        "chi-square quantile of 0.95 and 1 px per keypoint (not stated)",
    ),
    remarks="its authors' name DSLAM also stands for Decentralised SLAM elsewhere",
)
