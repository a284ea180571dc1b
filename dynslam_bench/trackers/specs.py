"""The specs of all built-in trackers; importing this loads neither torch nor OpenCV."""

from __future__ import annotations

from .adapters.specs import adapter_specs
from .protocol import TrackerSpec
from .systems import emfoa_oft, mask_rcnn, orb_slam2


def all_specs() -> list[TrackerSpec]:
    """Every built-in tracker's spec."""
    return [orb_slam2.SPEC, mask_rcnn.SPEC, *emfoa_oft.SPECS, *adapter_specs()]
