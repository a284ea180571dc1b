"""The example in C++: compiled with the system's compiler, run as anybody would."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from dynslam_bench.envs.slam_env import SlamEnv

SOURCE = Path(__file__).resolve().parents[3] / "examples" / "cpp" / "direct_odometry.cpp"
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler here")
def test_a_tracker_in_one_cpp_file_follows_the_camera(tmp_path: Path) -> None:
    program = tmp_path / "direct_odometry"
    assert COMPILER is not None
    command = [COMPILER, "-O2", "-Wall", "-Wextra", "-Werror", "-o", str(program), str(SOURCE)]
    subprocess.run(command, check=True, capture_output=True)
    env = SlamEnv("synthetic/sitting_xyz?scene=100", f"subprocess:{program}", frames=(0, 12))
    env.reset(seed=0)
    info: dict = {}
    for _ in range(11):
        *_, info = env.step(0)
    outcomes = env.episode.outcomes
    assert [each.state for each in outcomes] == ["ok"] * 12
    assert all(set(each.timings) >= {"odometry", "transfer"} for each in outcomes[1:])
    metrics = info["episode_metrics"]
    env.close()
    assert metrics["ate_rmse_m"] < 0.3 * metrics["static_camera_ate_rmse_m"]
