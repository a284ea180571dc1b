"""ICL-NUIM in its TUM-compatible form: ``rgb/N.png``, ``depth/N.png`` and a ``*.gt.freiburg`` by frame number.

Its camera has a negative fy: the y axis points up, in images and in poses alike. Turning it down mirrors the camera and
the world, ``M T M`` with ``M = diag(1, -1, 1)``, after which fy is positive and every pose is a rotation as before.
Its ``associations.txt`` names the depth image first; images are paired by their numbers instead.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import load_tum
from dynslam_bench.sequences.readers.lists import Contents, find_names, list_folder

CAMERA = Camera(640, 480, 481.20, 480.0, 319.5, 239.5)
FPS = 30.0
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of ICL-NUIM.

    Args:
        folder: The sequence's folder.
        fps: Frame rate in Hz, which makes stamps of the frame numbers; 30 where not given.

    Raises:
        SequenceError: Images or the trajectory are missing, or named otherwise.
        TrajectoryError: The trajectory cannot be read.
    """
    rate = fps or FPS
    files = find_names(folder, "*.gt.freiburg")
    if len(files) > 1:
        raise SequenceError(f"{folder} holds {len(files)} trajectories ({', '.join(files[:3])[:200]}), expected 1")
    file = load_tum(folder / files[0])
    truth = Trajectory(file.trajectory.timestamps / rate, MIRROR @ file.trajectory.T_world_cam @ MIRROR)
    dropped = ", ".join(f"ground truth: {phrase}" for phrase in file.notes.describe())
    colour, depth = list_folder(folder, "rgb", rate), list_folder(folder, "depth", rate)
    return Contents(colour, depth, False, truth, dropped, CAMERA, rate)
