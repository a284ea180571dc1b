"""Composition of systems: one back end for all, and filters of their own; settings and specs that systems share."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

from pydantic import Field, create_model

from dynslam_bench.contracts import DynamicFilter, Tracker, TrackerContext, TrackerSpec
from dynslam_bench.core import SegmentationError, SettingsError
from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.settings import Settings
from dynslam_bench.culling.settings import GuardSettings, Unmatched
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.segmentation.settings import FORMS, SegmentationSettings
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings

if TYPE_CHECKING:
    from dynslam_bench.flow.settings import FlowMethodSettings

SOURCES = ", ".join(form for form in FORMS.split(", ") if form != "none")
"""Sources of masks, as `segmentation.source` names them."""
_EVERY_SECOND_FRAME: dict[str, Any] = {
    "segmentation.schedule": "every_nth",
    "segmentation.n": 2,
}
"""Settings with which the network runs on every second frame."""
FAST_MASKS = {"fast": _EVERY_SECOND_FRAME | {"segmentation.crowded_share": 0.5}}
"""Preset: the network runs on every second frame, and on every frame while masks cover half of the view.

``dynslam-bench report compare`` compares runs with a preset and without.
"""
FAST_FLOW = {"fast": _EVERY_SECOND_FRAME | {"flow.budget": 24}}
"""Preset: the network runs on every second frame, and the flow searches for less than half as long."""


class UnrepairedSettings(SegmentationSettings):
    """Segmentation for systems with another use of depth: masks are not repaired."""

    repair: Literal["none"] = Field("none", description="masks are not repaired")


class ObjectSettings(UnrepairedSettings):
    """Segmentation for systems that judge objects or boxes: masks are neither repaired nor grown."""

    dilation_px: Literal[0] = Field(0, description="masks are not grown")


class UnfilteredSystemSettings(Settings):
    """Settings of every system on this project's back end."""

    filters: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """One tuple a filter, in the order of application: ``module:Class`` below ``dynslam_bench.culling``, and the groups
    of the settings that the class takes, its own first. A filter is left out where the settings lack one of its
    groups, or where its own group has ``enabled = false``."""
    preprocessing: PreprocessingSettings = PreprocessingSettings()
    features: FeatureSettings = FeatureSettings()
    backend: BackendSettings = BackendSettings()

    def verify(self) -> None:
        """Raise `SettingsError` where the named map does not exist."""
        self.backend.map.verify()


class SystemSettings(UnfilteredSystemSettings):
    """A system with filters, and the guard that limits what they remove."""

    guard: GuardSettings = GuardSettings()


class SemanticSystemSettings(SystemSettings):
    """A system that uses masks or boxes; they are optional where its default source is ``none``."""

    segmentation: SegmentationSettings = SegmentationSettings()

    def verify(self) -> None:
        """Raise `SettingsError` where a system that needs masks has none: it would become another system."""
        super().verify()
        default: SegmentationSettings = (
            type(self).model_fields["segmentation"].get_default(call_default_factory=True)
        )
        if self.segmentation.source == "none" != default.source:
            raise SettingsError(
                "this system needs masks, but segmentation.source is 'none'",
                f"sources: {SOURCES}; without masks run dynaslam-g, 'emfoa-oft?masks=none', opf-slam or orb-slam2",
            )


class MonocularSemanticSettings(SemanticSystemSettings):
    """A system that uses masks and no depth; repair needs depth."""

    backend: MonocularBackendSettings = MonocularBackendSettings()
    segmentation: UnrepairedSettings = UnrepairedSettings()


# Parts that only some systems have. They are loaded by name, so that no other system depends on their
# code.
MASK_STAGE = "dynslam_bench.trackers.systems.mask_stage:build_mask_stage"
"""Builds the segmentation stage:
``(settings.segmentation, context, filters, cache) -> (MaskScheduler | None, CachedStage | None)``."""
FLOW = "dynslam_bench.flow.registry:build_flow"
"""Builds the optical flow: ``(settings.flow, *, device, threads) -> FlowEstimator``."""
REFINE_PREDICTION = "dynslam_bench.culling.ego_motion:refine_prediction"
"""Refines the predicted pose by the flow: ``(FrameBundle, FilterState) -> T_world_cam | None``."""


def component_entry_points(settings: UnfilteredSystemSettings) -> list[str]:
    """The entry points of the parts that a system has beside the back end: filters in force, masks, flow.

    Args:
        settings: The system's settings.
    """
    parts = [f"dynslam_bench.culling.{name}" for name, _ in _filters_in_force(settings)]
    if isinstance(settings, SemanticSystemSettings):
        parts.append(MASK_STAGE)
    if getattr(settings, "flow", None) is not None:
        parts += [FLOW, REFINE_PREDICTION]
    return parts


def _filters_in_force(settings: UnfilteredSystemSettings) -> list[tuple[str, list[Any]]]:
    """The filters of a system that are not left out: ``module:Class``, and the groups of settings that it takes."""
    in_force: list[tuple[str, list[Any]]] = []
    for name, *groups in settings.filters:
        arguments = [getattr(settings, group, None) for group in groups]
        if None not in arguments and getattr(arguments[0], "enabled", True):
            in_force.append((name, arguments))
    return in_force


def build(settings: UnfilteredSystemSettings, context: TrackerContext) -> Tracker:
    """The factory of every system that is a table's entry: its `filters` on the shared back end.

    The filters are loaded here, so that a table of systems imports neither torch nor OpenCV.
    """
    filters = []
    for name, arguments in _filters_in_force(settings):
        make_filter = load_object(f"dynslam_bench.culling.{name}")
        filters.append(make_filter(*arguments))
    return compose(settings, context, filters, getattr(settings, "flow", None))


def compose(
    settings: UnfilteredSystemSettings,
    context: TrackerContext,
    filters: Sequence[DynamicFilter] = (),
    flow: "FlowMethodSettings | None" = None,
) -> Tracker:
    """Build the pipeline of a system: back end, extractor, segmentation, filters and flow.

    Args:
        settings: Its settings; a `SemanticSystemSettings` brings a segmentation stage.
        context: Where it runs.
        filters: Its dynamic feature filters, in the order of application.
        flow: Settings of its optical flow; None for a system without one.

    Raises:
        SegmentationError: The semantic source is not available.
        SettingsError: The settings hold an online setting that has an effect and that no part
            takes.
    """
    from dynslam_bench.core.stage_cache import StageCache
    from dynslam_bench.features.registry import build_extractor, cached_extractor
    from dynslam_bench.slam.backend import build_backend
    from dynslam_bench.slam.pipeline import CachedStage, SlamPipeline

    cache = None if context.cache is None else StageCache(Path(context.cache))
    cached: dict[str, CachedStage] = {}

    # Features, from the stage cache where there is one.
    features = settings.features
    extractor = build_extractor(features)
    if cache is not None:
        cached_features = cached_extractor(extractor, features, cache, context.threads)
        if cached_features is not None:
            extractor = cached["features"] = cached_features

    # Masks, for systems with a semantic stage.
    masks = None
    if isinstance(settings, SemanticSystemSettings):
        masks, cached_masks = load_object(MASK_STAGE)(
            settings.segmentation, context, filters, cache
        )
        if cached_masks is not None:
            cached["segmentation"] = cached_masks
    if masks is None:
        _check_masks_not_needed(settings, filters)

    # Flow, and the motion of the camera that follows from it.
    estimate_flow = None
    refine_prediction = None
    if flow is not None:
        estimate_flow = load_object(FLOW)(flow, device=context.device, threads=context.threads)
        refine_prediction = load_object(REFINE_PREDICTION)

    return SlamPipeline(
        extractor=extractor,
        mask_scheduler=masks,
        filters=filters,
        flow=estimate_flow,
        refine_prediction=refine_prediction,
        backend=build_backend(
            settings.backend, features.scale_factor, features.levels, features.extractor
        ),
        settings=settings,
        cached=cached,
    )


def _check_masks_not_needed(
    settings: UnfilteredSystemSettings, filters: Sequence[DynamicFilter]
) -> None:
    """Raise `SegmentationError` where a filter needs masks of a system that has none."""
    needing = [
        dynamic_filter.name
        for dynamic_filter in filters
        if {"masks", "boxes"} & dynamic_filter.needs
    ]
    if not needing:
        return
    fault = "segmentation.source is 'none'"
    cure = f"sources: {SOURCES}"
    if not isinstance(settings, SemanticSystemSettings):
        fault = f"{type(settings).__name__} has no group segmentation"
        cure = "derive it from SemanticSystemSettings, see docs/how-to/filter.md (A filter beside masks)"
    raise SegmentationError(f"filter '{needing[0]}' needs masks, but {fault}", cure)


BACKEND = (
    "monocular back end: the unit of length is the median depth of the first map; "
    "no loop closing unless asked for (backend.loop_closing.enabled)"
)
"""Assumption of every monocular system."""
CFPN = "the CFPN acts in the embedded network alone: with COCO weights its convolutions are zero (plain Mask R-CNN)"
"""Assumption on where the paper's improved mask branch acts."""
UNMATCHED: dict[Unmatched, str] = {
    "keep": "a feature that the flow loses is not judged and stays (not stated)",
    "drop": "a feature that the flow loses is dropped",
    "judge": "a feature that the flow loses is judged by the place where it was lost",
}
"""Treatment of features without a match, by the setting `unmatched`."""


def system_spec(
    name: str,
    label: str,
    filters: Sequence[tuple[str, ...]],
    groups: Mapping[str, Settings],
    *,
    base: type[UnfilteredSystemSettings]
    | tuple[type[UnfilteredSystemSettings], ...] = SemanticSystemSettings,
    assumptions: Sequence[str] = (),
    entry_point: str = f"{__name__}:build",
    **spec: Any,
) -> TrackerSpec:
    """The spec of a system that is composed of filters.

    Args:
        name: Its id.
        label: Its name in tables.
        filters: One tuple a filter, in order: ``("module:Class", group, ...)``, see
            `UnfilteredSystemSettings.filters`.
        groups: Groups of its settings, with their defaults, that `base` lacks or has with other
            defaults.
        base: Settings of the kind of system that it is.
        assumptions: Where it deviates from its source, or the source is silent; `sentences` fills
            in ``{masks}``, ...
        entry_point: Factory ``module:function``; `build` where the system is its filters on the
            shared back end and nothing else.
        **spec: Further fields of `TrackerSpec`.
    """
    # make this system's settings class; pickle looks it up among this module's globals
    title = "".join(word.capitalize() for word in re.findall(r"\w+", name))
    fields: dict[str, Any] = {group: (type(default), default) for group, default in groups.items()}
    made = create_model(f"{title}Settings", __base__=base, __module__=__name__, **fields)
    settings = cast("type[UnfilteredSystemSettings]", made)
    settings.filters = tuple(filters)
    globals()[settings.__name__] = settings

    # assumptions state the numbers of the default settings
    stated = sentences(settings())
    return TrackerSpec(
        id=name,
        entry_point=entry_point,
        label=label,
        settings=settings,
        assumptions=tuple(text.format(**stated) for text in assumptions),
        **spec,
    )


def sentences(settings: UnfilteredSystemSettings) -> dict[str, str]:
    """Sentences of specs by name, made from the settings, so that a spec states the numbers in force.

    ``masks``, ``boxes``: their source; ``dilation``: how far masks are grown, where the source is
    silent; ``tracks``: how the flow is computed; ``matches``: how a system that tests matches uses
    it; ``links``: how a system with a memory of features uses it.
    """
    stated: dict[str, str] = {}
    if isinstance(settings, SemanticSystemSettings):
        masks = describe_masks(settings.segmentation)
        dilation = f"masks grown by {settings.segmentation.dilation_px} px (not stated)"
        stated = {
            "masks": masks,
            "boxes": f"boxes are those of the instance masks, which{masks[5:]}",
            "dilation": dilation,
        }
    flow = getattr(settings, "flow", None)
    if flow is not None:
        tracks = describe_tracks(flow)
        # the first group that has the setting; without any, lost features stay
        unmatched: Unmatched = "keep"
        for _, group in settings:
            if hasattr(group, "unmatched"):
                unmatched = group.unmatched
                break
        links = f"features are followed by {tracks}, not by descriptors; one without a past begins at 0.5"
        stated |= {
            "tracks": tracks,
            "matches": f"matches are {tracks}; {UNMATCHED[unmatched]}",
            "links": links,
        }
    return stated


def describe_masks(segmentation: SegmentationSettings) -> str:
    """Source of a system's masks, and what the shared stage adds to them."""
    frames = segmentation.compensate
    bridged = f"bridged for {frames} segmented frames" if frames else "not bridged"
    return (
        f"masks come from the stage that all systems share: scores of at least {segmentation.confidence:g}, "
        f"missed detections {bridged}"
    )


def describe_tracks(flow: "FlowMethodSettings") -> str:
    """Words on how a system's flow is computed."""
    limit = flow.forward_backward_px
    check = f"a check of {limit:g} px on the way back" if limit else "no check on the way back"
    return f"Lucas-Kanade tracks (window {flow.window_px} px, begun at the motion model's guess, {check})"
