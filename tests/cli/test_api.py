"""The public interface for Python: lazy, typed names, each with the result of its command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import dynslam_bench as db
from dynslam_bench.core.errors import RunError, SettingsError


def test_a_suite_its_report_and_its_frame(walk: Path, tmp_path: Path) -> None:
    suite = tmp_path / "mine.toml"
    suite.write_text(f"trackers = ['never-move', 'constant-velocity']\nsequences = ['{walk}']\n")
    results = tmp_path / "results"
    runs = db.bench(suite, results=results)
    assert [run.status for run in runs] == ["ok", "ok"] and all(run.metrics["ate_rmse_m"] > 0 for run in runs)
    assert len(runs[0].trajectory) == len(runs[0].frames()) == 4 and (runs[0].folder / "run.json").is_file()
    again = db.run("never-move", walk, results=results)
    assert again.record.run_id == runs[0].record.run_id, "it is stored already"
    assert sorted(db.load(results)["tracker"]) == ["constant-velocity", "never-move"]
    assert db.report(results).html == results / "report" / "index.html"


def test_unfit_options_are_errors_of_the_user(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="colour"):
        db.run("never-move", walk, results=tmp_path, colour=1)
    with pytest.raises(SettingsError, match="no preset 'slow'"):
        db.run("orb-slam2", walk, results=tmp_path, preset="slow")
    assert not list(tmp_path.glob("runs/*"))


def test_names_are_listed_and_loaded_on_first_use() -> None:
    assert set(dir(db)) == {"bench", "load", "report", "run", "sequence", "trackers", "tune", "__version__"}
    with pytest.raises(AttributeError, match="nothing"):
        _ = db.nothing
    code = "import dynslam_bench, sys; print([m for m in ('numpy', 'pandas', 'typer', 'pydantic') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
