"""The monocular systems: beside ORB-SLAM3's monocular mode where nothing moves, beside each other where people walk.

    python tests/benchmarks/monocular.py                       # all; ten starts each, tens of minutes
    python tests/benchmarks/monocular.py --only walking --starts 5

Every case runs two trackers in turn on the same frames, from several starts of the sequence. Printed are the medians
over the starts: ATE in mm over each one's own tracked frames, Sim(3)-aligned (protocol tum-rgbd/v1-sim3), coverage, and
what a camera that never moves scores. Ours repeats to the last bit; ORB-SLAM3 does not, so its runs vary by the start
and by themselves. It needs the extra [orbslam3] and a vocabulary (docs/orbslam3.md).
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in

from compare_trackers import compare

from dynslam_bench.evaluation.ape import static_camera
from dynslam_bench.evaluation.protocol import MONOCULAR
from dynslam_bench.sequences.catalogue import open_sequence

TUM = Path(__file__).resolve().parents[3] / "shared" / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"


@dataclass(frozen=True)
class Case:
    """Two trackers on parts of a sequence that begin every `apart` frames."""

    a: str
    b: str
    sequence: str
    apart: int
    frames: int | None


CASES = {
    "fr1_xyz": Case("orb-slam2-mono", "orbslam3-mono", str(TUM), 1, None),
    "sitting": Case("orb-slam2-mono", "orbslam3-mono", "synthetic/sitting_xyz", 10, 150),
    "walking": Case("emfoa-oft-mono", "orb-slam2-mono", "synthetic/walking_xyz", 20, 200),
    "chen": Case("chen-slam-mono", "orb-slam2-mono", "synthetic/walking_xyz", 20, 200),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="number of the first start, to go on with a case")
    parser.add_argument("--json", type=Path, default=None, help="write every run's numbers to this file")
    options = parser.parse_args()
    one_thread()
    results = {name: [part(CASES[name], options.first + at) for at in range(options.starts)] for name in options.only}
    for name, parts in results.items():
        show(name, CASES[name], parts)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    return 0


def one_thread() -> None:
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def part(case: Case, number: int) -> dict:
    """Both trackers from one start on; what standing still scores there besides."""
    start = number * case.apart
    sequence = open_sequence(case.sequence, frames=(start, None if case.frames is None else start + case.frames))
    frames = [sequence[index] for index in range(len(sequence))]
    settings = argparse.Namespace(
        a=case.a, b=case.b, set_a=[], set_b=[], device="cpu", threads=1, repeats=1, protocol=MONOCULAR
    )
    found = compare(sequence, frames, start, settings)
    still = static_camera(sequence.ground_truth, sequence.timestamps, 0.02)["constant_rmse_m"]
    return found | {"static_camera_ate_rmse_m": float(still)}


def show(name: str, case: Case, parts: list[dict]) -> None:
    """A table: medians, ranges, every start's error."""
    import numpy as np

    print(
        f"\n## {name}: {parts[0]['frames']} frames from the first of {len(parts)} starts, {case.apart} frames apart\n"
    )
    print("| tracker | ATE mm, median [min - max] | failed | coverage, median [min] | frame ms | ATE of each start |")
    print("| --- | --- | --- | --- | --- | --- |")
    for side, tracker in (("a", case.a), ("b", case.b)):
        runs = [each[side][0] for each in parts]
        errors = [run["own_ate_online_m"] for run in runs]
        known = [1e3 * error for error in errors if error is not None]
        covered = [100 * run["coverage"] for run in runs]
        spread = f"{np.median(known):.1f} [{min(known):.1f} - {max(known):.1f}]" if known else "-"
        each = " ".join("-" if error is None else f"{1e3 * error:.0f}" for error in errors)
        print(
            f"| {tracker} | {spread} | {len(errors) - len(known)} | {np.median(covered):.1f} % [{min(covered):.1f}] "
            f"| {np.median([run['median_ms'] for run in runs]):.0f} | {each} |"
        )
    print(f"\nnever moving: {1e3 * np.median([each['static_camera_ate_rmse_m'] for each in parts]):.0f} mm")


if __name__ == "__main__":
    sys.exit(main())
