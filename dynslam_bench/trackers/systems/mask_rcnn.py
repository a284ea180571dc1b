"""Mask R-CNN as a SLAM filter: cull the features on people (DynaSLAM's variant N)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..protocol import TrackerContext, TrackerSpec
from .composition import SHARED_MASKS, SemanticSystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


def build(settings: SemanticSystemSettings, context: TrackerContext) -> SlamPipeline:
    """Semantic culling, then the shared back end."""
    from dynslam_bench.culling.semantic import SemanticFilter

    return compose(settings, context, [SemanticFilter(settings.segmentation)])


SPEC = TrackerSpec(
    id="mask-rcnn",
    entry_point=f"{__name__}:build",
    label="Mask R-CNN culling (our back end)",
    settings=SemanticSystemSettings,
    summary="drops the features on dilated masks of people; the masks' source is a setting",
    provenance="faithful-code",
    published_as=("DynaSLAM N",),
    license="MIT",
    citation="He et al., Mask R-CNN, ICCV 2017; Bescos et al., DynaSLAM, IEEE RA-L 2018 (variant N)",
    assumptions=(SHARED_MASKS, "no further drop of features at the border of the grown mask"),
)
