"""The specs of all built-in trackers; importing this loads neither torch nor OpenCV."""

from __future__ import annotations

from .adapters.specs import adapter_specs
from .protocol import TrackerSpec
from .systems import (
    blitz_slam,
    cfp_slam,
    chen_slam,
    dai_slam,
    detect_slam,
    dgs_slam,
    di_slam,
    ds_slam,
    dynaslam,
    dynatm_slam,
    emfoa_oft,
    huai_slam,
    mask_rcnn,
    mor_slam,
    ngd_slam,
    opf_slam,
    orb_slam2,
    seg_slam,
    sgc_slam,
    sof_slam,
    yolo_slam,
)

_SINGLE = (
    blitz_slam,
    cfp_slam,
    chen_slam,
    dai_slam,
    detect_slam,
    dgs_slam,
    di_slam,
    ds_slam,
    dynatm_slam,
    huai_slam,
    mask_rcnn,
    mor_slam,
    ngd_slam,
    opf_slam,
    orb_slam2,
    seg_slam,
    sgc_slam,
    sof_slam,
    yolo_slam,
)


def all_specs() -> list[TrackerSpec]:
    """Every built-in tracker's spec."""
    return [*emfoa_oft.SPECS, *dynaslam.SPECS, *(module.SPEC for module in _SINGLE), *adapter_specs()]
