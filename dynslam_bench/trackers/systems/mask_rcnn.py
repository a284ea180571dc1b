"""Masks of people as the only filter; `dynaslam-n` is the published system with the same rule."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.trackers.systems.composition import (
    CFPN,
    FAST_MASKS,
    SemanticSystemSettings,
    composed,
    describe_masks,
)

build = composed(("semantic:SemanticFilter", "segmentation"))

SPEC = TrackerSpec(
    id="mask-rcnn",
    entry_point=f"{__name__}:build",
    label="Mask R-CNN culling (our back end)",
    settings=SemanticSystemSettings,
    summary="drops the features on dilated masks of people; the masks' source is a setting",
    provenance="own",
    presets=FAST_MASKS,
    license="MIT",
    citation="He et al., Mask R-CNN, ICCV 2017; Bescos et al., DynaSLAM, IEEE RA-L 2018 (variant N)",
    assumptions=(
        describe_masks(SemanticSystemSettings().segmentation),
        CFPN,
        "masks of people alone; DynaSLAM, whose rule it is, culls nineteen classes (dynaslam-n)",
        "no further drop of features at the border of the grown mask",
    ),
)
