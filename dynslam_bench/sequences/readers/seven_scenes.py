"""7-Scenes: ``frame-*.color.png``, ``.depth.png`` and ``.pose.txt``, the poses being KinectFusion's 4x4 matrices.

The poses are camera to world and taken to the last digit. A frame that KinectFusion lost (a pose that is no number)
stays a frame without ground truth. Raw depth 65535 is missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.reading import read_text
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.stamps import from_seconds, to_seconds
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.readers.lists import Contents, find_names, stamped

CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_factor=1000.0)
FPS = 30.0
MISSING = 65535
_LOST = ("nan", "inf", "#ind", "#qnan", "#inf")


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of 7-Scenes.

    Args:
        folder: The sequence's folder, ``seq-01`` for example.
        fps: Frame rate in Hz, which makes stamps of the frame numbers; 30 where not given.

    Raises:
        SequenceError: Files are missing or not named by a number, or a pose is no rigid transformation.
    """
    rate = fps or FPS
    files = find_names(folder, "frame-*.color.png")
    numbers = [name.removeprefix("frame-").removesuffix(".color.png") for name in files]
    bad = [number for number in numbers if not (number.isascii() and number.isdigit() and len(number) < 16)]
    if bad:
        raise SequenceError(f"frame-{bad[0][:40]}.color.png of {folder} is named by no number")
    stamps = from_seconds(int(number) / rate for number in numbers)
    colour, depth = stamped(files, stamps, str(folder)), [f"frame-{number}.depth.png" for number in numbers]
    poses = [read_pose(folder / f"frame-{number}.pose.txt") for number in numbers]
    tracked_frames = [i for i, pose in enumerate(poses) if pose is not None]
    tracked = np.array([poses[i] for i in tracked_frames])
    truth = Trajectory(to_seconds(stamps[tracked_frames]), tracked, stamps[tracked_frames]) if tracked_frames else None
    lost = len(poses) - len(tracked_frames)
    dropped = f"ground truth: {lost} of {len(poses)} poses lost" if lost else ""
    paired = stamped(depth, stamps, str(folder))
    return Contents(colour, paired, True, truth, dropped, CAMERA, rate, missing_depth=MISSING)


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """A 4x4 pose, unchanged; None where it is no number, as KinectFusion writes a lost frame.

    Raises:
        SequenceError: The file is missing, or holds no rigid transformation.
    """
    parts = read_text(path, limit=1 << 16, kind=SequenceError).split()
    if len(parts) == 16 and any(mark in part.lower() for part in parts for mark in _LOST):
        return None
    try:
        pose = np.array([float(part) for part in parts]).reshape(4, 4)
    except ValueError:
        raise SequenceError(f"{path} holds {len(parts)} values, expected the 16 numbers of a 4x4 pose") from None
    if not se3.is_pose(pose, tolerance=1e-3):
        raise SequenceError(f"{path} holds no rigid transformation")
    return pose
