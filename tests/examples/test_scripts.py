"""The example scripts, run as they stand but for fewer frames."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from notebooks import EXAMPLES

from dynslam_bench.testing import check_tracker
from dynslam_bench.trackers import TRACKERS


def main_of(script: str):
    return runpy.run_path(str(EXAMPLES / script))["main"]


def test_own_data_set_then_its_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, results = str(tmp_path / "mine"), str(tmp_path / "results")
    main_of("own_dataset.py")(folder, results, 8)
    still, slam = capsys.readouterr().out.splitlines()
    assert still.startswith("never-move   ok") and slam.startswith("orb-slam2    ok")
    assert float(slam.split()[-2]) < 0.5 * float(still.split()[-2]), "mm: the recording can be tracked"

    main_of("read_results.py")(results, str(tmp_path / "figures"))
    told = capsys.readouterr().out
    assert "folder/mine" in told and "slowest frames" in told
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"ate.html", "frames.html"}


def test_own_tracker_is_found_where_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = shutil.copytree(EXAMPLES / "own_tracker", tmp_path / "source")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", tmp_path / "there", source], check=True, capture_output=True, timeout=120)
    monkeypatch.syspath_prepend(tmp_path / "there")
    try:
        TRACKERS.refresh()
        found = {found.spec.id: found for found in TRACKERS.all()}["shift-odometry"]
        assert found.spec.entry_point == "own_tracker.slam:ShiftOdometry" and "own-tracker" in found.source
    finally:
        monkeypatch.undo()
        TRACKERS.refresh()


def test_own_tracker_keeps_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES / "own_tracker")
    check_tracker("own_tracker:SPEC")


def test_ppo_trains_and_is_judged(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("stable_baselines3", reason="the extra [rl] is not installed")
    main_of("ppo.py")(8, frames=4, scenes=1)
    assert "default settings:" in (text := capsys.readouterr().out) and "after 8 steps" in text
