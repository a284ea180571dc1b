"""Chen et al. (Micromachines 2022), the paper's direct parent: masks, Lucas-Kanade, epipolar culling."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.blocks.box_epipolar_settings import BoxEpipolarSettings

from .composition import SemanticSystemSettings, compose
from .published import PublishedFlowSettings, grown_in_words, masks_in_words, matches_in_words

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class ChenSlamSettings(SemanticSystemSettings):
    """Masks and the epipolar test."""

    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=1.0, outside_px=1.0, fit="kept")
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: ChenSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B1, then B3 on the rest."""
    from dynslam_bench.culling.blocks.box_epipolar import BoxEpipolarFilter
    from dynslam_bench.culling.blocks.semantic import SemanticFilter

    filters = [
        SemanticFilter(settings.segmentation),
        BoxEpipolarFilter(settings.box_epipolar, settings.segmentation),
    ]
    return compose(settings, context, filters, settings.flow)


SPEC = TrackerSpec(
    id="chen-slam",
    entry_point=f"{__name__}:build",
    label="Chen et al. 2022 (our back end)",
    settings=ChenSlamSettings,
    summary="masks, then the epipolar test on Lucas-Kanade flow",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Chen et al., Micromachines 13(11) 2006, 2022",
    assumptions=(
        masks_in_words(ChenSlamSettings().segmentation),
        matches_in_words(ChenSlamSettings().flow, ChenSlamSettings().box_epipolar.unmatched),
        grown_in_words(ChenSlamSettings().segmentation),
        "epipolar threshold 1 px; RANSAC 1 px, 0.99, refitted to its inliers",
        "RGB-D back end (theirs is monocular)",
    ),
)
