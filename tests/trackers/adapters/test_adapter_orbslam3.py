"""The real ORB-SLAM3: settings file, vocabulary, cameras it cannot take; and, where it is installed, real frames."""

import importlib.util
import lzma
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.core.errors import SettingsError, TrackerError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.trackers import TrackerContext, build_tracker
from dynslam_bench.trackers.adapters.orbslam3 import check_camera, find_vocabulary, settings_yaml
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings

SHARED = Path(__file__).resolve().parents[4] / "shared"
PACKED = SHARED / "weights" / "orb_vocabulary_small.txt.xz"
XYZ = SHARED / "data" / "tum" / "rgbd_dataset_freiburg1_xyz"
INSTALLED = importlib.util.find_spec("pyorbslam3") is not None
FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))

needs_orbslam3 = pytest.mark.skipif(not INSTALLED, reason="pyorbslam3 is not installed")
needs_vocabulary = pytest.mark.skipif(not PACKED.is_file(), reason="no ORB vocabulary beside the checkout")
needs_data = pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")


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
    path.write_text(settings_yaml(camera, OrbSlam3Settings(features=1500, close_depth_baselines=35), 29.7))
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
        assert node.isReal() == (key in reals) and node.isInt() == (key in integers) and node.real() == value, key
    assert stored.getNode("File.version").string() == "1.0" and stored.getNode("Camera.type").string() == "PinHole"


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
    with pytest.raises(TrackerError, match=expected) as caught:
        check_camera(camera, OrbSlam3Settings())
    assert "\n" not in str(caught.value)


def test_cameras_it_can_take():
    check_camera(FR1, OrbSlam3Settings())
    check_camera(replace(FR1, width=320, height=240), OrbSlam3Settings())
    check_camera(replace(FR1, width=320, height=110), OrbSlam3Settings(levels=6))
    with pytest.raises(SettingsError, match="features"):
        build_tracker("orbslam3", {"features": 5})


def test_vocabulary_is_found_unpacked_and_cached(tmp_path, monkeypatch):
    text = toy_vocabulary()
    plain, packed = tmp_path / "voc.txt", tmp_path / "voc.txt.xz"
    plain.write_text(text)
    packed.write_bytes(lzma.compress(text.encode()))
    assert find_vocabulary(str(plain)) == plain
    unpacked = find_vocabulary(str(packed))
    assert unpacked.read_text() == text and unpacked != plain
    stamp = unpacked.stat().st_mtime_ns
    assert find_vocabulary(str(packed)) == unpacked and unpacked.stat().st_mtime_ns == stamp
    assert [path.name for path in unpacked.parent.iterdir()] == [unpacked.name], "nothing half written beside it"
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
        ("".join([*LINES[:2], LINES[2].replace("0 0", "9 0", 1), *LINES[3:]]), "line 3 names parent 9"),
    ],
)
def test_damaged_vocabularies(tmp_path, content, expected):
    for path, data in (
        (tmp_path / "v.txt", content.encode()),
        (tmp_path / "v.txt.xz", lzma.compress(content.encode())),
    ):
        path.write_bytes(data)
        with pytest.raises(TrackerError, match=expected) as caught:
            find_vocabulary(str(path))
        message = str(caught.value)
        assert "\n" not in message and "v.txt" in message and "DYNSLAM_BENCH_ORB_VOCABULARY" in message


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


@needs_orbslam3
@needs_vocabulary
@needs_data
def test_two_resets_on_real_frames():
    """25 frames of fr1_xyz, twice in one process: poses, stats, final trajectory, and nothing left running."""
    sequence = open_sequence(XYZ, frames=(0, 25))
    tracker = build_tracker("orbslam3", {"vocabulary": str(PACKED)}, TrackerContext(fps=sequence.fps))
    try:
        for _ in range(2):
            tracker.reset(sequence.camera, rng=np.random.default_rng(0))
            results = [tracker.track(sequence[index]) for index in range(25)]
            assert {result.state for result in results} == {"ok"}
            assert np.allclose(results[0].T_world_cam, np.eye(4))
            assert all(result.stats["inliers"] > 50 and result.stats["keypoints"] > 500 for result in results)
            assert list(results[-1].timings) == ["tracking", "transfer"]
            final = tracker.finalize()
            assert final.timestamps.tolist() == sequence.timestamps.tolist()
            poses = np.stack([result.T_world_cam for result in results])
            assert np.abs(final.T_world_cam - poses).max() < 0.05
            truth = sequence.ground_truth.positions
            at = np.searchsorted(sequence.ground_truth.timestamps, sequence.timestamps)
            moved = np.linalg.norm(truth[at[-1]] - truth[at[0]])
            assert abs(np.linalg.norm(poses[-1, :3, 3]) - moved) < 0.02
        process = tracker._program._process
    finally:
        tracker.close()
    assert process.poll() is not None


@needs_orbslam3
@needs_vocabulary
def test_frames_without_features():
    """Black frames give no pose and no crash; once there is something to see it begins."""
    from dynslam_bench.contracts.sequence import Frame

    camera = replace(FR1, distortion=(0.0,) * 5)
    tracker = build_tracker("orbslam3", {"vocabulary": str(PACKED)})
    try:
        tracker.reset(camera, rng=np.random.default_rng(0))
        for index in range(4):
            black = Frame(index, index / 30, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32))
            result = tracker.track(black)
            assert result.state == "initialising" and result.T_world_cam is None
        texture = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
        grey = cv2.resize(texture, (640, 480), interpolation=cv2.INTER_NEAREST)
        seen = Frame(4, 4 / 30, np.repeat(grey[..., None], 3, axis=2), np.full((480, 640), 2.0, np.float32))
        assert tracker.track(seen).state == "ok"
        assert tracker.finalize().timestamps.tolist() == [4 / 30]
    finally:
        tracker.close()
