"""Chen et al. (Micromachines 2022), the paper's direct parent: masks, Lucas-Kanade, epipolar culling.

Theirs is monocular: `chen-slam-mono`. `chen-slam` is the same with depth, to stand beside the other systems.
"""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings
from dynslam_bench.trackers.systems.composition import (
    BACKEND,
    MonocularSemanticSettings,
    PublishedFlowSettings,
    SemanticSystemSettings,
    composed,
    describe_dilation,
    describe_masks,
    describe_matches,
)


class ChenSlamSettings(SemanticSystemSettings):
    """Masks and the epipolar test."""

    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=1.0, outside_px=1.0, fit="kept")
    flow: PublishedFlowSettings = PublishedFlowSettings()


class ChenSlamMonoSettings(MonocularSemanticSettings):
    """The same without depth."""

    box_epipolar: BoxEpipolarSettings = ChenSlamSettings().box_epipolar
    flow: PublishedFlowSettings = PublishedFlowSettings()


build = composed(
    ("semantic:SemanticFilter", "segmentation"), ("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation")
)


def _spec(name: str, summary: str, settings: type[ChenSlamSettings | ChenSlamMonoSettings], sensor: str) -> TrackerSpec:
    defaults = settings()
    mono = settings is ChenSlamMonoSettings
    return TrackerSpec(
        id=name,
        entry_point=f"{__name__}:build",
        label=f"Chen et al. 2022{', monocular' * mono} (our back end)",
        settings=settings,
        summary=summary,
        sensors="rgb" if mono else "rgbd",
        provenance="inspired",
        ranked=False,
        license="MIT (re-implemented from the description)",
        citation="Chen et al., Micromachines 13(11) 2006, 2022",
        assumptions=(
            describe_masks(defaults.segmentation),
            describe_matches(defaults.flow, defaults.box_epipolar.unmatched),
            describe_dilation(defaults.segmentation),
            "epipolar threshold 1 px; RANSAC 1 px, 0.99, refitted to its inliers",
            sensor,
        ),
    )


SPECS = [
    _spec(
        "chen-slam",
        "masks, then the epipolar test on Lucas-Kanade flow",
        ChenSlamSettings,
        "RGB-D back end (theirs is monocular: chen-slam-mono)",
    ),
    _spec(
        "chen-slam-mono",
        "masks, then the epipolar test on Lucas-Kanade flow, without depth as published",
        ChenSlamMonoSettings,
        BACKEND,
    ),
]
