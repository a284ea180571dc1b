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


def _assumptions(name: str, base: type[SystemSettings], groups: Groups) -> list[str]:
    """Sentences on what is assumed or ours in a system, as its settings make them true."""
    masks = base is not SystemSettings
    monocular = base is MonocularSemanticSettings
    tested = "epipolar" in groups
    paper = name.startswith("emfoa-oft-paper")
    sparse = isinstance(groups.get("flow"), FlowSettings)
    guarded = tested and not paper
    sentences: list[str] = []
    if name == "emfoa-oft":
        sentences.append(
            "the paper's are the masks, the EMFOA-optimised DAISY Filter Flow and the epipolar test; "
            "ours are the flow at the points alone without aggregated costs, the conditions under "
            "which the epipolar test may cull, and the tests of motion and free space in depth"
        )

    # masks
    if masks:
        sentences.append("{masks}")
        sentences.append(CFPN)
    if masks and "segmentation" not in groups:
        sentences.append("{dilation}")

    if tested:
        sentences.append("epipolar threshold 1 px and RANSAC (not stated in the paper)")
    if not monocular:
        sentences.append("RGB-D back end (the paper says monocular, depth-based and RGB-D in turn)")

    # flow
    if sparse:
        sentences.append(
            "labels are searched at the points alone and by the descriptors' term of Eq. 1 alone; "
            "no Eq. 2 and 3 (ours)"
        )
    if paper and not sparse:
        sentences.append(
            "weights and truncations of Eq. 1 (not stated): alpha 55, beta 190, 0.882 a histogram, "
            "7 and 2 grey levels"
        )
        sentences.append(
            "labels live on superpixels, pass between them, are refined by Lucas-Kanade and tried "
            "on every pixel of the region (as in DAISY Filter Flow; the refinement, the way back of 1.5 px and the "
            "smoothing by regions are ours)"
        )

    # the guard of the epipolar test, and tests beside it
    if guarded:
        sentences.append(
            "the epipolar test is skipped where F means nothing: too little parallax, one plane (ours)"
        )
    if guarded and monocular:
        sentences.append("a failing point goes only where its neighbours fail too (ours)")
    if guarded and not monocular:
        sentences.append(
            "a failing point goes only where its neighbours fail too, and an F that depth "
            "contradicts is not used (ours)"
        )
    if "motion" in groups:
        sentences.append(
            "rigid motion in depth and free space seen before are tested as well "
            "(ours, no part of the paper)"
        )

    if monocular:
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
