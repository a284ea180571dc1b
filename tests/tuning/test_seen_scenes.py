"""Studies say where the masks come from a network that was trained on the scenes, wherever a number stands."""

from __future__ import annotations

from pathlib import Path

import pytest
from simulated import TRACKER, SimulatedTuner, make_spec, simulated_design

from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.tuning import finish, write_page
from dynslam_bench.tuning.splits import seen_note, splits_seen

MASKED = {"tracker": "mask-rcnn", "space": {"include": ["features.n_features"]}, "trials": 3}


@pytest.mark.parametrize(
    ("source", "seen"), [("auto", ["tune", "confirm"]), ("embedded", ["tune", "confirm"]), ("oracle", [])]
)
def test_splits_are_seen_by_the_embedded_network_alone(source: str, seen: list[str]) -> None:
    from dynslam_bench.trackers import TRACKERS

    spec = make_spec()
    design = simulated_design(spec.tune, spec.held_out)
    settings = apply_overrides(TRACKERS.get("mask-rcnn").settings(), {"segmentation.source": source})
    assert splits_seen(settings, design) == seen
    assert splits_seen(TRACKERS.get(TRACKER).settings(), design) == [], "a system without masks"


def test_page_summary_and_preset_mark_what_the_network_was_trained_on(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(**MASKED), tmp_path)
    tuner.run()
    summary = finish(tuner)
    assert summary.seen == ["tune", "confirm"]
    page = write_page(tuner, summary).read_text()
    note = seen_note(summary.seen)
    assert "race and choice" in note and page.count("trained on those very scenes") >= 3, "result and both tables"
    assert "in the race §" in page and "unseen instances §" in page and "held-out §" not in page
    assert "trained on" in (tuner.folder / "best.toml").read_text().replace("\n# ", " ")


def test_exact_masks_and_systems_without_masks_are_not_marked(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(trials=3), tmp_path)
    tuner.run()
    summary = finish(tuner)
    assert summary.seen == [] and seen_note(summary.seen) == ""
    assert "§" not in write_page(tuner, summary).read_text()
