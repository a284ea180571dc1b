"""The example scripts, run as they stand but for fewer frames."""

import ast
import json
import runpy
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dynslam_bench import api as db
from dynslam_bench.core.settings import parameters
from dynslam_bench.testing import check_tracker
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import read_study

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def main_of(script: str):
    return runpy.run_path(str(EXAMPLES / script))["main"]


def test_own_data_set_then_its_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "mine")
    results = str(tmp_path / "results")
    main_of("own_dataset.py")(folder, results, 8)
    still, slam = capsys.readouterr().out.splitlines()
    assert still.startswith("never-move   ok")
    assert slam.startswith("orb-slam2    ok")
    assert float(slam.split()[-2]) < 0.5 * float(still.split()[-2]), (
        "mm: the recording can be tracked"
    )

    main_of("read_results.py")(results, str(tmp_path / "figures"))
    told = capsys.readouterr().out
    assert "folder/mine" in told
    assert "slowest frames" in told
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"ate.html", "frames.html"}


def test_own_tracker_is_found_where_it_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = shutil.copytree(EXAMPLES / "own_tracker", tmp_path / "source")
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    subprocess.run(
        [*command, "--target", tmp_path / "there", source],
        check=True,
        capture_output=True,
        timeout=120,
    )
    monkeypatch.syspath_prepend(tmp_path / "there")
    try:
        TRACKERS.refresh()
        found = {found.spec.id: found for found in TRACKERS.all()}["shift-odometry"]
        assert found.spec.entry_point == "own_tracker.slam:ShiftOdometry"
        assert "own-tracker" in found.source
    finally:
        monkeypatch.undo()
        TRACKERS.refresh()


def test_own_tracker_keeps_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES / "own_tracker")
    check_tracker("own_tracker:SPEC")


COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler here")
def test_a_cpp_program_reads_its_settings_from_a_template(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in (EXAMPLES / "program").iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    flags = ["-O2", "-Wall", "-Wextra", "-Werror", "-o", "odometry"]
    subprocess.run([COMPILER, *flags, "odometry.cpp"], check=True, capture_output=True)
    how: dict[str, Any] = {"frames": (0, 12), "results": tmp_path / "results"}
    sequence = "synthetic/sitting_xyz?scene=100"
    runs = [
        db.run("batch:odometry.toml", sequence, settings=settings, **how)
        for settings in ({}, {"huber": 4.0, "keyframe_m": 0.1})
    ]
    for run in runs:
        assert run.status == "ok", run.record.reason
        assert run.record.coverage == 1.0
        assert run.metrics["ate_rmse_m"] < 0.5 * run.metrics["static_camera_ate_rmse_m"]
    assert runs[0].metrics["ate_rmse_m"] != runs[1].metrics["ate_rmse_m"]

    # its study is one of its two settings
    study = read_study("study.toml")
    spec = TRACKERS.get(study.tracker)
    assert [parameter.name for parameter in parameters(spec.settings)] == ["huber", "keyframe_m"]
    assert study.instances(*study.held_out)


@pytest.mark.parametrize("benchmark", ["masks-v0", "features-v0"])
def test_agents_are_compared(
    benchmark: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("stable_baselines3", reason="the extra [rl] is not installed")
    monkeypatch.syspath_prepend(EXAMPLES / "online_control")
    main_of("online_control/compare.py")(
        benchmark, steps=12, seeds=1, scenes=1, test=2, data_root=str(tmp_path), frames=(0, 10)
    )
    text = capsys.readouterr().out
    rows = [row.split(" | ") for row in text.splitlines() if row.count(" | ") == 7]
    losses = {row[0][2:].partition(":")[0]: float(row[1]) for row in rows if row[1][0].isdigit()}
    assert losses["best static of each scene"] <= losses["best static"]
    assert {"default", "random", "hindsight splice", "rule by hand", "PPO"} < set(losses)
    assert losses["hindsight splice"] <= losses["best static of each scene"]
    assert "left out" in text, "no recordings there"
    assert "is not at" in text, "no recordings there"


def test_static_settings_become_a_minari_data_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("minari", "jax", "h5py"):
        pytest.importorskip(module, reason="Minari is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.syspath_prepend(EXAMPLES / "online_control")
    data = main_of("online_control/dataset.py")("features-v0", 1, frames=[0, 6])
    assert [len(episode.rewards) for episode in data] == [2] * 12


# The notebooks run from the first cell to the last, on less data, and are stored without outputs.


NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
SHORTER = {
    "leaderboard": {
        "FRAMES = 60": "FRAMES = 4",
        "range(100, 107)": "range(100, 102)",
        ', "mask-rcnn"': "",
    },
    "culling": {},
}
SHOWN = {
    "leaderboard": ["never move", "droid-w/v1", "'ok': 4"],
    "culling": ["epipolar_f_judged", "precision 83%, recall 33%"],
}
"""Texts in the outputs of a notebook, from its first cells to its last one; `tests/tuning` runs that of studies."""


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_they_hold_no_outputs(notebook: Path) -> None:
    code = [cell for cell in cells(notebook) if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert [(cell["outputs"], cell["execution_count"]) for cell in code] == [([], None)] * len(code)


@pytest.mark.parametrize("name", SHORTER)
def test_they_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shown = play(EXAMPLES / "notebooks" / f"{name}.ipynb", SHORTER[name])
    output = capsys.readouterr().out + "".join(
        v.to_json() if hasattr(v, "to_json") else repr(v) for v in shown
    )
    output = output.replace("\\/", "/")  # as JSON writes it
    assert [text for text in SHOWN[name] if text not in output] == []


def cells(notebook: Path) -> list[dict[str, Any]]:
    """All cells of a notebook."""
    return json.loads(notebook.read_text(encoding="utf-8"))["cells"]


def play(notebook: Path, changes: Mapping[str, str]) -> list[Any]:
    """Run a notebook and return the values that its cells show.

    Args:
        notebook: The file.
        changes: Texts of its code and their replacements, for shorter runs; each has to occur.
    """
    code = ["".join(cell["source"]) for cell in cells(notebook) if cell["cell_type"] == "code"]
    for old, new in changes.items():
        assert any(old in text for text in code), f"{notebook.name} has no {old!r}"
        code = [text.replace(old, new) for text in code]
    names: dict[str, Any] = {}
    shown = []
    for text in code:
        *before, last = ast.parse(text).body
        if not isinstance(last, ast.Expr):
            before.append(last)
        exec(compile(ast.Module(before, []), str(notebook), "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), str(notebook), "eval"), names))
    return [value for value in shown if value is not None]
