"""RGB-D in EuRoC's layout: ``mav0/cam0``, ``mav0/depth0`` (registered), ``mav0/state_groundtruth_estimate0``.

Stamps are nanoseconds. The ground truth is the body's, its quaternion has w first, and ``T_BS`` of ``cam0`` places the
camera on the body. EuRoC itself has no depth: ``depth0`` is what others add, in millimetres unless its ``sensor.yaml``
states a ``depth_factor``.
"""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.readers.lists import Contents, ImageList, stamped
from dynslam_bench.sequences.readers.tables import (
    camera_on_body,
    camera_truth,
    floats,
    frame_rate,
    nanoseconds,
    numbers,
    read_rows,
    read_yaml,
    section,
)

MILLIMETRES = 1000.0


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read a folder in EuRoC's layout.

    Args:
        folder: The sequence's folder, which holds ``mav0``, or ``mav0`` itself.
        fps: Nominal frame rate in Hz in place of the stated one.

    Raises:
        SequenceError: There is no depth, or a file is missing or malformed.
    """
    base = "mav0/" if (folder / "mav0").is_dir() else ""
    if not (folder / base / "depth0" / "data.csv").is_file():
        raise SequenceError(
            f"{folder} has no {base}depth0/data.csv, that is no depth", "EuRoC's own sequences are stereo"
        )
    colour, depth = _images(folder, f"{base}cam0"), _images(folder, f"{base}depth0")
    file = folder / base / "cam0" / "sensor.yaml"
    where, sensor = str(file), read_yaml(file)
    width, height = numbers(section(sensor, "resolution", where), 2, f"{where}: resolution")
    fx, fy, cx, cy = numbers(section(sensor, "intrinsics", where), 4, f"{where}: intrinsics")
    k = numbers(section(sensor, "distortion_coefficients", where), 4, f"{where}: distortion_coefficients")
    factor = _depth_factor(folder / base / "depth0" / "sensor.yaml")
    if min(width, height, fx, fy, factor) <= 0:
        raise SequenceError(f"{file}: size, focal lengths and depth_factor have to be above 0")
    camera = Camera(int(width), int(height), fx, fy, cx, cy, (k[0], k[1], k[2], k[3], 0.0), factor)
    truth = _truth(folder / base / "state_groundtruth_estimate0" / "data.csv", sensor.get("T_BS"), where)
    return Contents(colour, depth, truth=truth, camera=camera, fps=fps or frame_rate(sensor.get("rate_hz")))


def _images(folder: Path, name: str) -> ImageList:
    path = folder / name / "data.csv"
    rows = read_rows(path)[1]
    if len(rows[0]) < 2:
        raise SequenceError(f"{path} has one column, expected a stamp and a file name")
    return stamped([f"{name}/data/{row[1]}" for row in rows], nanoseconds([row[0] for row in rows], path), str(path))


def _depth_factor(path: Path) -> float:
    if not path.is_file():
        return MILLIMETRES
    return numbers(read_yaml(path).get("depth_factor", MILLIMETRES), 1, f"{path}: depth_factor")[0]


def _truth(path: Path, T_BS: object, where: str) -> Trajectory | None:
    if not path.is_file():
        return None
    rows = read_rows(path)[1]
    if len(rows[0]) < 8:
        raise SequenceError(f"{path} has {len(rows[0])} columns, expected a stamp, a position and a quaternion")
    stamps, values = nanoseconds([row[0] for row in rows], path), floats([row[1:8] for row in rows], path)
    return camera_truth(stamps, values[:, [0, 1, 2, 4, 5, 6, 3]], camera_on_body(T_BS, where), str(path))
