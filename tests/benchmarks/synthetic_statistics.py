"""Image statistics of rendered sequences beside the Bonn and TUM excerpts: a Markdown table.

Usage: python tests/benchmarks/synthetic_statistics.py [ID ...] [--every 15] [--cache DIR]

Corners: FAST with threshold 20 (with non-maximum suppression) a frame. Depth: share of pixels with a depth. Contrast:
standard deviation of the grey values. Flow: magnitude of pyramidal Lucas-Kanade flow of up to 500 corners to the next
frame, median of a frame's median and 95 %. Of rendered sequences the geometry tells exactly which share of the image
people and what moves cover, and how fast, in the world, the surface moves that each moving pixel sees (median and 95 %
of all such pixels). Of recordings corners say it: they are followed over five frames and placed in the world by their
depths and the true poses; those displaced at more than 0.5 m/s move. What is slower hides in the sensors' noise, and
what that adds is seen in the rows of scenes in which nothing moves.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic import REPLICA_IDS, open_synthetic
from dynslam_bench.sequences.synthetic.renderer import view_of
from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence
from dynslam_bench.sequences.synthetic.settings import FPS

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
    "FAST corners", "depth valid", "contrast", "flow px, median", "95 %", "person area", "moving area",
    "its speed m/s, median", "95 %",
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


def exact_speeds(sequence: SyntheticSequence, index: int) -> NDArray[np.float64]:
    """Speeds ``[N]`` in m/s, in the world, of what all pixels see that belong to something that moves."""
    scene, renderer = sequence.scene, sequence.renderer
    hit, depth = renderer._geometry(*renderer._tiles(view_of(scene, index)))
    primitive = hit >> 3
    moving = (hit >= 0) & np.isin(scene.instance[primitive], list(scene.moving(index + 1)))
    (turn, origin), (turned, moved) = scene.place(index / FPS), scene.place((index + 1) / FPS)
    v, u = np.nonzero(moving)
    pose, p = sequence.ground_truth.T_world_cam[index], primitive[moving]
    points = sequence.camera.unproject(np.stack([u, v], -1), depth[moving]) @ pose[:3, :3].T + pose[:3, 3]
    after = np.einsum("nij,nkj,nk->ni", turned[p], turn[p], points - origin[p]) + moved[p]
    return np.asarray(np.linalg.norm(after - points, axis=1) * FPS)


def row(name: str, sequence: Sequence, every: int) -> str:
    """One line of the table."""
    fast = cv2.FastFeatureDetector_create(20)
    found: dict[str, list[float]] = {key: [] for key in ("corners", "valid", "contrast", "flow", "tail", "area")}
    people: list[float] = []
    moving: list[float] = []
    for index in range(1, len(sequence) - GAP, every):
        frame = sequence[index]
        now, after = (cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in (frame, sequence[index + 1]))
        found["corners"].append(len(fast.detect(now)))
        found["valid"].append(float((frame.depth > 0).mean()))
        found["contrast"].append(float(now.std()))
        start, end = follow(now, after)
        if len(start):
            lengths = np.linalg.norm(end - start, axis=1)
            found["flow"].append(float(np.median(lengths)))
            found["tail"].append(float(np.percentile(lengths, 95)))
        if isinstance(sequence, SyntheticSequence):
            masks = sequence.masks[index]
            persons = [k for k, kind in masks.class_names.items() if kind == "person"]
            people.append(float(np.isin(masks.instances, persons).mean()))
            of_pixels = exact_speeds(sequence, index)
            found["area"].append(len(of_pixels) / now.size)
            moving += list(of_pixels)
        else:
            of_corners = speeds(sequence, index, [now, cv2.cvtColor(sequence[index + GAP].rgb, cv2.COLOR_RGB2GRAY)])
            found["area"] += [float((of_corners > MOVES_MPS).mean())] if len(of_corners) else []
            moving += list(of_corners[of_corners > MOVES_MPS])
    mean, middle = ({key: how(each) for key, each in found.items() if each} for how in (np.mean, np.median))
    person = f"{np.mean(people):.2f} (max {np.max(people):.2f})" if people else "-"
    speed = f"{np.median(moving):.2f} | {np.percentile(moving, 95):.2f}" if moving else "- | -"
    return (
        f"| {name} | {mean['corners']:.0f} | {mean['valid']:.2f} | {mean['contrast']:.0f} | {middle['flow']:.1f} "
        f"| {middle['tail']:.1f} | {person} | {mean['area']:.2f}{'' if people else ' of corners'} | {speed} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    others = [f"synthetic/walking_xyz?scene={scene}" for scene in (1, 100)]
    parser.add_argument("ids", nargs="*", default=[*REPLICA_IDS, *others])
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
