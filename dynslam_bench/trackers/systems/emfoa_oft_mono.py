"""Our system without depth: masks, EMFOA-optimised sparse flow and the epipolar test on the monocular back end.

The paper calls itself monocular in half of its text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import EpipolarSettings
from dynslam_bench.slam.settings import NO_DEPTH
from dynslam_bench.trackers.systems.composition import (
    BACKEND,
    CFPN,
    MonocularSemanticSettings,
    compose,
    grown_in_words,
    masks_in_words,
)
from dynslam_bench.trackers.systems.emfoa_oft import SKIPPED, SPARSE, EpipolarTestSettings

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class DepthlessEpipolarSettings(EpipolarSettings):
    """The epipolar test and its guard, as far as it needs no depth."""

    max_contradiction: float = Field(0.2, description=NO_DEPTH)


class EmfoaOftMonoSettings(MonocularSemanticSettings, EpipolarTestSettings):
    """Masks, flow and the epipolar test."""

    epipolar: DepthlessEpipolarSettings = DepthlessEpipolarSettings()


def build(settings: EmfoaOftMonoSettings, context: TrackerContext) -> SlamPipeline:
    """Mask culling, then flow and epipolar culling."""
    from dynslam_bench.culling.epipolar import EpipolarFilter
    from dynslam_bench.culling.semantic import SemanticFilter

    filters = [SemanticFilter(settings.segmentation), EpipolarFilter(settings.epipolar)]
    return compose(settings, context, filters, settings.flow)


SPEC = TrackerSpec(
    id="emfoa-oft-mono",
    entry_point=f"{__name__}:build",
    label="EMFOA-OFT, monocular (our back end)",
    settings=EmfoaOftMonoSettings,
    summary="our own system without depth: masks, EMFOA-optimised sparse flow, guarded epipolar test",
    sensors="rgb",
    provenance="own",
    license="MIT",
    citation="EMFOA-OFT-SLAM: the paper that this toolkit implements; see docs/method.md",
    assumptions=(
        masks_in_words(EmfoaOftMonoSettings().segmentation),
        CFPN,
        grown_in_words(EmfoaOftMonoSettings().segmentation),
        "epipolar threshold 1 px and RANSAC (not stated in the paper)",
        SPARSE,
        SKIPPED,
        "a failing point goes only where its neighbours fail too (ours)",
        BACKEND,
    ),
)
