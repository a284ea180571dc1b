"""Trajectories in the formats of others: EuRoC, VSLAM-LAB, COLMAP and bags of ROS 2 (MCAP); the file shows which."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core import (
    RunError,
    TrajectoryError,
    read_lines,
    temporary_folder,
    translate_errors,
    write_atomic,
)
from dynslam_bench.core.version import install_hint
from dynslam_bench.geometry import (
    Array,
    Camera,
    FileNotes,
    LoadedTrajectory,
    Trajectory,
    is_number,
    load_trajectory,
    se3,
)
from dynslam_bench.sequences.bags import read_bag_poses
from dynslam_bench.sequences.readers.files import POSE, camera_poses_from_body, read_image_list
from dynslam_bench.sequences.readers.layouts import is_bag
from dynslam_bench.slam.map_files import Cloud


def read_trajectory(
    path: str | Path, timestamps: str | Path | None = None, topic: str | None = None
) -> LoadedTrajectory:
    """Read a trajectory, with counts of the lines that were skipped, sorted or repaired (`FileNotes`).

    Args:
        path: A file in TUM's or KITTI's format, a table with a heading such as EuRoC's or
            VSLAM-LAB's, a folder of COLMAP's text files (or its ``images.txt``), or a bag.
        timestamps: Stamps where the format has none: for KITTI a file whose lines begin with one
            each, for COLMAP a list of stamps and images such as ``rgb.txt``.
        topic: The topic to take of a bag that has several topics of poses.

    Raises:
        DynslamError: A file cannot be read, is malformed, or stamps are missing.
    """
    # a reconstruction of COLMAP, a bag, or a file with a pose a line
    path = Path(path).expanduser()
    if path.name == IMAGES or (path / IMAGES).is_file():
        trajectory = read_colmap(
            path, None if timestamps is None else _stamps_by_name(Path(timestamps))
        )
        return LoadedTrajectory(trajectory, FileNotes(lines=len(trajectory)))
    if is_bag(path):
        return read_bag_trajectory(path, topic)
    if path.is_dir():
        raise TrajectoryError(
            f"the folder {path} holds neither {IMAGES} of COLMAP nor a bag of ROS 2"
        )
    return load_trajectory(path, timestamps)


def _stamps_by_name(path: Path) -> dict[str, float]:
    """The stamp of each image of a list, by the name that the list gives and by the file's own."""
    images = read_image_list(path.expanduser())
    stamps = dict(zip(images.files, images.stamps.tolist(), strict=True))
    return {Path(file).name: stamp for file, stamp in stamps.items()} | stamps


POSE_TABLES = {
    "euroc": (
        "data.csv",
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        [0, 1, 2, 6, 3, 4, 5],
    ),
    "vslam-lab": ("00000_KeyFrameTrajectory.csv", ",".join(POSE), [0, 1, 2, 3, 4, 5, 6]),
}
"""Tables of poses as EuRoC's ground truth and VSLAM-LAB's systems write them.

For each its file, its heading, and its columns behind the stamp: places in ``tx ty tz qx qy qz qw``.
"""


def write_pose_table(folder: Path, form: str, trajectory: Trajectory) -> None:
    """Write poses as a table of `POSE_TABLES`.

    Raises:
        DynslamError: The file cannot be written.
    """
    # position and quaternion (x, y, z, w), in the order of the table's columns
    name, heading, columns = POSE_TABLES[form]
    rows = np.concatenate(se3.to_quaternion(trajectory.T_world_cam), axis=1)[:, columns].tolist()
    lines = [
        f"{ns}," + ",".join(f"{value:.9f}" for value in row)
        for ns, row in zip(trajectory.timestamps_ns.tolist(), rows, strict=True)
    ]
    write_atomic(folder / name, "\n".join([heading, *lines]) + "\n")


IMAGES = "images.txt"
"""COLMAP's file of the images and their poses."""


def write_colmap(
    folder: Path,
    trajectory: Trajectory,
    camera: Camera,
    names: Sequence[str],
    cloud: Cloud | None = None,
) -> None:
    """Write a reconstruction.

    Args:
        folder: Folder of the reconstruction; it exists.
        trajectory: Camera-to-world poses, one an image.
        camera: The camera of all images.
        names: The image of each pose, relative to the folder of images.
        cloud: Map points, written without tracks and with the error 0, neither of which is known;
            None for none.

    Raises:
        DynslamError: A file cannot be written.
    """
    # one camera for all images
    model, parameters = _colmap_camera(camera)
    numbers = " ".join(f"{value:.12g}" for value in parameters)
    write_atomic(
        folder / "cameras.txt",
        f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {model} {camera.width} "
        f"{camera.height} {numbers}\n",
    )

    # the images with their poses, world to camera
    position, quaternion = se3.to_quaternion(se3.inverse(trajectory.T_world_cam))
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] (none)"]
    for number, (t, q, name) in enumerate(zip(position, quaternion, names, strict=True), start=1):
        pose = " ".join(f"{value:.12f}" for value in (q[3], *q[:3], *t))
        lines += [f"{number} {pose} 1 {name}", ""]
    write_atomic(folder / IMAGES, "\n".join(lines) + "\n")

    # the map points, without tracks and with the error 0
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    if cloud is not None:
        rows = zip(cloud.positions.tolist(), cloud.colours.tolist(), strict=True)
        points += [
            f"{i} {x:.7g} {y:.7g} {z:.7g} {r} {g} {b} 0"
            for i, ((x, y, z), (r, g, b)) in enumerate(rows, 1)
        ]
    write_atomic(folder / "points3D.txt", "\n".join(points) + "\n")


def _colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model of a camera, and its parameters."""
    # the corner of the first pixel is at 0
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if not camera.is_distorted:
        return "PINHOLE", values
    k1, k2, p1, p2, k3 = camera.distortion
    if not k3:
        return "OPENCV", [*values, k1, k2, p1, p2]
    return "FULL_OPENCV", [*values, k1, k2, p1, p2, k3, 0, 0, 0]


def read_colmap(folder: Path, stamps: Mapping[str, float] | None = None) -> Trajectory:
    """The poses of ``images.txt``, camera to world, in order of their stamps.

    Args:
        folder: The reconstruction's, or ``images.txt`` itself.
        stamps: Stamp in seconds of each image by its name; None where the names are the stamps.

    Raises:
        TrajectoryError: A line is malformed, an image has no stamp or that of another one, or there
            is no image.
    """
    path = folder / IMAGES if folder.is_dir() else folder
    poses_by_stamp: dict[float, Array] = {}  # world to camera, [4, 4]
    numbered = enumerate(read_lines(path, kind=TrajectoryError), start=1)
    lines = ((number, line) for number, line in numbered if not line.startswith("#"))
    for number, line in lines:
        # an image has two lines, of which the second holds its points and is often empty
        if not line.strip():
            continue
        next(lines, None)

        # ID QW QX QY QZ TX TY TZ CAMERA NAME; the name may hold spaces
        parts = line.split(maxsplit=9)
        if len(parts) != 10 or not all(map(is_number, parts[1:8])):
            raise TrajectoryError(
                f"{path} line {number} is no image: expected ID QW QX QY QZ TX TY TZ CAMERA NAME"
            )
        values = np.array(parts[1:8], dtype=np.float64)
        if not np.isfinite(values).all() or not np.any(values[:4]):
            raise TrajectoryError(f"{path} line {number} holds no pose")
        stamp = _stamp(parts[9].strip(), stamps, path)
        if stamp in poses_by_stamp:
            raise TrajectoryError(
                f"{path} line {number} repeats a stamp, {stamp:.6f}", "keep one camera"
            )
        poses_by_stamp[stamp] = se3.from_quaternion(values[4:], values[[1, 2, 3, 0]])
    if not poses_by_stamp:
        raise TrajectoryError(f"{path} names no image")

    # in order of time, camera to world
    stamps_in_order = sorted(poses_by_stamp)
    poses = np.array([poses_by_stamp[stamp] for stamp in stamps_in_order])
    return Trajectory(np.array(stamps_in_order), se3.inverse(poses))


def _stamp(name: str, stamps: Mapping[str, float] | None, path: Path) -> float:
    """The stamp of an image in seconds.

    Args:
        name: The image as the reconstruction names it.
        stamps: Stamps by name; None where the names are the stamps.
        path: The file that names it.

    Raises:
        TrajectoryError: It has none.
    """
    if stamps is not None:
        stamp = stamps.get(name, stamps.get(Path(name).name))
        if stamp is None:
            raise TrajectoryError(
                f"{path} names the image '{name[:100]}', which the list of stamps does not"
            )
        return stamp
    stem = Path(name).stem
    if "." not in stem or not is_number(stem) or not np.isfinite(float(stem)):
        raise TrajectoryError(
            f"the image '{name[:100]}' of {path} is not named by its stamp in seconds",
            "give a list of stamps and images such as rgb.txt with --timestamps FILE",
        )
    return float(stem)


POSE_MESSAGE = "geometry_msgs/msg/PoseStamped"
"""Type of the messages on a topic of poses."""
PATH_MESSAGE = "nav_msgs/msg/Path"
"""Type of the message that holds a whole trajectory."""


def read_bag_trajectory(path: Path, topic: str | None = None) -> LoadedTrajectory:
    """The poses of a ROS 1 or 2 bag or an MCAP file, which are assumed to be the camera's own.

    Args:
        path: The file, or the folder of a ROS 2 bag.
        topic: Topic of the poses; needed where there are several.

    Raises:
        DynslamError: `rosbags` is missing, the bag is damaged, or the topic is not the only one and
            was not named.
    """
    stamps, rows = read_bag_poses(path, topic)
    camera_poses = (
        camera_poses_from_body(stamps, rows, np.eye(4), str(path)) if len(stamps) else None
    )
    if camera_poses is None:
        raise TrajectoryError(f"{path} holds no pose", "name its topic with --topic")
    return camera_poses


def write_bag(folder: Path, trajectories: Mapping[str, Trajectory]) -> None:
    """Write trajectories, each on the topics ``/NAME/pose`` and ``/NAME/path``.

    Args:
        folder: Folder that becomes a bag of ROS 2: ``trajectory.mcap`` with its ``metadata.yaml``.
            It exists.
        trajectories: Camera-to-world poses by name.

    Raises:
        DynslamError: `rosbags` is not installed, or the file cannot be written.
    """
    with translate_errors(
        RunError,
        "MCAP is written with rosbags, which is not installed",
        install_hint("bags"),
        of=ImportError,
    ):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.LATEST)
    with temporary_folder(folder / "trajectory") as work:
        bag = work / "trajectory"
        with translate_errors(RunError, f"cannot write {folder}", "check the free space"):
            with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                for name, trajectory in trajectories.items():
                    _write_messages(writer, store, name, trajectory)
            for file in bag.iterdir():
                file.replace(folder / file.name)


def _write_messages(writer: Any, store: Any, name: str, trajectory: Trajectory) -> None:
    """Write a trajectory: each pose at its stamp, and all of them as a path at the first one.

    Args:
        writer: Writer of the bag, from ``rosbags``.
        store: The types of the messages.
        name: Name of the trajectory, the first part of its topics.
        trajectory: Camera-to-world poses.
    """
    # a message for each pose: position and quaternion (x, y, z, w) in the frame ``world``
    types = store.types
    poses = []
    topic = writer.add_connection(f"/{name}/pose", POSE_MESSAGE, typestore=store)
    rows = np.concatenate(se3.to_quaternion(trajectory.T_world_cam), axis=1).tolist()
    for ns, row in zip(trajectory.timestamps_ns.tolist(), rows, strict=True):
        sec, nanosec = divmod(ns, 1_000_000_000)
        time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        position = types["geometry_msgs/msg/Point"](*row[:3])
        orientation = types["geometry_msgs/msg/Quaternion"](*row[3:])
        pose = types["geometry_msgs/msg/Pose"](position=position, orientation=orientation)
        header = types["std_msgs/msg/Header"](stamp=time, frame_id="world")
        message = types[POSE_MESSAGE](header=header, pose=pose)
        poses.append(message)
        writer.write(topic, ns, store.serialize_cdr(message, POSE_MESSAGE))

    # the whole path in one message, for viewers
    if poses:
        whole = types[PATH_MESSAGE](header=poses[0].header, poses=poses)
        topic = writer.add_connection(f"/{name}/path", PATH_MESSAGE, typestore=store)
        writer.write(
            topic, int(trajectory.timestamps_ns[0]), store.serialize_cdr(whole, PATH_MESSAGE)
        )
