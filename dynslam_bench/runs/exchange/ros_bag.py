"""Trajectories as a bag of ROS 2 (an MCAP file), as Foxglove and ``ros2 bag`` read them; bags of others as poses.

Written are ``geometry_msgs/PoseStamped`` on one topic a trajectory and its whole ``nav_msgs/Path`` at its first stamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core.errors import RunError, TrajectoryError
from dynslam_bench.core.files import temporary_folder
from dynslam_bench.core.version import install_hint
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.bags import read_bag_poses
from dynslam_bench.sequences.readers.bodies import camera_truth

POSE, PATH = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"
BAG = "trajectory"
_BILLION = 1_000_000_000


def read_bag_trajectory(path: Path, topic: str | None = None) -> Trajectory:
    """The poses of a ROS 1 or 2 bag or an MCAP file, taken for the camera's.

    Args:
        path: The file, or the folder of a ROS 2 bag.
        topic: Topic of the poses; needed where there are several.

    Raises:
        DynslamError: `rosbags` is missing, the bag is damaged, or the topic is not the only one and was not named.
    """
    stamps, rows = read_bag_poses(path, topic)
    found = camera_truth(stamps, rows, np.eye(4), str(path)) if len(stamps) else None
    if found is None:
        raise TrajectoryError(f"{path} holds no pose", "name its topic with --topic")
    return found


def write_bag(folder: Path, trajectories: Mapping[str, Trajectory], frame_id: str = "world") -> None:
    """Write trajectories, each on the topics ``/NAME/pose`` and ``/NAME/path``.

    Args:
        folder: Where, it exists: it becomes a bag of ROS 2, ``trajectory.mcap`` with its ``metadata.yaml``.
        trajectories: Camera-to-world poses by name.
        frame_id: Name of the world's frame.

    Raises:
        DynslamError: `rosbags` is not installed, or the file cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RunError("MCAP is written with rosbags, which is not installed", install_hint("bags")) from error
    store = get_typestore(Stores.LATEST)
    with temporary_folder(folder / BAG) as work:
        bag = work / BAG
        try:
            with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                for name, trajectory in trajectories.items():
                    _write(writer, store, name, trajectory, frame_id)
            for file in bag.iterdir():
                file.replace(folder / file.name)
        except OSError as error:
            raise RunError(f"cannot write {folder}: {error.strerror}", "check the free space") from error


def _write(writer: Any, store: Any, name: str, trajectory: Trajectory, frame_id: str) -> None:
    poses = _messages(store.types, trajectory, frame_id)
    topic = writer.add_connection(f"/{name}/pose", POSE, typestore=store)
    for pose in poses:
        writer.write(topic, _at(pose), store.serialize_cdr(pose, POSE))
    if poses:
        whole = store.types[PATH](header=poses[0].header, poses=poses)
        topic = writer.add_connection(f"/{name}/path", PATH, typestore=store)
        writer.write(topic, _at(poses[0]), store.serialize_cdr(whole, PATH))


def _at(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * _BILLION + stamp.nanosec)


def _messages(types: Mapping[str, Any], trajectory: Trajectory, frame_id: str) -> list[Any]:
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    made = []
    for ns, p, q in zip(trajectory.timestamps_ns.tolist(), position.tolist(), quaternion.tolist(), strict=True):
        sec, nanosec = divmod(ns, _BILLION)
        time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        header = types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
        where = types["geometry_msgs/msg/Point"](*p)
        turned = types["geometry_msgs/msg/Quaternion"](*q)
        pose = types["geometry_msgs/msg/Pose"](position=where, orientation=turned)
        made.append(types[POSE](header=header, pose=pose))
    return made
