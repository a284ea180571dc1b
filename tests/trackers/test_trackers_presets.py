"""Presets that ship: they fit their tracker, act, and have a study behind them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dynslam_bench.core.settings import apply_overrides, flatten
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.trackers.presets import FOLDER, shipped
from dynslam_bench.tuning.study_file import read_study

PRESETS = sorted(file.name.removesuffix(".toml").split(".") for file in FOLDER.glob("*.toml"))
STUDIES = Path(__file__).resolve().parents[2] / "docs" / "studies"


@pytest.mark.parametrize(("tracker", "name"), PRESETS, ids=".".join)
def test_a_preset_fits_its_tracker_and_was_tuned_by_a_study_that_is_published(tracker: str, name: str) -> None:
    overrides = shipped(tracker)[name]
    spec = TRACKERS.get(tracker)
    assert spec.presets[name] == overrides, "the tracker offers it"
    default = flatten(spec.settings())
    changed = flatten(apply_overrides(spec.settings(), overrides))
    assert {key for key in default if default[key] != changed[key]}, "it changes something"
    study = read_study(STUDIES / f"{name}-{tracker}.toml")
    assert study.tracker == tracker
    assert set(overrides) <= set(study.space.include), "nothing but what was tuned"


def test_presets_ship() -> None:
    assert {name for _, name in PRESETS} >= {"fast"}
