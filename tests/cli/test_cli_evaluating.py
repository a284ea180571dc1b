"""`eval` takes every format that it names, and never stamps that are no seconds."""

import json

import numpy as np
import pytest
from cli_helpers import one_line

from dynslam_bench.evaluation import evaluate_files
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.runs.exchange.formats import write_euroc, write_vslam_lab
from dynslam_bench.sequences import open_sequence


@pytest.fixture
def pair():
    rng = np.random.default_rng(3)
    stamps, twists = 1305031100 + np.arange(90) / 30, np.cumsum(rng.normal(0, 0.02, (90, 6)), axis=0)
    return Trajectory(stamps, se3.exp(twists + rng.normal(0, 0.005, (90, 6)))), Trajectory(stamps, se3.exp(twists))


@pytest.mark.parametrize("write", [write_euroc, write_vslam_lab])
def test_tables_in_nanoseconds_give_the_errors_of_the_same_poses_in_seconds(cli, pair, tmp_path, write):
    for trajectory, name in zip(pair, ("estimate", "truth"), strict=True):
        write_tum(tmp_path / f"{name}.txt", trajectory)
        write(tmp_path / f"{name}.csv", trajectory)
    found = []
    for one, other in (("estimate.txt", "truth.txt"), ("estimate.csv", "truth.csv"), ("estimate.csv", "truth.txt")):
        code, out, err = cli("eval", tmp_path / one, tmp_path / other, "--json")
        assert code == 0, err
        found.append(json.loads(out)["metrics"])
    for metrics in found[1:]:
        assert metrics == pytest.approx(found[0], rel=1e-4)
    assert found[0]["ate_rmse_m"] > 0.001 and found[0]["rpe_1s_trans_rmse_m"] > 0.001


def test_stamps_that_are_no_seconds_are_refused(cli, pair, tmp_path):
    for trajectory, name in zip(pair, ("estimate", "truth"), strict=True):
        write_tum(tmp_path / f"{name}.txt", trajectory)
        rows = [line.split(" ") for line in (tmp_path / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        lines = [" ".join([stamp.replace(".", ""), *rest]) for stamp, *rest in rows]
        (tmp_path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    code, _, err = cli("eval", tmp_path / "estimate.txt", tmp_path / "truth.txt")
    assert code == 1 and "stamps up to 1.305e+18, which are no seconds" in one_line(err) and "nanoseconds?" in err


def test_hints_are_shown_of_files_runs_and_boards(cli, tmp_path):
    sequence = "synthetic/walking_rpy?frames=60"
    truth = open_sequence(sequence).ground_truth
    noise = se3.exp(np.random.default_rng(0).normal(0, 1e-3, (60, 6)))
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "inverted.txt", Trajectory(truth.timestamps, se3.inverse(truth.T_world_cam @ noise)))
    files = tmp_path / "inverted.txt", tmp_path / "truth.txt"
    code, out, err = cli("eval", *files)
    assert code == 0 and "hint: inverted-poses: " in out, err
    code, out, err = cli("eval", *files, "--json")
    assert [hint["id"] for hint in json.loads(out)["hints"]] == ["inverted-poses"]
    assert json.loads(out)["metrics"] == pytest.approx(evaluate_files(*files).metrics)
    results = "--results", tmp_path / "results"
    code, _, err = cli("import", files[0], "--tracker", "theirs", "--sequence", sequence, *results)
    assert code == 0, err
    assert "hint: inverted-poses: " in cli("runs", "show", *results)[1]
    code, _, err = cli("report", tmp_path / "results", "-o", tmp_path / "report")
    assert code == 0, err
    text = (tmp_path / "report" / "report.md").read_text()
    assert "‡" in text and "inverted-poses 1" in text


def test_a_protocol_for_some_sequences_says_so(cli, pair, tmp_path):
    for trajectory, name in zip(pair, ("estimate", "truth"), strict=True):
        write_tum(tmp_path / f"{name}.txt", trajectory)
    code, out, _ = cli("eval", tmp_path / "estimate.txt", tmp_path / "truth.txt", "--protocol", "droid-w/v1-bonn")
    assert code == 0 and "droid-w/v1-bonn means something for bonn/* only" in out
