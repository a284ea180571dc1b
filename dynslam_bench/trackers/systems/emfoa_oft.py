"""EMFOA-OFT-SLAM as the paper describes it, this project's system made from it, and the ablations of both.

A variant of a system is an ablation, but for ``emfoa-oft?masks=none``, a system of its own: its id
says what differs.

The paper: masks of an improved Mask R-CNN drop the features on people; DAISY Filter Flow, optimised
by the elite moth-flame algorithm, matches the remaining ORB points with the previous image; the
fundamental matrix of those matches culls points off their epipolar lines; the rest is tracked and
mapped. `docs/explanation/paper.md` lists who runs which equation.
"""

from collections.abc import Mapping
from typing import Any

from dynslam_bench.contracts import TrackerSpec
from dynslam_bench.core.settings import Settings
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
    system_spec,
)
from dynslam_bench.trackers.systems.published import SEMANTIC, UNGUARDED

Groups = Mapping[str, Settings]
"""Groups of settings, by name."""

FILTERS = (
    ("epipolar:EpipolarFilter", "epipolar"),
    ("rigid_motion:RigidMotionFilter", "motion"),
    ("free_space:FreeSpaceFilter", "free_space"),
)
"""The filters of all systems here, in the order of application; each needs its group of settings."""
EPIPOLAR: Groups = {"flow": FlowSettings(), "epipolar": EpipolarSettings()}
"""The sparse flow and the guarded epipolar test."""
OWN: Groups = {**EPIPOLAR, "motion": RigidMotionSettings(), "free_space": FreeSpaceSettings()}
"""This project's own: `EPIPOLAR`, and the tests of depth."""
VOTE: Groups = {"segmentation": ObjectSettings(), "epipolar": EpipolarSettings(mode="object")}
"""Without mask culling: the epipolar vote of its points decides on an object (`EpipolarFilter`)."""
PAPER: Groups = {"flow": DenseFlowSettings(terms=3), "epipolar": UNGUARDED}
"""The paper's flow, dense and with all terms, and its test on every frame, without the guard."""


# What is assumed where the paper is silent, and what is this project's own: sentences for the specs.

_SOURCES = (
    "the paper's are the masks, the EMFOA-optimised DAISY Filter Flow and the epipolar test; "
    "ours are the flow at the points alone without aggregated costs, the conditions under "
    "which the epipolar test may cull, and the tests of motion and free space in depth"
)
_THRESHOLD = "epipolar threshold 1 px and RANSAC (not stated in the paper)"
_RGBD = "RGB-D back end (the paper says monocular, depth-based and RGB-D in turn)"
_SPARSE_FLOW = (
    "labels are searched at the points alone and by the descriptors' term of Eq. 1 alone; "
    "no Eq. 2 and 3 (ours)"
)
_DENSE_WEIGHTS = (
    "weights and truncations of Eq. 1 (not stated): alpha 55, beta 190, 0.882 a histogram, "
    "7 and 2 grey levels"
)
_DENSE_FLOW = (
    "labels live on superpixels, pass between them, are refined by Lucas-Kanade and tried "
    "on every pixel of the region (as in DAISY Filter Flow; the refinement, the way back of 1.5 px and the "
    "smoothing by regions are ours)"
)
_GUARD = "the epipolar test is skipped where F means nothing: too little parallax, one plane (ours)"
_NEIGHBOURS = "a failing point goes only where its neighbours fail too (ours)"
_NEIGHBOURS_AND_DEPTH = (
    "a failing point goes only where its neighbours fail too, and an F that depth "
    "contradicts is not used (ours)"
)
_DEPTH_TESTS = (
    "rigid motion in depth and free space seen before are tested as well "
    "(ours, no part of the paper)"
)


def _assumptions(name: str, base: type[SystemSettings], groups: Groups) -> list[str]:
    """Sentences on what is assumed or ours in a system, as its settings make them true."""
    has_masks = base is not SystemSettings
    is_monocular = base is MonocularSemanticSettings
    is_tested = "epipolar" in groups
    is_paper = name.startswith("emfoa-oft-paper")
    is_sparse = isinstance(groups.get("flow"), FlowSettings)
    sentences: list[str] = []
    if name == "emfoa-oft":
        sentences.append(_SOURCES)

    # masks; `composition.sentences` has the texts in braces
    if has_masks:
        sentences += ["{masks}", CFPN]
    if has_masks and "segmentation" not in groups:
        sentences.append("{dilation}")

    # the epipolar test and the back end
    if is_tested:
        sentences.append(_THRESHOLD)
    if not is_monocular:
        sentences.append(_RGBD)

    # flow
    if is_sparse:
        sentences.append(_SPARSE_FLOW)
    if is_paper and not is_sparse:
        sentences += [_DENSE_WEIGHTS, _DENSE_FLOW]

    # the guard of the epipolar test, which the paper's variants lack, and the tests beside it
    if is_tested and not is_paper:
        sentences.append(_GUARD)
        sentences.append(_NEIGHBOURS if is_monocular else _NEIGHBOURS_AND_DEPTH)
    if "motion" in groups:
        sentences.append(_DEPTH_TESTS)

    if is_monocular:
        sentences.append(BACKEND)
    return sentences


def _spec(
    name: str, label: str, base: type[SystemSettings], groups: Groups, summary: str, **more: Any
) -> TrackerSpec:
    """The spec of one of these systems; `more` are further fields of `TrackerSpec`."""
    filters = FILTERS if "masks=vote" in name else (SEMANTIC, *FILTERS)
    return system_spec(
        name,
        label,
        filters,
        groups,
        base=base,
        summary=summary,
        license="MIT",
        citation="EMFOA-OFT-SLAM: the paper that this toolkit implements; see docs/explanation/paper.md",
        assumptions=_assumptions(name, base, groups),
        **{"provenance": "own", **more},
    )


VARIANTS: dict[str, tuple[type[SystemSettings], Groups, str]] = {
    "emfoa-oft?depth=none": (
        SemanticSystemSettings,
        EPIPOLAR,
        "without the tests of depth, which are ours",
    ),
    "emfoa-oft?masks=none&depth=none": (
        SystemSettings,
        EPIPOLAR,
        "the guarded epipolar test alone",
    ),
    "emfoa-oft?masks=vote": (
        SemanticSystemSettings,
        {**OWN, **VOTE},
        "the vote of an object's points, and the tests of depth",
    ),
    "emfoa-oft?masks=vote&depth=none": (
        SemanticSystemSettings,
        {**EPIPOLAR, **VOTE},
        "objects go by the vote of their points, not by class",
    ),
    "emfoa-oft?flow=none": (SemanticSystemSettings, {}, "masks alone"),
    "emfoa-oft?flow=lucas-kanade": (
        SemanticSystemSettings,
        {**OWN, "flow": FlowMethodSettings(method="lucas-kanade")},
        "Lucas-Kanade instead of DAISY Filter Flow",
    ),
    "emfoa-oft?search=patchmatch": (
        SemanticSystemSettings,
        {**OWN, "flow": FlowSettings(search="patchmatch")},
        "PatchMatch instead of EMFOA",
    ),
    "emfoa-oft?search=emfoa-literal": (
        SemanticSystemSettings,
        {**OWN, "flow": FlowSettings(search="emfoa-literal")},
        "the moth-flame equations as printed",
    ),
    "emfoa-oft-paper?flow=sparse": (
        SemanticSystemSettings,
        {**PAPER, "flow": FlowSettings()},
        "the paper's test on the flow of our own system",
    ),
    "emfoa-oft-paper?masks=none": (
        SystemSettings,
        PAPER,
        "the paper's flow and epipolar test alone",
    ),
}
"""Ablations: id, settings, and what differs."""
SPECS = (
    _spec(
        "emfoa-oft",
        "EMFOA-OFT with depth tests, our own (our back end)",
        SemanticSystemSettings,
        OWN,
        "our own system: masks, EMFOA-optimised sparse flow, guarded epipolar test, tests of depth",
        presets=FAST_FLOW,
    ),
    _spec(
        "emfoa-oft-paper",
        "EMFOA-OFT-SLAM (our back end)",
        SemanticSystemSettings,
        PAPER,
        "the paper's system: masks, EMFOA-optimised dense DAISY Filter Flow, epipolar culling",
        provenance="faithful-paper",
        published_as=("EMFOA-OFT-SLAM",),
    ),
    # the paper calls itself monocular in half of its text
    _spec(
        "emfoa-oft-mono",
        "EMFOA-OFT, monocular (our back end)",
        MonocularSemanticSettings,
        EPIPOLAR,
        "our own system without depth: masks, EMFOA-optimised sparse flow, guarded epipolar test",
        sensors="rgb",
    ),
    _spec(
        "emfoa-oft?masks=none",
        "EMFOA-OFT without masks, our own (our back end)",
        SystemSettings,
        OWN,
        "our own system without masks: EMFOA-optimised sparse flow, guarded epipolar test, tests of depth",
    ),
    *(
        _spec(name, f"{name} (ablation)", base, groups, f"ablation: {difference}", ranked=False)
        for name, (base, groups, difference) in VARIANTS.items()
    ),
)
