"""Compare our ATE and RPE with the TUM benchmark's own scripts on given trajectories.

    python tests/benchmarks/evaluation_agreement.py --scripts DIR ESTIMATE GROUNDTRUTH [ESTIMATE
    GROUNDTRUTH ...]

DIR holds `associate.py`, `evaluate_ate.py` and `evaluate_rpe.py` of the benchmark (a Python 3 port
comes with evo's source distribution, `test/tum_benchmark_tools`, trajectories in `test/data`). What
keeps them from running on Python 3 and NumPy 2 (`numpy.linalg.linalg`, `keys.sort()` of a
dictionary's keys) is mended in a temporary copy.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from dynslam_bench.evaluation import Protocol, RPESpec, evaluate
from dynslam_bench.geometry.trajectory_files import read_tum

DELTAS = ((1, "f"), (10, "f"), (1, "s"), (0.1, "m"), (0.5, "m"), (5, "deg"), (0.2, "rad"))


def mended(scripts: Path, folder: Path) -> Path:
    for name in ("associate.py", "evaluate_ate.py", "evaluate_rpe.py"):
        shutil.copy(scripts / name, folder / name)
        path = folder / name
        path.write_text(
            re.sub(
                r"keys = (\w+)\.keys\(\)",
                r"keys = list(\1.keys())",
                path.read_text().replace("numpy.linalg.linalg", "numpy.linalg"),
            )
        )
    return folder


def official(folder: Path, script: str, *arguments: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, script, *arguments, "--verbose"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
    )
    found = re.findall(r"(compared_pose_pairs|[\w.]*rmse) ([\d.]+)", done.stdout)
    if not found:
        raise SystemExit(f"{script} failed: {done.stderr.strip().splitlines()[-1:]}")
    return {name: float(value) for name, value in found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scripts", type=Path, required=True)
    parser.add_argument("files", type=Path, nargs="+")
    options = parser.parse_args()
    print(
        "| trajectory | metric | pairs (TUM) | pairs (ours) | m (TUM) | m (ours) | deg (TUM) | deg (ours) |"
    )
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as temporary:
        folder = mended(options.scripts, Path(temporary))
        for est, gt in zip(options.files[::2], options.files[1::2], strict=True):
            pair = (str(gt.resolve()), str(est.resolve()))
            estimate = read_tum(est)
            truth = read_tum(gt)
            theirs = official(folder, "evaluate_ate.py", *pair)
            ours = evaluate(estimate, truth)
            rmse = next(value for name, value in theirs.items() if name.endswith("rmse"))
            print(
                f"| {est.stem} | ATE | {theirs['compared_pose_pairs']:.0f} | {ours.n_pairs} | {rmse:.6f} "
                f"| {ours.metrics['ate_rmse_m']:.6f} | | |"
            )
            for delta, unit in DELTAS:
                theirs = official(
                    folder,
                    "evaluate_rpe.py",
                    *pair,
                    *(("--fixed_delta", "--delta", str(delta), "--delta_unit", unit)),
                )
                spec = RPESpec(delta=delta, unit=unit)
                ours = evaluate(estimate, truth, Protocol(id="agreement", rpe=(spec,)))
                print(
                    f"| {est.stem} | RPE {delta:g} {unit} | {theirs['compared_pose_pairs']:.0f} "
                    f"| {ours.n_pairs_rpe[spec.key]} | {theirs['translational_error.rmse']:.6f} "
                    f"| {ours.metrics[f'rpe_{spec.key}_trans_rmse_m']:.6f} | {theirs['rotational_error.rmse']:.6f} "
                    f"| {ours.metrics[f'rpe_{spec.key}_rot_rmse_deg']:.6f} |"
                )


if __name__ == "__main__":
    main()
