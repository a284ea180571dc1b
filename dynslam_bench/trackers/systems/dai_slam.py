"""Dai et al. (TPAMI 2020): point correlations on a Delaunay graph, no semantics."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import CorrelationSettings
from dynslam_bench.flow.settings import FlowMethodSettings
from dynslam_bench.trackers.systems.composition import SystemSettings, composed, describe_tracks


class DaiSlamSettings(SystemSettings):
    """The correlation graph on Lucas-Kanade tracks."""

    correlation: CorrelationSettings = CorrelationSettings()
    flow: FlowMethodSettings = FlowMethodSettings(method="lucas-kanade")


build = composed(("correlation_graph:CorrelationFilter", "correlation"))

SPEC = TrackerSpec(
    id="dai-slam",
    entry_point=f"{__name__}:build",
    label="Dai et al. (our back end)",
    settings=DaiSlamSettings,
    summary="cuts inconsistent edges of a Delaunay graph, keeps the largest rigid component",
    provenance="inspired",
    ranked=False,
    published_as=("Dai et al. DSLAM",),
    license="MIT (re-implemented from the description)",
    citation="Dai et al., RGB-D SLAM in Dynamic Environments Using Point Correlations, TPAMI 2020",
    assumptions=(
        "the graph is over tracked features and their last frames; the paper's is over map points and their keyframes, "
        "with a second one over a window of keyframes",
        f"features are followed by {describe_tracks(DaiSlamSettings().flow)}; one that it loses is not judged",
        "each edge is tested against the oldest common observation of at most 8 frames ago; no Huber step",
        "components are those of points observed for 4 frames or more; younger points follow the settled ones around "
        "them; what has neither flow nor depth is never judged",
        "the static part is the component of the largest volume, as in the back end of the paper",
        "chi-square quantile of 0.95 and 1 px per keypoint (not stated)",
    ),
    remarks=(
        "within 8 frames people move less than depth noise shows, edges stay whole and one component holds people and "
        "room: 4 % of the features on people go on a rendered half sphere; its authors' name DSLAM also stands for "
        "Decentralised SLAM elsewhere"
    ),
)
