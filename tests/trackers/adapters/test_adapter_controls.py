"""The control rows and `replay:FILE`: exact poses, and the names they are found by."""

import importlib.util
import lzma
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import (
    PluginError,
    SegmentationError,
    SequenceError,
    SettingsError,
    TrackerError,
    TrajectoryError,
)
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE, load_object
from dynslam_bench.evaluation import evaluate
from dynslam_bench.flow.registry import FLOWS, build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.geometry import Camera, Trajectory, se3, write_tum
from dynslam_bench.geometry.motion_covariances import (
    MotionCovariances,
    adjoint,
    write_motion_covariances,
)
from dynslam_bench.segmentation.build_segmenter import SEGMENTERS
from dynslam_bench.sequences.catalogue import DATASETS, open_sequence, sequence_ids
from dynslam_bench.testing import (
    CornerSequence,
    check_filter,
    check_segmenter,
    check_sequence,
    check_tracker,
)
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.adapters import odometry as opencv_odometry
from dynslam_bench.trackers.adapters.odometry import FrameToFrame
from dynslam_bench.trackers.adapters.orbslam3 import check_camera, find_vocabulary, settings_yaml
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings
from dynslam_bench.trackers.adapters.subprocess_tracker import read_track_answer
from dynslam_bench.trackers.registry import resolve_settings
from dynslam_bench.trackers.systems.composition import SystemSettings, compose

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def blank(index, stamp):
    return Frame(index, stamp, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32))


def reset(tracker, camera=CAMERA):
    tracker.reset(camera, rng=np.random.default_rng(0))
    return tracker


@pytest.fixture
def trajectory(tmp_path):
    stamps = 1305031102.175304 + np.arange(20) / 30
    poses = se3.exp(np.random.default_rng(1).normal(size=(20, 6)))
    path = tmp_path / "estimate.txt"
    write_tum(path, Trajectory(stamps, poses))
    return path, stamps, poses


@pytest.mark.parametrize("name", ["never-move", "constant-velocity"])
def test_controls_stand_still_without_images(name):
    tracker = reset(build_tracker(name))
    for index in range(12):
        result = tracker.track(blank(index, index / 30))
        assert result.state == "ok"
        assert np.allclose(result.T_world_cam, np.eye(4), atol=1e-12)


def test_constant_velocity_repeats_the_measured_motion():
    """After the measured frames each pose is the one before times exp(velocity * dt), whatever the images show."""
    sequence = CornerSequence(12)
    tracker = reset(build_tracker("constant-velocity", {"frames": 4}), sequence.camera)
    stamps = sequence.timestamps
    results = [tracker.track(sequence[i]) for i in range(4)]
    poses = sequence.ground_truth.T_world_cam
    truth = se3.inverse(poses[0]) @ poses
    measured = np.stack([result.T_world_cam for result in results])
    assert np.linalg.norm(measured[:, :3, 3] - truth[:4, :3, 3], axis=1).max() < 0.01
    assert min(result.stats["inliers"] for result in results[1:]) >= 12
    velocity = se3.log(measured[3]) / (stamps[3] - stamps[0])
    pose = measured[3]
    stamp = stamps[3]
    for index, gap in ((4, 0.04), (5, 0.5), (6, 0.01)):
        stamp += gap
        frame = Frame(
            index, stamp, np.zeros_like(sequence[0].rgb), np.zeros_like(sequence[0].depth)
        )
        pose = pose @ se3.exp(velocity * gap)
        assert np.allclose(tracker.track(frame).T_world_cam, pose, atol=1e-6)


def test_replay_gives_the_files_poses(trajectory):
    path, stamps, poses = trajectory
    tracker = reset(build_tracker(f"replay:{path}"))
    for index, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        result = tracker.track(blank(index, stamp + 0.009))
        assert result.state == "ok"
        assert np.allclose(result.T_world_cam, pose, atol=1e-8)
        assert result.stats["stamp_gap_s"] == pytest.approx(0.009, abs=2e-6)


def test_replay_says_what_of_the_file_it_did_not_take_as_it_stands(trajectory, tmp_path):
    path = trajectory[0]
    assert build_tracker(f"replay:{path}").measured == {"notes": []}
    rows = [line.split() for line in path.read_text().splitlines() if line[0] != "#"]
    nanoseconds = tmp_path / "nanoseconds.txt"
    lines = [[str(round(float(row[0]) * 1e9)), *row[1:]] for row in rows]
    nanoseconds.write_text("".join(f"{' '.join(line)}\n" for line in lines))
    (note,) = build_tracker(f"replay:{nanoseconds}").measured["notes"]
    assert "nanoseconds" in note


def test_replay_skips_a_hole(trajectory, tmp_path):
    path, stamps, _ = trajectory
    lines = path.read_text().splitlines(keepends=True)
    holed = tmp_path / "holed.txt"
    holed.write_text("".join(lines[:6] + lines[9:]))  # a header line, then poses 0-4 and 8-19
    tracker = reset(build_tracker(f"replay:{holed}"))
    states = [tracker.track(blank(i, stamp)).state for i, stamp in enumerate(stamps)]
    assert states == ["ok"] * 5 + ["lost"] * 3 + ["ok"] * 12


def test_replay_gives_the_covariances_of_a_file(trajectory, tmp_path):
    path, stamps, _ = trajectory
    file = tmp_path / "covariances.txt"
    matrices = np.array([np.eye(6) * (k + 1) for k in range(19)])
    write_motion_covariances(file, MotionCovariances(stamps[1:], matrices))
    settings = {"covariances": str(file)}
    tracker = reset(build_tracker(f"replay:{path}", settings))
    results = [tracker.track(blank(k, float(stamp))) for k, stamp in enumerate(stamps)]
    assert results[0].motion_covariance is None
    assert [result.motion_covariance[0, 0] for result in results[1:]] == list(range(1, 20))
    file.write_text("1 2\n")
    with pytest.raises(TrajectoryError, match="has 2 values, not the 37"):
        build_tracker(f"replay:{path}", settings)


@pytest.mark.parametrize("per_s", [1e3, 1e6, 1e9])
def test_replay_takes_covariances_in_the_units_of_trajectories(trajectory, tmp_path, per_s):
    path, stamps, _ = trajectory
    file = tmp_path / "covariances.txt"
    numbers = " ".join("1" if k % 7 == 0 else "0" for k in range(36))
    file.write_text("".join(f"{stamp * per_s:.6f} {numbers}\n" for stamp in stamps[1:].tolist()))
    tracker = reset(build_tracker(f"replay:{path}", {"covariances": str(file)}))
    results = [tracker.track(blank(k, float(stamp))) for k, stamp in enumerate(stamps)]
    assert all(np.array_equal(result.motion_covariance, np.eye(6)) for result in results[1:])


@pytest.mark.parametrize(("later", "belong"), [(0.01, 0), (11 / 30, 8)])
def test_replay_refuses_covariances_of_another_trajectory(trajectory, tmp_path, later, belong):
    path, stamps, _ = trajectory
    file = tmp_path / "covariances.txt"
    matrices = np.tile(np.eye(6), (19, 1, 1))
    write_motion_covariances(file, MotionCovariances(stamps[1:] + later, matrices))
    with pytest.raises(TrajectoryError, match=f"{belong} of 19 stamps .* belong to a pose"):
        build_tracker(f"replay:{path}", {"covariances": str(file)})


@pytest.mark.parametrize("seen", [[0, 2, 4], [3, 4, 9], [0, 1, 1, 2]])
def test_replay_composes_the_covariances_of_poses_between_frames(trajectory, tmp_path, seen):
    path, stamps, poses = trajectory
    file = tmp_path / "covariances.txt"
    matrices = np.array([np.eye(6) * (k + 1) for k in range(19)])
    write_motion_covariances(file, MotionCovariances(stamps[1:], matrices))
    tracker = reset(build_tracker(f"replay:{path}", {"covariances": str(file)}))
    results = [tracker.track(blank(k, float(stamps[row]))) for k, row in enumerate(seen)]
    assert results[0].motion_covariance is None
    for k in range(1, len(seen)):
        # each error, transported behind the rest of the motion
        expected = np.zeros((6, 6))
        for row in range(seen[k - 1] + 1, seen[k] + 1):
            back = adjoint(se3.inverse(poses[seen[k]]) @ poses[row])
            expected += back @ matrices[row - 1] @ back.T
        if seen[k] == seen[k - 1]:
            assert results[k].motion_covariance is None
        else:
            assert np.allclose(results[k].motion_covariance, expected, rtol=1e-6)


def test_replay_id_carries_the_file(trajectory):
    path = trajectory[0]
    spec = TRACKERS.get(f"replay:{path}")
    assert spec.id == f"replay:{path}"
    assert resolve_settings(spec).file == str(path)
    assert "estimate.txt" in spec.label
    path.write_text(path.read_text() + "1400000000.0 0 0 0 0 0 0 1\n")
    assert TRACKERS.get(f"replay:{path}").version != spec.version, "another content is another run"
    assert resolve_settings(spec, {"tolerance_s": "0.02"}).tolerance_s == 0.02
    assert TRACKERS.get("replay").id == "replay"


def test_bound_values_stay_text(trajectory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trajectory[0].rename(tmp_path / "5")
    assert resolve_settings(TRACKERS.get("replay:5")).file == "5"
    assert resolve_settings(TRACKERS.get("subprocess:true")).command == "true"


@pytest.mark.slow
def test_names_with_a_colon_still_load_specs(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from dynslam_bench.trackers import TrackerSpec\n"
        "SPEC = TrackerSpec('mine', 'dynslam_bench.trackers.adapters.controls:NeverMove', 'mine')\n"
    )
    assert TRACKERS.get(f"{file}:SPEC").id == "mine"
    assert TRACKERS.get("dynslam_bench.trackers.adapters.specs:NEVER_MOVE").id == "never-move"
    with pytest.raises(PluginError):
        TRACKERS.get("never-move:x")


@pytest.mark.parametrize(
    ("name", "settings", "error", "words"),
    [
        ("replay", {}, SettingsError, "replay:FILE"),
        ("replay:", {}, PluginError, "lacks its file"),
        ("replay:missing.txt", {}, TrajectoryError, r"missing\.txt"),
        ("replay:empty.txt", {}, TrajectoryError, r"empty\.txt"),
        ("replay:estimate.txt", {"tolerance_s": 0}, SettingsError, "tolerance_s"),
    ],
)
def test_replay_faults(tmp_path, monkeypatch, trajectory, name, settings, error, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(error, match=words):
        build_tracker(name, settings)


# Dense frame-to-frame odometries of OpenCV and Open3D, and the chain that they share.


XYZ = Path(__file__).resolve().parents[4] / "shared" / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"
needs_data = pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")
needs_opencv = pytest.mark.skipif(
    bool(opencv_odometry.unavailable()), reason=opencv_odometry.unavailable()
)
needs_open3d = pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None, reason="open3d is not installed"
)


@pytest.mark.slow
@needs_opencv
def test_opencv_keeps_the_contract():
    check_tracker("opencv-odometry", frames=2)


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize(
    ("name", "settings", "bound"),
    [
        pytest.param("opencv-odometry", {"method": "rgbd"}, 0.01, marks=needs_opencv),
        pytest.param("opencv-odometry", {"method": "rgb"}, 0.01, marks=needs_opencv),
        pytest.param("open3d-odometry", {}, 0.015, marks=needs_open3d),
    ],
)
def test_odometries_follow_a_static_scene(name, settings, bound):
    sequence = open_sequence(XYZ, frames=(0, 12))
    tracker = reset(build_tracker(name, settings), sequence.camera)
    results = [tracker.track(sequence[index]) for index in range(12)]
    assert {result.state for result in results} == {"ok"}
    estimate = Trajectory(sequence.timestamps, np.stack([result.T_world_cam for result in results]))
    metrics = evaluate(estimate, sequence.ground_truth, "tum-rgbd/v1").metrics
    assert metrics["ate_rmse_m"] < bound < metrics["static_camera_ate_rmse_m"] / 2


def test_without_the_api_it_is_listed_and_says_what_to_install(monkeypatch):
    for name in ("Odometry", "rgbd"):
        monkeypatch.delattr(cv2, name, raising=False)
    assert "opencv-odometry" in [found.spec.id for found in TRACKERS.all()]
    hints = TRACKERS.get("opencv-odometry").missing()
    assert len(hints) == 1
    assert "opencv-contrib-python-headless" in hints[0]
    assert cv2.__version__ in hints[0]
    with pytest.raises(TrackerError, match="opencv-contrib"):
        build_tracker("opencv-odometry")


class Scripted(FrameToFrame):
    """Frames carry their number in a pixel; a motion of 1 along x each, or none where the script says so."""

    def __init__(self, failing):
        self.failing = failing

    def start(self, camera):
        """Nothing to set up."""

    def prepare(self, rgb, depth):
        return int(rgb[0, 0, 0])

    def align(self, reference, current):
        return (
            None
            if current in self.failing
            else se3.exp(np.array([current - reference, 0.0, 0, 0, 0, 0]))
        )


@pytest.mark.parametrize(
    ("failing", "blind", "states", "place"),
    [
        ((2, 3), (), "ok ok lost lost ok", 4),
        # as if it had not moved while it was lost
        ((1, 2, 3, 4, 5), (), "ok lost lost lost lost lost ok ok", 2),
        ((), (0, 1, 3), "initialising initialising ok lost ok", 2),
    ],
)
def test_lost_frames_are_bridged_from_the_last_good_one(failing, blind, states, place):
    tracker = reset(Scripted(failing))
    results = []
    for index in range(len(states.split())):
        depth = np.full((48, 64), 0.0 if index in blind else 1.0, np.float32)
        results.append(
            tracker.track(Frame(index, float(index), np.full((48, 64, 3), index, np.uint8), depth))
        )
    assert " ".join(result.state for result in results) == states
    assert results[-1].T_world_cam[0, 3] == place
    assert all((result.T_world_cam is None) == (result.state != "ok") for result in results)


def test_undistortion_maps_invert_the_distortion():
    camera = Camera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.26, -0.95, -0.005, 0.003, 1.16))
    columns, rows = camera.undistortion_maps()
    grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1).reshape(-1, 2)
    expected = camera.distort_points(grid).reshape(48, 64, 2)
    assert np.abs(columns - expected[..., 0]).max() < 1e-3
    assert np.abs(rows - expected[..., 1]).max() < 1e-3


PAGES = (
    "reference/plugins.md",
    "how-to/dataset.md",
    "how-to/filter.md",
    "how-to/program.md",
    "how-to/segmenter.md",
)


@pytest.fixture
def example(tmp_path):
    """Writes a named example of the pages and gives its path."""
    text = "\n".join(
        (Path(__file__).parents[3] / "docs" / page).read_text(encoding="utf-8") for page in PAGES
    )
    blocks = re.findall(r"```python\n(# (\w+\.py)\n.*?)```", text, re.DOTALL)
    texts = {name: text for text, name in blocks}
    assert len(texts) == len(blocks) >= 7

    def write(name):
        path = tmp_path / name
        path.write_text(texts[name])
        return path

    return write


@pytest.fixture
def plugged(monkeypatch):
    """Names a plug-in in the environment, as the page's shell lines do."""

    def plug(kind, path, registry):
        monkeypatch.setenv(ENVIRONMENT_VARIABLE, f"{kind}={path}:SPEC")
        registry.refresh()
        assert not [failure for failure in registry.failures() if str(path) in failure.source]
        used.append(registry)

    used = []
    yield plug
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    for registry in used:
        registry.refresh()


def test_tracker(example):
    path = example("my_slam.py")
    check_tracker(f"{path}:SPEC", frames=3)
    sequence = CornerSequence(4)
    tracker = reset(build_tracker(f"{path}:SPEC", {"step_m": "0.02"}), sequence.camera)
    assert [tracker.track(sequence[i]).T_world_cam[2, 3] for i in range(4)] == pytest.approx(
        [0, 0.02, 0.04, 0.06]
    )


def test_data_set(example, plugged, tmp_path):
    plugged("sequences", example("my_data.py"), DATASETS)
    sequence = open_sequence("grey/wall", data_root=tmp_path)
    check_sequence(sequence)
    assert "grey/wall" in sequence_ids()
    assert len(sequence) == 20
    assert open_sequence("grey/wall", data_root=tmp_path, frames="5:8")[0].timestamp == 5 / 30
    with pytest.raises(SequenceError, match="known: grey/wall"):
        open_sequence("grey/door", data_root=tmp_path)


def test_segmenter(example, plugged):
    plugged("segmenters", example("my_segmenter.py"), SEGMENTERS)
    build = load_object(SEGMENTERS.get("near").entry_point)
    check_segmenter(lambda: build(None, None))
    sequence = CornerSequence(3)
    tracker = reset(
        build_tracker("mask-rcnn", {"segmentation.source": "plugin:near"}), sequence.camera
    )
    assert tracker.track(sequence[0]).state == "ok"


@pytest.mark.slow
def test_flow(example, plugged):
    plugged("flow", example("my_flow.py"), FLOWS)
    flow = build_flow(FlowSettings(plugin="no-motion"))
    points = np.array([[3.5, 4.5], [10, 20]], np.float32)
    guess = np.array([[np.nan, np.nan], [11, 21]], np.float32)
    image = np.zeros((48, 64), np.uint8)
    result = flow.track(flow.prepare(image), flow.prepare(image), points, guess=guess)
    assert result.xy.tolist() == [[3.5, 4.5], [11, 21]]
    assert result.valid.all()


@pytest.mark.slow
def test_filter_and_system(example):
    path = example("far_slam.py")
    check_filter(load_object(f"{path}:FarFilter"))
    assert TRACKERS.get(f"{path}:SPEC").id == "far-slam"
    check_tracker(f"{path}:SPEC", frames=2)


@pytest.mark.slow
def test_filter_beside_masks(example):
    path = example("people_slam.py")
    carried, settings = load_object(f"{path}:CarriedFilter"), load_object(f"{path}:CarriedSettings")
    check_filter(lambda: carried(settings()))
    check_tracker(f"{path}:SPEC", frames=2, settings={"segmentation.source": "oracle"})
    with pytest.raises(SettingsError, match="needs masks"):
        TRACKERS.get(f"{path}:SPEC").settings(segmentation={"source": "none"}).verify()
    sequence = open_sequence("synthetic/walking_xyz", frames=(0, 2))
    context = TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    dropped = []
    for behind_m in (0.0, 0.5):
        chosen = {"segmentation.source": "oracle", "carried.behind_m": behind_m}
        tracker = reset(build_tracker(f"{path}:SPEC", chosen, context), sequence.camera)
        stats = tracker.track(sequence[0]).stats
        dropped.append(stats["carried_dropped"])
        assert stats["semantic_objects"] >= 1
    assert 0 <= dropped[0] < dropped[1], "its setting reaches it"


def test_a_filter_that_needs_masks_without_the_group_is_told_how_to_get_it(example):
    path = example("people_slam.py")
    carried = load_object(f"{path}:CarriedFilter")(load_object(f"{path}:CarriedSettings")())
    with pytest.raises(SegmentationError, match=r"'carried' needs masks.*SemanticSystemSettings"):
        compose(SystemSettings(), TrackerContext(), [carried])


PACKED = XYZ.parents[2] / "weights" / "orb_vocabulary_small.txt.xz"
INSTALLED = importlib.util.find_spec("pyorbslam3") is not None
FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))

needs_orbslam3 = pytest.mark.skipif(not INSTALLED, reason="pyorbslam3 is not installed")
needs_vocabulary = pytest.mark.skipif(
    not PACKED.is_file(), reason="no ORB vocabulary beside the checkout"
)


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    monkeypatch.delenv("DYNSLAM_BENCH_ORB_VOCABULARY", raising=False)


def toy_vocabulary():
    """A complete tree of random words in DBoW2's text format: three branches, two levels."""
    words = np.random.default_rng(0).integers(0, 256, (12, 32)).astype(str)
    parents = [0, 0, 0, *np.repeat([1, 2, 3], 3).tolist()]
    nodes = [
        f"{parent} {int(parent > 0)} {' '.join(word)}  {0.5 if parent else 0}"
        for parent, word in zip(parents, words, strict=True)
    ]
    return "\n".join(["3 2  0 0", *nodes]) + "\n"


def test_settings_file_holds_our_camera(tmp_path):
    """Read back with OpenCV, whose parser is the one that ORB-SLAM3 uses; reals must not turn into integers."""
    path = tmp_path / "settings.yaml"
    camera = replace(FR1, fx=500.0, baseline_m=0.08, distortion=(1e-7, -0.5, 0.0, 2.0, 1.0))
    path.write_text(
        settings_yaml(camera, OrbSlam3Settings(features=1500, close_depth_baselines=35), 29.7)
    )
    stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    reals = {
        "Camera1.fx": 500.0, "Camera1.fy": 516.5, "Camera1.cx": 318.6, "Camera1.cy": 255.3, "Camera1.k1": 1e-7,
        "Camera1.k2": -0.5, "Camera1.p1": 0.0, "Camera1.p2": 2.0, "Camera1.k3": 1.0, "Stereo.b": 0.08,
        "Stereo.ThDepth": 35.0, "RGBD.DepthMapFactor": 1.0, "ORBextractor.scaleFactor": 1.2,
    }  # fmt: skip
    integers = {
        "Camera.width": 640, "Camera.height": 480, "Camera.fps": 30, "Camera.RGB": 1, "ORBextractor.nFeatures": 1500,
        "ORBextractor.nLevels": 8, "ORBextractor.iniThFAST": 20, "ORBextractor.minThFAST": 7,
    }  # fmt: skip
    for key, value in (reals | integers).items():
        node = stored.getNode(key)
        assert node.isReal() == (key in reals), key
        assert node.isInt() == (key in integers), key
        assert node.real() == value, key
    assert stored.getNode("File.version").string() == "1.0"
    assert stored.getNode("Camera.type").string() == "PinHole"


class Fisheye(Camera):
    """Some other model of a plug-in."""


@pytest.mark.parametrize(
    "camera, expected",
    [
        (Fisheye(640, 480, 500.0, 500.0, 320.0, 240.0), "cannot take a Fisheye"),
        (replace(FR1, fx=float("nan")), "fx=nan"),
        (replace(FR1, fy=-516.5), "fy=-516.5"),
        (replace(FR1, baseline_m=0.0), "baseline=0 m"),
        (replace(FR1, distortion=(0.1, float("inf"), 0.0, 0.0, 0.0)), "inf"),
        (replace(FR1, distortion=(0.1, 0.2, 0.0, 0.0)), "4 distortion coefficients"),
        (replace(FR1, width=320, height=110), "320x110.*needs 117 pixels"),
        (replace(FR1, width=300, height=560), "2.38 times as high as wide"),
    ],
)
def test_cameras_it_cannot_take(camera, expected):
    with pytest.raises(TrackerError, match=expected):
        check_camera(camera, OrbSlam3Settings())


def test_cameras_it_can_take():
    check_camera(FR1, OrbSlam3Settings())
    check_camera(replace(FR1, width=320, height=240), OrbSlam3Settings())
    check_camera(replace(FR1, width=320, height=110), OrbSlam3Settings(levels=6))
    with pytest.raises(SettingsError, match="features"):
        build_tracker("orbslam3", {"features": 5})


def test_vocabulary_is_found_unpacked_and_cached(tmp_path, monkeypatch):
    text = toy_vocabulary()
    plain = tmp_path / "voc.txt"
    packed = tmp_path / "voc.txt.xz"
    plain.write_text(text)
    packed.write_bytes(lzma.compress(text.encode()))
    assert find_vocabulary(str(plain)) == plain
    unpacked = find_vocabulary(str(packed))
    assert unpacked.read_text() == text
    assert unpacked != plain
    stamp = unpacked.stat().st_mtime_ns
    assert find_vocabulary(str(packed)) == unpacked
    assert unpacked.stat().st_mtime_ns == stamp
    assert [path.name for path in unpacked.parent.iterdir()] == [unpacked.name], (
        "nothing half written beside it"
    )
    monkeypatch.setenv("DYNSLAM_BENCH_ORB_VOCABULARY", str(packed))
    assert find_vocabulary("") == unpacked
    assert find_vocabulary(str(plain)) == plain, "the setting wins"


TEXT = toy_vocabulary()
LINES = TEXT.splitlines(keepends=True)


@pytest.mark.parametrize(
    "content, expected",
    [
        ("", "line 1 is ''"),
        ("hello world\n", "line 1 is 'hello world'"),
        ("<!DOCTYPE html>\n<html>\n", "line 1 is '<!DOCTYPE html>'"),
        ("99 3 0 0\n", "line 1"),
        (LINES[0], "1 inner nodes have no children"),
        (TEXT[: len(TEXT) // 2], "line 7 is not a node of 35 numbers"),
        ("".join(LINES[:-3]), "1 inner nodes have no children, as if its end were missing"),
        ("".join([*LINES[:5], "garbage\n", *LINES[5:]]), "line 6 is not a node"),
        (
            "".join([*LINES[:2], LINES[2].replace("0 0", "9 0", 1), *LINES[3:]]),
            "line 3 names parent 9",
        ),
    ],
)
def test_damaged_vocabularies(tmp_path, content, expected):
    for path, data in (
        (tmp_path / "v.txt", content.encode()),
        (tmp_path / "v.txt.xz", lzma.compress(content.encode())),
    ):
        path.write_bytes(data)
        with pytest.raises(
            TrackerError, match=rf"v\.txt.*{expected}.*DYNSLAM_BENCH_ORB_VOCABULARY"
        ):
            find_vocabulary(str(path))


def test_vocabularies_that_are_not_there(tmp_path):
    (tmp_path / "cut.txt.xz").write_bytes(lzma.compress(TEXT.encode())[:-40])
    (tmp_path / "v.txt").write_bytes(np.random.default_rng(0).bytes(5000))
    for name, words in (
        ("", r"none is named.*DYNSLAM_BENCH_ORB_VOCABULARY"),
        (str(tmp_path / "nowhere.txt"), r"no vocabulary file .*nowhere\.txt"),
        (str(tmp_path / "cut.txt.xz"), r"no intact \.xz"),
        (str(tmp_path / "v.txt"), "line 1"),
    ):
        with pytest.raises(TrackerError, match=words):
            find_vocabulary(name)


@pytest.mark.slow
@needs_orbslam3
@needs_vocabulary
@needs_data
def test_two_resets_on_real_frames():
    """25 frames of fr1_xyz, twice in one process: poses, stats, final trajectory, and nothing left running."""
    sequence = open_sequence(XYZ, frames=(0, 25))
    with closing(
        build_tracker("orbslam3", {"vocabulary": str(PACKED)}, TrackerContext(fps=sequence.fps))
    ) as tracker:
        for _ in range(2):
            tracker.reset(sequence.camera, rng=np.random.default_rng(0))
            results = [tracker.track(sequence[index]) for index in range(25)]
            assert {result.state for result in results} == {"ok"}
            assert np.allclose(results[0].T_world_cam, np.eye(4))
            assert all(
                result.stats["inliers"] > 50 and result.stats["keypoints"] > 500
                for result in results
            )
            assert list(results[-1].timings) == ["tracking", "transfer"]
            final = tracker.finalize()
            assert final.timestamps.tolist() == sequence.timestamps.tolist()
            poses = np.stack([result.T_world_cam for result in results])
            assert np.abs(final.T_world_cam - poses).max() < 0.05
            truth = sequence.ground_truth.positions
            at = np.searchsorted(sequence.ground_truth.timestamps, sequence.timestamps)
            assert (
                abs(np.linalg.norm(poses[-1, :3, 3]) - np.linalg.norm(truth[at[-1]] - truth[at[0]]))
                < 0.02
            )
        process = tracker._program._process
    assert process.poll() is not None


@pytest.mark.slow
@needs_orbslam3
@needs_vocabulary
def test_frames_without_features():
    """Black frames give no pose and no crash; once there is something to see it begins."""
    camera = replace(FR1, distortion=(0.0,) * 5)
    with closing(reset(build_tracker("orbslam3", {"vocabulary": str(PACKED)}), camera)) as tracker:
        for index in range(4):
            black = Frame(
                index,
                index / 30,
                np.zeros((480, 640, 3), np.uint8),
                np.zeros((480, 640), np.float32),
            )
            result = tracker.track(black)
            assert result.state == "initialising"
            assert result.T_world_cam is None
        texture = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
        grey = cv2.resize(texture, (640, 480), interpolation=cv2.INTER_NEAREST)
        seen = Frame(
            4, 4 / 30, np.repeat(grey[..., None], 3, axis=2), np.full((480, 640), 2.0, np.float32)
        )
        assert tracker.track(seen).state == "ok"
        assert tracker.finalize().timestamps.tolist() == [4 / 30]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (np.eye(6).ravel().tolist(), np.eye(6)),
        (np.eye(6).tolist(), np.eye(6)),
        ([1.0, 2.0], np.full((6, 6), np.nan)),
        ("sure", np.full((6, 6), np.nan)),
        ({"a": 1}, np.full((6, 6), np.nan)),
        ([1e12] * 36, np.full((6, 6), 1e12)),
        (None, None),
    ],
)
def test_a_program_may_answer_with_a_covariance(given, expected):
    answer = {"index": 0, "state": "ok", "T_world_cam": np.eye(4).ravel().tolist()}
    answer["motion_covariance"] = given
    result = read_track_answer(answer, blank(0, 0.0), "program", lambda: 0.0)
    if expected is None:
        assert result.motion_covariance is None
    else:
        assert np.array_equal(result.motion_covariance, expected, equal_nan=True)
