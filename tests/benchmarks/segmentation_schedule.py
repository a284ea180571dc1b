"""What segmenting fewer frames costs: pose error and time of keyframe-only segmentation against every frame.

    python tests/benchmarks/segmentation_schedule.py [--sequences ID ...] [--tracker mask-rcnn] [--source embedded]
        [--set segmentation.max_carry=5 ...] [--offsets 0 10 20]

Each sequence runs twice in turn from each start offset: with `segmentation.schedule=every`, and with `keyframes` plus
what --set says. Printed per sequence, as means over the offsets: ATE RMSE (SE(3)-aligned, online / final), share of
frames segmented, milliseconds of CPU and of wall time a frame of the whole tracker; last the geometric-mean ATE ratio.
One thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.core.settings import parse_assignments  # noqa: E402
from dynslam_bench.evaluation.evaluate import evaluate  # noqa: E402
from dynslam_bench.evaluation.protocol import get_protocol  # noqa: E402
from dynslam_bench.geometry.trajectory import Trajectory  # noqa: E402
from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.trackers import TrackerContext, build_tracker  # noqa: E402

TWINS = ("walking_xyz", "walking_static", "walking_halfsphere", "walking_rpy")
DEFAULT = [f"synthetic/{name}@{instance}?frames=200" for instance in (100, 101) for name in TWINS]


@dataclass
class Measured:
    """One run: ATE in metres, share of frames segmented, milliseconds a frame."""

    online: float
    final: float
    segmented: float
    cpu_ms: float
    wall_ms: float


def measure(tracker_id: str, sequence_id: str, offset: int, settings: dict) -> Measured:
    """Run a tracker over a sequence from a frame on."""
    sequence = open_sequence(sequence_id, frames=(offset, None))
    tracker = build_tracker(tracker_id, settings, TrackerContext(sequence_id=sequence.id, masks=sequence.masks))
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    stamps, poses, segmented = [], [], 0
    cpu = wall = 0.0
    for index in range(len(sequence)):
        frame = sequence[index]
        begin, used = time.perf_counter(), time.process_time()
        result = tracker.track(frame)
        wall += time.perf_counter() - begin
        cpu += time.process_time() - used
        segmented += result.stats.get("segmented", 0.0) > 0
        if result.state == "ok":
            stamps.append(frame.timestamp)
            poses.append(result.T_world_cam)
    protocol = get_protocol("tum-rgbd/v1")
    errors = [
        evaluate(part, sequence.ground_truth, protocol, input_timestamps=sequence.timestamps).metrics["ate_rmse_m"]
        for part in (Trajectory(np.array(stamps), np.array(poses)), tracker.finalize())
    ]
    frames = len(sequence)
    return Measured(*errors, segmented / frames, 1e3 * cpu / frames, 1e3 * wall / frames)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", default=DEFAULT)
    parser.add_argument("--tracker", default="mask-rcnn")
    parser.add_argument("--source", default="embedded")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", dest="changes")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    every = {"segmentation.source": options.source, "segmentation.schedule": "every"}
    sparse = every | {"segmentation.schedule": "keyframes"} | parse_assignments(options.changes)
    print("| sequence | ATE every, mm | ATE keyframes, mm | ratio | segmented | CPU ms | wall ms |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    ratios = []
    for name in options.sequences:
        runs = [[measure(options.tracker, name, offset, s) for s in (every, sparse)] for offset in options.offsets]
        table = np.array([[[r.online, r.final, r.segmented, r.cpu_ms, r.wall_ms] for r in pair] for pair in runs])
        ratios.extend(np.log(table[:, 1, :2] / table[:, 0, :2]))
        a, b = table.mean(axis=0)
        print(
            f"| {name} | {1e3 * a[0]:.2f} / {1e3 * a[1]:.2f} | {1e3 * b[0]:.2f} / {1e3 * b[1]:.2f} "
            f"| {b[0] / a[0]:.2f} / {b[1] / a[1]:.2f} | {b[2]:.0%} "
            f"| {a[3]:.1f} -> {b[3]:.1f} | {a[4]:.1f} -> {b[4]:.1f} |",
            flush=True,
        )
    online, final = np.exp(np.mean(ratios, axis=0))
    spread = np.exp(np.std(ratios, axis=0, ddof=1) / np.sqrt(len(ratios))) if len(ratios) > 1 else (np.nan, np.nan)
    print(
        f"\ngeometric mean of {len(ratios)} ratios, online x {online:.3f} (standard error factor {spread[0]:.3f}), "
        f"final x {final:.3f} ({spread[1]:.3f})"
    )


if __name__ == "__main__":
    main()
