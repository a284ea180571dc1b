"""Image statistics of rendered sequences beside the Bonn and TUM excerpts, measured alike: a Markdown table.

Usage: python tests/benchmarks/synthetic_statistics.py [ID ...] [--every 15] [--cache DIR]

Corners: FAST with threshold 20 (with non-maximum suppression) a frame. Depth: share of pixels with a depth. Contrast:
standard deviation of the grey values. Flow: magnitude of pyramidal Lucas-Kanade flow of up to 500 corners to the next
frame, median of a frame's median and 95 %. Moving: corners are followed over five frames and placed in the world by
their depths and the true poses; those displaced at more than 0.5 m/s move. Their share, and the median of their
speeds. Corners at edges of the depth are left out. What moves slower hides in the noise, and what the sensors and
wrong matches add is seen in the static rows.
Areas: of people and of what moves, from the exact masks.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic import TWIN_IDS, open_synthetic

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
EXCERPTS = {
    "Bonn crowd (excerpt)": "bonn/rgbd_bonn_crowd",
    "TUM fr1_xyz (excerpt)": "tum/rgbd_dataset_freiburg1_xyz",
    "TUM fr1_rpy (excerpt)": "tum/rgbd_dataset_freiburg1_rpy",
}
GAP = 5
"""Frames over which corners are followed to see which of them move."""
MOVES_MPS = 0.5
EDGE = 0.1
"""A corner counts where the depths of 7 x 7 pixels around it, all known, differ by less than this share."""
COLUMNS = (
    "FAST corners", "depth valid", "contrast", "flow px, median", "95 %", "moving corners", "their speed, m/s",
    "person area", "moving area",
)  # fmt: skip


def follow(now: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Corners ``[N, 2]`` of an image, and where they are in another; those that come back to within half a pixel."""
    points = cv2.goodFeaturesToTrack(now, 500, 0.01, 8)
    if points is None:
        return np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    window = {"winSize": (21, 21), "maxLevel": 4}
    ends, there, _ = cv2.calcOpticalFlowPyrLK(now, after, points, None, **window)
    back, here, _ = cv2.calcOpticalFlowPyrLK(after, now, ends, None, **window)
    good = (there.ravel() == 1) & (here.ravel() == 1) & (np.abs(back - points).reshape(-1, 2).max(axis=1) < 0.5)
    return points.reshape(-1, 2)[good], ends.reshape(-1, 2)[good]


def speeds(sequence: Sequence, index: int, grey: list[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """Speeds ``[N]`` in m/s, in the world, of corners with a depth in a frame and `GAP` frames later."""
    truth = sequence.ground_truth
    if truth is None:
        return np.empty(0)
    stamps = sequence.timestamps[[index, index + GAP]]
    nearest = [int(np.abs(truth.timestamps - stamp).argmin()) for stamp in stamps]
    places, known = [], []
    for k, points in enumerate(follow(*grey)):
        depth = sequence[index + GAP * k].depth
        u, v = np.clip(np.rint(points).astype(int), 0, np.array(depth.shape[::-1]) - 1).T
        pose, z = truth.T_world_cam[nearest[k]], depth[v, u].astype(np.float64)
        rays = sequence.camera.undistort_points(points)
        places.append(sequence.camera.unproject(rays, z) @ pose[:3, :3].T + pose[:3, 3])
        square = np.ones((7, 7), np.uint8)
        step = cv2.dilate(depth, square)[v, u] - cv2.erode(depth, square)[v, u]
        known.append((z > 0) & (step < EDGE * z))
    moved = np.linalg.norm(places[1] - places[0], axis=1)[known[0] & known[1]]
    return np.asarray(moved / (stamps[1] - stamps[0]))


def areas(sequence: Sequence, index: int) -> tuple[float, float]:
    """Shares of the image that people and what moves cover; NaN without exact masks."""
    if sequence.masks is None:
        return np.nan, np.nan
    masks = sequence.masks[index]
    people = [k for k, name in masks.class_names.items() if name == "person"]
    return float(np.isin(masks.instances, people).mean()), float(np.isin(masks.instances, list(masks.moving)).mean())


def row(name: str, sequence: Sequence, every: int) -> str:
    """One line of the table."""
    fast = cv2.FastFeatureDetector_create(20)
    found: dict[str, list[float]] = {key: [] for key in ("corners", "valid", "contrast", "flow", "tail", "share")}
    people, moving, fast_ones = [], [], []
    for index in range(1, len(sequence) - GAP, every):
        frame = sequence[index]
        now, after, later = (
            cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in (frame, sequence[index + 1], sequence[index + GAP])
        )
        found["corners"].append(len(fast.detect(now)))
        found["valid"].append(float((frame.depth > 0).mean()))
        found["contrast"].append(float(now.std()))
        start, end = follow(now, after)
        if len(start):
            lengths = np.linalg.norm(end - start, axis=1)
            found["flow"].append(float(np.median(lengths)))
            found["tail"].append(float(np.percentile(lengths, 95)))
        measured = speeds(sequence, index, [now, later])
        if len(measured):
            found["share"].append(float((measured > MOVES_MPS).mean()))
            fast_ones += list(measured[measured > MOVES_MPS])
        person_area, moving_area = areas(sequence, index)
        people.append(person_area)
        moving.append(moving_area)
    area = f"{np.mean(people):.2f} (max {np.max(people):.2f}) | {np.mean(moving):.2f}"
    middle = {key: np.median(values) if values else np.nan for key, values in found.items()}
    mean = {key: np.mean(values) if values else np.nan for key, values in found.items()}
    return (
        f"| {name} | {mean['corners']:.0f} | {mean['valid']:.2f} | {mean['contrast']:.0f} | {middle['flow']:.1f} "
        f"| {middle['tail']:.1f} | {mean['share']:.2f} | {np.median(fast_ones) if fast_ones else np.nan:.2f} | {area} |"
    ).replace("nan (max nan) | nan", "- | -")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ids", nargs="*", default=[*TWIN_IDS, "synthetic/walking_xyz@1", "synthetic/walking_xyz@100"])
    parser.add_argument("--every", type=int, default=15)
    parser.add_argument("--cache", type=Path, help="folder of rendered frames; default none are kept")
    parser.add_argument("--rendered", action="store_true", help="leave out the excerpts")
    arguments = parser.parse_args()
    print("| sequence |", " | ".join(COLUMNS), "|")
    print("| --- |" + " --- |" * len(COLUMNS))
    for name, folder in {} if arguments.rendered else EXCERPTS.items():
        if (DATA / folder).is_dir():
            print(row(name, open_sequence(DATA / folder), max(1, arguments.every // 3)), flush=True)
    for id in arguments.ids:
        print(row(id, open_synthetic(id, arguments.cache), arguments.every), flush=True)


if __name__ == "__main__":
    main()
