"""`sequences doctor`: faults put into a recording are named, a sound one has none, nothing makes it raise."""

import re
import shutil
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequence_folders import SHARED, Altered, make_folder, needs_shared, scaled

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences import PreprocessingSettings, open_sequence
from dynslam_bench.sequences.calibration import Window, adjust, calibrate
from dynslam_bench.sequences.cameras import read_camera, write_camera
from dynslam_bench.sequences.doctor import Diagnosis, Finding, _turn, diagnose, examine, stretches, truth_findings
from dynslam_bench.sequences.preprocessing import Preprocessed
from dynslam_bench.sequences.rgbd_motion import READINGS, read_as, rgbd_pairs
from dynslam_bench.sequences.synthetic import RenderSettings, open_synthetic

FRAMES = 80


@pytest.fixture(scope="module")
def sound():
    """A rendered office without people, at half the size."""
    id, settings = f"synthetic/walking_halfsphere?scene=1&frames={FRAMES}", RenderSettings(people="none")
    small = PreprocessingSettings(width=320, height=240)
    return Altered(Preprocessed(open_synthetic(id, None, settings=settings), small))


@pytest.fixture(scope="module")
def pairs(sound):
    """The motions that `examine` compares with a truth."""
    return [pair for start in (0, 40) for pair in rgbd_pairs(sound.frames[start : start + 40], sound.camera)]


@pytest.fixture(scope="module")
def diagnosed(sound, pairs):
    """What is found of a fault; faults of the truth alone share the images' motions."""

    @cache
    def found(name):
        if "truth" not in FAULTS[name]:
            return examine(Altered(sound, **FAULTS[name]))
        truth = FAULTS[name]["truth"](sound.ground_truth)
        return Diagnosis(sound.id, FRAMES, tuple(truth_findings(sound.timestamps, truth, sound.camera, pairs)))

    return found


def of_poses(change):
    return lambda truth: Trajectory(truth.timestamps, change(truth.T_world_cam))


def of_a_body(pose):
    return of_poses(lambda poses: poses @ pose)


def w_first(poses):
    position, quaternion = se3.to_quaternion(poses)
    return se3.from_quaternion(position, quaternion[:, [3, 0, 1, 2]])


def wander(seed):
    """A truth of another recording: a random walk."""
    twist = np.random.default_rng(seed).normal(0, 0.02, (FRAMES, 6)).cumsum(axis=0)
    return lambda truth: Trajectory(truth.timestamps, se3.exp(twist))


BODY = se3.exp(np.zeros(6))
BODY[:3, :3] = [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]
LEVER = np.eye(4)
LEVER[:3, 3] = 0.15, -0.2, 0.0


FAULTS = {
    "truth-time-shift": {"truth": lambda truth: Trajectory(truth.timestamps + 0.2, truth.T_world_cam)},
    "truth-scale": {"truth": scaled(1000.0)},
    "truth-inverted": {"truth": of_poses(se3.inverse)},
    "truth-quaternion-order": {"truth": of_poses(w_first)},
    "truth-axes": {"truth": of_a_body(BODY)},
    "truth-lever-arm": {"truth": of_a_body(LEVER)},
    "truth-sparse": {"truth": lambda truth: Trajectory(truth.timestamps[::20], truth.T_world_cam[::20])},
    "camera-focal-length": {"camera": lambda camera: replace(camera, fx=2 * camera.fx, fy=2 * camera.fy)},
    "camera-principal-point": {"camera": lambda camera: replace(camera, cx=90.0)},
    "depth-factor": {"frame": lambda frame, _: (frame.rgb, frame.depth / 5)},
    "depth-units": {"frame": lambda frame, _: (frame.rgb, frame.depth * 1000)},
    "depth-byte-order": {
        "frame": lambda frame, _: (
            frame.rgb, (frame.depth * 5000).astype(np.uint16).byteswap().astype(np.float32) / 5000,
        )
    },
    "depth-not-registered": {"frame": lambda frame, _: (frame.rgb, np.roll(frame.depth, 30, axis=1))},
    "depth-empty": {"frame": lambda frame, _: (frame.rgb, np.zeros_like(frame.depth))},
    "depth-delay": {"frame": lambda frame, base: (frame.rgb, base[frame.index - 5].depth)},
    "colour-flipped": {"frame": lambda frame, _: (frame.rgb[::-1], frame.depth)},
    "colour-frozen": {"frame": lambda frame, base: (base[0].rgb, frame.depth)},
    "colour-blank": {"frame": lambda frame, _: (np.zeros_like(frame.rgb), frame.depth)},
}  # fmt: skip


def test_a_sound_recording_has_no_fault(sound):
    diagnosis = examine(sound)
    assert diagnosis.ok and diagnosis.findings == () and diagnosis.frames == FRAMES


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named(diagnosed, name):
    diagnosis = diagnosed(name)
    assert [finding.id for finding in diagnosis.findings if finding.severity == "fault"] == [name]
    assert not diagnosis.ok and all(finding.text and finding.cure for finding in diagnosis.findings)


@pytest.mark.parametrize(("name", "value"), [("truth-time-shift", 0.2), ("truth-scale", 1000.0), ("depth-factor", 5.0),
                                             ("camera-focal-length", 0.5), ("truth-lever-arm", 0.25)])  # fmt: skip
def test_a_fault_is_measured(diagnosed, name, value):
    (finding,) = diagnosed(name).findings
    assert finding.value == pytest.approx(value, rel=0.1)


def test_an_unrelated_truth_is_named_or_said_to_be_unclear(sound, pairs):
    truths = [wander(seed)(sound.ground_truth) for seed in (0, 1, 2)]
    ids = [finding.id for truth in truths for finding in truth_findings(sound.timestamps, truth, sound.camera, pairs)]
    assert ids == ["truth-unclear", "truth-other-sequence", "truth-unclear"]


def test_readings_undo_each_convention(sound):
    poses = sound.ground_truth.T_world_cam
    written = {
        "inverted": se3.inverse(poses),
        "w first": w_first(poses),
        "w first, inverted": w_first(se3.inverse(poses)),
    }
    for reading, file in written.items():
        np.testing.assert_allclose(read_as(file, reading), poses, atol=1e-9)
    assert set(written) < set(READINGS)


def test_without_truth_depth_or_motion_it_is_a_note(sound):
    def ids(sequence):
        return [(finding.severity, finding.id) for finding in examine(sequence).findings]

    assert ids(Altered(sound, truth=lambda _: None)) == [("note", "no-truth")]
    still = Altered(sound, frame=lambda frame, base: (base[0].rgb, base[0].depth),
                    truth=of_poses(lambda poses: np.tile(poses[:1], (len(poses), 1, 1))))  # fmt: skip
    assert ids(still) == [("note", "no-motion")]
    still.ground_truth = scaled(5.0)(sound.ground_truth)
    assert ids(still) == [("fault", "truth-other-sequence")]
    colour = Altered(sound, frame=lambda frame, _: (frame.rgb, np.zeros_like(frame.depth)))
    colour.has_depth = False
    assert ("note", "no-depth") in ids(colour) and all(severity == "note" for severity, _ in ids(colour))
    apart = Altered(sound, truth=lambda truth: Trajectory(truth.timestamps + 900, truth.T_world_cam))
    assert ids(apart) == [("fault", "truth-other-sequence")]


def test_damaged_folders_never_raise(tmp_path):
    assert [f.id for f in diagnose(tmp_path / "nothing").findings] == ["unreadable"]
    folder, _, depth = make_folder(tmp_path / "one")
    assert "too-short" in [f.id for f in diagnose(folder).findings]
    (folder / "rgb" / "2.png").write_bytes(b"no image")
    diagnosis = diagnose(folder)
    assert not diagnosis.ok and diagnosis.frames == 3 and diagnosis.findings[0].id == "unreadable"
    for index, image in enumerate(depth):
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), image[::2, ::2])
    assert [f.id for f in diagnose(folder).findings] == ["depth-size"]
    for index, image in enumerate(depth):
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), (image >> 8).astype(np.uint8))
    assert [f.id for f in diagnose(folder).findings] == ["depth-format"]
    (folder / "groundtruth.txt").write_text("1 2 3\n")
    assert [f.id for f in diagnose(folder).findings] == ["unreadable"]
    (folder / "groundtruth.txt").unlink()
    (folder / "depth.txt").unlink()
    shutil.rmtree(folder / "depth")
    assert [(f.id, f.severity) for f in diagnose(folder).findings] == [("no-depth", "fault")]


@pytest.mark.parametrize(("ids", "verdict"), [((), "no fault found"), (("note",), "could not be compared"),
                                              (("fault", "note"), "1 fault")])  # fmt: skip
def test_the_verdict_says_whether_the_truth_was_compared(ids, verdict):
    findings = tuple(Finding("truth-unclear", severity, 0.2, "", "unclear", "look") for severity in ids)
    assert Diagnosis("x", 40, findings).verdict.endswith(verdict)


def test_the_cure_of_turned_axes_is_their_inverse(diagnosed):
    (finding,) = diagnosed("truth-axes").findings
    rows = re.search(r"\[(.*)\]", finding.cure).group(1).split(";")
    cure = np.array([[float(value) for value in row.split(",")] for row in rows])
    np.testing.assert_allclose(BODY[:3, :3] @ cure, np.eye(3), atol=0.02)


@pytest.mark.parametrize("angle", [30, 40, 50, 85])
def test_the_cure_of_turned_axes_is_a_rotation(angle):
    R, _ = cv2.Rodrigues(np.array([np.radians(angle), 0, 0]))
    rows = _turn(R).split(";")
    cure = np.array([[float(value) for value in row.split(",")] for row in rows])
    np.testing.assert_allclose(cure @ cure.T, np.eye(3), atol=0.005)


def test_stretches_cover_a_short_recording_and_sample_a_long_one():
    assert stretches(95, 240) == [(0, 40), (40, 80), (80, 95)]
    parts = stretches(6000, 240)
    assert sum(stop - start for start, stop in parts) <= 240 and parts[0][0] == 0 and parts[-1][1] == 6000


@needs_shared
@pytest.mark.parametrize("name", ["tum/rgbd_dataset_freiburg1_rpy", "fixed_camera/man_130"])
def test_real_recordings_have_no_fault(name):
    assert diagnose(SHARED / "data" / name, most_frames=60).ok


# Readout time, delay of depth and depth factor, from exact points, a rendered sequence, and what cannot tell them.


CAMERA = Camera(320, 240, 260.0, 262.0, 160.0, 118.0)
FPS, WINDOW = 30.0, 12
NORMAL, DISTANCE = np.array([0.35, 0.5, 1.0]), 2.0
"""The world is the plane NORMAL . X = DISTANCE."""


def pose(times):
    """Rotations camera to world ``[N, 3, 3]`` and centres ``[N, 3]`` of a camera that is turned to and fro."""
    t = np.asarray(times)[:, None]
    angles = np.array([0.12, 0.15, 0.2]) * np.sin(2 * np.pi * np.array([1.1, 0.9, 1.3]) * t + (0.3, 1.2, 2.5))
    centres = 0.12 * np.sin(2 * np.pi * np.array([0.8, 1.2, 0.7]) * t + (0.0, 2.0, 4.0))
    return Rotation.from_rotvec(angles).as_matrix(), centres


def depth_image(stamp, readout_s):
    """Depth of the plane, every row from its own pose."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(float)
    R, centre = pose(stamp + ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5) * readout_s)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    along = np.einsum("rij,rcj,i->rc", R, rays, NORMAL)
    return ((DISTANCE - centre @ NORMAL)[:, None] / along).astype(np.float32)


def seen(points, stamp, readout_s):
    """Pixels ``[L, 2]`` of points, each by the pose of the row that it falls on; NaN outside of the image."""
    late = np.zeros(len(points))
    for _ in range(8):
        R, centre = pose(stamp + late)
        pixels = CAMERA.project(np.einsum("nji,nj->ni", R, points - centre))
        late = ((pixels[:, 1] + 0.5) / CAMERA.height - 0.5) * readout_s
    outside = ((pixels < 4) | (pixels > (CAMERA.width - 5, CAMERA.height - 5))).any(axis=1)
    return np.where(outside[:, None], np.nan, pixels)


def window(first, readout_s, delay_s, rng):
    """Exact tracks through some frames, but for a tenth of a pixel."""
    stamps = (first + np.arange(WINDOW)) / FPS
    at = rng.uniform(-1.5, 1.5, (150, 2))
    points = np.column_stack([at, (DISTANCE - at @ NORMAL[:2]) / NORMAL[2]])
    pixels = np.stack([seen(points, stamp, readout_s) for stamp in stamps], axis=1)
    pixels += rng.normal(0, 0.1, pixels.shape)
    depth = np.stack([depth_image(stamp + delay_s, readout_s) for stamp in stamps])
    return Window(CAMERA, stamps, pixels[np.isfinite(pixels[..., 0]).sum(1) >= 4], depth, np.zeros(WINDOW))


@pytest.mark.parametrize(("readout_s", "delay_s"), [(0.0, 0.0), (0.03, -0.034)])
def test_exact_points_give_back_readout_and_delay(readout_s, delay_s):
    rng = np.random.default_rng(3)
    readout, delay = adjust([window(first, readout_s, delay_s, rng) for first in (0, 12, 24, 36)])
    assert readout.value == pytest.approx(readout_s, abs=5e-4)
    assert delay.value == pytest.approx(delay_s, abs=1e-3)
    assert abs(readout.value - readout_s) < readout.half < 0.004
    assert abs(delay.value - delay_s) < delay.half < 0.004


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    sequence = open_synthetic("synthetic/fast_desk@0?frames=26", tmp_path_factory.mktemp("rendered"))
    other = Altered(sequence, truth=scaled(2.0), camera=lambda camera: replace(camera, readout_s=0.0))
    return calibrate(sequence), calibrate(other)


def test_a_rendered_rolling_shutter_is_measured(fast):
    readout, delay, factor = fast[0].quantities
    assert readout.value == pytest.approx(0.026, abs=0.003)
    assert readout.low < 0.026 < readout.high
    assert readout.observable
    assert readout.written is None, "it is what the camera states"
    assert delay.low < 0.0 < delay.high
    assert factor.low < 5000 < factor.high
    assert not fast[0].measured


def test_what_differs_from_the_camera_is_to_be_written(fast):
    readout, _, factor = fast[1].quantities
    assert fast[1].camera.readout_s == readout.written == pytest.approx(0.026, abs=0.003)
    assert factor.low < 2500 < factor.high
    assert fast[1].measured


def test_a_camera_file_keeps_the_delay_and_pairs_by_it(tmp_path):
    folder, _, raw = make_folder(tmp_path / "own")
    file = folder / "camera.toml"
    write_camera(file, replace(read_camera(file).camera(), depth_delay_s=1 / 30, readout_s=0.02), fps=30.0)
    assert read_camera(file).camera().depth_delay_s == 1 / 30
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    np.testing.assert_array_equal(sequence[0].depth, raw[0].astype(np.float32) / np.float32(5000))
    np.testing.assert_allclose(sequence.depth_timestamps, sequence.timestamps, atol=1e-6)
    part = open_sequence(folder, frames="1:")
    np.testing.assert_allclose(part.depth_timestamps, part.timestamps, atol=1e-6)


@pytest.fixture
def still(tmp_path):
    """A camera at rest before a textured wall."""
    folder, *_ = make_folder(tmp_path / "still", frames=18, width=320, height=240)
    (folder / "groundtruth.txt").unlink()
    write_camera(folder / "camera.toml", CAMERA, fps=FPS)
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    texture = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    for i in range(18):
        cv2.imwrite(str(folder / f"rgb/{i}.png"), texture)
        cv2.imwrite(str(folder / f"depth/{i}.png"), np.full((240, 320), 10000, np.uint16))
    return folder


def test_a_camera_at_rest_tells_nothing(still):
    found = calibrate(open_sequence(still))
    assert [each.observable for each in found.quantities] == [False] * 3
    assert all(each.reason for each in found.quantities)
    assert found.camera == CAMERA


@pytest.mark.parametrize("fault", ["frames", "black", "depth"])
def test_recordings_that_cannot_be_used_are_one_clear_line(still, fault):
    for i in range(18):
        if fault == "black":
            cv2.imwrite(str(still / f"rgb/{i}.png"), np.zeros((240, 320, 3), np.uint8))
        elif fault == "depth":
            cv2.imwrite(str(still / f"depth/{i}.png"), np.zeros((240, 320), np.uint16))
    sequence = open_sequence(still, frames="0:1" if fault == "frames" else None)
    with pytest.raises(SequenceError) as error:
        calibrate(sequence)
    assert {"frames": "1 frame", "black": "points", "depth": "depth"}[fault] in str(error.value)
    assert error.value.hint
