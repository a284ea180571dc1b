"""ROS 1 bags, ROS 2 bags and MCAP files unpacked into a folder in TUM layout, which is then a sequence like any other.

Reads with the pure-Python package ``rosbags`` (extra ``[bags]``). Stamps are those of the messages'
headers, images and depth stay as they are to the last bit, and nothing is guessed where several
topics would do.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import SequenceError, atomic_folder, translate_errors, write_lines
from dynslam_bench.geometry import Camera, parse_ns
from dynslam_bench.sequences.cameras import CAMERA_FILE, write_camera
from dynslam_bench.sequences.catalogue import open_folder

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of image messages."""
INFO = "sensor_msgs/msg/CameraInfo"
"""Type of a camera's calibration."""
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
"""Types of messages that hold a stamped pose."""


@dataclass(frozen=True)
class Unpacked:
    """The result of unpacking a bag.

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
        depth: Topic of depth images that are registered to the colour images; needed where there
            are several.
        truth: Topic of camera-to-world poses; ``none`` for no ground truth, needed where there are
            several.

    Raises:
        SequenceError: `rosbags` is not installed, the bag is damaged, a topic is missing or one of
            several, or the folder exists already.
    """
    source = Path(bag).expanduser()
    target = Path(folder).expanduser()
    if target.exists():
        raise SequenceError(f"{target} exists already", "name a folder that does not")
    with _opened(source) as reader:
        # which topics to take
        topics = _Topics(reader, source)
        chosen_colour = topics.image("colour", colour)
        chosen_depth = topics.image("depth", depth)
        chosen_truth = topics.pose(truth)

        # write images, camera and truth; the frames of reference that the images name show whether they
        # are registered
        with atomic_folder(target) as work:
            colour_frame = _write_images(reader, topics.connections[chosen_colour], work, "rgb")
            depth_frame = _write_images(reader, topics.connections[chosen_depth], work, "depth")
            write_camera(work / CAMERA_FILE, topics.camera(chosen_colour))
            if chosen_truth:
                poses = _read(reader, topics.connections[chosen_truth])
                write_lines(work / "groundtruth.txt", map(pose_line, poses))
            # only what opens as a sequence is kept
            count = len(open_folder(work))

    # what a user should know
    notes = []
    if colour_frame != depth_frame:
        notes.append(
            f"depth is in the frame '{depth_frame}', colour in '{colour_frame}': is {chosen_depth} registered?"
        )
    if chosen_truth:
        notes.append(f"the poses of {chosen_truth} are taken for the colour camera's")
    return Unpacked(target, chosen_colour, chosen_depth, chosen_truth, count, tuple(notes))


def read_bag_poses(
    bag: str | Path, topic: str | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps in nanoseconds ``[N]`` and rows ``tx ty tz qx qy qz qw`` ``[N, 7]`` of a bag's topic of poses.

    Args:
        bag: A ROS 1 ``.bag``, a ROS 2 folder, an ``.mcap`` or ``.db3`` file.
        topic: Which one; needed where there are several.

    Raises:
        SequenceError: `rosbags` is not installed, the bag is damaged, or the topic is missing or
            one of several.
    """
    source = Path(bag).expanduser()
    with _opened(source) as reader:
        topics = _Topics(reader, source)
        chosen = topics.pose(topic, "--topic")
        lines = []
        if chosen:
            messages = _read(reader, topics.connections[chosen])
            lines = [pose_line(message).split() for message in messages]
    table = np.array(lines, dtype=np.float64).reshape(-1, 8)
    if not np.isfinite(table).all():
        raise SequenceError(f"{source} holds poses that are not finite")
    # stamps are parsed from their text: floating point does not hold nanoseconds
    stamps_ns = np.array([parse_ns(line[0]) for line in lines], dtype=np.int64)
    return stamps_ns, table[:, 1:]


class _Topics:
    """The topics of a bag, and which of them to take.

    Args:
        reader: The opened bag.
        source: Its path, for messages.

    Attributes:
        connections: The connections of each topic, by its name.
    """

    def __init__(self, reader: Any, source: Path) -> None:
        self.reader = reader
        self.source = source
        self.connections: dict[str, list[Any]] = {
            name: topic.connections for name, topic in reader.topics.items()
        }

    def of_types(self, types: Sequence[str]) -> list[str]:
        """Names of all topics whose messages are of one of these types."""
        return sorted(
            topic
            for topic, connections in self.connections.items()
            if connections[0].msgtype in types
        )

    def image(self, kind: str, wanted: str | None) -> str:
        """The topic of ``colour`` or ``depth`` images: the wanted one, else the only one."""
        candidates = self.of_types(IMAGES)
        if wanted is None:
            candidates = [topic for topic in candidates if kind_of(self._first(topic)) == kind]
        return self._one(f"{kind} images", candidates, wanted, f"--{kind}")

    def pose(self, wanted: str | None, option: str = "--truth (or --truth none)") -> str:
        """The topic of poses: the wanted one, else the only one; empty for none."""
        candidates = self.of_types(POSES)
        if wanted == "none" or (wanted is None and not candidates):
            return ""
        return self._one("poses", candidates, wanted, option)

    def camera(self, colour: str) -> Camera:
        """The calibration beside the colour images' topic, else the only one."""
        # calibrations whose namespace the topic of the images begins with
        namespace = colour.rpartition("/")[0]
        infos = self.of_types((INFO,))
        beside = [topic for topic in infos if namespace.startswith(topic.rpartition("/")[0])]
        beside = beside or infos
        if len(beside) != 1:
            raise SequenceError(
                f"{self.source} has {len(beside)} topics of calibration for {colour}, expected 1"
            )
        return camera_of(self._first(beside[0]), f"{beside[0]} of {self.source}")

    def _first(self, topic: str) -> Any:
        """The first message of a topic."""
        for message in _read(self.reader, self.connections[topic]):
            return message
        raise SequenceError(f"topic {topic} of {self.source} has no message")

    def _one(self, what: str, candidates: list[str], wanted: str | None, option: str) -> str:
        """The wanted topic, else the only candidate; where there are several, `option` chooses one."""
        listed = ", ".join(candidates)[:300] or "none"
        if wanted is not None and wanted not in candidates:
            raise SequenceError(
                f"{self.source} has no topic '{wanted}' of {what}", f"there are: {listed}"
            )
        if wanted is None and len(candidates) != 1:
            hint = f"choose one with {option}" if candidates else "is it the right bag?"
            raise SequenceError(
                f"{self.source} has {len(candidates)} topics of {what}: {listed}", hint
            )
        return wanted or candidates[0]


def _write_images(reader: Any, connections: list[Any], work: Path, name: str) -> str:
    """Write the images of a topic and their list; the frame that the first one names."""
    (work / name).mkdir()
    rows = []
    frame = ""
    encode = colour_file if name == "rgb" else depth_file
    for index, message in enumerate(_read(reader, connections)):
        suffix, data = encode(message, f"image {index} of {connections[0].topic}")
        (work / name / f"{index:06d}{suffix}").write_bytes(data)
        rows.append(f"{stamp_text(message)} {name}/{index:06d}{suffix}")
        frame = frame or str(message.header.frame_id)
    write_lines(work / f"{name}.txt", rows)
    return frame


def _read(reader: Any, connections: list[Any]) -> Iterator[Any]:
    """The messages of a topic's connections, in the bag's order."""
    for connection, _, raw in reader.messages(connections=connections):
        yield reader.deserialize(raw, connection.msgtype)


@contextmanager
def _opened(source: Path) -> Iterator[Any]:
    """The bag's reader; whatever it raises over a damaged bag becomes one line."""
    if not source.exists():
        raise SequenceError(f"there is no bag {source}")
    with translate_errors(
        SequenceError,
        "bags are read with rosbags, which is not installed",
        "pip install rosbags",
        of=ImportError,
    ):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    # a damaged bag makes its readers raise whatever they like
    with (
        translate_errors(SequenceError, f"bag {source} cannot be read", of=Exception),
        AnyReader([source], default_typestore=get_typestore(Stores.LATEST)) as reader,
    ):
        yield reader


# Messages of ROS as images, stamps, poses and cameras; ROS 1 and 2 name a few fields otherwise.

COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "mono8": (1, None),
    "8UC3": (3, None),
    "8UC1": (1, None),
}
"""Channels of each encoding, and OpenCV's conversion to blue, green, red."""
DEPTHS: dict[str, np.dtype[Any]] = {
    "16UC1": np.dtype(np.uint16),
    "mono16": np.dtype(np.uint16),
    "32FC1": np.dtype(np.float32),
}
"""Type of the numbers of each encoding of depth."""
MILLIMETRES = 1000.0
"""Units a metre of a 16-bit depth image, as REP 118 of ROS has it; one of floating-point numbers is in metres."""


def stamp_text(message: Any) -> str:
    """The header's stamp in seconds, to the nanosecond."""
    stamp = message.header.stamp
    return f"{int(stamp.sec)}.{int(stamp.nanosec):09d}"


def kind_of(message: Any) -> str:
    """``colour``, ``depth`` or empty, of an image message, compressed or not."""
    if hasattr(message, "encoding"):
        if message.encoding in DEPTHS:
            return "depth"
        return "colour" if message.encoding in COLOURS else ""
    return "" if "compressedDepth" in message.format else "colour"


def colour_file(message: Any, where: str) -> tuple[str, bytes]:
    """Suffix and content of a file that holds the colour image: as it came where it is compressed, else a PNG.

    Raises:
        SequenceError: It is no such image.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        return (".png" if data.startswith(b"\x89PNG") else ".jpg"), data
    if message.encoding not in COLOURS:
        raise SequenceError(
            f"{where} is of '{message.encoding}', expected one of {', '.join(COLOURS)}"
        )
    # pixels in OpenCV's order, as a PNG
    channels, code = COLOURS[message.encoding]
    pixels = _pixels(message, np.dtype(np.uint8), channels, where)
    if code is not None:
        pixels = cv2.cvtColor(pixels, code)
    return ".png", cv2.imencode(".png", pixels)[1].tobytes()


def depth_file(message: Any, where: str) -> tuple[str, bytes]:
    """Suffix and content of a file that holds the depth image: a PNG of millimetres or an array of float32 metres.

    Raises:
        SequenceError: It is no such image.
    """
    kind = DEPTHS.get(getattr(message, "encoding", ""))
    if kind is None:
        raise SequenceError(
            f"{where} holds no depth image of {', '.join(DEPTHS)}",
            "choose another topic with --depth",
        )
    depth = _pixels(message, kind, 1, where)
    if kind == np.uint16:
        return ".png", cv2.imencode(".png", depth)[1].tobytes()
    buffer = BytesIO()
    np.save(buffer, depth)
    return ".npy", buffer.getvalue()


def _pixels(message: Any, kind: np.dtype[Any], channels: int, where: str) -> NDArray[Any]:
    """The pixels ``[H, W]`` or ``[H, W, channels]`` of an uncompressed image in the machine's byte order."""
    # as many bytes as the size says, or more a row
    height = int(message.height)
    width = int(message.width)
    step = int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    used = width * channels * kind.itemsize
    if min(height, width) < 1 or len(data) != height * step or step < used:
        raise SequenceError(
            f"{where} is {width}x{height} of {message.encoding} in {len(data)} bytes, {step} a row"
        )

    # rows without their padding, in the machine's byte order
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :used])
    values = rows.view(kind.newbyteorder(">" if message.is_bigendian else "<")).astype(kind)
    return values.reshape(height, width, channels) if channels > 1 else values


def camera_of(message: Any, where: str) -> Camera:
    """The camera of a ``CameraInfo``.

    Raises:
        SequenceError: Its distortion is not the radial-tangential one of five coefficients, or it
            is none.
    """
    # K, row by row, and the distortion k1, k2, p1, p2, k3
    k = _coefficients(message, "k")
    d = _coefficients(message, "d")
    valid = len(k) == 9 and np.isfinite(k).all()
    if not valid or min(k[0], k[4], message.width, message.height) <= 0:
        raise SequenceError(
            f"{where} holds no calibration (K = {k.tolist()})", "the camera was not calibrated"
        )
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial") or d[5:].any():
        raise SequenceError(
            f"{where} has the distortion '{message.distortion_model}', only plumb_bob is read"
        )
    distortion = [*d[:5].tolist(), *[0.0] * 5][:5]
    size = int(message.width), int(message.height)
    return Camera(*size, k[0], k[4], k[2], k[5], tuple(distortion), MILLIMETRES)


def _coefficients(message: Any, name: str) -> NDArray[np.float64]:
    """A field of a ``CameraInfo``; ROS 1 writes its name in capitals."""
    values = getattr(message, name, getattr(message, name.upper(), ()))
    return np.asarray(values, float).ravel()


def pose_line(message: Any) -> str:
    """A line ``timestamp tx ty tz qx qy qz qw`` of a stamped pose, transformation or odometry."""
    outer = getattr(message, "pose", None) or message.transform
    # one with covariance holds the pose inside
    inner = getattr(outer, "pose", outer)
    position = getattr(inner, "position", None) or inner.translation
    rotation = getattr(inner, "orientation", None) or inner.rotation
    values = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    return " ".join([stamp_text(message), *[repr(float(value)) for value in values]])
