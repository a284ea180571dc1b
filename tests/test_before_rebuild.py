"""What was stored, and what was plugged in, before the rooms were rebuilt loads with today's code."""

from __future__ import annotations

import json
import shutil
import sys
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core.moved import MOVED
from dynslam_bench.reports import build_report
from dynslam_bench.runs import RunStore, load_frames, score
from dynslam_bench.runs.frames import read_csv, write_csv
from dynslam_bench.testing import CornerSequence
from dynslam_bench.tuning import StudySummary, Tuner, read_study, write_page

FIXTURE = Path(__file__).resolve().parent / "fixtures" / "before_rebuild"
OLD_SLAM, NEVER_MOVE = "a7abe04996a79cc4", "e7f8d4df9db4bb16"


@pytest.fixture
def before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the fixture, as the working folder: reading a store adds metrics to it."""
    monkeypatch.chdir(shutil.copytree(FIXTURE, tmp_path / "before"))
    return Path.cwd()


def test_both_runs_are_read_and_scored(before: Path) -> None:
    store = RunStore("results")
    records, unreadable = store.all()
    assert [record.run_id for record in records] == [NEVER_MOVE, OLD_SLAM] and unreadable == []
    assert [record.repeat for record in records] == ["seed 0", "seed 0"]
    for record in records:
        (stored,) = before.glob(f"results/metrics/*/{record.run_id}.json")
        old = json.loads(stored.read_text())["online"]["metrics"]["ate_rmse_m"]
        assert score(store, record, again=True).metrics["ate_rmse_m"] == pytest.approx(old, rel=1e-9)
        assert score(store, record, "evo-default").metrics["ate_rmse_m"] > 0


def test_their_frames_are_read_and_written_again(before: Path) -> None:
    for run_id in (OLD_SLAM, NEVER_MOVE):
        old = before / "results" / "runs" / run_id / "frames.csv"
        rows = read_csv(old)
        write_csv(before / "again.csv", rows)
        assert len(rows) == 8 and read_csv(before / "again.csv") == rows
    frame = load_frames(OLD_SLAM, RunStore("results"))
    assert frame["stat_matches"].tolist()[:2] == [0.0, 614.0] and frame["state"].tolist() == ["ok"] * 8


def test_they_make_rows_of_the_run_table_and_a_report(before: Path) -> None:
    frame = RunStore("results").frame()
    assert frame["tracker"].tolist() == ["never-move", "old-slam"] and (frame["ate_rmse_m"] > 0).all()
    page = build_report("results", before / "report").html.read_text()
    assert "Old Slam" in page and "never move" in page


def test_the_study_and_its_page_are_read(before: Path) -> None:
    tuner = Tuner(read_study("small.toml"), "results", reading=True)
    assert tuner.spec.offsets == (0,)  # as it was run, not today's default
    assert [trial.state.name for trial in tuner.study.get_trials()] == ["COMPLETE"] * 3
    summary = StudySummary.read(tuner.folder / "summary.json")
    assert summary.conclusion.startswith("trial 1: on the tune split ATE x 0.956")
    page = write_page(tuner, summary)
    assert page.is_file() and "threshold_px" in page.read_text()


def test_the_plugin_of_then_tracks_with_a_deprecation_for_its_old_import(before: Path) -> None:
    sys.modules.pop("dynslam_bench.slam.result", None)
    with pytest.warns(
        DeprecationWarning, match=r"'dynslam_bench\.slam\.result' has moved.*import from 'dynslam_bench\.contracts'"
    ):
        from dynslam_bench.trackers import TRACKERS, build_tracker

        TRACKERS.get("./old_slam.py:SPEC")
        tracker = build_tracker("./old_slam.py:SPEC", {"features": 400})
    scene = CornerSequence(4)
    tracker.reset(scene.camera, rng=np.random.default_rng(0))
    results = [tracker.track(scene[index]) for index in range(4)]
    assert [result.state for result in results] == ["ok"] * 4
    true = np.linalg.inv(scene.ground_truth.T_world_cam[0]) @ scene.ground_truth.T_world_cam[3]
    assert np.linalg.norm(results[3].T_world_cam[:3, 3] - true[:3, 3]) < 0.02


@pytest.mark.parametrize("old", sorted(MOVED))
def test_every_old_path_warns_and_gives_the_names_of_the_new_ones(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match="has moved") as caught:
        module = import_module(old)
    assert [str(w.message) for w in caught if old in str(w.message)]
    names = {name: home for home in reversed(MOVED[old]) for name in vars(import_module(home)) if name[0] != "_"}
    assert names and all(getattr(module, name) is getattr(import_module(home), name) for name, home in names.items())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert import_module(old) is module  # once is enough
