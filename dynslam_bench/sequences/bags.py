"""ROS 1 bags, ROS 2 bags and MCAP files unpacked into a folder in TUM layout, which is then a sequence like any other.

Reads with the pure-Python package ``rosbags`` (extra ``[bags]``). Stamps are those of the messages' headers, images and
depth stay as they are to the last bit, and nothing is guessed where several topics would do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError, SequenceError
from dynslam_bench.core.files import atomic_folder
from dynslam_bench.geometry.stamps import parse_ns

from .catalogue import open_folder
from .published.cameras import CAMERA_FILE, write_camera
from .readers import bag_messages as messages

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
NONE = "none"


@dataclass(frozen=True)
class Unpacked:
    """What came of a bag.

    Attributes:
        folder: The sequence's folder.
        colour: Topic of the colour images.
        depth: Topic of the depth images.
        truth: Topic of the ground truth; empty for none.
        frames: Paired frames.
        notes: What a user should know, one line each.
    """

    folder: Path
    colour: str
    depth: str
    truth: str
    frames: int
    notes: tuple[str, ...]


def unpack_bag(
    bag: str | Path,
    folder: str | Path,
    *,
    colour: str | None = None,
    depth: str | None = None,
    truth: str | None = None,
) -> Unpacked:
    """Unpack a bag into a new folder in TUM layout; it appears whole, and only if it opens as a sequence.

    Args:
        bag: A ROS 1 ``.bag``, a ROS 2 folder, an ``.mcap`` or ``.db3`` file.
        folder: The folder to make.
        colour: Topic of the colour images; needed where there are several.
        depth: Topic of depth images that are registered to the colour images; needed where there are several.
        truth: Topic of camera-to-world poses; ``none`` for no ground truth, needed where there are several.

    Raises:
        SequenceError: `rosbags` is not installed, the bag is damaged, a topic is missing or one of several, or the
            folder exists already.
    """
    source, target = Path(bag).expanduser(), Path(folder).expanduser()
    if target.exists():
        raise SequenceError(f"{target} exists already", "name a folder that does not")
    with _opened(source) as reader:
        topics = _Topics(reader, source)
        chosen_colour, chosen_depth = topics.image("colour", colour), topics.image("depth", depth)
        chosen_truth = topics.pose(truth)
        with atomic_folder(target) as work:
            frames = {
                kind: _write_images(reader, topics.connection(topic), work, name)
                for kind, topic, name in (("colour", chosen_colour, "rgb"), ("depth", chosen_depth, "depth"))
            }
            write_camera(work / CAMERA_FILE, topics.camera(chosen_colour))
            if chosen_truth:
                lines = [messages.pose_line(found) for found in _read(reader, topics.connection(chosen_truth))]
                (work / "groundtruth.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
            count = len(open_folder(work))
    notes = []
    if frames["colour"] != frames["depth"]:
        notes.append(
            f"depth is in the frame '{frames['depth']}', colour in '{frames['colour']}': is {chosen_depth} registered?"
        )
    if chosen_truth:
        notes.append(f"the poses of {chosen_truth} are taken for the colour camera's")
    return Unpacked(target, chosen_colour, chosen_depth, chosen_truth, count, tuple(notes))


def read_bag_poses(bag: str | Path, topic: str | None = None) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps in nanoseconds ``[N]`` and rows ``tx ty tz qx qy qz qw`` ``[N, 7]`` of a bag's topic of poses.

    Args:
        bag: A ROS 1 ``.bag``, a ROS 2 folder, an ``.mcap`` or ``.db3`` file.
        topic: Which one; needed where there are several.

    Raises:
        SequenceError: `rosbags` is not installed, the bag is damaged, or the topic is missing or one of several.
    """
    source = Path(bag).expanduser()
    try:
        with _opened(source) as reader:
            topics = _Topics(reader, source)
            chosen = topics.pose(topic, "--topic")
            lines = [messages.pose_line(found) for found in _read(reader, topics.connection(chosen))] if chosen else []
    except OSError as error:  # e.g. a file that its metadata name is missing
        raise SequenceError(f"bag {source} cannot be read: {error.strerror or error}") from error
    table = np.array([line.split() for line in lines], dtype=np.float64).reshape(-1, 8)
    if not np.isfinite(table).all():
        raise SequenceError(f"{source} holds poses that are not finite")
    return np.array([parse_ns(line.split()[0]) for line in lines], dtype=np.int64), table[:, 1:]


class _Topics:
    """The topics of a bag, and which of them to take."""

    def __init__(self, reader: Any, source: Path) -> None:
        self.reader, self.source = reader, source
        self.found: dict[str, list[Any]] = {}
        for connection in reader.connections:
            self.found.setdefault(connection.topic, []).append(connection)

    def connection(self, topic: str) -> list[Any]:
        return self.found[topic]

    def of_types(self, types: Sequence[str]) -> list[str]:
        return sorted(topic for topic, found in self.found.items() if found[0].msgtype in types)

    def image(self, kind: str, wanted: str | None) -> str:
        candidates = self.of_types(IMAGES)
        if wanted is None:
            candidates = [topic for topic in candidates if messages.kind_of(self._first(topic)) == kind]
        return self._one(f"{kind} images", candidates, wanted, f"--{kind}")

    def pose(self, wanted: str | None, option: str = "--truth (or --truth none)") -> str:
        candidates = self.of_types(POSES)
        if wanted == NONE or (wanted is None and not candidates):
            return ""
        return self._one("poses", candidates, wanted, option)

    def camera(self, colour: str) -> Any:
        namespace = colour.rpartition("/")[0]
        infos = self.of_types((INFO,))
        beside = [topic for topic in infos if namespace.startswith(topic.rpartition("/")[0])] or infos
        if len(beside) != 1:
            raise SequenceError(f"{self.source} has {len(beside)} topics of calibration for {colour}, expected 1")
        return messages.camera_of(self._first(beside[0]), f"{beside[0]} of {self.source}")

    def _first(self, topic: str) -> Any:
        for message in _read(self.reader, self.found[topic]):
            return message
        raise SequenceError(f"topic {topic} of {self.source} has no message")

    def _one(self, what: str, candidates: list[str], wanted: str | None, option: str) -> str:
        if wanted is not None and wanted in candidates:
            return wanted
        listed = ", ".join(candidates)[:300] or "none"
        if wanted is not None:
            raise SequenceError(f"{self.source} has no topic '{wanted}' of {what}", f"there are: {listed}")
        if len(candidates) != 1:
            raise SequenceError(
                f"{self.source} has {len(candidates)} topics of {what}: {listed}",
                f"choose one with {option}" if candidates else "is it the right bag?",
            )
        return candidates[0]


def _write_images(reader: Any, connections: list[Any], work: Path, name: str) -> str:
    """Write the images of a topic and their list; the frame that the first one names."""
    (work / name).mkdir()
    rows, frame = [], ""
    for index, message in enumerate(_read(reader, connections)):
        where = f"image {index} of {connections[0].topic}"
        if name == "rgb":
            suffix, data = messages.colour_file(message, where)
            (work / name / f"{index:06d}{suffix}").write_bytes(data)
        else:
            suffix = _write_depth(work / name / f"{index:06d}", messages.depth_array(message, where))
        rows.append(f"{messages.stamp_text(message)} {name}/{index:06d}{suffix}")
        frame = frame or str(message.header.frame_id)
    (work / f"{name}.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return frame


def _write_depth(stem: Path, depth: Any) -> str:
    import cv2

    if depth.dtype == np.float32:
        np.save(stem.with_suffix(".npy"), depth)
        return ".npy"
    stem.with_suffix(".png").write_bytes(cv2.imencode(".png", depth)[1].tobytes())
    return ".png"


def _read(reader: Any, connections: list[Any]) -> Iterator[Any]:
    for connection, _, raw in reader.messages(connections=connections):
        yield reader.deserialize(raw, connection.msgtype)


@contextmanager
def _opened(source: Path) -> Iterator[Any]:
    """The bag's reader; whatever it raises over a damaged bag becomes one line."""
    if not source.exists():
        raise SequenceError(f"there is no bag {source}")
    open_reader = _reader()
    try:
        with open_reader(source) as reader:
            yield reader
    except (DynslamError, OSError):
        raise
    except Exception as error:  # a damaged bag makes its readers raise whatever they like
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise SequenceError(f"bag {source} cannot be read: {reason}") from error


def _reader() -> Callable[[Path], Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise SequenceError("bags are read with rosbags, which is not installed", "pip install rosbags") from error
    return lambda path: AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
