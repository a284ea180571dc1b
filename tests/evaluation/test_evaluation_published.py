"""Published numbers from published trajectories, repeated stamps beside evo, rows that agree with a printed number."""

import csv
from pathlib import Path

import numpy as np
import pytest
from evaluation_walks import noisy, walk

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation import evaluate_files, hints
from dynslam_bench.evaluation.compare_protocols import ComparisonRow, agrees, compare_protocols_of_files
from dynslam_bench.geometry.trajectory import RepeatedStamps
from dynslam_bench.geometry.trajectory_files import load_tum, write_tum

AUTHOR = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories" / "rgbd-vo"
STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def published():
    """Estimate, truth and the author's numbers of every line of the author's tables."""
    for table in sorted(AUTHOR.glob("*/published.csv")):
        for line in csv.DictReader(table.open()):
            numbers = {name: float(line[f"{name}_m"]) for name in STATISTICS}
            yield table.parent / line["trajectory"], table.parent / "groundtruth.txt", numbers


@pytest.mark.skipif(not AUTHOR.is_dir(), reason="the author's trajectories are not beside the checkout")
def test_an_authors_evo_tables_are_given_back():
    lines = list(published())
    assert len(lines) == 44
    for estimate, truth, numbers in lines:
        metrics = evaluate_files(estimate, truth, "evo-as/v1").metrics
        assert {name: metrics[f"ate_{name}_m"] for name in STATISTICS} == pytest.approx(numbers, abs=1e-9), estimate


@pytest.mark.skipif(not AUTHOR.is_dir(), reason="the author's trajectories are not beside the checkout")
def test_tolerance_and_scale_move_one_published_number():
    estimate, truth = AUTHOR / "rgbd_bonn_crowd" / "rgbdvo.txt", AUTHOR / "rgbd_bonn_crowd" / "groundtruth.txt"
    shown = {
        name: (round(result.metrics["ate_rmse_m"], 4), result.n_pairs)
        for name in ("evo-as/v1", "tum-rgbd/v1-sim3", "evo-as/v1-se3", "tum-rgbd/v1")
        for result in [evaluate_files(estimate, truth, name)]
    }
    assert shown == {
        "evo-as/v1": (0.0733, 554), "tum-rgbd/v1-sim3": (0.1099, 904),
        "evo-as/v1-se3": (54.8671, 554), "tum-rgbd/v1": (53.3026, 904),
    }  # fmt: skip
    rows = compare_protocols_of_files(load_tum(estimate), load_tum(truth))
    assert [row.label for row in rows if agrees(row, "0.0733")] == ["evo_ape -as"]


@pytest.mark.skipif(not AUTHOR.is_dir(), reason="the author's trajectories are not beside the checkout")
def test_several_recordings_in_one_file_are_named():
    folder = AUTHOR / "rgbd_dataset_freiburg3_walking_xyz"
    file, truth = load_tum(folder / "ours.txt"), load_tum(folder / "groundtruth.txt").trajectory
    (hint,) = (h for h in hints(file.trajectory, truth, "evo-as/v1", notes=file.notes) if h.id == "several-recordings")
    assert "825 of 2934 poses lie within the truth's time, the others in 2 stretches" in hint.text
    result = evaluate_files(folder / "ours.txt", folder / "groundtruth.txt", "evo-as/v1")
    assert any("1669 pairs are made of 825 estimated poses" in line for line in result.diagnostics)


@pytest.mark.parametrize("longer", ["estimate", "truth"])
@pytest.mark.parametrize("scaled", [True, False])
def test_repeated_stamps_are_taken_as_evo_takes_them(tmp_path, longer, scaled):
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    truth = walk(n=300)
    estimate = noisy(truth).select(slice(0, None, 3))
    pair = {"truth": truth, "estimate": estimate} if longer == "truth" else {"truth": estimate, "estimate": truth}
    for name, trajectory in pair.items():
        write_tum(tmp_path / f"{name}.txt", trajectory)
        *lines, last = (tmp_path / f"{name}.txt").read_text().splitlines()
        stamp, x, *rest = lines[20].split()
        moved = " ".join([stamp, f"{float(x) + 0.5:.9f}", *rest])
        (tmp_path / f"{name}.txt").write_text("\n".join([*lines[:20], moved, moved, *lines[20:], last]) + "\n")
    reference, estimated = (file_interface.read_tum_trajectory_file(str(tmp_path / f"{name}.txt")) for name in pair)
    reference, estimated = sync.associate_trajectories(reference, estimated, max_diff=0.01)
    estimated.align(reference, correct_scale=scaled)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, estimated))
    files = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    ours = evaluate_files(*files, "evo-as/v1" if scaled else "evo-as/v1-se3")
    assert ours.n_pairs == len(error.error)
    assert ours.metrics["ate_rmse_m"] == pytest.approx(error.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert any("repeat the next line's stamp, all are taken" in line for line in ours.diagnostics)
    under_tum = evaluate_files(*files, "tum-rgbd/v1")
    assert any("replaced by a later line" in line for line in under_tum.diagnostics)
    assert under_tum.metrics["ate_max_m"] < 0.3 < ours.metrics["ate_max_m"]


def test_repeated_stamps_stay_in_order_and_are_kept():
    poses = np.tile(np.eye(4), (3, 1, 1))
    twice = RepeatedStamps(np.array([1.0, 1.0, 2.0]), poses)
    assert isinstance(twice.select(slice(0, 2)), RepeatedStamps) and isinstance(twice.with_poses(poses), RepeatedStamps)
    with pytest.raises(Exception, match="not strictly increasing"):
        RepeatedStamps(np.array([1.0, 2.0, 1.0]), poses)


@pytest.mark.parametrize(
    ("value", "printed", "same"),
    [
        (0.073255, "0.0733", True), (0.073255, "0.0732", False), (0.07325, "0.073", True), (0.0735, "7.3e-2", True),
        (0.0736, "0.0730", False), (1.4, "1", True), (None, "0.07", False),
    ],
)  # fmt: skip
def test_a_row_agrees_to_the_last_printed_digit(value, printed, same):
    assert agrees(ComparisonRow("ATE", "", value, 9, ""), printed) is same


@pytest.mark.parametrize("printed", ["7 cm", "", "nan", "inf"])
def test_what_is_no_printed_number_is_refused(printed):
    with pytest.raises(EvaluationError, match="as it was printed"):
        agrees(ComparisonRow("ATE", "", 0.1, 9, ""), printed)
