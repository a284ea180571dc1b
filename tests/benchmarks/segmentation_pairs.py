"""Two ways to make masks, in pairs of runs: pose error, frames segmented, time of the whole tracker.

    python tests/benchmarks/segmentation_pairs.py schedule|oracle [--sequences ID ...] [--tracker mask-rcnn]
        [--set segmentation.max_carry=5 ...] [--offsets 0 10 20]

`schedule`: the embedded network on every frame against keyframes only (plus what --set says); `oracle`: the exact masks
against the embedded network's. Each sequence runs both ways in turn from each start offset. Printed per sequence, as
means over the offsets: ATE RMSE (SE(3)-aligned, online / final; lost frames as `hold` counts them), coverage, share of
frames segmented, milliseconds of CPU and of wall time a frame; last the geometric-mean ATE ratio. One thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import astuple, dataclass
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
DEFAULT = [f"synthetic/{name}?scene={instance}&frames=200" for instance in (100, 101) for name in TWINS]
"""Held out: on instances 0-99 the embedded network was trained."""
EMBEDDED = {"segmentation.source": "embedded"}
PAIRS: dict[str, dict[str, dict[str, object]]] = {
    "schedule": {
        "every": EMBEDDED | {"segmentation.schedule": "every"},
        "keyframes": EMBEDDED | {"segmentation.schedule": "keyframes"},
    },
    "oracle": {"oracle": {"segmentation.source": "oracle"}, "embedded": EMBEDDED},
}


@dataclass
class Measured:
    """One run: ATE in metres, share of frames segmented, milliseconds a frame."""

    online: float
    final: float
    coverage: float
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
    protocol = get_protocol("tum-rgbd/v1").model_copy(update={"lost_frames": "hold"})
    errors = [
        evaluate(part, sequence.ground_truth, protocol, input_timestamps=sequence.timestamps).metrics["ate_rmse_m"]
        for part in (Trajectory(np.array(stamps), np.array(poses)), tracker.finalize())
    ]
    frames = len(sequence)
    return Measured(*errors, len(stamps) / frames, segmented / frames, 1e3 * cpu / frames, 1e3 * wall / frames)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair", choices=PAIRS)
    parser.add_argument("--sequences", nargs="+", default=DEFAULT)
    parser.add_argument("--tracker", default="mask-rcnn")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", dest="changes")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    (first, usual), (second, other) = PAIRS[options.pair].items()
    ways = (usual, other | parse_assignments(options.changes))
    print(f"| sequence | ATE {first}, mm | ATE {second}, mm | ratio | coverage | segmented | CPU ms | wall ms |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    ratios = []
    for name in options.sequences:
        runs = [[astuple(measure(options.tracker, name, offset, way)) for way in ways] for offset in options.offsets]
        table = np.array(runs)
        ratios.extend(np.log(table[:, 1, :2] / table[:, 0, :2]))
        a, b = (Measured(*row) for row in table.mean(axis=0))
        print(
            f"| {name} | {1e3 * a.online:.2f} / {1e3 * a.final:.2f} | {1e3 * b.online:.2f} / {1e3 * b.final:.2f} "
            f"| {b.online / a.online:.2f} / {b.final / a.final:.2f} | {a.coverage:.0%} -> {b.coverage:.0%} "
            f"| {a.segmented:.0%} -> {b.segmented:.0%} | {a.cpu_ms:.1f} -> {b.cpu_ms:.1f} "
            f"| {a.wall_ms:.1f} -> {b.wall_ms:.1f} |",
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
