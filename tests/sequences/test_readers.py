"""Every layout that is read, against a writer of its published format: poses, cameras, traps, and wrong folders."""

import gzip
import resource
import shutil
import struct
import tarfile
import tempfile
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from helpers.published_folders import WRITERS, image, lines, random_poses, write_seven_scenes
from helpers.sequence_folders import SHARED, make_folder, needs_shared, rewrite

from dynslam_bench.core import STAGES_VARIABLE, DynslamError, SequenceError
from dynslam_bench.core.images import read_image
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.envs import SlamEnv
from dynslam_bench.geometry import Camera, load_tum, read_tum, se3, trajectory_files
from dynslam_bench.sequences import (
    PreprocessingSettings,
    Sequence,
    SequenceView,
    decoded,
    fetch,
    open_sequence,
)
from dynslam_bench.sequences.bags import unpack_bag
from dynslam_bench.sequences.cameras import CAMERAS
from dynslam_bench.sequences.catalogue import catalogue
from dynslam_bench.sequences.decoded import Decoded
from dynslam_bench.sequences.readers import files as reader_files
from dynslam_bench.sequences.readers import recorded
from dynslam_bench.sequences.readers.layouts import LAYOUTS, find_layout, layout_of
from dynslam_bench.testing import CornerSequence, check_sequence

OTHERS = [layout.name for layout in LAYOUTS if layout.name != "tum"]
FOCAL = {
    "eth3d": (726.28741455078, 726.28741455078, 354.6496887207, 186.46566772461),
    "icl-nuim": (481.2, 480.0, 319.5, 239.5),
    "7-scenes": (585.0, 585.0, 320.0, 240.0),
    "tartanair-shibuya": (772.5483399593904, 772.5483399593904, 320.0, 180.0),
    "openloris": (611.0, 612.0, 433.0, 249.0),
    "vslam-lab": (60.5, 61.5, 31.5, 23.5),
    "euroc": (58.6, 57.2, 31.2, 24.3),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder of every layout, with three frames and known poses."""
    root = tmp_path_factory.mktemp("layouts")
    poses = random_poses(0)
    for name, write in WRITERS.items():
        write(root / name, poses)
    return root, poses


def test_every_layout_has_a_writer():
    assert set(WRITERS) == {layout.name for layout in LAYOUTS}
    assert layout_of("tum").name == "tum"
    with pytest.raises(SequenceError, match="unknown layout 'kitti'"):
        layout_of("kitti")


@pytest.mark.parametrize("name", OTHERS)
def test_a_folder_in_the_published_format_is_read(written, name):
    root, poses = written
    sequence = open_sequence(root / name)
    assert find_layout(root / name).name == name
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == FOCAL[name]
    # its first row is sky
    frame = sequence[len(sequence) - 1]
    missing = 1 if name == "tartanair-shibuya" else 0
    assert (frame.depth[missing:] == 2.0).all()
    assert not frame.depth[:missing].any()
    assert (frame.rgb == 90).all()
    assert len(sequence) == (4 if name == "icl-nuim" else 3)
    truth = sequence.ground_truth
    assert np.abs(truth.T_world_cam - poses).max() < 1e-12
    assert np.abs(truth.timestamps - sequence.timestamps[-3:]).max() < 1e-6
    check_sequence(sequence)
    chosen = open_sequence(
        root / name, camera=Camera(camera.width, camera.height, 100.0, 100.0, 10.0, 10.0)
    )
    assert chosen.camera.fx == 100.0
    assert chosen.digest() != sequence.digest()


def test_seven_scenes_to_the_last_bit_with_missing_depth_and_frames_that_kinectfusion_lost(
    tmp_path,
):
    poses = random_poses(3, n=40)
    write_seven_scenes(tmp_path / "seq-01", poses)
    lines(tmp_path / "seq-01" / "frame-000002.pose.txt", ["-1.#IND -1.#IND -1.#IND -1.#IND"] * 4)
    sequence = open_sequence(tmp_path / "seq-01")
    assert np.array_equal(sequence.ground_truth.T_world_cam, np.delete(poses, 2, axis=0))
    assert "1 of 40 poses lost" in sequence.dropped
    assert (sequence[1].depth == 0).all()
    assert (sequence[0].depth == 2.0).all()


def test_frame_0_of_icl_has_no_pose_and_its_view_is_mirrored_back(written):
    """A point that the published camera (fy = -480) sees at a pixel is seen there by ours."""
    sequence = open_sequence(written[0] / "icl-nuim")
    assert "1 frames without ground truth" in sequence.dropped
    pose = sequence.ground_truth.T_world_cam[1]
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    published = mirror @ pose @ mirror
    point = np.array([0.3, 0.4, 2.0, 1.0])
    seen = np.linalg.inv(pose) @ mirror @ published @ point
    pixel = 481.2 * 0.3 / 2 + 319.5, -480.0 * 0.4 / 2 + 239.5
    assert np.allclose(sequence.camera.project(seen[:3]), pixel, atol=1e-9)


BROKEN = {
    "eth3d": [
        ("associated.txt", None, "no depth"),
        ("calibration.txt", "726 726 354", "3 values, not the 4"),
    ],
    "icl-nuim": [
        ("depth/1.png", "x", "cannot be decoded"),
        ("livingRoom0.gt.freiburg", "1 2", "2 values"),
    ],
    "7-scenes": [
        ("frame-000001.pose.txt", None, "cannot read"),
        ("frame-000001.pose.txt", "1 0 0 0 0 1", "6 values, expected the 16"),
        ("frame-000001.pose.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "no rigid"),
        ("frame-000001.depth.png", None, "1 of 3 depth images"),
        ("frame-x.color.png", "", "named by no number"),
    ],
    "tartanair-shibuya": [
        ("times.txt", "0.0", "3 colour images, 3 depth arrays, 1 stamps and 3 poses"),
        ("depth_0/000000.npy", "not an array", "is it an .npy file"),
        ("gt_pose.txt", "1 2 3", "3 values, not the 7"),
    ],
    "openloris": [
        ("sensors.yaml", "a: [", "no valid YAML"),
        ("sensors.yaml", "d400_color_optical_frame: 3", "lacks 'intrinsics'"),
        ("trans_matrix.yaml", "trans_matrix: []", "no rigid transformation from base_link"),
        ("aligned_depth.txt", None, "cannot read"),
        (
            "groundtruth.txt",
            "4711.0 0 0 0 0 0 0 1",
            r"never nearer than 4705\.9.*bias of their own",
        ),
    ],
    "vslam-lab": [
        ("rgb.csv", "ts_rgb_0 (ns),path_rgb_0\n1,a.png", "no column 'ts_depth_0"),
        (
            "rgb.csv",
            "ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0\n1,../a.png,1,depth_0/0.png",
            "does not lie in",
        ),
        ("calibration.yaml", "cameras: []", "describes no camera 'rgb_0'"),
        (
            "groundtruth.csv",
            "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1,2,3,4,5,6,x,8",
            "'x' is not a number",
        ),
    ],
    "euroc": [
        ("mav0/depth0/data.csv", None, "that is no depth"),
        ("mav0/cam0/sensor.yaml", "resolution: [1]", "resolution holds no 2 numbers"),
        (
            "mav0/cam0/data.csv",
            "#timestamp [ns],filename\nx,a.png",
            "'x' is not a stamp in nanoseconds",
        ),
    ],
}


@pytest.mark.parametrize(
    ("name", "file", "content", "words"),
    [(name, *case) for name, cases in BROKEN.items() for case in cases],
)
def test_wrong_or_partial_folders_give_one_clear_line(tmp_path, name, file, content, words):
    WRITERS[name](tmp_path / "s", random_poses(2))
    if content is None:
        (tmp_path / "s" / file).unlink()
    else:
        (tmp_path / "s" / file).write_text(content)
    with pytest.raises(DynslamError, match=words) as caught:
        layout_of(name).read(tmp_path / "s", None)
        sequence = open_sequence(tmp_path / "s")
        [sequence[i] for i in range(len(sequence))]
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "s") in str(caught.value)


def test_every_catalogued_sequence_opens_once_it_lies_where_it_belongs(tmp_path):
    """Nothing is listed that cannot be opened: the reader named reads a folder of the published layout."""
    entries = catalogue()
    root = tmp_path / "root"
    first = {}
    for entry in entries.values():
        made = tmp_path / f"{entry.layout} {entry.camera}"
        camera = CAMERAS.get(entry.camera)
        if not made.exists():
            size = {} if camera is None else {"size": (camera.width, camera.height)}
            WRITERS[entry.layout](made, random_poses(5), **size)
        place = entry.folders(root)[0]
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(made)
        first.setdefault((entry.dataset, entry.layout, entry.camera), entry.id)
    assert len(entries) > 200
    assert len(first) >= 11
    assert {name: entry.find(root) for name, entry in entries.items()} == {
        name: entry.folders(root)[0] for name, entry in entries.items()
    }
    for name in first.values():
        sequence = open_sequence(name, data_root=root)
        assert sequence.id == name
        assert sequence.license
        assert sequence.tags
        assert len(sequence.ground_truth) == 3


def test_a_folder_of_ones_own_with_one_image_more(tmp_path):
    """What lies beside a sequence does not change what it is."""
    WRITERS["tum"](tmp_path / "s", random_poses(2))
    image(tmp_path / "s" / "frame.color.png", 1, (4, 4))
    assert find_layout(tmp_path / "s").name == "tum"


# TUM-layout folders: what is read, and one clear line for everything that is wrong with them.


def test_reads_what_was_written(tmp_path):
    folder, rgb, depth = make_folder(tmp_path / "seq")
    sequence = open_sequence(folder)
    assert isinstance(sequence, Sequence)
    assert sequence.id == "folder/seq"
    assert (sequence.camera.width, sequence.camera.height) == (32, 24)
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, 100.066666667)  # to the nanosecond
    assert frame.rgb.dtype == np.uint8
    assert (frame.rgb == rgb[2]).all()
    assert frame.depth.dtype == np.float32
    assert np.allclose(frame.depth, depth[2] / 5000, rtol=1e-6)
    assert (frame.depth[depth[2] == 0] == 0).all()
    assert len(sequence) == 4
    assert sequence[-1].index == 3
    with pytest.raises(IndexError):
        sequence[4]
    assert np.array_equal(sequence.ground_truth.timestamps, sequence.timestamps)
    assert sequence.fps == 30
    assert sequence.masks is None
    assert (
        sequence.dropped
        == "4 frames of 4 colour and 4 depth images (|dt| < 0.02 s); 4 ground-truth poses"
    )


@pytest.mark.parametrize(("frames", "fps"), [(5, 10), (1, 30)])
def test_fps_follows_from_the_stamps_where_nothing_states_it(tmp_path, frames, fps):
    folder, *_ = make_folder(tmp_path / "seq", frames=frames, rate=10, fps=None)
    sequence = open_sequence(folder)
    assert len(sequence) == frames
    assert sequence.fps == pytest.approx(fps)


@pytest.mark.parametrize(("per_s", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds")])
@pytest.mark.parametrize("fps", [None, 30])
def test_stamps_in_another_unit_are_refused_with_the_unit(tmp_path, per_s, unit, fps):
    folder, *_ = make_folder(tmp_path / "seq", frames=5, rate=1 / (round(per_s / 30)), fps=fps)
    with pytest.raises(SequenceError, match=f"look like {unit}") as caught:
        open_sequence(folder)
    assert f"{round(per_s / 30):g} s apart" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_digest_tells_contents_apart_and_survives_moving_and_links(tmp_path):
    folder, *_ = make_folder(tmp_path / "a", frames=3)
    digests = [open_sequence(folder).digest()]
    moved = folder.rename(tmp_path / "b")
    (moved / "rgb").rename(tmp_path / "elsewhere")
    (moved / "rgb").symlink_to(tmp_path / "elsewhere")
    (moved / "up").symlink_to(moved)
    assert open_sequence(moved).digest() == digests[0]
    digests.append(
        open_sequence(moved, camera=replace(open_sequence(moved).camera, readout_s=0.02)).digest()
    )
    rewrite(moved / "groundtruth.txt", lambda lines: lines[:-1])
    digests.append(open_sequence(moved).digest())
    (tmp_path / "elsewhere" / "0.png").write_bytes((moved / "rgb" / "1.png").read_bytes() + b"\0")
    digests.append(open_sequence(moved).digest())
    assert len(set(digests)) == 4


def test_frames_and_stride(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=7)
    view = open_sequence(folder, frames="1:6", stride=2)
    assert isinstance(view, SequenceView)
    assert isinstance(view, Sequence)
    assert len(view) == 3
    assert [view[i].index for i in range(3)] == [0, 1, 2]
    assert view.fps == open_sequence(folder).fps / 2
    assert (view[1].rgb == rgb[3]).all()
    assert view.dropped.startswith("7 frames")
    assert len(open_sequence(folder, frames=(2, None))) == 5
    wrong = [({"frames": frames}, "no range") for frames in ("3", "a:b", "5:5", "-2:")]
    for part, words in (
        *wrong,
        ({"frames": "7:9"}, "hold none of the 7 frames"),
        ({"stride": 0}, "stride is 0"),
    ):
        with pytest.raises(SequenceError, match=words):
            open_sequence(folder, **part)


def test_ground_truth_hole_and_bad_lines_are_counted(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=30)
    rewrite(
        folder / "groundtruth.txt",
        lambda lines: [*lines[:11], "100.4 nan 0 0 0 0 0 1", *lines[21:]],
    )
    dropped = open_sequence(folder).dropped
    assert "1 of 21 lines skipped: not finite" in dropped
    assert "10 frames without ground truth within 0.02 s (largest hole 0.37 s)" in dropped


def test_pairing_is_strict_one_to_one_and_counted(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=5)
    shifted = [100.019, 100.121, 100.1999, 100.2001, 100.4]  # near, too far, near, spare, equal
    for kind, stamps in (("rgb", [100.0, 100.1, 100.2, 100.3, 100.4]), ("depth", shifted)):
        lines(folder / f"{kind}.txt", [f"{s:.4f} {kind}/{i}.png" for i, s in enumerate(stamps)])
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [100.0, 100.2, 100.4]
    assert "2 colour images without depth; 2 depth images unused" in sequence.dropped


def test_disordered_lists_are_put_in_order_and_counted(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=6)

    def disorder(lines):
        stamp, comma = lines[3].split()[0], lines[2].replace(" ", ",")
        return [
            "# comment",
            lines[1],
            lines[0],
            comma,
            *lines[3:],
            "nan rgb/0.png",
            f"{stamp} rgb/0.png",
            "101.5",
            "",
        ]

    rewrite(folder / "rgb.txt", disorder)
    rewrite(folder / "depth.txt", lambda lines: [line.replace(" ", "\t") + "\r" for line in lines])
    sequence = open_sequence(folder)
    assert (np.diff(sequence.timestamps) > 0).all()
    assert len(sequence) == 6
    assert (sequence[0].rgb == rgb[0]).all()
    # the last of two equal stamps wins, as in TUM's associate.py
    assert (sequence[3].rgb == rgb[0]).all()
    counts = "1 stamps not finite; 1 duplicate stamps; 2 stamps out of order; 1 lines without a file name"
    assert counts in sequence.dropped


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: rewrite(f / "groundtruth.txt", lambda _: ["# nothing"]), "holds no poses"),
        (
            lambda f: (f / "rgb.txt").write_bytes((f / "depth.txt").read_bytes()),
            "has 16 bits a channel, expected 8",
        ),
        (lambda f: (f / "rgb" / "0.png").write_bytes(b"<html>404</html>"), "cannot be decoded"),
        (
            lambda f: (f / "rgb" / "2.png").write_bytes((f / "rgb" / "2.png").read_bytes()[:-20]),
            r"2\.png is truncated \(\d+ bytes\)",
        ),
        (
            lambda f: cv2.imwrite(str(f / "depth" / "0.png"), np.full((24, 32), 77, np.uint8)),
            r"1 channel\(s\) of 8 bits \(values 77 to 77\), expected 1 of 16 bits",
        ),
        (lambda f: rewrite(f / "rgb.txt", lambda _: []), "lists no image"),
        (
            lambda f: rewrite(f / "rgb.txt", lambda _: ["abc rgb/0.png"]),
            "line 1: 'abc' is not a timestamp",
        ),
        (lambda f: (f / "rgb.txt").write_bytes(b"\xff\xfe\x00"), "not a text file"),
        (
            lambda f: rewrite(f / "depth.txt", lambda ls: [f"9{line}" for line in ls]),
            "none of the 4 colour images",
        ),
        (
            lambda f: (f / "rgb" / "1.png").unlink(),
            "1 of 4 colour images .* are missing, the first is rgb/1.png",
        ),
        (
            lambda f: (f / "depth" / "1.png").write_bytes(b""),
            r"1 of 4 depth images .* are empty \(0 bytes\)",
        ),
    ],
)
def test_damaged_folders_give_one_clear_line(tmp_path, damage, words):
    folder, *_ = make_folder(tmp_path / "seq", frames=4)
    damage(folder)
    with pytest.raises(DynslamError, match=words):
        list(map(open_sequence(folder).__getitem__, range(4)))


def test_wrong_sizes(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq")
    with pytest.raises(SequenceError, match="is 32x24, but the camera of folder/seq is 640x480"):
        open_sequence(folder, camera="tum-fr1")
    for i in range(4):
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.full((12, 16), 9000, np.uint16))
    with pytest.raises(SequenceError, match="is 16x12, but its colour image is 32x24"):
        open_sequence(folder)
    frame = open_sequence(folder, preprocessing=PreprocessingSettings(width=32, height=24))[0]
    assert frame.depth.shape == frame.rgb.shape[:2] == (24, 32)


def test_associations_file(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=3)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    lines(
        folder / "associations.txt",
        [f"{100 + i} rgb/{i}.png {107 + i} depth/{i}.png" for i in (2, 0, 1)],
    )
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [100, 101, 102]
    assert "1 stamps out of order" in sequence.dropped
    assert (sequence[0].rgb == rgb[0]).all()
    (folder / "associations.txt").write_text("100 rgb/0.png depth/0.png")
    with pytest.raises(SequenceError, match="has 3 parts, expected 4"):
        open_sequence(folder)


def test_folders_without_lists(tmp_path):
    folder, rgb, _ = make_folder(tmp_path / "seq", frames=3, fps=None)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).unlink()
    with pytest.raises(SequenceError, match="named by a frame number, which has no time"):
        open_sequence(folder)
    rewrite(folder / "camera.toml", lambda lines: [*lines, "fps = 25.0"])
    sequence = open_sequence(folder)
    assert sequence.timestamps.tolist() == [0, 0.04, 0.08]
    assert (sequence[1].rgb == rgb[1]).all()
    for path in folder.glob("*/?.png"):
        path.rename(path.with_name(f"5{path.stem}.5.png"))
    assert open_sequence(folder).timestamps.tolist() == [50.5, 51.5, 52.5]
    shutil.rmtree(folder / "depth")
    with pytest.raises(SequenceError, match=r"neither depth.txt nor a folder depth"):
        open_sequence(folder)


def test_grey_and_alpha_images_become_rgb(tmp_path):
    folder, *_ = make_folder(tmp_path / "seq", frames=2)
    cv2.imwrite(str(folder / "rgb" / "0.png"), np.full((24, 32), 90, np.uint8))
    cv2.imwrite(
        str(folder / "rgb" / "1.png"),
        np.dstack([np.full((24, 32), v, np.uint8) for v in (1, 2, 3, 200)]),
    )
    sequence = open_sequence(folder)
    assert sequence[0].rgb.shape == (24, 32, 3)
    assert (sequence[0].rgb == 90).all()
    assert sequence[1].rgb[0, 0].tolist() == [3, 2, 1]


def test_few_missing_files_are_tolerated_and_counted(tmp_path):
    """Bonn's lists name a few depth images that its archives lack."""
    folder, *_ = make_folder(tmp_path / "seq", frames=60)
    (folder / "depth" / "17.png").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 59
    assert "1 colour images without depth; 1 listed files that do not exist" in sequence.dropped
    (folder / "depth" / "18.png").unlink()
    with pytest.raises(SequenceError, match="2 of 60 depth images"):
        open_sequence(folder)


@needs_shared
def test_bonn_poses_are_the_camera_s_and_positions_stay_those_of_the_file():
    folder = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
    raw = read_tum(folder / "groundtruth.txt")
    truth = open_sequence(folder).ground_truth
    np.testing.assert_array_equal(truth.positions, raw.positions)
    relative = se3.inverse(raw.T_world_cam) @ truth.T_world_cam
    assert np.ptp(relative[:, :3, :3], axis=0).max() < 1e-9, (
        "one fixed rotation between markers and camera"
    )
    assert se3.is_pose(truth.T_world_cam[0], 1e-9)


rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="needs the extra [bags]")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra [bags]")
typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra [bags]")

SIZE = (16, 12)
START = 1_700_000_000
RNG = np.random.default_rng(0)
COLOUR = RNG.integers(0, 256, (3, 12, 16, 3), dtype=np.uint8)
MILLIMETRES = RNG.integers(500, 9000, (3, 12, 16), dtype=np.uint16)
METRES = MILLIMETRES.astype(np.float32) / np.float32(1000)
POSES = random_poses(4)


class Bag:
    """Writes messages of either version of ROS."""

    def __init__(self, path, kind):
        self.one = kind == "ros1"
        self.path = path.with_suffix(".bag") if self.one else path
        self.types = typesys.get_typestore(
            typesys.Stores.ROS1_NOETIC if self.one else typesys.Stores.ROS2_HUMBLE
        )
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        self.writer = (
            rosbag1.Writer(self.path)
            if self.one
            else rosbag2.Writer(path, version=9, storage_plugin=plugin)
        )
        self.connections = {}

    def make(self, name, **fields):
        return self.types.types[name](**fields)

    def add(self, topic, name, i, frame="camera", **fields):
        stamp = self.make("builtin_interfaces/msg/Time", sec=START, nanosec=i * 33_333_333)
        header = self.make(
            "std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": i} if self.one else {})
        )
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        serialize = self.types.serialize_ros1 if self.one else self.types.serialize_cdr
        raw = serialize(self.make(name, header=header, **fields), name)
        self.writer.write(self.connections[topic], 10**18 + i, raw)

    def image(self, topic, i, pixels, encoding, frame="camera", padding=0):
        rows = np.pad(pixels.reshape(len(pixels), -1).view(np.uint8), ((0, 0), (0, padding)))
        fields = {
            "encoding": encoding,
            "is_bigendian": 0,
            "step": rows.shape[1],
            "data": rows.ravel(),
        }
        self.add(topic, "sensor_msgs/msg/Image", i, frame, height=12, width=16, **fields)

    def info(self, topic, model="plumb_bob"):
        k = np.array([300.0, 0, 8, 0, 301.0, 6, 0, 0, 1])
        fields = {
            "d": np.array([0.1, -0.2, 1e-3, 2e-3, 0.3]),
            "k": k,
            "r": np.eye(3).ravel(),
            "p": np.zeros(12),
        }
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        self.add(
            topic, "sensor_msgs/msg/CameraInfo", 0, height=12, width=16, distortion_model=model, binning_x=0,
            binning_y=0, roi=roi, **{(key.upper() if self.one else key): v for key, v in fields.items()},
        )  # fmt: skip

    def pose(self, topic, i, pose):
        (x, y, z), (qx, qy, qz, qw) = (part.tolist() for part in se3.to_quaternion(pose))
        inner = self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        self.add(topic, "geometry_msgs/msg/PoseStamped", i, "map", pose=inner)


@pytest.fixture
def write(tmp_path):
    def made(
        kind,
        *,
        depths=("/cam/aligned/image",),
        metres=False,
        models=("plumb_bob",),
        depth_frame="camera",
    ):
        bag = Bag(tmp_path / f"bag_{kind}", kind)
        images, encoding = (METRES, "32FC1") if metres else (MILLIMETRES, "16UC1")
        with bag.writer:
            for model in models:
                bag.info("/cam/color/camera_info", model)
            for i in range(3):
                bag.image("/cam/color/image_raw", i, COLOUR[i], "rgb8", padding=5)
                for topic in depths:
                    bag.image(topic, i, images[i], encoding, depth_frame)
                bag.pose("/mocap", i, POSES[i])
        return bag.path

    return made


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_a_bag_is_unpacked_to_the_last_bit(write, tmp_path, kind):
    bag = write(kind)
    found = unpack_bag(bag, tmp_path / "out")
    assert (found.colour, found.depth, found.truth) == (
        "/cam/color/image_raw",
        "/cam/aligned/image",
        "/mocap",
    )
    sequence = open_sequence(tmp_path / "out")
    assert len(sequence) == found.frames == 3
    for i in range(3):
        assert (sequence[i].rgb == COLOUR[i]).all()
        assert np.array_equal(sequence[i].depth, METRES[i])
    assert np.allclose(sequence.timestamps, START + np.arange(3) * 0.033333333, atol=1e-6, rtol=0)
    assert np.abs(sequence.ground_truth.T_world_cam - POSES).max() < 1e-12
    assert sequence.camera == Camera(
        16, 12, 300.0, 301.0, 8.0, 6.0, (0.1, -0.2, 1e-3, 2e-3, 0.3), depth_factor=1000.0
    )
    with pytest.raises(
        SequenceError, match=r"is a bag \(unpack it first: dynslam-bench sequences unpack"
    ):
        open_sequence(bag)


def test_a_single_mcap_file_and_depth_in_metres(write, tmp_path):
    (file,) = write("mcap", metres=True, depth_frame="ir").glob("*.mcap")
    found = unpack_bag(file, tmp_path / "out", truth="none")
    assert found.truth == ""
    assert "depth is in the frame 'ir', colour in 'camera'" in found.notes[0]
    sequence = open_sequence(tmp_path / "out")
    assert sequence.ground_truth is None
    assert np.array_equal(sequence[2].depth, METRES[2])


def test_several_topics_are_a_question_and_wrong_bags_give_one_clear_line(write, tmp_path):
    out = tmp_path / "out"
    damaged = tmp_path / "damaged.bag"
    bag = write("ros2", depths=("/cam/aligned/image", "/cam/raw/image"))
    for source, depth, words in (
        (bag, None, r"2 topics of depth images: /cam/aligned/image, /cam/raw/image.*--depth"),
        (bag, "/x", r"no topic '/x' of depth images \(there are: /cam/aligned/image"),
        (write("ros1", models=()), None, "0 topics of calibration"),
        (write("mcap", models=("equidistant",)), None, "distortion 'equidistant', only plumb_bob"),
        (tmp_path / "none.bag", None, "there is no bag"),
        (tmp_path / "bag_mcap" / "metadata.yaml", None, "cannot be read"),
        (damaged, None, "cannot be read"),
    ):
        damaged.write_bytes((tmp_path / "bag_ros1.bag").read_bytes()[:900])
        with pytest.raises(SequenceError, match=words) as caught:
            unpack_bag(source, out, depth=depth)
        assert "\n" not in str(caught.value)
        assert not out.exists()
    assert unpack_bag(bag, out, depth="/cam/raw/image").depth == "/cam/raw/image"
    with pytest.raises(SequenceError, match="exists already"):
        unpack_bag(bag, out, depth="/cam/raw/image")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StageCache:
    monkeypatch.setenv(STAGES_VARIABLE, str(tmp_path / "cache"))
    return StageCache()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_folder(tmp_path / "recording", frames=6)[0]


def files(cache: StageCache) -> list[Path]:
    return sorted(cache.folder.rglob("*.*"))


def same(one: Sequence, other: Sequence) -> bool:
    frames, others = (
        [sequence[index] for index in range(len(sequence))] for sequence in (one, other)
    )
    return all(
        a.timestamp == b.timestamp
        and a.index == b.index
        and (a.rgb == b.rgb).all()
        and (a.depth == b.depth).all()
        for a, b in zip(frames, others, strict=True)
    )


def test_frames_are_the_same_and_decoded_once(
    folder: Path, cache: StageCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = open_sequence(folder)
    reads = Mock(wraps=recorded.read_colour)
    mapped = Decoded(plain)
    monkeypatch.setattr(recorded, "read_colour", reads)
    assert reads.call_count == 0, "making it decodes nothing"
    assert same(mapped, Decoded(open_sequence(folder)))
    decoded_once = reads.call_count
    assert same(mapped, Decoded(open_sequence(folder)))
    assert reads.call_count - decoded_once == 1, "opening decodes the first frame"
    assert same(mapped, plain)
    assert mapped[-1].index == 5
    assert (mapped.id, mapped.digest(), mapped.camera) == (plain.id, plain.digest(), plain.camera)
    assert mapped[0].rgb.dtype == np.uint8
    assert mapped[0].depth.dtype == np.float32
    assert len(files(cache)) == 1
    assert cache.info()["entries_by_stage"] == {"frames": 1}
    with pytest.raises(ValueError, match="read-only"):
        mapped[0].rgb[0] = 0


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-9], lambda _: b"", lambda data: b"x" * len(data)]
)
def test_a_damaged_file_is_written_again(folder: Path, cache: StageCache, damage) -> None:
    Decoded(open_sequence(folder))[0]
    (file,) = files(cache)
    file.write_bytes(damage(file.read_bytes()))
    assert same(Decoded(open_sequence(folder)), open_sequence(folder))


def test_other_frames_are_another_file(folder: Path, cache: StageCache) -> None:
    whole = open_sequence(folder)
    smaller = open_sequence(folder, preprocessing=PreprocessingSettings(width=16, height=16))
    for count, variant in enumerate(
        [whole, SequenceView(whole, 1), SequenceView(whole, 0, None, 2), smaller], 1
    ):
        assert same(Decoded(variant), variant)
        assert len(files(cache)) == count
    cv2.imwrite(str(folder / "rgb" / "3.png"), 255 - whole[3].rgb)
    changed = open_sequence(folder)
    assert same(Decoded(changed), changed)
    assert len(files(cache)) == 5
    assert not same(Decoded(changed), Decoded(whole))


def test_of_several_at_once_one_decodes(
    folder: Path, cache: StageCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = Mock(wraps=decoded._write)
    monkeypatch.setattr(decoded, "_write", written)
    with ThreadPoolExecutor(3) as pool:
        frames = pool.map(lambda sequence: Decoded(sequence)[1], [open_sequence(folder)] * 3)
        assert {frame.index for frame in frames} == {1}
    assert written.call_count == 1
    assert len(files(cache)) == 1


def test_a_full_disk_is_one_line_and_leaves_nothing(folder: Path, cache: StageCache) -> None:
    sequence = open_sequence(folder)
    sequence.digest()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # as if the disk were full
    try:
        with pytest.raises(
            DynslamError, match=r"cannot write the 0 MB of decoded frames .*free some space"
        ) as caught:
            Decoded(sequence)[0]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    assert files(cache) == []
    assert Decoded(sequence)[5].index == 5


def test_more_frames_than_the_cache_holds_are_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StageCache.__init__, "__defaults__", (None, 20_000))
    with pytest.raises(
        SequenceError, match=r"6 decoded frames of .*choose part of the sequence by frames"
    ):
        Decoded(open_sequence(folder))


def test_a_damaged_image_is_named(folder: Path, cache: StageCache) -> None:
    sequence = open_sequence(folder)
    (folder / "depth" / "3.png").write_bytes(b"damaged")
    with pytest.raises(SequenceError, match=r"3\.png"):
        Decoded(sequence)[0]
    assert files(cache) == []


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["emfoa-oft?masks=none", "opencv-odometry"])
def test_an_episode_is_the_same_to_the_bit(tracker: str) -> None:
    sequence = CornerSequence(6)
    episodes = []
    for memory_map in (False, True):
        env = SlamEnv(
            sequence, tracker, observation=["stats", "rgb", "depth", "gray"], memory_map=memory_map
        )
        steps = [env.reset(seed=0)[0]] + [env.step(0)[0] for _ in range(5)]
        episodes.append([value.tobytes() for step in steps for value in step.values()])
        episodes[-1].append(env.online_trajectory().T_world_cam.tobytes())
    assert episodes[0] == episodes[1]


def lying_png(width: int, height: int) -> bytes:
    """A PNG of a few hundred bytes that claims any size, with right checksums."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(99))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_an_image_that_claims_to_be_huge_costs_nothing(tmp_path: Path, kind: str) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    (folder / kind / "2.png").write_bytes(lying_png(40_000, 35_000))
    sequence = open_sequence(folder)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SequenceError, match="is 40000x35000, but"):
        sequence[2]
    with pytest.raises(SequenceError, match=r"claims to be 40000x35000, at most 64 megapixels"):
        read_image(folder / kind / "2.png", kind=SequenceError)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # KB


def test_a_png_whose_chunk_claims_gigabytes_is_refused(tmp_path: Path) -> None:
    header, chunk, rest = lying_png(16, 12).partition(b"IDAT")
    (tmp_path / "1.png").write_bytes(header[:-4] + b"\xff\xff\xff\xff" + chunk + rest)
    with pytest.raises(SequenceError, match="is truncated"):
        read_image(tmp_path / "1.png", kind=SequenceError)


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "rgb/../../secret.png", "a\\..\\b.png"]
)
def test_lists_name_nothing_outside_their_folder(tmp_path: Path, name: str) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((24, 32, 3), np.uint8))
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text() + f"99.0 {name}\n")
    with pytest.raises(SequenceError, match="does not lie in"):
        open_sequence(folder)


def test_a_manifest_that_leads_outside_is_a_fault(tmp_path: Path) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    for content in (f"{'0' * 64}  ../../etc/passwd\n".encode(), b"\xff\xfe"):
        (folder / fetch.MANIFEST).write_bytes(content)
        (fault,) = fetch.verify(str(folder)).faults
        assert "does not lie in" in fault or "is not a text file" in fault


@pytest.mark.parametrize("module", [reader_files, trajectory_files])
def test_millions_of_lines_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: ModuleType
) -> None:
    monkeypatch.setattr(module, "MOST_LINES", 1000)
    (tmp_path / "seq.txt").write_bytes(b"#\n" * 1001)
    with pytest.raises(DynslamError, match="has more than 1000 lines"):
        (reader_files.read_image_list if module is reader_files else load_tum)(tmp_path / "seq.txt")


def refuses(archive: Path, words: str) -> None:
    with tempfile.TemporaryDirectory() as target, pytest.raises(SequenceError, match=words):
        fetch.extract(archive, Path(target))


@pytest.mark.parametrize(
    ("method", "size", "words"),
    [
        (zipfile.ZIP_DEFLATED, 2_000_000, "unpacks to more than"),
        # it takes the memory the file asks for
        (zipfile.ZIP_LZMA, 1, "compressed in a way that is not unpacked here"),
    ],
)
def test_bombs_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: int, size: int, words: str
) -> None:
    monkeypatch.setattr(fetch, "MAX_SLACK", 1_000_000)
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", method) as file:
        file.writestr("zeros", bytes(size))
    refuses(tmp_path / "bomb.zip", words)


def tar_header(name: bytes, size: int, kind: bytes) -> bytes:
    """A tar header of any size, with a right checksum."""
    block = bytearray(tarfile.TarInfo(name.decode()).tobuf(tarfile.GNU_FORMAT)[:512])
    block[124:136] = b"\x80" + size.to_bytes(11, "big")
    block[156:157] = kind
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize(
    "kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK]
)
def test_a_tar_header_that_claims_gigabytes_costs_nothing(tmp_path: Path, kind: bytes) -> None:
    archive = tmp_path / "a.tgz"
    archive.write_bytes(gzip.compress(tar_header(b"x", 3 << 30, kind) + bytes(10 << 20), 1))
    refuses(archive, "a header claims 3221225472 bytes")


def test_a_million_empty_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch, "MAX_MEMBERS", 20)
    tar = tmp_path / "a.tar"
    zipped = tmp_path / "a.zip"
    with tarfile.open(tar, "w") as as_tar, zipfile.ZipFile(zipped, "w") as as_zip:
        for number in range(30):
            as_tar.addfile(tarfile.TarInfo(f"seq/{number}"))
            as_zip.writestr(f"zip/{number}", "")
    for archive in (tar, zipped):
        refuses(archive, "holds more than 20 files, refused")


def test_zeros_after_the_end_of_an_archive_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetch, "MAX_SLACK", 1_000_000)
    empty = tarfile.TarInfo("seq/rgb.txt").tobuf() + bytes(1024)
    (tmp_path / "a.tgz").write_bytes(gzip.compress(empty, 1) + gzip.compress(bytes(4_000_000), 9))
    refuses(tmp_path / "a.tgz", r"unpacks to more than 0\.0 GB")
