"""Trajectories in any of the formats: which one it is shows in the file."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_file import load_trajectory
from dynslam_bench.geometry.tum_file import FileNotes, TumFile
from dynslam_bench.sequences.readers.layouts import is_bag
from dynslam_bench.sequences.readers.lists import read_image_list

from .colmap import IMAGES, read_colmap
from .pose_tables import is_pose_table, read_pose_table
from .ros_bag import read_bag_trajectory


def read_trajectory(path: str | Path, timestamps: str | Path | None = None, topic: str | None = None) -> TumFile:
    """Read a trajectory with the counts of what was not taken as it stands.

    Args:
        path: A file in TUM's or KITTI's format, a table of EuRoC or VSLAM-LAB, a folder of COLMAP's text files (or its
            ``images.txt``), or a bag.
        timestamps: Stamps where the format has none: for KITTI a file whose lines begin with one each, for COLMAP a
            list of stamps and images such as ``rgb.txt``.
        topic: Of a bag with several topics of poses, the one to take.

    Raises:
        DynslamError: A file cannot be read, is malformed, or stamps are missing.
    """
    path = Path(path).expanduser()
    if path.name == IMAGES or (path / IMAGES).is_file():
        return _whole(read_colmap(path, None if timestamps is None else _stamps_by_name(Path(timestamps))))
    if is_bag(path):
        return _whole(read_bag_trajectory(path, topic))
    if path.is_dir():
        raise TrajectoryError(f"the folder {path} holds neither {IMAGES} of COLMAP nor a bag of ROS 2")
    if is_pose_table(path):
        return _whole(read_pose_table(path))
    return load_trajectory(path, timestamps)


def _whole(trajectory: Trajectory) -> TumFile:
    return TumFile(trajectory, FileNotes(lines=len(trajectory)))


def _stamps_by_name(path: Path) -> dict[str, float]:
    """The stamp of each image of a list, by the name that the list gives and by the file's own."""
    images = read_image_list(path.expanduser())
    stamps = images.stamps.tolist()
    return {Path(file).name: stamp for file, stamp in zip(images.files, stamps, strict=True)} | dict(
        zip(images.files, stamps, strict=True)
    )
