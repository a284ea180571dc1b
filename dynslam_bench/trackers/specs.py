"""The specs of all built-in trackers; importing this loads neither torch nor OpenCV."""

from __future__ import annotations

from importlib import import_module

from dynslam_bench.contracts.tracker import TrackerSpec

from .adapters.specs import adapter_specs
from .systems import chen_slam, dynaslam, emfoa_oft, emfoa_oft_mono

_SYSTEMS = (
    "blitz_slam", "cfp_slam", "dai_slam", "detect_slam", "dgs_slam", "di_slam", "ds_slam", "dynatm_slam",
    "huai_slam", "mask_rcnn", "mor_slam", "ngd_slam", "opf_slam", "orb_slam2", "orb_slam2_mono", "seg_slam", "sgc_slam",
    "sof_slam", "yolo_slam",
)  # fmt: skip
_SINGLE = [import_module(f".systems.{name}", __package__).SPEC for name in _SYSTEMS]


def all_specs() -> list[TrackerSpec]:
    """Every built-in tracker's spec."""
    return [*emfoa_oft.SPECS, emfoa_oft_mono.SPEC, *dynaslam.SPECS, *chen_slam.SPECS, *_SINGLE, *adapter_specs()]
