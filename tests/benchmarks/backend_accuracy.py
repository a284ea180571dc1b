"""Accuracy and frame time of the shared back end on the excerpts and on rendered sequences.

    python tests/benchmarks/backend_accuracy.py [--offsets 0 1 2 3] [--set backend.tracking.min_inliers=30]
        [--sequences xyz rpy crowd "synthetic/sitting_rpy?frames=200"]

Each row is the mean over start offsets: ATE RMSE in mm (protocol tum-rgbd/v1) of the online and of the final
trajectory, coverage, keyframes, and the time of a frame in ms (one thread, wall clock; decoding excluded). `orb-slam2`
runs; on `crowd` it is `mask-rcnn` with the YOLO network at ../shared/weights, whose time counts. A repeated run with
another number of OpenCV threads must give the same bits: the last column says so.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.core.settings import parse_assignments  # noqa: E402
from dynslam_bench.evaluation import evaluate  # noqa: E402
from dynslam_bench.geometry.trajectory import Trajectory  # noqa: E402
from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.trackers import TrackerContext, build_tracker  # noqa: E402

SHARED = ROOT.parent / "shared"
EXCERPTS = {
    "xyz": SHARED / "data/tum/rgbd_dataset_freiburg1_xyz",
    "rpy": SHARED / "data/tum/rgbd_dataset_freiburg1_rpy",
    "crowd": SHARED / "data/bonn/rgbd_bonn_crowd",
}
MASKED = {"segmentation.source": f"onnx:{SHARED / 'weights/yolov8n-seg_480x640_fp32.onnx'}"}
HEAD = (
    "| sequence | ATE online mm | ATE final mm | coverage | keyframes | ms p50 / p95 | same bits |\n"
    + "| --- " * 7
    + "|"
)


def run(name: str, frames: list, sequence, settings: dict) -> tuple[list[float], np.ndarray, list[float]]:
    """Errors in mm, coverage and keyframes; the online poses; the frame times in ms."""
    tracker_id, masked = ("mask-rcnn", MASKED) if name == "crowd" else ("orb-slam2", {})
    context = TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    tracker = build_tracker(tracker_id, masked | settings, context)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    results, times = [], []
    for frame in frames:
        start = time.perf_counter()
        results.append(tracker.track(frame))
        times.append(1e3 * (time.perf_counter() - start))
    tracked = [(frame.timestamp, r.T_world_cam) for frame, r in zip(frames, results, strict=True) if r.state == "ok"]
    stamps, poses = (np.array(column) for column in zip(*tracked, strict=True))
    errors = [
        1e3 * evaluate(trajectory, sequence.ground_truth, "tum-rgbd/v1").metrics["ate_rmse_m"]
        for trajectory in (Trajectory(stamps, poses), tracker.finalize())
    ]
    keyframes = sum(result.stats["keyframe"] for result in results)
    return [*errors, len(tracked) / len(results), keyframes], poses, times


def main() -> int:
    """Print one row a sequence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", default=["xyz", "rpy", "crowd"])
    parser.add_argument("--offsets", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--data-root", type=Path, default=None)
    options = parser.parse_args()
    settings = parse_assignments(options.set)
    print(HEAD)
    for name in options.sequences:
        sequence = open_sequence(str(EXCERPTS.get(name, name)), data_root=options.data_root)
        frames = [sequence[i] for i in range(len(sequence))]
        cv2.setNumThreads(1)
        run(name, frames[:3], sequence, settings)  # compiles
        runs = [run(name, frames[offset:], sequence, settings) for offset in options.offsets]
        cv2.setNumThreads(2)
        _, repeated, _ = run(name, frames[options.offsets[0] :], sequence, settings)
        rows = [row for row, _, _ in runs]
        mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0)
        median, p95 = np.percentile(np.concatenate([times for _, _, times in runs]), (50, 95))
        print(
            f"| {name} | {mean[0]:.2f} +- {spread[0]:.2f} | {mean[1]:.2f} +- {spread[1]:.2f} | {mean[2]:.3f} "
            f"| {mean[3]:.1f} | {median:.1f} / {p95:.1f} | {'yes' if np.array_equal(runs[0][1], repeated) else 'NO'} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
