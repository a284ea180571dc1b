"""`eval` takes every format that it names, and never stamps that are no seconds."""

import json

import numpy as np
import pytest
from cli_helpers import one_line

from dynslam_bench.evaluation import evaluate_files
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.sequences import open_sequence


@pytest.fixture
def pair(tmp_path):
    """An estimate and its ground truth, which lie in ``estimate.txt`` and ``truth.txt``, too."""
    rng = np.random.default_rng(3)
    stamps, twists = 1305031100 + np.arange(90) / 30, np.cumsum(rng.normal(0, 0.02, (90, 6)), axis=0)
    estimate = Trajectory(stamps, se3.exp(twists + rng.normal(0, 0.005, (90, 6))))
    trajectories = {"estimate": estimate, "truth": Trajectory(stamps, se3.exp(twists))}
    for name, trajectory in trajectories.items():
        write_tum(tmp_path / f"{name}.txt", trajectory)
    return trajectories


def test_stamps_that_are_no_seconds_are_refused(cli, pair, tmp_path):
    for name in pair:
        lines = [line.split() for line in (tmp_path / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        text = "".join(" ".join([stamp.replace(".", ""), *rest]) + "\n" for stamp, *rest in lines)
        (tmp_path / f"{name}.txt").write_text(text)
    code, _, err = cli("eval", "estimate.txt", "truth.txt")
    assert code == 1 and "which are no seconds" in one_line(err)


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


def test_a_protocol_for_some_sequences_says_so(cli, pair):
    code, out, _ = cli("eval", "estimate.txt", "truth.txt", "--protocol", "droid-w/v1-bonn")
    assert code == 0 and "droid-w/v1-bonn means something for bonn/* only" in out


def test_the_protocol_of_a_published_number_is_marked(cli, facts, pair):
    command = ("protocols", "compare", "estimate.txt", "truth.txt")
    rows = {row["label"]: row["rmse_m"] for row in facts(*command)}
    printed = f"{rows['evo_ape -as']:.9f}"
    code, out, _ = cli(*command, "--published", printed)
    marked = [line for line in out.splitlines() if " agrees " in line]
    assert code == 0 and any(line.startswith("ATE     evo_ape -as") for line in marked)
    assert all(row["agrees"] == (f"{row['rmse_m']:.9f}" == printed) for row in facts(*command, "--published", printed))
    code, out, _ = cli(*command, "--published", "77")
    assert code == 0 and "No row agrees with 77; the nearest is" in out.splitlines()[-1]
    code, _, err = cli(*command, "--published", "7cm")
    assert code == 1 and "as it was printed" in one_line(err)
