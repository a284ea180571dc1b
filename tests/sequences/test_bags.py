"""Bags of ROS 1 and 2 and MCAP files, written with rosbags: unpacked to the last bit, refused in one line."""

import numpy as np
import pytest
from published_folders import random_poses

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.bags import unpack_bag

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="needs the extra [bags]")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra [bags]")
typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra [bags]")

SIZE, START = (16, 12), 1_700_000_000
RNG = np.random.default_rng(0)
COLOUR = RNG.integers(0, 256, (3, 12, 16, 3), dtype=np.uint8)
MILLIMETRES = RNG.integers(500, 9000, (3, 12, 16), dtype=np.uint16)
POSES = random_poses(4)


class Bag:
    """Writes messages of either version of ROS."""

    def __init__(self, path, kind):
        self.one = kind == "ros1"
        self.path = path.with_suffix(".bag") if self.one else path
        self.types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if self.one else typesys.Stores.ROS2_HUMBLE)
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        self.writer = rosbag1.Writer(self.path) if self.one else rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self.connections = {}

    def make(self, name, **fields):
        return self.types.types[name](**fields)

    def header(self, i, frame):
        stamp = self.make("builtin_interfaces/msg/Time", sec=START, nanosec=i * 33_333_333)
        extra = {"seq": i} if self.one else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def add(self, topic, name, i, message):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        raw = (self.types.serialize_ros1 if self.one else self.types.serialize_cdr)(message, name)
        self.writer.write(self.connections[topic], 10**18 + i, raw)

    def image(self, topic, i, pixels, encoding, frame="camera", padding=0):
        rows = pixels.reshape(pixels.shape[0], -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        message = self.make(
            "sensor_msgs/msg/Image", header=self.header(i, frame), height=12, width=16, encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip
        self.add(topic, "sensor_msgs/msg/Image", i, message)

    def info(self, topic, model="plumb_bob"):
        k = np.array([300.0, 0, 8, 0, 301.0, 6, 0, 0, 1])
        fields = {"d": np.array([0.1, -0.2, 1e-3, 2e-3, 0.3]), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(0, "camera"), height=12, width=16, distortion_model=model,
            binning_x=0, binning_y=0, roi=roi, **{(key.upper() if self.one else key): v for key, v in fields.items()},
        )  # fmt: skip
        self.add(topic, "sensor_msgs/msg/CameraInfo", 0, message)

    def pose(self, topic, i, pose):
        (x, y, z), (qx, qy, qz, qw) = (part.tolist() for part in se3.to_quaternion(pose))
        inner = self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        name = "geometry_msgs/msg/PoseStamped"
        self.add(topic, name, i, self.make(name, header=self.header(i, "map"), pose=inner))


@pytest.fixture
def write(tmp_path):
    def made(kind, *, metres=False, second_depth=False, info="/cam/color/camera_info", depth_frame="camera", **model):
        bag = Bag(tmp_path / f"bag_{kind}", kind)
        with bag.writer:
            if info:
                bag.info(info, **model)
            for i in range(3):
                bag.image("/cam/color/image_raw", i, COLOUR[i], "rgb8", padding=5)
                depth = (MILLIMETRES[i] / np.float32(1000)).astype(np.float32) if metres else MILLIMETRES[i]
                bag.image("/cam/aligned/image", i, depth, "32FC1" if metres else "16UC1", depth_frame)
                if second_depth:
                    bag.image("/cam/raw/image", i, MILLIMETRES[i], "16UC1")
                bag.pose("/mocap", i, POSES[i])
        return bag.path

    return made


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_a_bag_is_unpacked_to_the_last_bit(write, tmp_path, kind):
    bag = write(kind)
    found = unpack_bag(bag, tmp_path / "out")
    assert (found.colour, found.depth, found.truth) == ("/cam/color/image_raw", "/cam/aligned/image", "/mocap")
    sequence = open_sequence(tmp_path / "out")
    assert len(sequence) == found.frames == 3
    for i in range(3):
        assert (sequence[i].rgb == COLOUR[i]).all()
        assert np.array_equal(sequence[i].depth, MILLIMETRES[i].astype(np.float32) / np.float32(1000))
    assert np.allclose(sequence.timestamps, START + np.arange(3) * 0.033333333, atol=1e-6, rtol=0)
    assert np.abs(sequence.ground_truth.T_world_cam - POSES).max() < 1e-12
    camera = sequence.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (16, 12, 300.0, 301.0, 8.0, 6.0)
    assert camera.distortion == (0.1, -0.2, 1e-3, 2e-3, 0.3)
    with pytest.raises(SequenceError, match=r"is a bag \(unpack it first: dynslam-bench sequences unpack"):
        open_sequence(bag)


def test_a_single_mcap_file_and_depth_in_metres(write, tmp_path):
    (file,) = write("mcap", metres=True, depth_frame="ir").glob("*.mcap")
    found = unpack_bag(file, tmp_path / "out", truth="none")
    assert found.truth == "" and "depth is in the frame 'ir', colour in 'camera'" in found.notes[0]
    sequence = open_sequence(tmp_path / "out")
    assert sequence.ground_truth is None
    assert np.array_equal(sequence[2].depth, (MILLIMETRES[2] / np.float32(1000)).astype(np.float32))


def test_several_topics_are_a_question(write, tmp_path):
    bag = write("ros2", second_depth=True)
    with pytest.raises(SequenceError, match=r"2 topics of depth images: /cam/aligned/image, /cam/raw/image.*--depth"):
        unpack_bag(bag, tmp_path / "out")
    with pytest.raises(SequenceError, match=r"no topic '/x' of depth images \(there are: /cam/aligned/image"):
        unpack_bag(bag, tmp_path / "out", depth="/x")
    assert not (tmp_path / "out").exists()
    assert unpack_bag(bag, tmp_path / "out", depth="/cam/raw/image").depth == "/cam/raw/image"
    with pytest.raises(SequenceError, match="exists already"):
        unpack_bag(bag, tmp_path / "out", depth="/cam/raw/image")


def test_wrong_bags_give_one_clear_line(write, tmp_path):
    with pytest.raises(SequenceError, match="0 topics of calibration"):
        unpack_bag(write("ros1", info=""), tmp_path / "out")
    with pytest.raises(SequenceError, match="distortion 'equidistant', only plumb_bob"):
        unpack_bag(write("mcap", model="equidistant"), tmp_path / "out")
    with pytest.raises(SequenceError, match="there is no bag"):
        unpack_bag(tmp_path / "none.bag", tmp_path / "out")
    damaged = tmp_path / "damaged.bag"
    damaged.write_bytes((tmp_path / "bag_ros1.bag").read_bytes()[:900])
    for bag in (damaged, tmp_path / "bag_mcap" / "metadata.yaml"):
        with pytest.raises(SequenceError, match="cannot be read") as caught:
            unpack_bag(bag, tmp_path / "out")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
