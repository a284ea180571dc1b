"""Score trajectories that their authors published, and compare with what they printed.

    python tests/benchmarks/published_trajectories.py ./trajectories --table agreement

The folder holds ``rgbd-vo/SEQUENCE/`` (EdwardjkFeng/rgbd-vo, commit 49ff0b8): trajectories, the
publisher's truth, and the author's tables of ``evo_ape -as`` as ``published.csv``. It holds
``authors/NAME/`` too: single trajectories, and ``modification_orb/SEQUENCE/``
(Sujan-PhdWork/modification_orb, commit 2cb9904): best tracks, truth, and one ``published.csv``.
"""

import argparse
import csv
from pathlib import Path

from dynslam_bench.evaluation import evaluate, evaluate_files, static_camera
from dynslam_bench.evaluation.compare_protocols import agrees, compare_protocols
from dynslam_bench.geometry.trajectory_files import load_tum, read_tum

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
SINGLE = {
    "dyslam/walking_xyz": "rgbd_dataset_freiburg3_walking_xyz",
    "dyn_orb_slam/walking_xyz": "rgbd_dataset_freiburg3_walking_xyz",
    "lc_crf_slam/traject": "",
    "yolo_slam_ywl0720/walking_xyz": "rgbd_dataset_freiburg3_walking_xyz",
    "yolo_dynaslam/walking_xyz": "rgbd_dataset_freiburg3_walking_xyz",
    "cds_slam/walking_rpy": "rgbd_dataset_freiburg3_walking_rpy",
    "ygc_slam/CameraTrajectory": "rgbd_dataset_freiburg3_walking_rpy",
    "ddn_slam/fr3_long_office": "rgbd_dataset_freiburg3_long_office_household",
    "amos_slam/CameraTrajectory": "",
}
"""Trajectories and the folder of their truth; empty where the author publishes it with the trajectory."""


def agreement(folder: Path) -> None:
    """How many of the author's numbers come out, with and without the rows outside of the truth's time."""
    print(
        "| sequence | numbers | agree to 1e-9 m | largest difference (m) | agree without rows of other recordings |"
    )
    print("| --- | ---: | ---: | ---: | ---: |")
    for table in sorted(folder.glob("rgbd-vo/*/published.csv")):
        truth = load_tum(table.parent / "groundtruth.txt")
        poses = truth.every_line or truth.trajectory
        differences = []
        cut = []
        for line in csv.DictReader(table.open()):
            files = table.parent / line["trajectory"], table.parent / "groundtruth.txt"
            metrics = evaluate_files(*files, "evo-as/v1").metrics
            differences.append(
                max(abs(metrics[f"ate_{name}_m"] - float(line[f"{name}_m"])) for name in STATISTICS)
            )
            estimate = read_tum(files[0])
            inside = (estimate.timestamps >= poses.timestamps[0] - 0.01) & (
                estimate.timestamps <= poses.timestamps[-1] + 0.01
            )
            cut.append(
                abs(
                    evaluate(estimate.select(inside), poses, "evo-as/v1").metrics["ate_rmse_m"]
                    - float(line["rmse_m"])
                )
                < 1e-6
            )
        good = sum(difference < 1e-9 for difference in differences)
        print(
            f"| {table.parent.name} | {len(cut)} | {good} | {max(differences):.0e} | {sum(cut)} |"
        )


def conventions(folder: Path) -> None:
    """One trajectory under every convention: the tracker has collapsed."""
    crowd = folder / "rgbd-vo" / "rgbd_bonn_crowd"
    estimate, truth = (load_tum(crowd / name) for name in ("rgbdvo.txt", "groundtruth.txt"))
    print("| metric | convention | m | pairs | 0.0733 is printed |")
    print("| --- | --- | ---: | ---: | --- |")
    for row in compare_protocols(estimate, truth):
        mark = "agrees" if agrees(row, "0.0733") else ""
        print(f"| {row.metric} | {row.label} | {row.rmse_m:.4f} | {row.pairs} | {mark} |")
    static = static_camera(truth.trajectory, estimate.trajectory.timestamps)["constant_rmse_m"]
    print(f"| ATE | a camera that does not move | {static:.4f} | | |")


def single(folder: Path) -> None:
    """Trajectories whose author prints no number of just that file."""
    print("| trajectory | ATE under `tum-rgbd/v1` (m) | pairs |")
    print("| --- | ---: | ---: |")
    for name, of_truth in SINGLE.items():
        estimate = folder / "authors" / f"{name}.txt"
        result = evaluate_files(
            estimate,
            (folder / "rgbd-vo" / of_truth if of_truth else estimate.parent) / "groundtruth.txt",
        )
        print(f"| {name} | {result.metrics['ate_rmse_m']:.4f} | {result.n_pairs} |")


TUM_STATISTICS = ("rmse", "mean", "median", "std")
"""What the author of ``modification_orb`` gives of TUM's `evaluate_ate.py`."""


def tum_agreement(folder: Path) -> None:
    """How many numbers of an author who used TUM's script come out under ``tum-rgbd/v1``."""
    print("| sequence | numbers | agree to 1e-6 m | largest difference (m) |")
    print("| --- | ---: | ---: | ---: |")
    own = folder / "modification_orb"
    for line in csv.DictReader((own / "published.csv").open()):
        files = (
            own / line["sequence"] / line["trajectory"],
            own / line["sequence"] / "groundtruth.txt",
        )
        metrics = evaluate_files(*files, "tum-rgbd/v1").metrics
        differences = [
            abs(metrics[f"ate_{name}_m"] - float(line[f"{name}_m"])) for name in TUM_STATISTICS
        ]
        good = sum(difference < 1e-6 for difference in differences)
        print(f"| {line['sequence']} | {len(differences)} | {good} | {max(differences):.0e} |")


def main() -> None:
    """Print one of the tables."""
    tables = {
        "agreement": agreement,
        "conventions": conventions,
        "single": single,
        "tum": tum_agreement,
    }
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--table", choices=tables, required=True)
    options = parser.parse_args()
    tables[options.table](options.folder)


if __name__ == "__main__":
    main()
