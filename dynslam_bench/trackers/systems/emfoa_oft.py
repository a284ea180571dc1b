"""EMFOA-OFT-SLAM as the paper describes it, our own system made from it, and the ablations of both.

The paper: masks of an improved Mask R-CNN drop the features on people; DAISY Filter Flow, optimised by the elite
moth-flame algorithm, matches the remaining ORB points with the previous image; the fundamental matrix of those matches
culls what leaves its epipolar line; the rest is tracked and mapped. `docs/method.md` says who runs which equation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import EpipolarSettings, FreeSpaceSettings, RigidMotionSettings
from dynslam_bench.flow.settings import DenseFlowSettings, FlowMethodSettings, FlowSettings
from dynslam_bench.trackers.systems.composition import (
    CFPN,
    FAST_FLOW,
    ObjectSettings,
    SemanticSystemSettings,
    SystemSettings,
    compose,
    grown_in_words,
    masks_in_words,
)

if TYPE_CHECKING:
    from dynslam_bench.contracts.filter import DynamicFilter
    from dynslam_bench.slam.pipeline import SlamPipeline


class EpipolarTestSettings(SystemSettings):
    """Flow at the points, and the epipolar test that asks before it culls."""

    flow: FlowSettings = FlowSettings()
    epipolar: EpipolarSettings = EpipolarSettings()


class DepthTestSettings(EpipolarTestSettings):
    """The tests of depth besides."""

    motion: RigidMotionSettings = RigidMotionSettings()
    free_space: FreeSpaceSettings = FreeSpaceSettings()


class EmfoaOftSettings(DepthTestSettings, SemanticSystemSettings):
    """Settings of our own system."""


class MaskedEpipolarTestSettings(EpipolarTestSettings, SemanticSystemSettings):
    """Masks and the epipolar test."""


class LucasKanadeSettings(EmfoaOftSettings):
    """Lucas-Kanade flow."""

    flow: FlowMethodSettings = FlowMethodSettings(method="lucas-kanade")  # type: ignore[assignment]


class PatchMatchSettings(EmfoaOftSettings):
    """PatchMatch as label search."""

    flow: FlowSettings = FlowSettings(search="patchmatch")


class LiteralSettings(EmfoaOftSettings):
    """The moth-flame equations as printed."""

    flow: FlowSettings = FlowSettings(search="emfoa-literal")


class ObjectVoteSettings(MaskedEpipolarTestSettings):
    """Objects go by the epipolar vote of their points."""

    segmentation: ObjectSettings = ObjectSettings()
    epipolar: EpipolarSettings = EpipolarSettings(mode="object")


class ObjectVoteDepthTestSettings(EmfoaOftSettings):
    """The same, and the tests of depth."""

    segmentation: ObjectSettings = ObjectSettings()
    epipolar: EpipolarSettings = EpipolarSettings(mode="object")


class PaperTestSettings(EpipolarTestSettings):
    """The paper's flow, dense and with all terms, and its test: F judges every frame, every failing point goes."""

    flow: DenseFlowSettings = DenseFlowSettings(terms=3)  # type: ignore[assignment]
    epipolar: EpipolarSettings = EpipolarSettings(
        min_parallax_px=0.0, parallax_share=0.0, homography_share=1.0, min_share=0.0, max_contradiction=1.0
    )


class PaperSettings(PaperTestSettings, SemanticSystemSettings):
    """Settings of the paper's system."""


class PaperSparseSettings(PaperSettings):
    """The paper's test on the flow of our own system."""

    flow: FlowSettings = FlowSettings()  # type: ignore[assignment]


def build(settings: SystemSettings, context: TrackerContext) -> SlamPipeline:
    """Mask culling, flow and epipolar culling, depth consistency: those of them that the settings have a group for."""
    from dynslam_bench.culling.semantic import SemanticFilter

    filters: list[DynamicFilter] = []
    if isinstance(settings, SemanticSystemSettings):
        filters.append(SemanticFilter(settings.segmentation))
    return _with_geometry(settings, context, filters)


def build_object_mode(settings: MaskedEpipolarTestSettings, context: TrackerContext) -> SlamPipeline:
    """Ablation: no mask culling; an object goes if the epipolar vote of its points says that it moves (step 3)."""
    return _with_geometry(settings, context, [])


def _with_geometry(settings: SystemSettings, context: TrackerContext, filters: list[DynamicFilter]) -> SlamPipeline:
    from dynslam_bench.culling.epipolar import EpipolarFilter
    from dynslam_bench.culling.free_space import FreeSpaceFilter
    from dynslam_bench.culling.rigid_motion import RigidMotionFilter

    if not isinstance(settings, EpipolarTestSettings):
        return compose(settings, context, filters)
    filters.append(EpipolarFilter(settings.epipolar))
    if isinstance(settings, DepthTestSettings) and settings.motion.enabled:
        filters.append(RigidMotionFilter(settings.motion))
    if isinstance(settings, DepthTestSettings) and settings.free_space.enabled:
        filters.append(FreeSpaceFilter(settings.free_space))
    return compose(settings, context, filters, settings.flow)


WHOSE = (
    "the paper's are the masks, the EMFOA-optimised DAISY Filter Flow and the epipolar test; ours are the flow at the "
    "points alone without aggregated costs, the conditions under which the epipolar test may cull, and the tests of "
    "motion and free space in depth"
)
SKIPPED = "the epipolar test is skipped where F means nothing: too little parallax, one plane (ours)"
SENSOR = "RGB-D back end (the paper says monocular, depth-based and RGB-D in turn)"
NOT_STATED = ("epipolar threshold 1 px and RANSAC (not stated in the paper)", SENSOR)
GUARDS = "a failing point goes only where its neighbours fail too, and an F that depth contradicts is not used (ours)"
SPARSE = "labels are searched at the points alone and by the descriptors' term of Eq. 1 alone; no Eq. 2 and 3 (ours)"
DENSE = (
    "weights and truncations of Eq. 1 (not stated): alpha 55, beta 190, 0.882 a histogram, 7 and 2 grey levels",
    "labels live on superpixels, pass between them, are refined by Lucas-Kanade and tried on every pixel of the region "
    "(as in DAISY Filter Flow; the refinement, the way back of 1.5 px and the smoothing by regions are ours)",
)
DEPTH = "rigid motion in depth and free space seen before are tested as well (ours, no part of the paper)"


def _assumptions(name: str, settings: type[SystemSettings]) -> tuple[str, ...]:
    said = [WHOSE] if name == "emfoa-oft" else []
    defaults = settings()
    if isinstance(defaults, SemanticSystemSettings):
        said += [masks_in_words(defaults.segmentation), CFPN]
        if defaults.segmentation.dilation_px:
            said.append(grown_in_words(defaults.segmentation))
    if not isinstance(defaults, EpipolarTestSettings):
        return (*said, SENSOR)
    said += NOT_STATED
    flow: FlowMethodSettings = defaults.flow
    if flow.method == "daisy":
        said += DENSE if isinstance(flow, DenseFlowSettings) else [SPARSE]
    if not issubclass(settings, PaperTestSettings):
        said += [SKIPPED, GUARDS]
    if issubclass(settings, DepthTestSettings):
        said.append(DEPTH)
    return tuple(said)


def _spec(name: str, summary: str, settings: type[SystemSettings], factory: str = "build") -> TrackerSpec:
    labels = {
        "emfoa-oft": "EMFOA-OFT with depth tests, our own (our back end)",
        "emfoa-oft-paper": "EMFOA-OFT-SLAM (our back end)",
    }
    paper = name == "emfoa-oft-paper"
    return TrackerSpec(
        id=name,
        entry_point=f"{__name__}:{factory}",
        label=labels.get(name, f"{name} (ablation)"),
        settings=settings,
        summary=summary,
        provenance="faithful-paper" if paper else "own",
        ranked=name in labels,
        presets=FAST_FLOW if name == "emfoa-oft" else {},
        license="MIT",
        citation="EMFOA-OFT-SLAM: the paper that this toolkit implements; see docs/method.md",
        published_as=("EMFOA-OFT-SLAM",) if paper else (),
        assumptions=_assumptions(name, settings),
    )


SPECS = [
    _spec(
        "emfoa-oft",
        "our own system: masks, EMFOA-optimised sparse flow, guarded epipolar test, tests of depth",
        EmfoaOftSettings,
    ),
    _spec(
        "emfoa-oft-paper",
        "the paper's system: masks, EMFOA-optimised dense DAISY Filter Flow, epipolar culling",
        PaperSettings,
    ),
    _spec("emfoa-oft-paper-sparse", "ablation: the paper's test on the flow of our own system", PaperSparseSettings),
    _spec("emfoa-oft-paper-no-masks", "ablation: the paper's flow and epipolar test alone", PaperTestSettings),
    _spec(
        "emfoa-oft-no-depth-test", "ablation: without the tests of depth, which are ours", MaskedEpipolarTestSettings
    ),
    _spec("emfoa-oft-no-masks", "ablation: geometry alone", DepthTestSettings),
    _spec("emfoa-oft-no-masks-no-depth-test", "ablation: the guarded epipolar test alone", EpipolarTestSettings),
    _spec("emfoa-oft-no-flow", "ablation: masks alone", SemanticSystemSettings),
    _spec("emfoa-oft-lk", "ablation: Lucas-Kanade instead of DAISY Filter Flow", LucasKanadeSettings),
    _spec("emfoa-oft-patchmatch", "ablation: PatchMatch instead of EMFOA", PatchMatchSettings),
    _spec("emfoa-oft-literal", "ablation: the moth-flame equations as printed", LiteralSettings),
    _spec(
        "emfoa-oft-object",
        "ablation: objects go by the vote of their points, not by class",
        ObjectVoteSettings,
        "build_object_mode",
    ),
    _spec(
        "emfoa-oft-object-depth-test",
        "ablation: the vote of an object's points, and the tests of depth",
        ObjectVoteDepthTestSettings,
        "build_object_mode",
    ),
]
