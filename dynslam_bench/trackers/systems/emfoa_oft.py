"""EMFOA-OFT-SLAM (the paper) and its ablations.

Masks of an improved Mask R-CNN drop the features on people; DAISY Filter Flow, optimised by the elite moth-flame
algorithm, matches the remaining ORB points with the previous image; the fundamental matrix of those matches culls what
leaves its epipolar line; the shared back end tracks and maps with what is left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dynslam_bench.culling.settings import EpipolarSettings, FreeSpaceSettings, MotionSettings
from dynslam_bench.flow.settings import FlowSettings

from ..protocol import TrackerContext, TrackerSpec
from .composition import SemanticSystemSettings, compose

if TYPE_CHECKING:
    from dynslam_bench.culling.filter import DynamicFilter
    from dynslam_bench.slam.pipeline import SlamPipeline


class EmfoaOftSettings(SemanticSystemSettings):
    """Settings of the paper's system."""

    flow: FlowSettings = FlowSettings()
    epipolar: EpipolarSettings = EpipolarSettings()
    motion: MotionSettings = MotionSettings()
    free_space: FreeSpaceSettings = FreeSpaceSettings()


class EmfoaOftNoFlowSettings(SemanticSystemSettings):
    """The ablation without flow: what needs a flow is no setting of it."""


def build(settings: EmfoaOftSettings, context: TrackerContext) -> SlamPipeline:
    """Mask culling, EMFOA-optimised flow, epipolar culling, depth consistency, the shared back end."""
    return _build(settings, context)


def build_without_flow(settings: EmfoaOftNoFlowSettings, context: TrackerContext) -> SlamPipeline:
    """Ablation: mask culling only."""
    from dynslam_bench.culling.semantic import SemanticFilter

    return compose(settings, context, [SemanticFilter(settings.segmentation)])


def build_object_mode(settings: EmfoaOftSettings, context: TrackerContext) -> SlamPipeline:
    """Ablation: no mask culling; an object goes if the epipolar vote of its points says that it moves (step 3)."""
    return _build(settings, context, semantic=False)


def _build(settings: EmfoaOftSettings, context: TrackerContext, *, semantic: bool = True) -> SlamPipeline:
    from dynslam_bench.culling.epipolar import EpipolarFilter
    from dynslam_bench.culling.free_space import FreeSpaceFilter
    from dynslam_bench.culling.motion import MotionFilter
    from dynslam_bench.culling.semantic import SemanticFilter

    filters: list[DynamicFilter] = []
    if semantic and settings.segmentation.source != "none":  # the ablation without masks
        filters.append(SemanticFilter(settings.segmentation))
    filters.append(EpipolarFilter(settings.epipolar))
    if settings.motion.enabled:
        filters.append(MotionFilter(settings.motion))
    if settings.free_space.enabled:
        filters.append(FreeSpaceFilter(settings.free_space))
    return compose(settings, context, filters, settings.flow)


OURS = (
    "a failing point goes only where its neighbours fail too, and an F that depth contradicts is not used (both ours)",
)
DEPTH_TESTS = ("rigid motion in depth and free space seen before are tested as well (both ours, no part of the paper)",)


def _spec(name: str, summary: str, defaults: dict[str, Any], factory: str = "build") -> TrackerSpec:
    geometry = factory != "build_without_flow"
    settings: type[SemanticSystemSettings] = EmfoaOftSettings if geometry else EmfoaOftNoFlowSettings
    if defaults:
        settings = _variant(name, defaults)
    return TrackerSpec(
        id=name,
        entry_point=f"{__name__}:{factory}",
        label="EMFOA-OFT-SLAM (our back end)" if name == "emfoa-oft" else f"{name} (ablation)",
        settings=settings,
        summary=summary,
        provenance="faithful-paper",
        ranked=name == "emfoa-oft",
        license="MIT",
        citation="EMFOA-OFT-SLAM: the paper that this toolkit implements; see docs/method.md",
        published_as=("EMFOA-OFT-SLAM",) if name == "emfoa-oft" else (),
        assumptions=(
            "epipolar threshold 1 px and RANSAC (not stated in the paper)",
            "weights and truncations of Eq. 1 (not stated)",
            "RGB-D back end (the paper says monocular, depth-based and RGB-D in turn)",
            "the epipolar test is skipped where F means nothing: too little parallax, one plane (not in the paper)",
            *(() if "epipolar.min_share" in defaults else OURS),
            *(() if "motion.enabled" in defaults or not geometry else DEPTH_TESTS),
        ),
    )


def _variant(name: str, defaults: dict[str, Any]) -> type[EmfoaOftSettings]:
    """A settings class with other defaults, given as dotted names."""
    from pydantic import create_model

    from dynslam_bench.core.settings import apply_overrides

    base = apply_overrides(EmfoaOftSettings(), defaults)
    fields: dict[str, Any] = {
        group: (EmfoaOftSettings.model_fields[group].annotation, getattr(base, group))
        for group in {dotted.split(".")[0] for dotted in defaults}
    }
    title = "".join(part.capitalize() for part in name.replace("+", "-").split("-"))
    return create_model(f"{title}Settings", __base__=EmfoaOftSettings, __module__=__name__, **fields)


NO_DEPTH_TEST = {"motion.enabled": False, "free_space.enabled": False}
AS_PRINTED = {
    **NO_DEPTH_TEST,
    "epipolar.min_share": 0.0,
    "epipolar.parallax_share": 0.0,
    "epipolar.max_contradiction": 1.0,
}

SPECS = [
    _spec("emfoa-oft", "the paper's system: masks, EMFOA-optimised DAISY Filter Flow, epipolar culling", {}),
    _spec(
        "emfoa-oft-paper", "as printed but for the guard against a degenerate F: every failing point goes", AS_PRINTED
    ),
    _spec("emfoa-oft-no-depth-test", "ablation: without the tests of depth, which are ours", NO_DEPTH_TEST),
    _spec("emfoa-oft-no-masks", "ablation: geometry alone", {"segmentation.source": "none"}),
    _spec(
        "emfoa-oft-no-masks-no-depth-test", "ablation: the guarded epipolar test alone",
        {"segmentation.source": "none", **NO_DEPTH_TEST},
    ),
    _spec(
        "emfoa-oft-paper-no-masks", "ablation: the paper's epipolar test alone",
        {"segmentation.source": "none", **AS_PRINTED},
    ),
    _spec("emfoa-oft-no-flow", "ablation: masks alone", {}, "build_without_flow"),
    _spec("emfoa-oft-lk", "ablation: Lucas-Kanade instead of DAISY Filter Flow", {"flow.method": "lucas-kanade"}),
    _spec("emfoa-oft-patchmatch", "ablation: PatchMatch instead of EMFOA", {"flow.search": "patchmatch"}),
    _spec("emfoa-oft-literal", "ablation: the moth-flame equations as printed", {"flow.search": "emfoa-literal"}),
    _spec(
        "emfoa-oft-object", "ablation: objects go by the vote of their points, not by class",
        {"epipolar.mode": "object", **NO_DEPTH_TEST}, "build_object_mode",
    ),
    _spec(
        "emfoa-oft-object-depth-test", "ablation: the vote of an object's points, and the tests of depth",
        {"epipolar.mode": "object"}, "build_object_mode",
    ),
]  # fmt: skip
