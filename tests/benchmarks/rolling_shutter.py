"""The effect of rolling-shutter compensation: each tracker with and without it, start by start.

    python tests/benchmarks/rolling_shutter.py [TRACKER ...] [--part fr1_xyz fr1_rpy bonn fast] [--starts 12]
        [--rival] [--results FOLDER]

Printed is the online ATE with : without, paired by start (lost frames held; protocol tum-rgbd/v1), and the medians.
Recordings are looked for in ``../shared``; what is not there is named. Starts of one recording share nearly all of
their frames: an interval over them says nothing beyond it. `--rival` runs ORB-SLAM3 once a start beside
them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dynslam_bench.core.settings import field_names
from dynslam_bench.runs import RunStore
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.evaluate import Outcome, evaluate
from dynslam_bench.tuning.instances import ProblemInstance, parse_instances
from dynslam_bench.tuning.summary import compared

SHARED = Path(__file__).resolve().parents[3] / "shared"
NETWORK = SHARED / "weights/yolov8n-seg_480x640_fp32.onnx"
VOCABULARY = SHARED / "weights/orb_vocabulary_small.txt.xz"
FOLDERS = {
    "fr1_xyz": SHARED / "data/tum/rgbd_dataset_freiburg1_xyz",
    "fr1_rpy": SHARED / "data/tum/rgbd_dataset_freiburg1_rpy",
    "bonn": SHARED / "data/bonn/rgbd_bonn_crowd",
}
FAST = tuple(f"synthetic/fast_{kind}?scene={{instances}}&frames=120" for kind in ("desk", "rpy", "walking"))
OFF = {"backend.tracking.rolling_shutter": False}


def instances_of(part: str, starts: int) -> list[ProblemInstance]:
    """Starts 0, 1, 2 ... of a recording; instances 100, 101 ... of the fast sequences."""
    texts = (
        [text.format(instances=f"100-{99 + starts}") for text in FAST]
        if part == "fast"
        else [f"{FOLDERS[part]}?offsets=0-{starts - 1}"]
    )
    return [instance for text in texts for instance in parse_instances(text)]


def own_masks(tracker: str, part: str) -> dict[str, str]:
    """YOLO's masks on recordings, exact ones on rendered sequences, where a tracker asks for any."""
    asks = "segmentation.source" in field_names(TRACKERS.get(tracker).settings)
    return {"segmentation.source": "oracle" if part == "fast" else f"onnx:{NETWORK}"} if asks else {}


def effect(tracker: str, part: str, options: argparse.Namespace) -> str:
    """One line: with it beside without it."""
    source, store = own_masks(tracker, part), RunStore(options.results)
    outcomes: list[dict[ProblemInstance, Outcome]] = [{}, {}, {}]
    for instance in instances_of(part, options.starts):
        for runs, settings in zip(outcomes, (source, source | OFF), strict=False):
            runs |= evaluate(tracker, settings, [instance], results=store)
        if options.rival:
            outcomes[2] |= evaluate("orbslam3", {"vocabulary": str(VOCABULARY)}, [instance], results=store)
    names = ("with", "without", "ORB-SLAM3")
    medians = [
        f"{name} {1e3 * np.median([run.ate_m for run in runs.values()]):.1f} mm"
        for name, runs in zip(names, outcomes, strict=True)
        if runs
    ]
    lost = max(1 - run.coverage for run in outcomes[0].values())
    return f"{tracker}, {part}: {compared(outcomes[0], outcomes[1])}; {', '.join(medians)}; most frames lost {lost:.1%}"


def main() -> None:
    """One line a tracker and part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trackers", nargs="*", metavar="TRACKER", default=["orb-slam2"])
    parser.add_argument("--part", nargs="+", default=[*FOLDERS, "fast"], choices=[*FOLDERS, "fast"])
    parser.add_argument("--starts", type=int, default=12)
    parser.add_argument("--rival", action="store_true")
    parser.add_argument("--results", type=Path, default=Path("results/rolling_shutter"))
    options = parser.parse_args()
    for part in options.part:
        if part != "fast" and not FOLDERS[part].is_dir():
            sys.stdout.write(f"{part}: not judged, no recording under {SHARED}\n")
        else:
            for tracker in options.trackers:
                sys.stdout.write(f"{effect(tracker, part, options)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
