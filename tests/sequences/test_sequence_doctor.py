"""`sequences doctor`: faults put into a recording are named, a sound one has none, nothing makes it raise."""

import re
import shutil
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from sequence_folders import SHARED, make_folder, needs_shared

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.doctor import Diagnosis, diagnose, examine, stretches
from dynslam_bench.sequences.rgbd_motion import READINGS, read_as, rgbd_pairs
from dynslam_bench.sequences.stream_checks import Finding
from dynslam_bench.sequences.truth_checks import truth_findings

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
FRAMES = 80


class Rendered:
    """A textured box seen from inside by a camera that swings: exact colour, depth and poses."""

    id, camera, masks, fps, license, citation = "test/box", CAMERA, None, 30.0, "CC0-1.0", ""

    def __init__(self):
        t = np.arange(FRAMES) / 30.0
        swing = np.stack([0.25 * np.sin(2.3 * t), 0.12 * np.sin(3.1 * t + 1), 0.2 * np.sin(1.7 * t)], axis=1)
        turn = np.stack([0.2 * np.sin(2.9 * t + 2), 0.3 * np.sin(2.1 * t), 0.15 * np.sin(3.7 * t + 1)], axis=1)
        self.timestamps = 100.0 + t
        self.ground_truth = Trajectory(self.timestamps, se3.exp(np.concatenate([swing, turn], axis=1)))
        rng = np.random.default_rng(3)
        noise = rng.integers(0, 255, (3, 40, 40), dtype=np.uint8)
        self.walls = [cv2.resize(each, (800, 800), interpolation=cv2.INTER_AREA) for each in noise]
        rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
        self.rays = np.stack(
            [(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)], -1
        )
        self.posts = np.random.default_rng(5).uniform((-1.2, -0.7, 1.2), (1.2, 0.7, 2.0), (9, 3))
        self.frames = [self._render(index) for index in range(FRAMES)]

    def _render(self, index):
        pose = self.ground_truth.T_world_cam[index]
        ways, start = self.rays @ pose[:3, :3].T, pose[:3, 3]
        half = np.array([2.0, 1.5, 2.6])
        with np.errstate(divide="ignore"):
            reach = (np.sign(ways) * half - start) / ways
        side = reach.argmin(axis=2)
        depth = np.take_along_axis(reach, side[..., None], 2)[..., 0]
        hit = start + depth[..., None] * ways
        u = np.where(side == 0, hit[..., 1], hit[..., 0]) * 150 + 400
        v = np.where(side == 2, hit[..., 1], hit[..., 2]) * 120 + 400
        gray = np.zeros(depth.shape, np.uint8)
        for wall in range(3):
            gray[side == wall] = self.walls[wall][v[side == wall].astype(int) % 800, u[side == wall].astype(int) % 800]
        for number, centre in enumerate(self.posts):  # balls in front, whose outlines are contours of both images
            offset = start - centre
            a, b, c = (ways**2).sum(-1), (ways * offset).sum(-1), offset @ offset - 0.16**2
            root = b * b - a * c
            near = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
            front = (near > 0.1) & (near < depth)
            depth = np.where(front, near, depth)
            gray[front] = 40 + 170 * (number % 2)
        rgb = np.repeat(cv2.GaussianBlur(gray, (3, 3), 0.8)[..., None], 3, axis=2)
        return Frame(index, float(self.timestamps[index]), rgb, depth.astype(np.float32))

    def __len__(self):
        return FRAMES

    def __getitem__(self, index):
        return self.frames[index]


class Altered:
    """A sequence with other frames, truth or camera."""

    def __init__(self, base, *, frame=None, truth=None, camera=None):
        self.base, self.frame = base, frame
        self.ground_truth = base.ground_truth if truth is None else truth(base.ground_truth)
        self.camera = camera or base.camera

    def __getattr__(self, name):
        return getattr(self.base, name)

    def __len__(self):
        return len(self.base)

    def __getitem__(self, index):
        frame = self.base[index]
        if self.frame is None:
            return frame
        rgb, depth = self.frame(frame, self.base)
        return Frame(frame.index, frame.timestamp, np.ascontiguousarray(rgb), np.ascontiguousarray(depth))


@pytest.fixture(scope="module")
def sound():
    return Rendered()


@pytest.fixture(scope="module")
def diagnosed(sound):
    return cache(lambda name: examine(Altered(sound, **FAULTS[name])))


def of_poses(change):
    return lambda truth: Trajectory(truth.timestamps, change(truth.T_world_cam))


def of_a_body(pose):
    return of_poses(lambda poses: poses @ pose)


def scaled(factor):
    def change(poses):
        poses = poses.copy()
        poses[:, :3, 3] *= factor
        return poses

    return of_poses(change)


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
    "camera-focal-length": {"camera": replace(CAMERA, fx=520.0, fy=520.0)},
    "camera-principal-point": {"camera": replace(CAMERA, cx=90.0)},
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


def test_an_unrelated_truth_is_named_or_said_to_be_unclear(sound):
    pairs = [pair for start in range(0, FRAMES, 40) for pair in rgbd_pairs(sound.frames[start : start + 40], CAMERA)]
    found = [truth_findings(sound.timestamps, wander(k)(sound.ground_truth), CAMERA, pairs) for k in (8, 9, 10)]
    ids = [finding.id for (finding,) in found]
    assert set(ids) <= {"truth-other-sequence", "truth-unclear"} and "truth-other-sequence" in ids


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

    without = Altered(sound)
    without.ground_truth = None
    assert ids(without) == [("note", "no-truth")]
    still = Altered(sound, frame=lambda frame, base: (base[0].rgb, base[0].depth),
                    truth=of_poses(lambda poses: np.tile(poses[:1], (len(poses), 1, 1))))  # fmt: skip
    assert ids(still) == [("note", "no-motion")]
    still.ground_truth = sound.ground_truth
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


def test_the_verdict_says_whether_the_truth_was_compared():
    note = Finding("truth-unclear", "note", 0.2, "", "unclear", "look")
    fault = Finding("truth-scale", "fault", 1000.0, "", "millimetres", "divide")
    verdicts = [Diagnosis("x", 40, findings).verdict for findings in ((), (note,), (fault, note))]
    assert verdicts[0] == "no fault found" and verdicts[2] == "1 fault"
    assert "could not be compared" in verdicts[1]


def test_the_cure_of_turned_axes_is_their_inverse(diagnosed):
    (finding,) = diagnosed("truth-axes").findings
    rows = re.search(r"\[(.*)\]", finding.cure).group(1).split(";")
    cure = np.array([[float(value) for value in row.split(",")] for row in rows])
    np.testing.assert_allclose(BODY[:3, :3] @ cure, np.eye(3), atol=0.02)


def test_a_folder_without_depth_is_named(tmp_path):
    folder, _, _ = make_folder(tmp_path / "one")
    (folder / "depth.txt").unlink(missing_ok=True)
    shutil.rmtree(folder / "depth")
    (finding,) = diagnose(folder).findings
    assert (finding.id, finding.severity) == ("no-depth", "fault")


def test_stretches_cover_a_short_recording_and_sample_a_long_one():
    assert stretches(95, 240) == [(0, 40), (40, 80), (80, 95)]
    parts = stretches(6000, 240)
    assert sum(stop - start for start, stop in parts) <= 240 and parts[0][0] == 0 and parts[-1][1] == 6000


@needs_shared
@pytest.mark.parametrize("name", ["tum/rgbd_dataset_freiburg1_rpy", "fixed_camera/man_130"])
def test_real_recordings_have_no_fault(name):
    assert diagnose(SHARED / "data" / name, most_frames=60).ok
