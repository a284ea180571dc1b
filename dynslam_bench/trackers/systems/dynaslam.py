"""DynaSLAM (Bescos et al. 2018): masks of a-priori dynamic classes, multi-view geometry, or both."""

from typing import Literal

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import MultiViewSettings
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.trackers.systems.composition import (
    CFPN,
    SemanticSystemSettings,
    SystemSettings,
    composed,
    describe_masks,
)


class DynaSlamMasksSettings(SemanticSystemSettings):
    """Masks of nineteen classes."""

    segmentation: SegmentationSettings = SegmentationSettings(classes="dynaslam19")


class DynaSlamSettings(DynaSlamMasksSettings):
    """Masks and multi-view geometry, constants of the paper."""

    multiview: MultiViewSettings = MultiViewSettings()


class DynaSlamCodeSettings(DynaSlamSettings):
    """The constants of the authors' code where they differ from the paper."""

    multiview: MultiViewSettings = MultiViewSettings(tau_m=0.6, order="farthest", min_keyframes=5, border_px=15)


class DynaSlamGeometrySettings(SystemSettings):
    """Without semantics."""

    multiview: MultiViewSettings = MultiViewSettings()


build = composed(("semantic:SemanticFilter", "segmentation"), ("multiview_depth:MultiViewFilter", "multiview"))
GEOMETRY = (
    "a seed needs a neighbourhood of nearly one depth (variance below 0.001 m^2, missing depth as 0), as in the code",
    "the next pixel of a region is the one nearest to its mean to 5 mm",
    "the low-cost tracking matches the last frame alone",
    "parallax is taken between camera centres (the code's translation is in another frame)",
)
AS_IN_THE_PAPER = (
    "the geometric test acts from the first keyframe on (the paper is silent, the code waits for five)",
    "features at the border of the geometric mask stay (the code drops those within 15 px, the paper does not)",
)
MASKS = (
    "nineteen classes where masks are exact or from a COCO network; the embedded network finds people alone",
    "masks are grown by 15 px, as in the code",
    "the further 15 px at the border of the semantic masks, whose features the code drops, stay",
)
UNION = "the masks of N and G are united, as in the code (the paper keeps G's where both find an object)"


def _spec(
    suffix: str,
    variant: str,
    settings: type[SystemSettings],
    provenance: Literal["faithful-code", "faithful-paper", "inspired"],
    published_as: tuple[str, ...],
    falls_short: str = "",
) -> TrackerSpec:
    defaults, assumptions = settings(), []
    if isinstance(defaults, SemanticSystemSettings):
        assumptions += [describe_masks(defaults.segmentation), CFPN, *MASKS]
    if "multiview" in settings.model_fields:
        assumptions += GEOMETRY if provenance == "faithful-code" else [*GEOMETRY, *AS_IN_THE_PAPER]
    if isinstance(defaults, DynaSlamSettings):
        assumptions.append(UNION)
    return TrackerSpec(
        id=f"dynaslam{suffix}",
        entry_point=f"{__name__}:build",
        label=f"DynaSLAM {variant} (our back end)",
        settings=settings,
        summary=f"DynaSLAM, variant {variant}",
        provenance=provenance,
        ranked=provenance != "inspired",
        published_as=published_as,
        license="MIT (re-implemented from the description; the authors' code is GPL-3.0)",
        citation="Bescos et al., DynaSLAM, IEEE RA-L 2018",
        assumptions=tuple(assumptions),
        remarks="background inpainting is left out: it rejects nothing" + falls_short,
    )


G_FALLS_SHORT = (
    "; worse than a static camera where people fill the view from the start (Bonn from frames 80 and 120: "
    "0.074 and 0.044 m against 0.053 and 0.029), which nobody reports of the authors' program: hence inspired"
)
BOTH = ("DynaSLAM N+G", "DynaSLAM")
SPECS = [
    _spec("", "N+G", DynaSlamSettings, "faithful-paper", BOTH),
    _spec("-code", "N+G (code's constants)", DynaSlamCodeSettings, "faithful-code", BOTH),
    _spec("-n", "N", DynaSlamMasksSettings, "faithful-code", ("DynaSLAM N",)),
    _spec("-g", "G", DynaSlamGeometrySettings, "inspired", ("DynaSLAM G",), G_FALLS_SHORT),
]
