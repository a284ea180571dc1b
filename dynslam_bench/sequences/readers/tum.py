"""Folders in TUM layout: TUM RGB-D, Bonn Dynamic, Wild-SLAM MoCap, and recordings of one's own."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import load_tum
from dynslam_bench.sequences.readers.lists import Contents, ImageList, list_folder, read_associations, read_image_list

ASSOCIATIONS = ("associations.txt", "associated.txt", "associate.txt", "association.txt")
GROUND_TRUTHS = ("groundtruth.txt", "pose.txt")


def read(folder: Path, fps: float | None = None) -> Contents:
    """Read the lists ``rgb.txt`` and ``depth.txt``, else an ``associations.txt``, else the names of the images.

    Args:
        folder: The sequence's folder.
        fps: Frame rate in Hz, which makes stamps of images that are named by frame numbers.

    Raises:
        SequenceError: The folder is not in TUM layout, or a list is malformed.
        TrajectoryError: The ground truth cannot be read.
    """
    truth, dropped = read_truth(folder)
    if not (folder / "rgb.txt").is_file() and not (folder / "depth.txt").is_file():
        for name in ASSOCIATIONS:
            if (folder / name).is_file():
                colour, depth = read_associations(folder / name)
                return Contents(colour, depth, paired=True, truth=truth, truth_dropped=dropped)
    return Contents(_list(folder, "rgb", fps), _list(folder, "depth", fps), truth=truth, truth_dropped=dropped)


def read_truth(folder: Path) -> tuple[Trajectory | None, str]:
    """The ground truth, None if there is no file, and one phrase on the lines that were not taken as they stand.

    Raises:
        TrajectoryError: It cannot be read.
    """
    for name in GROUND_TRUTHS:
        if (folder / name).is_file():
            file = load_tum(folder / name)
            return file.trajectory, ", ".join(f"ground truth: {phrase}" for phrase in file.notes.describe())
    return None, ""


def _list(folder: Path, name: str, fps: float | None) -> ImageList:
    file = folder / f"{name}.txt"
    return read_image_list(file) if file.is_file() else list_folder(folder, name, fps)
