"""Folders of VSLAM-LAB: ``rgb.csv`` (stamps in nanoseconds, pairs), ``calibration.yaml``, ``groundtruth.csv``.

The ground truth is that of the body, on which ``T_BS`` places the camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.readers.lists import Contents, stamped
from dynslam_bench.sequences.readers.tables import (
    camera_on_body,
    camera_truth,
    column,
    floats,
    frame_rate,
    nanoseconds,
    numbers,
    read_rows,
    read_yaml,
    section,
)

COLUMNS = ("ts_rgb_0 (ns)", "path_rgb_0", "ts_depth_0 (ns)", "path_depth_0")
POSE = ("ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw")


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder of VSLAM-LAB.

    Args:
        folder: The sequence's folder.
        fps: Nominal frame rate in Hz in place of the stated one.

    Raises:
        SequenceError: A file is missing or malformed, or there is no depth.
    """
    table, calibration, poses = (folder / name for name in ("rgb.csv", "calibration.yaml", "groundtruth.csv"))
    heading, rows = read_rows(table)
    places = [column(heading, name, table) for name in COLUMNS]
    stamps, files, depth_stamps, depth_files = ([row[at] for row in rows] for at in places)
    colour = stamped(files, nanoseconds(stamps, table), str(table))
    order = np.argsort(nanoseconds(stamps, table), kind="stable")
    depth = stamped([depth_files[i] for i in order], nanoseconds([depth_stamps[i] for i in order], table), str(table))
    stated = _camera(read_yaml(calibration), calibration)
    truth = None
    if poses.is_file():
        names, values = read_rows(poses)
        places = [column(names, name, poses) for name in POSE]
        picked = [[row[at] for at in places] for row in values]
        T_body_cam = camera_on_body(stated.get("T_BS"), str(calibration))
        stamps_ns = nanoseconds([row[0] for row in picked], poses)
        truth = camera_truth(stamps_ns, floats([r[1:] for r in picked], poses), T_body_cam, str(poses))
    nominal = fps or frame_rate(stated.get("fps"))
    return Contents(colour, depth, True, truth, camera=_intrinsics(stated, calibration), fps=nominal)


def _camera(document: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """What the file states of the camera ``rgb_0``."""
    for value in document.values():
        for entry in value if isinstance(value, list) else []:
            if isinstance(entry, dict) and entry.get("cam_name") == "rgb_0":
                return entry
    raise SequenceError(f"{path} describes no camera 'rgb_0'")


def _intrinsics(stated: Mapping[str, Any], path: Path) -> Camera:
    where = str(path)
    width, height = numbers(section(stated, "image_dimension", where), 2, f"{where}: image_dimension")
    fx, fy = numbers(section(stated, "focal_length", where), 2, f"{where}: focal_length")
    cx, cy = numbers(section(stated, "principal_point", where), 2, f"{where}: principal_point")
    (factor,) = numbers(section(stated, "depth_factor", where), 1, f"{where}: depth_factor")
    kind = stated.get("distortion_type")
    if kind not in (None, "radtan4", "radtan5"):
        raise SequenceError(f"{path}: the distortion '{str(kind)[:40]}' is not read, only radtan4 and radtan5")
    count = 0 if kind is None else int(kind[-1])
    k = numbers(stated.get("distortion_coefficients"), count, f"{where}: distortion") if count else []
    if min(width, height, fx, fy, factor) <= 0:
        raise SequenceError(f"{path}: size, focal lengths and depth_factor have to be above 0")
    distortion = (*k, *[0.0] * (5 - len(k)))
    return Camera(int(width), int(height), fx, fy, cx, cy, distortion, factor)  # type: ignore[arg-type]
