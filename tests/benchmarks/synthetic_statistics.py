"""Image statistics of the rendered twins beside the Bonn and TUM excerpts, measured alike: a Markdown table.

Usage: python tests/benchmarks/synthetic_statistics.py [ID ...] [--every 15]

Corners: FAST with threshold 20 (with non-maximum suppression) a frame. Depth: share of pixels with a depth. Flow:
magnitude of pyramidal Lucas-Kanade flow of up to 500 corners to the next frame, median of a frame's median and 95 %.
Contrast: standard deviation of the grey values. Areas: from the exact masks.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.sequences.synthetic import TWIN_IDS, open_synthetic

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
EXCERPTS = {
    "Bonn crowd (excerpt)": "bonn/rgbd_bonn_crowd",
    "TUM fr1_xyz (excerpt)": "tum/rgbd_dataset_freiburg1_xyz",
    "TUM fr1_rpy (excerpt)": "tum/rgbd_dataset_freiburg1_rpy",
}


def recorded(folder: Path, every: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, float, float]]:
    """Grey images of neighbouring frames, and the valid depth of the first."""
    colors, depths = sorted((folder / "rgb").iterdir()), sorted((folder / "depth").iterdir())
    stamps = np.array([float(path.stem) for path in depths])
    for index in range(0, len(colors) - 1, every):
        nearest = depths[int(np.abs(stamps - float(colors[index].stem)).argmin())]
        now, after = (cv2.imread(str(colors[i]), cv2.IMREAD_GRAYSCALE) for i in (index, index + 1))
        yield now, after, cv2.imread(str(nearest), cv2.IMREAD_UNCHANGED) > 0, np.nan, np.nan


def rendered(id: str, every: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, float, float]]:
    """The same of a rendered sequence, with the areas of people and of what moves."""
    sequence = open_synthetic(id, None)
    for index in range(1, len(sequence) - 1, every):
        frame, after = sequence[index], sequence[index + 1]
        masks = sequence.masks[index]
        people = [k for k, name in masks.class_names.items() if name == "person"]
        now, then = (cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in (frame, after))
        moving = float(np.isin(masks.instances, list(masks.moving)).mean())
        yield now, then, frame.depth > 0, float(np.isin(masks.instances, people).mean()), moving


def row(name: str, frames: Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, float, float]]) -> str:
    """One line of the table."""
    fast = cv2.FastFeatureDetector_create(20)
    corners, valid, medians, tails, contrast, people, moving = ([] for _ in range(7))
    for now, after, depth, person_area, moving_area in frames:
        corners.append(len(fast.detect(now)))
        valid.append(depth.mean())
        contrast.append(now.std())
        people.append(person_area)
        moving.append(moving_area)
        points = cv2.goodFeaturesToTrack(now, 500, 0.01, 8)
        if points is None:
            continue
        ends, found, _ = cv2.calcOpticalFlowPyrLK(now, after, points, None, winSize=(21, 21), maxLevel=4)
        lengths = np.linalg.norm((ends - points).reshape(-1, 2), axis=1)[found.ravel() == 1]
        if len(lengths):
            medians.append(np.median(lengths))
            tails.append(np.percentile(lengths, 95))
    areas = (
        "- | -"
        if np.isnan(people).any()
        else f"{np.mean(people):.2f} (max {np.max(people):.2f}) | {np.mean(moving):.2f}"
    )
    return (
        f"| {name} | {np.mean(corners):.0f} | {np.mean(valid):.2f} | {np.mean(contrast):.0f} "
        f"| {np.median(medians):.1f} | {np.median(tails):.1f} | {areas} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ids", nargs="*", default=[*TWIN_IDS, "synthetic/walking_xyz@1", "synthetic/walking_xyz@100"])
    parser.add_argument("--every", type=int, default=15)
    arguments = parser.parse_args()
    print("| sequence | FAST corners | depth valid | contrast | flow px, median | 95 % | person area | moving area |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, folder in EXCERPTS.items():
        if (DATA / folder).is_dir():
            print(row(name, recorded(DATA / folder, max(1, arguments.every // 3))), flush=True)
    for id in arguments.ids:
        print(row(id, rendered(id, arguments.every)), flush=True)


if __name__ == "__main__":
    main()
