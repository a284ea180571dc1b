"""What published systems get that their sources do not name is said in their specs, with the numbers in force."""

from __future__ import annotations

import pytest
from baseline_rows import PAGE, shown, table

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import build, parameters
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.trackers import TRACKERS, TrackerSpec
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    SystemSettings,
)

PUBLISHED = [
    spec
    for spec in all_specs()
    if issubclass(spec.settings, SystemSettings) and not spec.id.startswith("emfoa-oft")  # docs/method.md says theirs
]
WITH_MASKS = [
    spec
    for spec in all_specs()
    if issubclass(spec.settings, SemanticSystemSettings) and spec.settings().segmentation.source != "none"
]
WITH_FLOW = [spec for spec in PUBLISHED if isinstance(getattr(spec.settings(), "flow", None), PublishedFlowSettings)]
GROW_UNSTATED = ("sof-slam", "seg-slam", "chen-slam", "chen-slam-mono", "huai-slam", "cfp-slam")
"""Systems whose masks are grown although no source says how far; DynaSLAM's 15 px are its own."""
OBJECTS = ("ds-slam", "di-slam", "yolo-slam", "dynatm-slam", "ngd-slam", "sgc-slam", "detect-slam", "dgs-slam")
"""Systems that judge by boxes or by whole objects."""
NAMED = {
    "ds-slam": ("undistorted", "degeneracy guard"),
    "blitz-slam": ("RANSAC of 1 px", "refitted", "movable", "boxes are those of the masks", "residual removal"),
    "yolo-slam": ("nearest depth first", "square metres", "without depth", "50 pairs", "boxes are those of"),
    "di-slam": (
        "SG-SLAM stands in",
        "unmatched = judge",
        "previous image",
        "refitted",
        "guard",
        "without growing regions",
    ),
    "sgc-slam": ("refitted", "fewer than 20", "quadtree"),
    "mask-rcnn": ("border of the grown mask",),
    "dynaslam-n": (
        "further 15 px at the border",
        "CFPN acts in the embedded network alone",
        "nineteen classes",
        "grown",
    ),
    "dynaslam-code": ("further 15 px at the border", "CFPN acts in the embedded", "united", "grown by 15 px"),
    "emfoa-oft-paper": ("CFPN acts in the embedded network alone", "masks grown by 15 px (not stated)"),
}
"""Words of further deviations, found by reading code beside source."""


def told(spec: TrackerSpec) -> str:
    return "; ".join((*spec.assumptions, spec.remarks))


def test_no_published_system_has_a_check_on_its_flow_unless_its_spec_says_so() -> None:
    checked = []
    for spec in PUBLISHED:
        flow = getattr(spec.settings(), "flow", None)
        if isinstance(flow, FlowSettings) and flow.forward_backward_px > 0:
            assert f"a check of {flow.forward_backward_px:g} px on the way back" in told(spec), spec.id
            checked.append(spec.id)
    assert checked == ["dai-slam"]


@pytest.mark.parametrize("name", OBJECTS)
def test_systems_that_look_at_objects_offer_no_setting_that_grows_or_repairs_a_mask(name: str) -> None:
    tunable = {each.name for each in parameters(TRACKERS.get(name).settings)}
    assert "segmentation.confidence" in tunable
    assert not [each for each in tunable if each.startswith(("segmentation.dilation", "segmentation.repair"))]


def test_masks_that_depth_completes_are_grown_and_not_repaired() -> None:
    tunable = {each.name for each in parameters(TRACKERS.get("blitz-slam").settings)}
    assert "segmentation.dilation_px" in tunable and "segmentation.repair" not in tunable
    with pytest.raises(SettingsError, match="repair"):
        build(TRACKERS.get("blitz-slam").settings, {"segmentation": {"repair": "depth"}})


def test_the_page_shows_the_table_of_the_specs() -> None:
    assert shown(PAGE.read_text(encoding="utf-8")) == table(), "rewrite it: python tests/trackers/baseline_rows.py"
