"""Blitz-SLAM (Fan et al. 2022): masks repaired by depth, then a strict epipolar test inside the boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import BoxEpipolarSettings, DepthBlockSettings
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    UnrepairedSettings,
    compose,
    masks_in_words,
    matches_in_words,
)

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class BlitzSlamSettings(SemanticSystemSettings):
    """Repaired masks and the epipolar test in boxes."""

    segmentation: UnrepairedSettings = UnrepairedSettings(dilation_px=0)
    depth_blocks: DepthBlockSettings = DepthBlockSettings()
    box_epipolar: BoxEpipolarSettings = BoxEpipolarSettings(inside_px=0.5, test_outside=False)
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: BlitzSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B9 and B1, then B3 inside the boxes with F from outside them."""
    from dynslam_bench.culling.box_epipolar import BoxEpipolarFilter
    from dynslam_bench.culling.depth_blocks import DepthBlockFilter

    filters = [
        DepthBlockFilter(settings.depth_blocks, settings.segmentation),
        BoxEpipolarFilter(settings.box_epipolar, settings.segmentation),
    ]
    return compose(settings, context, filters, settings.flow)


SPEC = TrackerSpec(
    id="blitz-slam",
    entry_point=f"{__name__}:build",
    label="Blitz-SLAM (our back end)",
    settings=BlitzSlamSettings,
    summary="masks repaired by depth, epipolar test of 0.5 px inside person boxes",
    provenance="faithful-paper",
    ranked=True,
    published_as=("Blitz-SLAM",),
    license="MIT (re-implemented from the description)",
    citation="Fan et al., Blitz-SLAM, Pattern Recognition 2022",
    assumptions=(
        masks_in_words(BlitzSlamSettings().segmentation),
        matches_in_words(BlitzSlamSettings().flow, BlitzSlamSettings().box_epipolar.unmatched),
        "RANSAC of 1 px, 0.99 for the fundamental matrix (not stated), refitted to its inliers",
        "with fewer than 20 matches outside the boxes all kept ones count; its boxes are those of the masks",
        "which classes are movable (not stated)",
        "the residual removal of its mapping is left out: it does not touch the pose",
    ),
)
