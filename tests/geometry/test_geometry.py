"""SE(3), camera, trajectories, stamps and files: random values, and agreement with SciPy, OpenCV and evo."""

import itertools
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.linalg
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from dynslam_bench.core.errors import TrajectoryError
from dynslam_bench.geometry import (
    Camera,
    FileNotes,
    Trajectory,
    associate,
    format_tum,
    load_tum,
    nearest_gap,
    read_kitti,
    read_tum,
    se3,
    stamps,
    write_kitti,
    write_tum,
)
from dynslam_bench.geometry.gauss_newton import apply_twist, twist_of

FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
BONN = Camera(
    640,
    480,
    542.822841,
    542.57687,
    315.59352,
    237.756098,
    (0.039903, -0.099343, -0.00073, -0.000144, 0.0),
)
PINHOLE = Camera(640, 480, 535.4, 539.2, 320.1, 247.6)


def twists(angle, n=50, seed=0):
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(n, 3))
    phi *= angle / np.linalg.norm(phi, axis=1, keepdims=True)
    return np.concatenate([rng.normal(0, 2, (n, 3)), phi], axis=1)


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-8, 9e-6, 1.1e-5, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-6]
)
def test_exp_and_log_are_inverse(angle):
    xi = twists(angle)
    poses = se3.exp(xi)
    assert all(se3.is_pose(pose, 1e-12) for pose in poses)
    assert np.allclose(se3.log(poses), xi, atol=1e-9 if angle < 3.1 else 1e-6)
    assert np.allclose(se3.rotation_angle(poses), angle, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 3.0])
def test_exp_is_the_matrix_exponential(angle):
    xi = twists(angle, 5)
    generators = se3.from_matrix(xi[:, :3], se3.hat(xi[:, 3:])) - np.diag([0, 0, 0, 1])
    assert np.allclose(se3.exp(xi), scipy.linalg.expm(generators), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-6, 1.1e-5, 0.3, 2.0])
def test_compiled_twists_are_those_of_numpy(angle):
    start = se3.exp(twists(1.0, 1, seed=1))[0]
    for twist in twists(angle, 5):
        assert np.allclose(twist_of(se3.exp(twist)), twist, atol=1e-9)
        assert np.allclose(apply_twist(start, twist), se3.exp(twist) @ start, atol=1e-9)


def test_inverse_transform_and_hat():
    poses = se3.exp(twists(1.0))
    assert np.allclose(se3.inverse(poses) @ poses, np.eye(4), atol=1e-12)
    points = np.random.default_rng(1).normal(size=(7, 3))
    assert np.allclose(
        se3.transform(poses[0], points), [(poses[0] @ np.append(p, 1))[:3] for p in points]
    )
    a = points[:3]
    b = points[3:6]
    assert np.allclose((se3.hat(a) @ b[..., None])[..., 0], np.cross(a, b))


def test_batches_of_any_shape():
    xi = twists(0.7, 12).reshape(3, 4, 6)
    poses = se3.exp(xi)
    assert poses.shape == (3, 4, 4, 4)
    assert np.allclose(se3.log(poses), xi)
    assert np.allclose(se3.from_quaternion(*se3.to_quaternion(poses)), poses)
    assert np.allclose(se3.rotation_angle(poses), 0.7)


def test_quaternions_are_normalised_and_canonical():
    lengths = np.array([[1.0], [-7], [1e-300], [1e200], [1e308]])  # a file may hold any number
    poses = se3.from_quaternion(np.zeros((5, 3)), lengths * [0.1, -0.2, 0.3, -0.4])
    assert np.allclose(poses, poses[0])
    _, again = se3.to_quaternion(poses)
    assert np.allclose(np.linalg.norm(again, axis=1), 1)
    assert (again[:, 3] > 0).all()


def test_rotations_of_quaternions_have_the_bits_of_scipy():
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(10, 100, 4)) * np.logspace(-6, 6, 100)[:, None]
    quaternions[0] = np.round(rng.normal(size=(100, 4)), 4)  # as a file may hold them
    rotations = se3.from_quaternion(np.zeros(3), quaternions)[..., :3, :3]
    expected = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix()
    assert np.array_equal(rotations.reshape(-1, 3, 3), expected)


def test_a_quaternion_of_length_zero_is_refused():
    with pytest.raises(ValueError, match="length 0"):
        se3.from_quaternion(np.zeros((2, 3)), np.eye(4)[:2] * [[1.0], [0.0]])


@pytest.mark.parametrize(
    "pose",
    [
        None,
        "pose",
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.eye(4, dtype=int),
    ],
    ids=["none", "text", "3x3", "nan", "mirror", "scaled", "homogeneous", "integers"],
)
def test_what_is_no_pose(pose):
    assert not se3.is_pose(pose)
    assert se3.is_pose(np.eye(4))


# -- camera


def pixel_grid(camera, border=0.0):
    u, v = np.meshgrid(
        np.linspace(border, camera.width - border, 25),
        np.linspace(border, camera.height - border, 19),
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("camera", [FR1, BONN, PINHOLE], ids=["fr1", "bonn", "pinhole"])
def test_undistort_and_distort_are_inverse(camera):
    distorted = pixel_grid(camera)
    undistorted = camera.undistort_points(distorted)
    assert np.abs(camera.distort_points(undistorted) - distorted).max() < 1e-4
    assert (np.abs(undistorted - distorted).max() > 1) == camera.is_distorted


@pytest.mark.parametrize("camera", [FR1, BONN], ids=["fr1", "bonn"])
def test_distortion_is_opencvs(camera):
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (100, 3))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    assert np.allclose(camera.distort_points(camera.project(points)), expected[:, 0], atol=1e-9)


def test_project_and_unproject_are_inverse():
    pixels = pixel_grid(PINHOLE)
    depth = np.random.default_rng(0).uniform(0.3, 8, len(pixels))
    points = PINHOLE.unproject(pixels, depth)
    assert np.allclose(points[:, 2], depth)
    assert np.allclose(PINHOLE.project(points), pixels)


@pytest.mark.parametrize(
    ("width", "height"), list(itertools.product((320, 640, 1280), (240, 480, 300)))
)
def test_resizing_scales_the_intrinsics_with_the_pixels(width, height):
    small = PINHOLE.resized(width, height)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    assert np.allclose(
        small.project(points), (PINHOLE.project(points) + 0.5) * (width / 640, height / 480) - 0.5
    )
    assert (small.width, small.height) == (width, height)
    back = small.resized(640, 480)
    assert np.allclose(
        [back.fx, back.fy, back.cx, back.cy], [PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy]
    )


def test_distortion_does_not_depend_on_the_resolution():
    small = FR1.resized(320, 240)
    pixels = pixel_grid(FR1, border=20)
    half = (pixels + 0.5) / 2 - 0.5
    assert np.allclose(
        small.distort_points(half), (FR1.distort_points(pixels) + 0.5) / 2 - 0.5, atol=1e-9
    )
    assert not FR1.undistorted().is_distorted
    assert np.array_equal(FR1.undistorted().matrix, FR1.matrix)


# -- trajectory


@pytest.mark.parametrize(
    ("stamps", "exact", "broken", "named"),
    [
        ([0.0, 1.0], None, 0.0, "2 stamps but 3 poses"),
        ([0.0, 1.0, 1.0], None, 0.0, r"not strictly increasing: 1\.0+ then 1\.0+"),
        (
            [0.0, 1.0, 1.0 + 4e-10],
            None,
            0.0,
            r"increasing in nanoseconds: 1\.000000000 then 1\.000000000",
        ),
        ([0.0, 1.0, np.nan], None, 0.0, "not finite"),
        ([0.0, 1.0, 2.0], None, np.inf, "not finite"),
        ([0.0, 1.0, 2.0], [10**9], 0.0, "3 stamps but 1 in ns"),
    ],
)
def test_trajectory_refuses_what_is_none(stamps, exact, broken, named):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = broken
    with pytest.raises(TrajectoryError, match=named):
        Trajectory(np.array(stamps), poses, exact)


def test_trajectory_views():
    trajectory = Trajectory(np.arange(5.0), se3.exp(twists(0.4, 5)))
    assert trajectory.select(trajectory.timestamps > 2).timestamps.tolist() == [3.0, 4.0]
    way = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(trajectory.positions))
    assert trajectory.path_length_m == pytest.approx(way)
    assert len(trajectory.select(slice(1, 4))) == 3
    assert trajectory.select(slice(0, 0)).path_length_m == 0


# Stamps: decimal text, nanoseconds and floats are one another's, exactly.

EUROC = 1403636579763555584
"""The first stamp of EuRoC's V1_01, in nanoseconds."""
POSE = "0 0 0 0 0 0 1"


def write(tmp_path, text, name="trajectory.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def poses_at(rows):
    """Lines of a pose each at stamps in nanoseconds."""
    return "".join(f"{stamps.format_ns(ns)} {POSE}\n" for ns in rows)


def test_text_and_nanoseconds_are_one_anothers() -> None:
    for ns in [
        0,
        1,
        -1,
        EUROC,
        2**63 - 1,
        *np.random.default_rng(0).integers(-(2**62), 2**62, 2000).tolist(),
    ]:
        text = stamps.format_ns(ns)
        assert stamps.parse_ns(text) == ns == int(Decimal(text).scaleb(9))


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("12", 12_000_000_000),
        ("12.", 12_000_000_000),
        (".5", 500_000_000),
        ("+1.5", 1_500_000_000),
        ("-0.000000001", -1),
        ("1.305031102175304055e+09", 1305031102175304055),  # as evo writes it
        ("0.0333333333333333", 33_333_333),
        ("1e-30", 0),
    ],
)
def test_further_ways_to_write_a_stamp(text: str, ns: int) -> None:
    assert stamps.parse_ns(text) == ns


@pytest.mark.parametrize(
    "text", ["nan", "inf", "", "1.2.3", "1e300", "9300000000.0", "-1e999999", "x"]
)
def test_what_is_no_stamp(text: str) -> None:
    with pytest.raises(ValueError, match="is not a number of seconds"):
        stamps.parse_ns(text)


def test_floats_are_those_of_the_text() -> None:
    """So that differences are TUM's and evo's to the last bit."""
    ns = np.random.default_rng(1).integers(0, 2 * 10**18, 20_000)
    ns = np.concatenate(
        [ns, ns // 10**9, ns // 10**3, np.arange(20_000) * 50_000 + 1_305_031_102_000_000_000]
    )
    assert stamps.to_seconds(ns).tolist() == [
        float(stamps.format_ns(stamp)) for stamp in ns.tolist()
    ]
    six = [f"{1305031102 + i / 7:.6f}" for i in range(2000)]
    assert [stamps.format_ns(stamps.ns_of(float(text))) for text in six] == [
        f"{text}000" for text in six
    ]


def test_files_keep_nanoseconds(tmp_path: Path) -> None:
    texts = [stamps.format_ns(EUROC + 50_000_000 * i + i) for i in range(40)]
    (tmp_path / "a.txt").write_text("".join(f"{text} {POSE}\n" for text in texts))
    read = read_tum(tmp_path / "a.txt")
    write_tum(tmp_path / "b.txt", read.select(slice(3, None)))
    assert [line.split()[0] for line in (tmp_path / "b.txt").read_text().splitlines()[1:]] == texts[
        3:
    ]
    write_kitti(tmp_path / "k.txt", read, tmp_path / "times.txt")
    assert (tmp_path / "times.txt").read_text().split() == texts
    assert (
        read_kitti(tmp_path / "k.txt", tmp_path / "times.txt").timestamps_ns.tolist()
        == read.timestamps_ns.tolist()
    )
    assert (
        file_interface.read_tum_trajectory_file(tmp_path / "b.txt").timestamps.tolist()
        == read.timestamps[3:].tolist()
    )


@pytest.mark.parametrize("gap", [1, 200, 999])
@pytest.mark.parametrize("start", [EUROC, 0])
def test_true_poses_that_cannot_be_told_apart_are_refused_with_gap_and_lines(
    tmp_path: Path, start: int, gap: int
) -> None:
    rows = [start, start + 2_000_000, start + 1_000_000, start + 1_000_000 + gap]
    with pytest.raises(
        TrajectoryError, match=rf"groundtruth\.txt lines 4 and 5: .* {gap} ns apart .*remove"
    ):
        load_tum(write(tmp_path, "# a comment\n" + poses_at(rows), "groundtruth.txt"))


def test_equal_stamps_and_stamps_a_microsecond_apart_are_read(tmp_path: Path) -> None:
    rows = [EUROC, EUROC, EUROC + 1000, EUROC + 2000]
    file = load_tum(write(tmp_path, poses_at(rows)))
    assert file.trajectory.timestamps_ns.tolist() == rows[1:]
    assert file.notes.duplicates == 1


def test_a_tolerance_is_met_or_missed_as_in_tums_script() -> None:
    """Differences that equal the tolerance on paper are decided by the floats of the texts, as in associate.py."""
    first = [1_305_031_102_000_000_000 + 103_700_000 * i for i in range(300)]
    second = [ns + 20_000_000 for ns in first]
    texts = [[stamps.format_ns(ns) for ns in list_] for list_ in (first, second)]
    found, _ = associate(*(stamps.to_seconds(np.array(list_)) for list_ in (first, second)), 0.02)
    expected = [
        i for i, (a, b) in enumerate(zip(*texts, strict=True)) if abs(float(a) - float(b)) < 0.02
    ]
    assert 0 < len(expected) < 300
    assert found.tolist() == expected


# The greedy associator against a slow transcription of the published rule.


def slow_associate(first, second, max_dt, strict=True):
    """All pairs, sorted by (|dt|, first, second), greedy, each stamp once."""
    pairs = [(abs(a - b), a, b) for a in first for b in second]
    matches = {}
    for dt, a, b in sorted(pairs):
        if (
            (dt < max_dt or (not strict and dt == max_dt))
            and a not in matches
            and b not in matches.values()
        ):
            matches[a] = b
    return [(list(first).index(a), list(second).index(b)) for a, b in sorted(matches.items())]


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("strict", [True, False])
def test_equals_the_slow_rule(seed, strict):
    rng = np.random.default_rng(seed)
    # stamps on a coarse grid give many exact ties, which is where orders differ
    grid = 0.005 if seed % 2 else 1e-6
    first = np.unique(np.round(1305031102.0 + rng.uniform(0, 2, 60) / 1.0, 6) // grid * grid)
    second = np.unique(np.round(1305031102.0 + rng.uniform(0, 2, 80), 6) // grid * grid)
    first = rng.permutation(first)
    second = rng.permutation(second)
    indices = associate(first, second, 0.02, strict=strict)
    assert list(zip(*(index.tolist() for index in indices), strict=True)) == slow_associate(
        first, second, 0.02, strict
    )


@pytest.mark.parametrize(
    ("first", "second", "max_dt", "strict", "pairs"),
    [
        *(
            (first, second, 0.02, True, [])
            for first, second in (([], []), ([1.0], []), ([], [1.0]))
        ),
        ([0.0], [0.5], 0.5, True, []),
        ([0.0], [0.5], 0.5, False, [(0, 0)]),
        ([1.0], [1.0], 0.0, False, [(0, 0)]),
        # the closer pair wins and the other stamp goes without
        ([0.0, 0.010], [0.008], 0.02, True, [(1, 0)]),
        ([0.008], [0.0, 0.010], 0.02, True, [(0, 1)]),
    ],
)
def test_the_limit_is_strict_or_not_and_the_closer_pair_wins(first, second, max_dt, strict, pairs):
    indices = associate(first, second, max_dt, strict=strict)
    assert list(zip(*(index.tolist() for index in indices), strict=True)) == pairs
    assert not any(index.flags.writeable for index in indices)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([0.0, float("nan")], [0.0], 0.02), "stamp 1 of 2 is nan"),
        (([0.0], [float("inf")], 0.02), "stamp 0 of 1 is inf"),
        (([0.0], [0.0], -1.0), "-1.0"),
        (([0.0], [0.0], float("nan")), "nan"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, text):
    with pytest.raises(TrajectoryError, match=text):
        associate(*arguments)


def test_nearest_gap():
    assert nearest_gap([0.0, 1.0, 9.0], [1.25, 0.5]).tolist() == [0.5, 0.25, 7.75]
    assert np.isinf(nearest_gap([1.0], [])).all()


# TUM and KITTI trajectory files: round trips, what is skipped and counted, and one-line errors.


RIGID = "1 0 0 0 0 1 0 0 0 0 1 0\n"
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def random_trajectory(n=50, seed=0, start=1305031102.175304):
    rng = np.random.default_rng(seed)
    return Trajectory(
        np.round(start + np.cumsum(rng.uniform(0.01, 0.05, n)), 6),
        se3.exp(rng.normal(0, 1, (n, 6))),
    )


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
    pose = read_tum(
        write(tmp_path, "1.0 0.1 0.2 0.3 0 0 0.7071067811865476 0.7071067811865476\n")
    ).T_world_cam[0]
    assert np.allclose(pose[:3], [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]])


def test_tum_skips_and_counts_like_the_official_tools(tmp_path):
    text = (
        "# comment\n\n"
        "3.0 3 0 0 0 0 0 1\n"
        "1.0,1,0,0,0,0,0,1\r\n"  # commas, Windows line end, out of order
        "2.0\t2 0 0 0 0 0 2\n"  # tab, quaternion of norm 2
        "2.5 nan 0 0 0 0 0 1\n"
        "nan 0 0 0 0 0 0 1\n"
        "2.6 inf 0 0 0 0 0 1\n"
        "2.7 0 0 0 0 0 0 0\n"
        "3.0 9 0 0 0 0 0 1 # the later line with this stamp holds\n"
    )
    file = load_tum(write(tmp_path, text))
    assert file.trajectory.timestamps.tolist() == [1.0, 2.0, 3.0]
    assert file.trajectory.positions[:, 0].tolist() == [1.0, 2.0, 9.0]
    assert np.allclose(file.trajectory.T_world_cam[1, :3, :3], np.eye(3))
    counts = {
        "lines": 8,
        "not_finite": 3,
        "zero_quaternions": 1,
        "duplicates": 1,
        "out_of_order": 1,
        "renormalised": 1,
    }
    assert file.notes == FileNotes(**counts, back_s=2.0)
    assert len(file.notes.describe()) == 5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "holds no poses"),
        ("# only\n# comments\n", "holds no poses"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0\n", "line 2 has 4 values"),
        ("# c\n1 0 0 x 0 0 0 1\n", "line 2: 'x' is not a number"),
        ("1 0 0 0 0 0 0 0 0 0 0 1\n", "KITTI"),
        ("1;0;0;0;0;0;0;1\n", "not by semicolons"),
        ("timestamp;tx;ty;tz;qx;qy;qz;qw\n1;0;0;0;0;0;0;1\n", "not by semicolons"),
        ("1,5 0,0 0,0 0,0 0,0 0,0 0,0 1,0\n", "decimal points"),
        ("1 0,0 0,0 0,0 0,0 0,0 0,0 1,0\n", "decimal points"),
        ("1305031102.175304 rgb/1305031102.175304.png\n", "list of images"),
        (
            "1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n",
            "no valid pose .1 of 2 lines skipped: not finite; 1 of 2",
        ),
    ],
)
def test_tum_bad_files_are_one_clear_line(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(TrajectoryError, match=expected) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)


def test_tum_missing_folder_and_binary_files(tmp_path):
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    for name, named in (
        ("missing.txt", "No such file"),
        ("", "directory"),
        ("image.png", "not a text file"),
    ):
        with pytest.raises(TrajectoryError, match=named):
            read_tum(tmp_path / name)


def test_stamps_that_a_file_tells_apart_make_a_trajectory_also_none():
    close = Trajectory(np.array([1.0, 1.0 + 2e-9]), np.tile(np.eye(4), (2, 1, 1)))
    assert close.timestamps_ns.tolist() == [1_000_000_000, 1_000_000_002]
    assert format_tum(close.select(slice(0, 0))) == "# timestamp tx ty tz qx qy qz qw\n"


def test_kitti_round_trip(tmp_path):
    original = random_trajectory(seed=5, start=0.0)
    write_kitti(tmp_path / "poses.txt", original, tmp_path / "times.txt")
    again = read_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")
    assert np.array_equal(again.timestamps, original.timestamps)
    assert np.allclose(again.T_world_cam, original.T_world_cam, atol=1e-8)


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


@pytest.mark.parametrize(
    "path", sorted(SHARED.glob("*/*/groundtruth.txt")), ids=lambda path: path.parent.name
)
def test_real_ground_truth_reads_whole(path):
    file = load_tum(path)
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    assert len(file.trajectory) + file.notes.duplicates == len(lines) == file.notes.lines
    assert file.notes.renormalised == 0
    assert file.trajectory.path_length_m > 0.1 or path.parent.parent.name == "fixed_camera"
