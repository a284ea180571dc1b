"""Accuracy and frame time of the shared back end on the excerpts and on rendered sitting twins.

    python tests/benchmarks/backend_accuracy.py [--offsets 0 1 2 3] [--set tracking.min_inliers=30]
        [--sequences xyz rpy crowd "synthetic/sitting_rpy?frames=200"] [--masks FILE.npz]

Each row is the mean over start offsets: ATE RMSE in mm after SE(3) alignment (protocol tum-rgbd/v1) of the online and
of the final trajectory, coverage, keyframes, and the times of a frame in ms (features + back end, one thread, wall
clock and processor time; decoding and masks excluded). On `crowd` people are masked by the YOLO network at
../shared/weights through cv2.dnn, dilated by 15 px; the masks are kept in --masks so that later calls start at once.
A repeated run with another number of OpenCV threads must give the same bits: the last column says so.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dynslam_bench.contracts.filter import FrameBundle  # noqa: E402
from dynslam_bench.core.settings import apply_overrides, parse_assignments  # noqa: E402
from dynslam_bench.features.registry import build_extractor  # noqa: E402
from dynslam_bench.sequences.catalogue import open_sequence  # noqa: E402
from dynslam_bench.slam.backend import RgbdBackend  # noqa: E402
from dynslam_bench.slam.settings import BackendSettings  # noqa: E402

SHARED = ROOT.parent / "shared"
EXCERPTS = {
    "xyz": SHARED / "data/tum/rgbd_dataset_freiburg1_xyz",
    "rpy": SHARED / "data/tum/rgbd_dataset_freiburg1_rpy",
    "crowd": SHARED / "data/bonn/rgbd_bonn_crowd",
}
NETWORK = SHARED / "weights/yolov8n-seg_480x640_fp32.onnx"


def person_masks(images: list[np.ndarray], cache: Path, dilation: int = 15) -> np.ndarray:
    """Bool ``[N, H, W]`` of people, dilated; from the cache if it fits."""
    if cache.exists():
        stored = np.load(cache)["masks"]
        if len(stored) == len(images):
            return stored
    net = cv2.dnn.readNetFromONNX(str(NETWORK))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * dilation + 1, 2 * dilation + 1))
    masks = []
    for rgb in images:
        height, width = rgb.shape[:2]
        net.setInput(cv2.dnn.blobFromImage(rgb, 1 / 255.0, (640, 480)))
        rows, prototypes = net.forward(["output0", "output1"])
        rows = rows[0].T
        rows = rows[(rows[:, 4:84].argmax(axis=1) == 0) & (rows[:, 4] > 0.25)]
        mask = np.zeros((height, width), np.uint8)
        boxes = np.column_stack([rows[:, :2] - rows[:, 2:4] / 2, rows[:, 2:4]])
        for i in np.array(cv2.dnn.NMSBoxes(boxes.tolist(), rows[:, 4].tolist(), 0.25, 0.5), int).ravel():
            logits = (rows[i, 84:] @ prototypes[0].reshape(32, -1)).reshape(120, 160).astype(np.float32)
            inside = cv2.resize(logits, (width, height)) > 0  # sigmoid > 0.5
            x, y, w, h = np.rint(boxes[i] * (width / 640, height / 480, width / 640, height / 480)).astype(int)
            area = slice(max(y, 0), y + h), slice(max(x, 0), x + w)
            mask[area] |= inside[area].astype(np.uint8)
        masks.append(cv2.dilate(mask, kernel) > 0)
    np.savez_compressed(cache, masks=np.array(masks))
    return np.array(masks)


def bundle(frame, camera, extractor) -> FrameBundle:
    """The frame with its features, as the pipeline makes it."""
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    keypoints = extractor.extract(gray)
    pixel = np.rint(keypoints.xy).astype(int).reshape(-1, 2)
    z = frame.depth[pixel[:, 1].clip(0, camera.height - 1), pixel[:, 0].clip(0, camera.width - 1)]
    xy = camera.undistort_points(keypoints.xy)
    return FrameBundle(frame.index, frame.timestamp, frame.rgb, gray, frame.depth, keypoints, xy, z)


def ate_mm(stamps, positions, truth, tolerance: float = 0.02) -> float:
    """RMSE of the translation after SE(3) alignment (Horn) over stamps with ground truth within the tolerance."""
    right = np.clip(np.searchsorted(truth.timestamps, stamps), 1, len(truth) - 1)
    left = right - 1
    nearest = np.where(stamps - truth.timestamps[left] < truth.timestamps[right] - stamps, left, right)
    known = np.abs(truth.timestamps[nearest] - stamps) < tolerance
    a, b = positions[known], truth.positions[nearest[known]]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return 1e3 * float(np.sqrt((((a - a.mean(0)) @ rotation.T + b.mean(0) - b) ** 2).sum(axis=1).mean()))


def run(frames, camera, masks, settings, first, extractor):
    """One run: results, times (wall and processor, seconds) and the back end."""
    backend = RgbdBackend(settings)
    backend.reset(camera, seed=0)
    results, times = [], []
    for i in range(first, len(frames)):
        start, cpu = time.perf_counter(), time.process_time()
        features = bundle(frames[i], camera, extractor)
        spent, cpu_spent = time.perf_counter() - start, time.process_time() - cpu
        pixel = np.rint(features.keypoints.xy).astype(int).reshape(-1, 2)
        keep = np.ones(len(features), bool) if masks is None else ~masks[i][pixel[:, 1], pixel[:, 0]]
        start, cpu = time.perf_counter(), time.process_time()
        results.append(backend.track(features, keep, np.ones(len(features), np.float32)))
        times.append((spent + time.perf_counter() - start, cpu_spent + time.process_time() - cpu))
    return results, np.array(times), backend


def main() -> int:
    """Print one row a sequence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", default=["xyz", "rpy", "crowd"])
    parser.add_argument("--offsets", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--masks", type=Path, default=Path(tempfile.gettempdir()) / "backend_crowd_masks.npz")
    parser.add_argument("--data-root", type=Path, default=None)
    options = parser.parse_args()
    settings = apply_overrides(BackendSettings(), parse_assignments(options.set))
    extractor = build_extractor()
    cv2.setNumThreads(1)
    print(
        "| sequence | ATE online mm | ATE final mm | coverage | keyframes | wall ms p50 / p95 | cpu ms p50 / p95 "
        "| same bits |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.sequences:
        sequence = open_sequence(str(EXCERPTS.get(name, name)), data_root=options.data_root)
        frames = [sequence[i] for i in range(len(sequence))]
        masks = person_masks([frame.rgb for frame in frames], options.masks) if name == "crowd" else None
        run(frames[:3], sequence.camera, masks, settings, 0, extractor)  # compiles
        rows, times, first_run = [], [], None
        for offset in options.offsets:
            results, spent, backend = run(frames, sequence.camera, masks, settings, offset, extractor)
            ok = [i for i, result in enumerate(results) if result.state == "ok"]
            stamps = np.array([frames[offset + i].timestamp for i in ok])
            positions = np.array([results[i].T_world_cam[:3, 3] for i in ok])
            final = backend.finalize()
            first_run = positions if first_run is None else first_run
            rows.append(
                (
                    ate_mm(stamps, positions, sequence.ground_truth),
                    ate_mm(final.timestamps, final.positions, sequence.ground_truth),
                    len(ok) / len(results),
                    sum(result.keyframe for result in results),
                )
            )
            times.append(1e3 * spent)
        cv2.setNumThreads(2)
        again, _, _ = run(frames, sequence.camera, masks, settings, options.offsets[0], extractor)
        cv2.setNumThreads(1)
        repeated = np.array([result.T_world_cam[:3, 3] for result in again if result.state == "ok"])
        mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0)
        (wall, cpu), (wall95, cpu95) = (np.percentile(np.concatenate(times), q, axis=0) for q in (50, 95))
        print(
            f"| {name} | {mean[0]:.2f} +- {spread[0]:.2f} | {mean[1]:.2f} +- {spread[1]:.2f} | {mean[2]:.3f} "
            f"| {mean[3]:.1f} | {wall:.1f} / {wall95:.1f} | {cpu:.1f} / {cpu95:.1f} "
            f"| {'yes' if np.array_equal(first_run, repeated) else 'NO'} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
