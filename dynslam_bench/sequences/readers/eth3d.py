"""ETH3D SLAM: TUM lists, paired by ``associated.txt``, with the camera in ``calibration.txt``.

A sequence is published as two archives of one folder: ``*_mono.zip`` (colour, lists, calibration, ground truth) and
``*_rgbd.zip`` (depth and ``associated.txt``).
"""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.trajectory_files import read_table
from dynslam_bench.sequences.readers import tum
from dynslam_bench.sequences.readers.lists import Contents, pinhole, read_associations

FPS = 27.1
DEPTH_FACTOR = 5000.0


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of ETH3D SLAM.

    Args:
        folder: The sequence's folder.
        fps: Frame rate in Hz in place of the published one.

    Raises:
        SequenceError: It lacks its depth archive, or a list or the calibration is malformed.
        TrajectoryError: The ground truth cannot be read.
    """
    pairs = folder / "associated.txt"
    if not pairs.is_file():
        raise SequenceError(
            f"{folder} has no associated.txt, that is no depth", "unpack the sequence's _rgbd archive into it as well"
        )
    colour, depth = read_associations(pairs)
    rows = read_table(folder / "calibration.txt", 4, "fx fy cx cy")
    fx, fy, cx, cy = rows[0].tolist()
    camera = pinhole(folder, colour.files[0], fx, fy, cx, cy, DEPTH_FACTOR)
    truth, dropped = tum.read_truth(folder)
    return Contents(colour, depth, True, truth, dropped, camera, fps or FPS)
