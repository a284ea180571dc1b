"""Poses as tables in CSV with stamps in nanoseconds: EuRoC's ``data.csv`` and VSLAM-LAB's trajectories.

EuRoC writes ``timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z`` below a heading that begins with ``#``; VSLAM-LAB has the
quaternion's w last and names its columns (``ts (ns)``, ``tx (m)``, ...), which tells the two apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import read_lines
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.readers.bodies import camera_truth
from dynslam_bench.sequences.readers.nanoseconds import column, floats, nanoseconds, read_rows
from dynslam_bench.sequences.readers.vslam_lab import POSE

EUROC_HEADING = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
_EUROC_ORDER = [1, 2, 3, 5, 6, 7, 4]
_W_FIRST = "w"


def is_pose_table(path: Path) -> bool:
    """Whether a file begins with the heading of such a table.

    Raises:
        TrajectoryError: It cannot be read.
    """
    first = next((line for line in read_lines(path, kind=TrajectoryError) if line.strip()), "").lower()
    return "," in first and ("timestamp" in first or "(ns)" in first)


def read_pose_table(path: Path) -> Trajectory:
    """The poses of a table of either kind, as the camera's own.

    Raises:
        DynslamError: A row is malformed, no row holds a pose, or the heading is of neither kind.
    """
    heading, rows = read_rows(path)
    if POSE[0] in heading:
        order = [column(heading, name, path) for name in POSE]
    elif len(heading) >= 8 and _W_FIRST in heading[4].lower():
        order = [0, *_EUROC_ORDER]
    else:
        raise TrajectoryError(
            f"{path} has the columns {', '.join(heading)[:200]}: neither EuRoC's nor VSLAM-LAB's",
            "EuRoC's fifth is the quaternion's w; VSLAM-LAB's are " + ", ".join(POSE),
        )
    picked = [[row[at] for at in order] for row in rows]
    stamps, values = nanoseconds([row[0] for row in picked], path), floats([row[1:] for row in picked], path)
    found = camera_truth(stamps, values, np.eye(4), str(path))
    if found is None:
        raise TrajectoryError(f"none of the {len(rows)} rows of {path} holds a rotation")
    return found


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Write poses as EuRoC's ground truth is written.

    Raises:
        DynslamError: The file cannot be written.
    """
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    _write(path, EUROC_HEADING, trajectory, [[*p, q[3], *q[:3]] for p, q in zip(position, quaternion, strict=True)])


def write_vslam_lab(path: Path, trajectory: Trajectory) -> None:
    """Write poses as VSLAM-LAB's systems write theirs.

    Raises:
        DynslamError: The file cannot be written.
    """
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    _write(path, ",".join(POSE), trajectory, [[*p, *q] for p, q in zip(position, quaternion, strict=True)])


def _write(path: Path, heading: str, trajectory: Trajectory, rows: list[list[float]]) -> None:
    lines = [
        f"{ns}," + ",".join(f"{value:.9f}" for value in row)
        for ns, row in zip(trajectory.timestamps_ns.tolist(), rows, strict=True)
    ]
    write_atomic(path, "\n".join([heading, *lines]) + "\n")
