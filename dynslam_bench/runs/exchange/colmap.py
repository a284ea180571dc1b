"""COLMAP's text format: ``cameras.txt``, ``images.txt`` and ``points3D.txt`` in a folder.

COLMAP states world-to-camera poses, puts the centre of the top-left pixel at (0.5, 0.5), and knows no stamps: they are
the images' names here (``rgb/1305031102.175304.png``, as in TUM's folders), or come from a list of images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import read_lines
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.tum_file import is_number
from dynslam_bench.slam.outputs.map_files import Cloud

IMAGES = "images.txt"
_HALF = 0.5


def write_colmap(
    folder: Path, trajectory: Trajectory, camera: Camera, names: Sequence[str], cloud: Cloud | None = None
) -> None:
    """Write a reconstruction.

    Args:
        folder: Where; it exists.
        trajectory: Camera-to-world poses, one an image.
        camera: Of all images.
        names: The image of each pose, relative to the folder of images.
        cloud: Map points, written without tracks and with the error 0, neither of which is known; None for none.

    Raises:
        DynslamError: A file cannot be written.
    """
    model, values = _camera_model(camera)
    numbers = " ".join(f"{value:.12g}" for value in values)
    write_atomic(folder / "cameras.txt", f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {model} {camera.width} "
                 f"{camera.height} {numbers}\n")  # fmt: skip
    position, quaternion = se3.to_quaternion(se3.inverse(trajectory.T_world_cam))
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] (none)"]
    for number, (t, q, name) in enumerate(zip(position, quaternion, names, strict=True), start=1):
        pose = " ".join(f"{value:.12f}" for value in (q[3], *q[:3], *t))
        lines += [f"{number} {pose} 1 {name}", ""]
    write_atomic(folder / IMAGES, "\n".join(lines) + "\n")
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    if cloud is not None:
        rows = zip(cloud.positions.tolist(), cloud.colours.tolist(), strict=True)
        points += [f"{i} {x:.7g} {y:.7g} {z:.7g} {r} {g} {b} 0" for i, ((x, y, z), (r, g, b)) in enumerate(rows, 1)]
    write_atomic(folder / "points3D.txt", "\n".join(points) + "\n")


def _camera_model(camera: Camera) -> tuple[str, list[float]]:
    """Name and parameters of COLMAP's model that holds the camera exactly."""
    pinhole = [camera.fx, camera.fy, camera.cx + _HALF, camera.cy + _HALF]
    k1, k2, p1, p2, k3 = camera.distortion
    if not camera.is_distorted:
        return "PINHOLE", pinhole
    return ("FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0, 0, 0]) if k3 else ("OPENCV", [*pinhole, k1, k2, p1, p2])


def read_colmap(folder: Path, stamps: Mapping[str, float] | None = None) -> Trajectory:
    """The poses of ``images.txt``, camera to world, in order of their stamps.

    Args:
        folder: The reconstruction's, or ``images.txt`` itself.
        stamps: Stamp in seconds of each image by its name; None where the names are the stamps.

    Raises:
        TrajectoryError: A line is malformed, an image has no stamp, or there is no image.
    """
    path = folder / IMAGES if folder.is_dir() else folder
    found: dict[float, NDArray[np.float64]] = {}
    held = False
    for number, line in enumerate(read_lines(path, kind=TrajectoryError), start=1):
        if line.startswith("#"):
            continue
        held = not held
        if not held or not line.strip():  # every other line holds the image's points, often none
            held = held and bool(line.strip())
            continue
        parts = line.split(maxsplit=9)
        if len(parts) != 10 or not all(map(is_number, parts[1:8])):
            raise TrajectoryError(f"{path} line {number} is no image: expected ID QW QX QY QZ TX TY TZ CAMERA NAME")
        values = np.array(parts[1:8], dtype=np.float64)
        if not np.isfinite(values).all() or not np.any(values[:4]):
            raise TrajectoryError(f"{path} line {number} holds no pose")
        name = parts[9].strip()
        found[_stamp(name, stamps, path)] = se3.from_quaternion(values[4:], values[[1, 2, 3, 0]])
    if not found:
        raise TrajectoryError(f"{path} names no image")
    order = sorted(found)
    return Trajectory(np.array(order), se3.inverse(np.array([found[stamp] for stamp in order])))


def _stamp(name: str, stamps: Mapping[str, float] | None, path: Path) -> float:
    if stamps is not None:
        known = stamps.get(name, stamps.get(Path(name).name))
        if known is None:
            raise TrajectoryError(f"{path} names the image '{name[:100]}', which the list of stamps does not")
        return known
    stem = Path(name).stem
    if "." not in stem or not is_number(stem) or not np.isfinite(float(stem)):
        raise TrajectoryError(
            f"the image '{name[:100]}' of {path} is not named by its stamp in seconds",
            "give a list of stamps and images such as rgb.txt with --timestamps FILE",
        )
    return float(stem)
