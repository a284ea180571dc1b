"""A recording of one's own: write it in TUM layout, with its ground truth, and run a tracker on it.

    python examples/own_dataset.py [FOLDER] [RESULTS]

Here the camera slides along a painted wall; put your own images, depth and poses in their place.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import dynslam_bench as db
from dynslam_bench.contracts import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum

FPS = 30.0
FX = 300.0
DEPTH_M = 2.0
STEP_PX = 3
CAMERA = f"""width = 320
height = 240
fx = {FX}
fy = {FX}
cx = 159.5                # the centre of the top-left pixel is 0
cy = 119.5
depth_factor = 5000.0     # raw units of the depth images a metre
fps = {FPS}
"""


def write_recording(folder: Path, frames: int) -> None:
    """Images below rgb/ and depth/, a list of each with stamps, the poses, and the camera."""
    wall = np.random.default_rng(0).integers(0, 255, (60, 80 + frames, 3), dtype=np.uint8)
    wall = cv2.resize(wall, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    stamps = np.round(1000 + np.arange(frames) / FPS, 6)
    # the lists: a stamp in seconds and a path a line
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        lines = [f"{stamp:.6f} {kind}/{stamp:.6f}.png\n" for stamp in stamps]
        (folder / f"{kind}.txt").write_text("".join(lines))
    # the images
    for index, stamp in enumerate(stamps):
        colour = wall[:240, STEP_PX * index : STEP_PX * index + 320]
        depth = np.full((240, 320), 5000 * DEPTH_M, np.uint16)  # 0 where depth is missing
        cv2.imwrite(str(folder / "rgb" / f"{stamp:.6f}.png"), colour)
        cv2.imwrite(str(folder / "depth" / f"{stamp:.6f}.png"), depth)
    (folder / "camera.toml").write_text(CAMERA)
    # the ground truth
    T_world_cam = np.tile(np.eye(4), (frames, 1, 1))  # camera to world; x right, y down, z forward
    T_world_cam[:, 0, 3] = np.arange(frames) * STEP_PX * DEPTH_M / FX
    write_tum(folder / "groundtruth.txt", Trajectory(stamps, T_world_cam))


def main(folder: str = "my_recording", results: str = "results", frames: int = 60) -> None:
    write_recording(Path(folder), frames)
    for tracker in ("never-move", "orb-slam2"):
        run = db.run(tracker, folder, results=results)
        print(f"{tracker:12} {run.status}: ATE {1000 * run.metrics['ate_rmse_m']:.1f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:3])
