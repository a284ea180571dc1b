"""How a system is put together: one back end for all, a list of filters of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from dynslam_bench.contracts.tracker import TrackerContext
from dynslam_bench.core.errors import SegmentationError, SettingsError
from dynslam_bench.core.settings import Settings, tunable
from dynslam_bench.culling.guard import GuardSettings
from dynslam_bench.culling.settings import Unmatched
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.segmentation.settings import FORMS, SegmentationSettings, expand_classes
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings

SOURCES = ", ".join(form for form in FORMS.split(", ") if form != "none")
"""Where masks can come from, as `segmentation.source` names it."""

if TYPE_CHECKING:
    from dynslam_bench.contracts.filter import DynamicFilter
    from dynslam_bench.segmentation.schedule import MaskScheduler
    from dynslam_bench.slam.pipeline import SlamPipeline


class UnrepairedSettings(SegmentationSettings):
    """Segmentation for systems with another use of depth: nothing repairs a mask there."""

    repair: Literal["none"] = Field("none", description="masks are not repaired")
    repair_depth_m: float = Field(0.2, description="no effect: masks are not repaired")
    repair_band_px: int = Field(8, description="no effect: masks are not repaired")


class ObjectSettings(UnrepairedSettings):
    """Segmentation for systems that look at objects or their boxes: nothing grows or repairs a mask there."""

    dilation_px: Literal[0] = Field(0, description="masks are not grown: objects and boxes count as they were found")


class SystemSettings(Settings):
    """What every system on our back end has."""

    preprocessing: PreprocessingSettings = PreprocessingSettings()
    features: FeatureSettings = FeatureSettings()
    backend: BackendSettings = BackendSettings()
    guard: GuardSettings = GuardSettings()

    def verify(self) -> None:
        """A map that is named is there."""
        self.backend.map.verify()


class SemanticSystemSettings(SystemSettings):
    """A system that uses masks or boxes; one whose own default is the source ``none`` does without."""

    segmentation: SegmentationSettings = SegmentationSettings()

    def verify(self) -> None:
        """A system that lives on masks does not quietly become another one without them."""
        super().verify()
        default: SegmentationSettings = type(self).model_fields["segmentation"].get_default(call_default_factory=True)
        if self.segmentation.source == "none" != default.source:
            raise SettingsError(
                "this system needs masks, but segmentation.source is 'none'",
                f"sources: {SOURCES}; without masks run dynaslam-g, emfoa-oft?masks=none, opf-slam or orb-slam2",
            )


def movable_classes(filters: Sequence[DynamicFilter]) -> frozenset[str]:
    """The classes that filters watch though they are not held for dynamic by themselves: their setting ``movable``."""
    named = (getattr(getattr(each, "settings", None), "movable", "") for each in filters)
    return frozenset().union(*(expand_classes(names) for names in named if names))


def compose(
    settings: SystemSettings,
    context: TrackerContext,
    filters: Sequence[DynamicFilter] = (),
    flow: FlowSettings | None = None,
) -> SlamPipeline:
    """The pipeline of a system.

    Args:
        settings: Its settings; a `SemanticSystemSettings` brings a segmentation stage.
        context: Where it runs.
        filters: Its dynamic feature filters, in the order of application.
        flow: Settings of its optical flow; None for a system without one.

    Raises:
        SegmentationError: The semantic source is not available.
        SettingsError: The settings hold an online setting that has an effect and that no part takes.
    """
    from dynslam_bench.core.stage_cache import StageCache
    from dynslam_bench.features.cached import cached_extractor
    from dynslam_bench.features.registry import build_extractor
    from dynslam_bench.flow.registry import build_flow
    from dynslam_bench.segmentation.cached import cache_segmenter
    from dynslam_bench.slam.backend import build_backend
    from dynslam_bench.slam.pipeline import SlamPipeline
    from dynslam_bench.slam.stages import CachedStage

    cache = None if context.cache is None else StageCache(Path(context.cache))
    cached: dict[str, CachedStage] = {}
    extractor = build_extractor(settings.features)
    if cache is not None:
        extractor = cached["features"] = cached_extractor(extractor, settings.features, cache, context.threads)
    masks = _mask_stage(settings, context, filters, deferred=cache is not None)
    if masks is not None and cache is not None:
        segmenter = cache_segmenter(masks, cache, context.sequence_id, context.device, context.threads)
        if segmenter is not None:
            cached["segmentation"] = segmenter
    features = settings.features
    backend = build_backend(settings.backend, features.scale_factor, features.levels, features.extractor)
    return SlamPipeline(
        extractor=extractor,
        masks=masks,
        filters=filters,
        flow=None if flow is None else build_flow(flow, device=context.device, threads=context.threads),
        backend=backend,
        settings=settings,
        cached=cached,
    )


def _mask_stage(
    settings: SystemSettings, context: TrackerContext, filters: Sequence[DynamicFilter], *, deferred: bool
) -> MaskScheduler | None:
    """Where the system's masks come from; None without a source, unless a filter needs one."""
    from dynslam_bench.segmentation.schedule import build_mask_stage

    masks = None
    if isinstance(settings, SemanticSystemSettings):
        masks = build_mask_stage(
            settings.segmentation,
            sequence_id=context.sequence_id,
            masks=context.masks,
            device=context.device,
            threads=context.threads,
            deferred=deferred,
            also=movable_classes(filters),
        )
    needing = [each.name for each in filters if {"masks", "boxes"} & each.needs]
    if needing and not isinstance(settings, SemanticSystemSettings):
        raise SegmentationError(
            f"filter '{needing[0]}' needs masks, but {type(settings).__name__} has no group segmentation",
            "derive the system's settings from SemanticSystemSettings, see docs/plugins.md (A filter beside masks)",
        )
    if masks is None and needing:
        raise SegmentationError(
            f"filter '{needing[0]}' needs masks, but segmentation.source is 'none'", f"sources: {SOURCES}"
        )
    return masks


# What systems without depth have in common.

BACKEND = (
    "monocular back end: the unit of length is the median depth of the first map; "
    "no loop closing unless asked for (backend.loop_closing.enabled)"
)
"""What every one of them assumes."""


class MonocularSystemSettings(SystemSettings):
    """A system that never looks at depth."""

    backend: MonocularBackendSettings = MonocularBackendSettings()


class MonocularSemanticSettings(MonocularSystemSettings, SemanticSystemSettings):
    """One with masks, which nothing repairs: that takes depth."""

    segmentation: UnrepairedSettings = UnrepairedSettings()


# What published systems have in common here, and how it is said in their specs.

CFPN = "the CFPN acts in the embedded network alone: with COCO weights its convolutions are zero (plain Mask R-CNN)"
"""The paper's improved mask branch, as far as it is there."""


class PublishedFlowSettings(FlowSettings):
    """Lucas-Kanade as published systems use it: no source of theirs names a check on the way back, so there is none."""

    method: Literal["daisy", "lucas-kanade", "dis"] = tunable(
        "lucas-kanade", meaning="which flow; the published one is Lucas-Kanade"
    )
    forward_backward_px: float = Field(
        0.0,
        ge=0.0,
        le=100.0,
        description="largest distance in pixels between a point and its way there and back; 0, no check, as published",
    )


LOST: dict[Unmatched, str] = {
    "keep": "a feature that the flow loses is not judged and stays (not stated)",
    "drop": "a feature that the flow loses is dropped",
    "judge": "a feature that the flow loses is judged by the place where it was lost",
}
"""What becomes of features without a match, by the setting `unmatched`."""


def masks_in_words(segmentation: SegmentationSettings, *, boxes: bool = False) -> str:
    """Where a system's masks, or its boxes, come from, and what the shared stage adds to them."""
    what = "boxes are those of the instance masks, which" if boxes else "masks"
    bridged = (
        f"missed detections bridged for {segmentation.compensate} segmented frames"
        if segmentation.compensate
        else "missed detections not bridged"
    )
    return (
        f"{what} come from the stage that all systems share: scores of at least {segmentation.confidence:g}, {bridged}"
    )


def grown_in_words(segmentation: SegmentationSettings) -> str:
    """How far a system's masks are grown, where its source does not say."""
    return f"masks grown by {segmentation.dilation_px} px (not stated)"


def tracks_in_words(flow: FlowSettings) -> str:
    """How a system's flow is computed."""
    check = (
        f"a check of {flow.forward_backward_px:g} px on the way back"
        if flow.forward_backward_px
        else "no check on the way back"
    )
    return f"Lucas-Kanade tracks (window {flow.window_px} px, begun at the motion model's guess, {check})"


def matches_in_words(flow: FlowSettings, unmatched: Unmatched) -> str:
    """How a system that tests matches finds them, and what becomes of the features that have none."""
    return f"matches are {tracks_in_words(flow)}; {LOST[unmatched]}"


def links_in_words(flow: FlowSettings) -> str:
    """How a system with a memory of features follows them, and what becomes of those that have no past."""
    return f"features are followed by {tracks_in_words(flow)}, not by descriptors; one without a past begins at 0.5"


# The presets that ship; what each is worth beside the defaults, on scenes that no choice has seen: docs/tuning.md.

_SECOND: dict[str, Any] = {"segmentation.schedule": "every_nth", "segmentation.n": 2}
FAST_MASKS = {"fast": _SECOND | {"segmentation.crowded_share": 0.5}}
"""The network sees every second frame, and every one while masks cover half of the view.

Between them masks are carried along by optical flow.
"""
FAST_FLOW = {"fast": _SECOND | {"flow.budget": 24}}
"""Every second frame, and the flow searches for less than half as long: behind masks no error shows a change."""
