"""The runs that SLAM-HPO's tables are made of."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from slam_hpo import real

import dynslam_bench as db
from dynslam_bench.runs import RunStore
from dynslam_bench.suites import load_suite

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "packaging" / "slam-hpo"
SEQUENCE = "synthetic/walking_xyz?scene=130"


def test_a_shorter_run_is_the_beginning_of_a_longer_one(tmp_path):
    long = db.run("orb-slam2", SEQUENCE, frames=(4, 44), stride=2, cache=True, results=tmp_path)
    short = real.run("orb-slam2", {}, SEQUENCE, 4, frames=12, results=tmp_path)
    part = real.evaluated(long.store, long.record, 12)
    assert (short.ate_m, short.coverage, short.status) == (part.ate_m, part.coverage, part.status)
    assert short.ate_m != real.evaluated(long.store, long.record, 20).ate_m
    assert len(RunStore(tmp_path).ids()) == 2


def test_a_run_without_a_pose_has_the_error_of_a_static_camera(tmp_path):
    lost = db.run(
        "orb-slam2", SEQUENCE, settings={"features.n_features": 1}, frames=(0, 20), results=tmp_path
    )
    found = real.evaluated(lost.store, lost.record, 20)
    assert found.coverage == 0
    assert found.status == "lost"
    still = db.run("never-move", SEQUENCE, frames=(0, 20), results=tmp_path)
    assert found.ate_m == pytest.approx(still.metrics["ate_rmse_m"], rel=0.02)


def test_the_suite_holds_the_default_and_points_of_the_space(tmp_path):
    spec = importlib.util.spec_from_file_location("make_table", PACKAGE / "make_table.py")
    make_table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_table)
    path = tmp_path / "suite.toml"
    path.write_text(make_table.suite("mask-rcnn", "0", "3"))
    specs = list(load_suite(path).specs())
    assert len(specs) == 4 * 8 * 2
    assert len({str(spec.settings) for spec in specs}) == 4


def test_the_package_s_equations_are_those_of_the_flow():
    """SLAM-HPO is installed without this package, so it has a copy."""
    own = ROOT / "dynslam_bench/flow/moth_flame.py"
    copied = PACKAGE / "slam_hpo/moth_flame.py"
    assert own.read_bytes() == copied.read_bytes(), f"cp {own} {copied}"


def test_a_copy_of_the_package_s_folder_is_complete(tmp_path):
    copy = shutil.copytree(PACKAGE, tmp_path / "copy", symlinks=True)
    assert [path for path in copy.rglob("*") if path.is_symlink()] == []
    code = f"import sys; sys.path.insert(0, {str(copy)!r}); import slam_hpo.moth_flame as one; print(one.__file__)"
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert Path(found.stdout.strip()) == copy / "slam_hpo" / "moth_flame.py"
