"""EMFOA-OFT-SLAM as the paper describes it, this project's system made from it, and the ablations of both.

An ablation is a variant: its id names the system and what differs, as in ``emfoa-oft?masks=none``.

The paper: masks of an improved Mask R-CNN drop the features on people; DAISY Filter Flow, optimised by the elite
moth-flame algorithm, matches the remaining ORB points with the previous image; the fundamental matrix of those matches
culls points off their epipolar lines; the rest is tracked and mapped. `docs/explanation/paper.md` lists who runs which
equation.
"""

from dataclasses import replace

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import EpipolarSettings, FreeSpaceSettings, RigidMotionSettings
from dynslam_bench.flow.settings import DenseFlowSettings, FlowMethodSettings, FlowSettings
from dynslam_bench.trackers.systems.composition import (
    BACKEND,
    CFPN,
    FAST_FLOW,
    MonocularSemanticSettings,
    ObjectSettings,
    SemanticSystemSettings,
    SystemSettings,
    composed,
    describe_dilation,
    describe_masks,
)


class EpipolarTestSettings(SystemSettings):
    """Flow at the points, and the guarded epipolar test."""

    flow: FlowSettings = FlowSettings()
    epipolar: EpipolarSettings = EpipolarSettings()


class DepthTestSettings(EpipolarTestSettings):
    """The tests of depth as well."""

    motion: RigidMotionSettings = RigidMotionSettings()
    free_space: FreeSpaceSettings = FreeSpaceSettings()


class EmfoaOftSettings(DepthTestSettings, SemanticSystemSettings):
    """Settings of this project's system."""


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
    """Objects are dynamic by the epipolar vote of their points."""

    segmentation: ObjectSettings = ObjectSettings()
    epipolar: EpipolarSettings = EpipolarSettings(mode="object")


class ObjectVoteDepthTestSettings(EmfoaOftSettings):
    """The same, and the tests of depth."""

    segmentation: ObjectSettings = ObjectSettings()
    epipolar: EpipolarSettings = EpipolarSettings(mode="object")


class PaperTestSettings(EpipolarTestSettings):
    """The paper's flow, dense and with all terms, and its test on every frame, without the guard."""

    flow: DenseFlowSettings = DenseFlowSettings(terms=3)  # type: ignore[assignment]
    epipolar: EpipolarSettings = EpipolarSettings(
        min_parallax_px=0.0, parallax_share=0.0, homography_share=1.0, min_share=0.0, max_contradiction=1.0
    )


class PaperSettings(PaperTestSettings, SemanticSystemSettings):
    """Settings of the paper's system."""


class PaperSparseSettings(PaperSettings):
    """The paper's test on the flow of this project's system."""

    flow: FlowSettings = FlowSettings()  # type: ignore[assignment]


class EmfoaOftMonoSettings(MonocularSemanticSettings, EpipolarTestSettings):
    """This project's system without depth: the paper calls itself monocular in half of its text."""


TESTS = (
    ("epipolar:EpipolarFilter", "epipolar"),
    ("ego_motion:RigidMotionFilter", "motion"),
    ("free_space:FreeSpaceFilter", "free_space"),
)
build = composed(("semantic:SemanticFilter", "segmentation"), *TESTS)
build_vote = composed(*TESTS)
"""Without mask culling: the epipolar vote of its points decides on an object (`EpipolarFilter`)."""

WHOSE = (
    "the paper's are the masks, the EMFOA-optimised DAISY Filter Flow and the epipolar test; ours are the flow at the "
    "points alone without aggregated costs, the conditions under which the epipolar test may cull, and the tests of "
    "motion and free space in depth"
)
SKIPPED = "the epipolar test is skipped where F means nothing: too little parallax, one plane (ours)"
SENSOR = "RGB-D back end (the paper says monocular, depth-based and RGB-D in turn)"
NOT_STATED = "epipolar threshold 1 px and RANSAC (not stated in the paper)"
GUARDS = "a failing point goes only where its neighbours fail too, and an F that depth contradicts is not used (ours)"
GUARD_WITHOUT_DEPTH = "a failing point goes only where its neighbours fail too (ours)"
SPARSE = "labels are searched at the points alone and by the descriptors' term of Eq. 1 alone; no Eq. 2 and 3 (ours)"
DENSE = (
    "weights and truncations of Eq. 1 (not stated): alpha 55, beta 190, 0.882 a histogram, 7 and 2 grey levels",
    "labels live on superpixels, pass between them, are refined by Lucas-Kanade and tried on every pixel of the region "
    "(as in DAISY Filter Flow; the refinement, the way back of 1.5 px and the smoothing by regions are ours)",
)
DEPTH = "rigid motion in depth and free space seen before are tested as well (ours, no part of the paper)"


def _assumptions(settings: SystemSettings) -> tuple[str, ...]:
    monocular, sparse = (
        isinstance(settings, EmfoaOftMonoSettings),
        isinstance(getattr(settings, "flow", None), FlowSettings),
    )
    sentences = []
    if isinstance(settings, SemanticSystemSettings):
        sentences += [describe_masks(settings.segmentation), CFPN]
        if settings.segmentation.dilation_px:
            sentences.append(describe_dilation(settings.segmentation))
    if isinstance(settings, EpipolarTestSettings):
        sentences.append(NOT_STATED)
    if not monocular:
        sentences.append(SENSOR)
    if isinstance(settings, PaperTestSettings):
        sentences += [SPARSE] if sparse else DENSE
    elif isinstance(settings, EpipolarTestSettings):
        sentences += [*[SPARSE] * sparse, SKIPPED, GUARD_WITHOUT_DEPTH if monocular else GUARDS]
    if isinstance(settings, DepthTestSettings):
        sentences.append(DEPTH)
    return (*sentences, BACKEND) if monocular else tuple(sentences)


def _spec(name: str, label: str, settings: type[SystemSettings], summary: str) -> TrackerSpec:
    return TrackerSpec(
        id=name,
        entry_point=f"{__name__}:build",
        label=f"{label} (our back end)",
        settings=settings,
        summary=summary,
        sensors="rgb" if issubclass(settings, MonocularSemanticSettings) else "rgbd",
        provenance="own",
        license="MIT",
        citation="EMFOA-OFT-SLAM: the paper that this toolkit implements; see docs/explanation/paper.md",
        assumptions=_assumptions(settings()),
    )


EMFOA_OFT = replace(
    _spec(
        "emfoa-oft",
        "EMFOA-OFT with depth tests, our own",
        EmfoaOftSettings,
        "our own system: masks, EMFOA-optimised sparse flow, guarded epipolar test, tests of depth",
    ),
    presets=FAST_FLOW,
    assumptions=(WHOSE, *_assumptions(EmfoaOftSettings())),
)
PAPER = replace(
    _spec(
        "emfoa-oft-paper",
        "EMFOA-OFT-SLAM",
        PaperSettings,
        "the paper's system: masks, EMFOA-optimised dense DAISY Filter Flow, epipolar culling",
    ),
    provenance="faithful-paper",
    published_as=("EMFOA-OFT-SLAM",),
)
MONOCULAR = _spec(
    "emfoa-oft-mono",
    "EMFOA-OFT, monocular",
    EmfoaOftMonoSettings,
    "our own system without depth: masks, EMFOA-optimised sparse flow, guarded epipolar test",
)
VARIANTS: dict[str, tuple[type[SystemSettings], str]] = {
    "emfoa-oft?depth=none": (MaskedEpipolarTestSettings, "without the tests of depth, which are ours"),
    "emfoa-oft?masks=none": (DepthTestSettings, "geometry alone"),
    "emfoa-oft?masks=none&depth=none": (EpipolarTestSettings, "the guarded epipolar test alone"),
    "emfoa-oft?masks=vote": (ObjectVoteDepthTestSettings, "the vote of an object's points, and the tests of depth"),
    "emfoa-oft?masks=vote&depth=none": (ObjectVoteSettings, "objects go by the vote of their points, not by class"),
    "emfoa-oft?flow=none": (SemanticSystemSettings, "masks alone"),
    "emfoa-oft?flow=lucas-kanade": (LucasKanadeSettings, "Lucas-Kanade instead of DAISY Filter Flow"),
    "emfoa-oft?search=patchmatch": (PatchMatchSettings, "PatchMatch instead of EMFOA"),
    "emfoa-oft?search=emfoa-literal": (LiteralSettings, "the moth-flame equations as printed"),
    "emfoa-oft-paper?flow=sparse": (PaperSparseSettings, "the paper's test on the flow of our own system"),
    "emfoa-oft-paper?masks=none": (PaperTestSettings, "the paper's flow and epipolar test alone"),
}
"""Ablations: id, settings, and what differs."""


def _variant(name: str, settings: type[SystemSettings], difference: str) -> TrackerSpec:
    spec = replace(_spec(name, name, settings, f"ablation: {difference}"), label=f"{name} (ablation)", ranked=False)
    return replace(spec, entry_point=f"{__name__}:build_vote") if "masks=vote" in name else spec


SPECS = [EMFOA_OFT, PAPER, MONOCULAR, *(_variant(name, *variant) for name, variant in VARIANTS.items())]
