"""Runs whose scale is unknown never stand in one table with errors that were taken without scale."""

import json

import pytest
from reports_fake_store import add_run

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import MONOCULAR, get_protocol
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs import RunStore, score


def mixed(root, trackers=("orb-slam2", "orb-slam2-mono")):
    """A store of one run a tracker; those called ``-mono`` are monocular."""
    store = RunStore(root)
    for tracker in trackers:
        run_id = add_run(store, tracker, "synthetic/sitting_xyz")
        path = store.folder(run_id) / "run.json"
        record = json.loads(path.read_text())
        record["tracker"]["sensors"] = "rgb" if tracker.endswith("-mono") else "rgbd"
        path.write_text(json.dumps(record))
    return store


def test_a_protocol_without_scale_leaves_monocular_runs_out_and_counts_them(tmp_path):
    store = mixed(tmp_path)
    metric = load_runs([store], get_protocol("tum-rgbd/v1"))
    assert [run.row.tracker for run in metric.runs] == ["orb-slam2"] and metric.without_scale == 1
    scaled = load_runs([store], get_protocol(MONOCULAR))
    assert {run.row.tracker for run in scaled.runs} == {"orb-slam2", "orb-slam2-mono"} and not scaled.without_scale
    assert all(run.row.metrics["ate_rmse_m"] > 0 for run in scaled.runs)


def test_where_nothing_else_is_there_the_report_says_which_protocol_shows_them(tmp_path):
    store = mixed(tmp_path, ("orb-slam2-mono",))
    with pytest.raises(ReportError, match=rf"all 1 runs of monocular trackers.*--protocol {MONOCULAR}"):
        load_runs([store], get_protocol("tum-rgbd/v1"))


def test_a_monocular_run_has_no_error_under_a_protocol_without_scale_but_the_reason(tmp_path):
    store = mixed(tmp_path, ("orb-slam2-mono",))
    (record,) = store.all()[0]
    scored = score(store, record, "tum-rgbd/v1")
    assert scored.online is None and "monocular" in scored.reasons["online"] and MONOCULAR in scored.reasons["online"]
    assert score(store, record, MONOCULAR).online is not None
