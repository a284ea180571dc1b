"""What published systems get from the shared stages is the same as their sources say, or stands in their specs."""

from __future__ import annotations

import pytest

from dynslam_bench.core.errors import SettingsError
from dynslam_bench.core.settings import build, parameters
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.trackers.registry import all_specs
from dynslam_bench.trackers.systems.composition import (
    PublishedFlowSettings,
    SemanticSystemSettings,
    UnfilteredSystemSettings,
    describe_masks,
    describe_tracks,
)

SYSTEMS = [spec for spec in all_specs() if issubclass(spec.settings, UnfilteredSystemSettings)]
OBJECTS = ("ds-slam", "di-slam", "yolo-slam", "dynatm-slam", "ngd-slam", "sgc-slam", "detect-slam", "dgs-slam")
"""Systems that judge by boxes or by whole objects."""


@pytest.mark.parametrize("spec", SYSTEMS, ids=lambda spec: spec.id)
def test_specs_state_how_masks_and_flow_are_computed(spec) -> None:
    text, settings = "; ".join(spec.assumptions), spec.settings()
    if isinstance(settings, SemanticSystemSettings):
        assert describe_masks(settings.segmentation).partition("come from")[2] in text
    if isinstance(getattr(settings, "flow", None), PublishedFlowSettings) and spec.provenance != "assumed":
        assert describe_tracks(settings.flow) in text


def test_no_published_system_has_a_check_on_its_flow_but_one_that_says_so() -> None:
    published = [
        spec for spec in SYSTEMS if not spec.id.startswith("emfoa-oft") and "flow" in spec.settings.model_fields
    ]
    checked = [spec.id for spec in published if spec.settings().flow.forward_backward_px > 0]
    assert len(published) > 8 and checked == ["dai-slam"]
    assert describe_tracks(TRACKERS.get("dai-slam").settings().flow) in "; ".join(TRACKERS.get("dai-slam").assumptions)


@pytest.mark.parametrize("name", (*OBJECTS, "blitz-slam"))
def test_masks_are_grown_and_repaired_only_where_the_system_does_it(name: str) -> None:
    settings = TRACKERS.get(name).settings
    assert ("segmentation.dilation_px" in {each.name for each in parameters(settings)}) == (name == "blitz-slam")
    with pytest.raises(SettingsError):
        build(settings, {"segmentation": {"repair": "depth"}})
