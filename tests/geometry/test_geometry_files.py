"""TUM and KITTI trajectory files: round trips, what is skipped and counted, and one-line errors."""

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import (
    FileNotes,
    format_tum,
    load_tum,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)

RIGID = "1 0 0 0 0 1 0 0 0 0 1 0\n"
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def random_trajectory(n=50, seed=0, start=1305031102.175304):
    rng = np.random.default_rng(seed)
    return Trajectory(np.round(start + np.cumsum(rng.uniform(0.01, 0.05, n)), 6), se3.exp(rng.normal(0, 1, (n, 6))))


def write(tmp_path, text, name="trajectory.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_tum_round_trip(tmp_path):
    original = random_trajectory()
    write_tum(tmp_path / "a.txt", original, comment="first\nsecond")
    again = read_tum(tmp_path / "a.txt")
    assert np.array_equal(again.timestamps, original.timestamps)
    assert np.allclose(again.T_world_cam, original.T_world_cam, atol=5e-9)
    lines = (tmp_path / "a.txt").read_text().splitlines()
    assert lines[:3] == ["# first", "# second", "# timestamp tx ty tz qx qy qz qw"]
    assert lines[3].split()[0] == f"{original.timestamps[0]:.6f}000"
    assert not load_tum(tmp_path / "a.txt").notes.describe()


def test_tum_quaternion_order_is_xyzw(tmp_path):
    pose = read_tum(write(tmp_path, "1.0 0.1 0.2 0.3 0 0 0.7071067811865476 0.7071067811865476\n")).T_world_cam[0]
    assert np.allclose(pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(pose[:3, 3], [0.1, 0.2, 0.3])


def test_tum_skips_and_counts_like_the_official_tools(tmp_path):
    path = write(
        tmp_path,
        "# comment\n\n"
        "3.0 3 0 0 0 0 0 1\n"
        "1.0,1,0,0,0,0,0,1\r\n"  # commas, Windows line end, out of order
        "2.0\t2 0 0 0 0 0 2\n"  # tab, quaternion of norm 2
        "2.5 nan 0 0 0 0 0 1\n"
        "nan 0 0 0 0 0 0 1\n"
        "2.6 inf 0 0 0 0 0 1\n"
        "2.7 0 0 0 0 0 0 0\n"
        "3.0 9 0 0 0 0 0 1 # the later line with this stamp holds\n",
    )
    file = load_tum(path)
    assert file.trajectory.timestamps.tolist() == [1.0, 2.0, 3.0]
    assert file.trajectory.positions[:, 0].tolist() == [1.0, 2.0, 9.0]
    assert np.allclose(file.trajectory.T_world_cam[1, :3, :3], np.eye(3))
    counts = {"lines": 8, "not_finite": 3, "zero_quaternions": 1, "duplicates": 1, "out_of_order": 1, "renormalised": 1}
    assert file.notes == FileNotes(**counts, back_s=2.0) and len(file.notes.describe()) == 5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "holds no poses"),
        ("# only\n# comments\n", "holds no poses"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0\n", "line 2 has 4 values"),
        ("# c\n1 0 0 x 0 0 0 1\n", "line 2: 'x' is not a number"),
        ("1 0 0 0 0 0 0 0 0 0 0 1\n", "KITTI"),
        ("1305031102.175304 rgb/1305031102.175304.png\n", "list of images"),
        ("1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", "no valid pose .1 of 2 lines skipped: not finite; 1 of 2"),
    ],
)
def test_tum_bad_files_are_one_clear_line(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(TrajectoryError, match=expected) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tum_missing_folder_and_binary_files(tmp_path):
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    for name, named in (("missing.txt", "No such file"), ("", "directory"), ("image.png", "not a text file")):
        with pytest.raises(TrajectoryError, match=named):
            read_tum(tmp_path / name)


def test_stamps_that_no_file_tells_apart_make_no_trajectory():
    poses = np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(
        TrajectoryError, match=r"not strictly increasing in nanoseconds: 1\.000000000 then 1\.000000000"
    ):
        Trajectory(np.array([1.0, 1.0 + 4e-10]), poses)
    assert Trajectory(np.array([1.0, 1.0 + 2e-9]), poses).timestamps_ns.tolist() == [1_000_000_000, 1_000_000_002]


def test_empty_trajectory_formats_to_its_header():
    assert format_tum(Trajectory(np.zeros(0), np.zeros((0, 4, 4)))) == "# timestamp tx ty tz qx qy qz qw\n"


def test_kitti_round_trip_and_evo(tmp_path):
    original = random_trajectory(seed=5, start=0.0)
    write_kitti(tmp_path / "poses.txt", original, tmp_path / "times.txt")
    again = read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")
    assert np.array_equal(again.timestamps, original.timestamps)
    assert np.allclose(again.T_world_cam, original.T_world_cam, atol=1e-8)
    evo = pytest.importorskip("evo.tools.file_interface").read_kitti_poses_file(str(tmp_path / "poses.txt"))
    assert np.allclose(np.array(evo.poses_se3), again.T_world_cam, atol=1e-8)


@pytest.mark.parametrize(
    ("poses", "named"),
    [
        (RIGID + "2 0 0 0 0 1 0 0 0 0 1 0\n", "pose 1 of 2"),
        ("1 0 0 0 0 0 0 1\n", "line 1 has 8 values"),
        (RIGID * 2, "2 poses but .* has 1 stamps"),
    ],
)
def test_kitti_bad_files(tmp_path, poses, named):
    with pytest.raises(TrajectoryError, match=named):
        read_kitti(write(tmp_path, poses), write(tmp_path, "0.0\n", "times.txt"))


@pytest.mark.parametrize("path", sorted(SHARED.glob("*/*/groundtruth.txt")), ids=lambda path: path.parent.name)
def test_real_ground_truth_reads_whole(path):
    file = load_tum(path)
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    assert len(file.trajectory) + file.notes.duplicates == len(lines) == file.notes.lines
    assert file.notes.renormalised == 0
    assert file.trajectory.path_length_m > 0.1 or path.parent.parent.name == "fixed_camera"
