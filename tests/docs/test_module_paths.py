"""What the tests, their scripts and the measurements take from the package is there, in code and in texts."""

from __future__ import annotations

from pathlib import Path

from documented_names import ROOT
from module_paths import is_there, taken

GROUPS = {f"dynslam_bench.{name}" for name in ("segmenters", "filters", "features", "flow", "sequences", "trackers")}
"""Groups of entry points: not all of them are rooms."""


OLD = tuple(GROUPS)


def test_every_path_leads_somewhere() -> None:
    files = [file for file in sorted((ROOT / "tests").rglob("*.py")) if "fixtures" not in file.parts]
    files.remove(Path(__file__))
    found = [(file.relative_to(ROOT), *each) for file in files for each in taken(file.read_text(encoding="utf-8"))]
    assert len(files) > 150 and len(found) > 1000
    gone = [f"{file}:{line}: {path}" for file, line, path in found if not is_there(path) and not path.startswith(OLD)]
    assert gone == []


def test_the_search_sees_what_it_is_for() -> None:
    script = "from dynslam_bench.runs import gone, run_one\nx = tuning.old.name\n"
    code = f"SCRIPT = {script!r}\nimport dynslam_bench.lost\n"
    paths = [path for _, path in taken(code)]
    assert {"dynslam_bench.runs.gone", "dynslam_bench.runs.run_one", "tuning.old.name"} < set(paths)
    assert [path for path in paths if is_there(path)] == ["dynslam_bench.runs", "dynslam_bench.runs.run_one"]
    assert is_there("dynslam_bench.reports.model.board.make_board") and is_there("reports.model.board")
    assert is_there("dynslam_bench.core.errors.DynslamError.hint")
    assert not is_there("dynslam_bench.reports.board") and not is_there("dynslam_bench.core.errors.Nothing")
