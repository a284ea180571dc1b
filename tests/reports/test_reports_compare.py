"""Two results folders side by side: which runs are paired, what differs, and what cannot be compared."""

import numpy as np
import pytest
from reports_fake_store import add_run, fill

from dynslam_bench.core.errors import ReportError
from dynslam_bench.reports import compare
from dynslam_bench.reports.tables.table import to_markdown
from dynslam_bench.runs.store import RunStore


def test_compare_finds_what_changed(made, tmp_path):
    store, paths = made
    walking = ["synthetic/walking_xyz", "synthetic/walking_rpy"]
    better = fill(tmp_path / "b", trackers={"orb-slam2": 0.10, "mask-rcnn": 0.002}, sequences=walking)
    comparison = compare(store, better)
    changed, same = (comparison.overall[f"{name} (our back end)"] for name in ("Mask R-CNN", "ORB-SLAM2"))
    assert changed.value == pytest.approx(0.1, rel=0.1) and same.value == pytest.approx(1.0)
    assert np.isnan(changed.high)  # two sequences give no interval
    verdicts = {row[0].text: row[5].text for row in comparison.table.rows if row[1].text.startswith("all ")}
    assert verdicts["Mask R-CNN (our back end)"] == "B better on 2 of 2, too few to tell"
    assert verdicts["ORB-SLAM2 (our back end)"] == "equal"
    assert (comparison.only_a, comparison.only_b) == (12 + 12 + 1 + 3 * 6, 0)
    itself = compare(store, store).overall
    assert compare(paths.data.parent, paths.data).overall.keys() == itself.keys()
    assert all(interval.value == 1 for interval in itself.values())
    assert "| Mask R-CNN (our back end) | all 2 sequences |" in to_markdown(comparison.table)


def test_compare_refuses_what_has_nothing_in_common(made, tmp_path):
    store, _ = made
    other = RunStore(tmp_path / "b")
    add_run(other, "new-tracker", "s/a")
    with pytest.raises(ReportError, match=r"\(61 runs\) and .* \(1 runs\) have no tracker and sequence in common"):
        compare(store, other)


def test_compare_pairs_runs_of_different_settings_and_says_what_differs(tmp_path):
    before, after = RunStore(tmp_path / "a"), RunStore(tmp_path / "b")
    for name in [f"s/{i}" for i in range(6)]:
        add_run(before, "ours", name, error=0.05, overrides={"epipolar.threshold_px": 1.0})
        add_run(after, "ours", name, error=0.02, overrides={"epipolar.threshold_px": 2.0})
        add_run(before, "same", name)
        add_run(after, "same", name)
    found = compare(before, after)
    name = "ours · epipolar.threshold_px=1.0 → ours · epipolar.threshold_px=2.0"
    assert found.differences == {name: ["epipolar.threshold_px: 1.0 in A, 2.0 in B"], "same": []}
    assert found.overall.keys() == found.differences.keys() and found.overall[name].high < 1
    assert (found.only_a, found.only_b) == (0, 0) and "What differs" in found.table.caption
    verdicts = {cells[0].text: cells[5].text for cells in found.table.rows if cells[1].text.startswith("all ")}
    assert verdicts[name] == "better"


def test_compare_takes_the_nearest_settings_and_leaves_the_rest(tmp_path):
    before, after = RunStore(tmp_path / "a"), RunStore(tmp_path / "b")
    add_run(before, "ours", "s/a")
    for seed in (0, 1):
        add_run(after, "ours", "s/a", seed, overrides={"x": 1})
    add_run(after, "ours", "s/a", overrides={"x": 1, "y": 2})
    found = compare(before, after)
    assert list(found.differences.values()) == [["x: default in A, 1 in B"]]
    assert (found.only_a, found.only_b) == (0, 1)
    assert found.table.rows[0][-1].text == "1 + 1", "of the repeats that both have"
