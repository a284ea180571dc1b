"""OpenLORIS-Scene: ``color.txt``, ``aligned_depth.txt``, ``groundtruth.txt`` of the robot's base, and two YAML files.

Intrinsics are in the order fx cx fy cy. The ground truth is that of ``base_link``; ``trans_matrix.yaml`` tells where on
it the camera sits. Stamps are said to carry a deliberate random bias, another for every sequence, so only those of one
sequence may be compared. A ground truth that shares no time with the images is refused with the measured gap.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.association import nearest_gap
from dynslam_bench.sequences.readers import tum
from dynslam_bench.sequences.readers.lists import Contents, pinhole, read_image_list
from dynslam_bench.sequences.readers.tables import numbers, read_yaml, section

CAMERA_FRAME, BASE_FRAME = "d400_color_optical_frame", "base_link"
DEPTH_FACTOR = 1000.0
LARGEST_GAP_S = 1.0


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of OpenLORIS-Scene, the D400 colour camera with its aligned depth.

    Args:
        folder: The sequence's folder, ``office1-1`` for example.
        fps: Nominal frame rate in Hz; from the stamps where not given.

    Raises:
        SequenceError: A file is missing or malformed, or the ground truth shares no time with the images.
        TrajectoryError: The ground truth cannot be read.
    """
    colour, depth = read_image_list(folder / "color.txt"), read_image_list(folder / "aligned_depth.txt")
    sensors = folder / "sensors.yaml"
    sensor = section(read_yaml(sensors), CAMERA_FRAME, str(sensors))
    fx, cx, fy, cy = numbers(section(sensor, "intrinsics", str(sensors)), 4, f"{sensors}: intrinsics")
    camera = pinhole(folder, colour.files[0], fx, fy, cx, cy, DEPTH_FACTOR)
    base, dropped = tum.read_truth(folder)
    if base is None:
        return Contents(colour, depth, camera=camera, fps=fps)
    gap = float(nearest_gap(colour.stamps, base.timestamps).min())
    if gap > LARGEST_GAP_S:
        raise SequenceError(
            f"the ground truth of {folder} is never nearer than {gap:.3f} s to an image",
            "stamps of OpenLORIS carry a bias of their own in every sequence: are both files of the same one?",
        )
    truth = base.with_poses(base.T_world_cam @ T_base_cam(folder / "trans_matrix.yaml"))
    return Contents(colour, depth, truth=truth, truth_dropped=dropped, camera=camera, fps=fps)


def T_base_cam(path: Path) -> NDArray[np.float64]:
    """The pose ``[4, 4]`` of the colour camera on the robot's base.

    Raises:
        SequenceError: The file holds no such transformation, or none that is rigid.
    """
    listed = section(read_yaml(path), "trans_matrix", str(path))
    for entry in listed if isinstance(listed, list) else []:
        if isinstance(entry, dict) and (entry.get("parent_frame"), entry.get("child_frame")) == (
            BASE_FRAME,
            CAMERA_FRAME,
        ):
            pose = np.array(numbers(entry.get("matrix"), 16, str(path))).reshape(4, 4)
            if se3.is_pose(pose, tolerance=1e-3):
                return pose
    raise SequenceError(f"{path} holds no rigid transformation from {BASE_FRAME} to {CAMERA_FRAME}")
