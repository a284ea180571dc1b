"""`sequences doctor`: faults put into a recording are named, a sound one has none, nothing makes it raise."""

import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from weakref import ref

import cv2
import numpy as np
import pytest
from helpers.envs_toys import write_sequence
from helpers.evaluation_walks import scaled, written_w_first
from helpers.sequence_folders import SHARED, Altered, frame_hash, make_folder, needs_shared, rewrite
from scipy.spatial.transform import Rotation

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.sequences import (
    Frame,
    FrameMasks,
    PreprocessingSettings,
    SequenceView,
    doctor,
    open_sequence,
)
from dynslam_bench.sequences import compose as composing
from dynslam_bench.sequences.calibration import calibrate
from dynslam_bench.sequences.camera_checks import axes_text
from dynslam_bench.sequences.cameras import read_camera, write_camera
from dynslam_bench.sequences.compose import compose
from dynslam_bench.sequences.doctor import (
    Diagnosis,
    Finding,
    diagnose,
    examine,
    stretches,
    truth_findings,
)
from dynslam_bench.sequences.preprocessing import Preprocessed, normalise
from dynslam_bench.sequences.rgbd_motion import rgbd_pairs
from dynslam_bench.sequences.synthetic import RenderSettings, open_synthetic
from dynslam_bench.sequences.synthetic.settings import ColorSensor
from dynslam_bench.sequences.view import SequencePart, Wrapped, sequence_part_of

FRAMES = 80


@pytest.fixture(scope="module")
def sound():
    """A rendered office without people, at half the size."""
    id = f"synthetic/walking_halfsphere?scene=1&frames={FRAMES}"
    # halving smooths enough
    settings = RenderSettings(
        people="none", antialias=False, color=ColorSensor(noise=False, shutter=0)
    )
    small = PreprocessingSettings(width=320, height=240)
    return Altered(Preprocessed(open_synthetic(id, None, settings=settings), small))


@pytest.fixture(scope="module")
def examined(sound):
    """What is found of the sound recording, and the motions that its truth was compared with."""
    measured = []

    def measure(frames, camera):
        pairs = list(rgbd_pairs(frames, camera))
        measured.extend(pairs)
        return pairs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(doctor, "rgbd_pairs", measure)
        return examine(sound), measured


@pytest.fixture(scope="module")
def pairs(examined):
    return examined[1]


@pytest.fixture(scope="module")
def diagnosed(sound, pairs):
    """What is found of a fault; faults of the truth alone share the images' motions."""

    @cache
    def found(name):
        if "truth" not in FAULTS[name]:
            return examine(SequenceView(Altered(sound, **FAULTS[name]), 0, 60))
        truth = FAULTS[name]["truth"](sound.ground_truth)
        return Diagnosis(
            sound.id, FRAMES, tuple(truth_findings(sound.timestamps, truth, sound.camera, pairs))
        )

    return found


def of_poses(change):
    return lambda truth: truth.with_poses(change(truth.T_world_cam))


def apart(truth):
    return Trajectory(truth.timestamps + 1000, truth.T_world_cam)


def moved_far(truth, index, distance_m):
    """One pose of the truth elsewhere."""
    poses = truth.T_world_cam.copy()
    poses[index, 0, 3] += distance_m
    return truth.with_poses(poses)


def wander(seed):
    """A truth of another recording: a random walk."""
    twist = np.random.default_rng(seed).normal(0, 0.02, (FRAMES, 6)).cumsum(axis=0)
    return lambda truth: Trajectory(truth.timestamps, se3.exp(twist))


BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
LEVER = se3.exp(np.array([0.15, -0.2, 0.0, 0, 0, 0]))


FAULTS = {
    "truth-time-shift": {"truth": lambda truth: Trajectory(truth.timestamps + 0.2, truth.T_world_cam)},
    "truth-scale": {"truth": lambda truth: scaled(truth, 1000.0)},
    "truth-inverted": {"truth": of_poses(se3.inverse)},
    "truth-quaternion-order": {"truth": written_w_first},
    "truth-quaternion-order, inverted": {"truth": lambda truth: written_w_first(of_poses(se3.inverse)(truth))},
    "truth-axes": {"truth": of_poses(lambda poses: poses @ BODY)},
    "truth-lever-arm": {"truth": of_poses(lambda poses: poses @ LEVER)},
    "truth-far": {"truth": lambda truth: moved_far(truth, 15, 1e9)},
    "truth-far, twice": {"truth": lambda truth: moved_far(moved_far(truth, 3, 50.0), 20, -2000.0)},
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


VALUES = {"truth-time-shift": 0.2, "truth-scale": 1000.0, "depth-factor": 5.0, "camera-focal-length": 0.5,
          "truth-lever-arm": 0.25}  # fmt: skip
"""The sizes of some of them."""


@pytest.mark.slow
def test_a_sound_recording_has_no_fault(sound, examined):
    assert examined[0] == Diagnosis(sound.id, FRAMES, ())


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_and_measured(diagnosed, name):
    diagnosis = diagnosed(name)
    (fault,) = (finding for finding in diagnosis.findings if finding.severity == "fault")
    assert fault.id == name.partition(",")[0]
    assert not diagnosis.ok
    assert all(finding.text and finding.cure for finding in diagnosis.findings)
    if name in VALUES:
        assert diagnosis.findings == (fault,)
        assert fault.value == pytest.approx(VALUES[name], rel=0.1)


@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_a_truth_in_another_unit_is_a_fault_where_the_images_tell_no_motion(sound, factor):
    truth = scaled(sound.ground_truth, factor)
    compared = (sound.timestamps, truth, sound.camera, [])
    first, second = truth_findings(*compared)
    assert (first.severity, first.id) == ("fault", "truth-far")
    assert "m/s by the median" in first.text
    assert "in metres" in first.cure
    assert (second.severity, second.id) == ("note", "motion-unmeasured")
    assert [
        found.id for found in truth_findings(sound.timestamps, sound.ground_truth, sound.camera, [])
    ] == ["motion-unmeasured"]


@pytest.mark.slow
def test_an_unrelated_truth_is_named_or_said_to_be_unclear(sound, pairs):
    truths = [wander(seed)(sound.ground_truth) for seed in (0, 1)]
    ids = [
        finding.id
        for truth in truths
        for finding in truth_findings(sound.timestamps, truth, sound.camera, pairs)
    ]
    assert ids == ["truth-unclear", "truth-other-sequence"]


REST = {"frame": lambda frame, base: (base[0].rgb, base[0].depth)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("severity", "finding", "changes"),
    [
        ("note", "no-truth", {"truth": lambda _: None}),
        (
            "note",
            "no-motion",
            REST | {"truth": of_poses(lambda poses: np.tile(poses[:1], (len(poses), 1, 1)))},
        ),
        ("note", "no-depth", {"frame": lambda frame, _: (frame.rgb, np.zeros_like(frame.depth))}),
        ("fault", "truth-other-sequence", REST | {"truth": lambda truth: scaled(truth, 5.0)}),
        ("fault", "truth-other-sequence", {"truth": apart}),
    ],
)
def test_without_truth_depth_or_motion_it_is_a_note(sound, severity, finding, changes):
    sequence = Altered(sound, **changes)
    sequence.has_depth = finding != "no-depth"
    findings = [
        (found.severity, found.id) for found in examine(SequenceView(sequence, 0, 40)).findings
    ]
    assert findings[0] == (severity, finding)
    assert finding == "no-depth" or len(findings) == 1
    assert {found for found, _ in findings} == {severity}


DAMAGES = {
    "too-short": lambda folder: None,
    "unreadable": lambda folder: (folder / "rgb" / "2.png").write_bytes(b"no image"),
    "unreadable, truth": lambda folder: (folder / "groundtruth.txt").write_text("1 2 3\n"),
    "unreadable, missing": shutil.rmtree,
    "unreadable, other clock": lambda folder: rewrite(
        folder / "depth.txt", lambda rows: [f"9{row}" for row in rows]
    ),
    "depth-size": lambda folder: fill(folder, "depth", np.full((12, 16), 9000, np.uint16)),
    "depth-format": lambda folder: fill(folder, "depth", np.full((24, 32), 90, np.uint8)),
    "no-depth": lambda folder: [(folder / "depth.txt").unlink(), shutil.rmtree(folder / "depth")],
}


def fill(folder, kind, image):
    """Make all of a folder's images of a kind the same."""
    for path in (folder / kind).iterdir():
        cv2.imwrite(str(path), image)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_folders_never_raise(tmp_path, damage):
    folder, *_ = make_folder(tmp_path / "one")
    DAMAGES[damage](folder)
    diagnosis = diagnose(folder)
    assert diagnosis.frames == {"too-short": 4, "unreadable": 3}.get(damage, 0)
    ids = [finding.id for finding in diagnosis.findings]
    assert damage.partition(",")[0] in ids
    assert not diagnosis.ok
    assert len(ids) == 1 or diagnosis.frames, "a folder that cannot be opened has one fault"


@pytest.mark.parametrize(("ids", "verdict"), [((), "no fault found"), (("note",), "could not be compared"),
                                              (("fault", "note"), "1 fault")])  # fmt: skip
def test_the_verdict_says_whether_the_truth_was_compared(ids, verdict):
    findings = tuple(
        Finding("truth-unclear", severity, 0.2, "", "unclear", "look") for severity in ids
    )
    assert verdict in Diagnosis("x", 40, findings).verdict


def matrix_of(text):
    return np.array([[float(value) for value in row.split(",")] for row in text.split(";")])


@pytest.mark.slow
def test_the_cure_of_turned_axes_is_their_inverse_and_a_rotation(diagnosed):
    (finding,) = diagnosed("truth-axes").findings
    cure = matrix_of(re.search(r"\[(.*)\]", finding.cure).group(1))
    np.testing.assert_allclose(BODY[:3, :3] @ cure, np.eye(3), atol=0.02)
    for angle in (30, 40, 50, 85):
        cure = matrix_of(axes_text(Rotation.from_euler("x", angle, degrees=True).as_matrix()))
        np.testing.assert_allclose(cure @ cure.T, np.eye(3), atol=0.005)


def test_stretches_cover_a_short_recording_and_sample_a_long_one():
    assert stretches(95, 240) == [(0, 40), (40, 80), (80, 95)]
    parts = stretches(6000, 240)
    assert sum(stop - start for start, stop in parts) <= 240
    assert parts[0][0] == 0
    assert parts[-1][1] == 6000


@pytest.mark.slow
@needs_shared
@pytest.mark.parametrize("name", ["tum/rgbd_dataset_freiburg1_rpy", "fixed_camera/man_130"])
def test_real_recordings_have_no_fault(name):
    assert diagnose(SHARED / "data" / name, most_frames=60).ok


# Readout time, delay of depth and depth factor, of a rendered sequence and of what cannot tell
# them.


PINHOLE = Camera(320, 240, 260.0, 262.0, 160.0, 118.0, depth_factor=5000.0)
FPS = 30.0


@pytest.mark.slow
def test_a_rendered_rolling_shutter_is_measured_and_what_differs_is_to_be_written(tmp_path):
    sequence = open_synthetic("synthetic/fast_desk@0?frames=20", tmp_path)
    stated = calibrate(sequence)
    readout, delay, factor = stated.quantities
    assert readout.value == pytest.approx(0.026, abs=0.003)
    assert readout.low < 0.026 < readout.high
    assert delay.low < 0.0 < delay.high
    assert factor.low < 5000 < factor.high
    assert readout.observable, "it is what the camera states"
    assert not stated.measured, "it is what the camera states"
    truth, camera = scaled(sequence.ground_truth, 2.0), replace(sequence.camera, readout_s=0.0)

    def late(frame, base):
        """Its depth is that of the next frame."""
        return frame.rgb, base[min(frame.index + 1, len(base) - 1)].depth

    other = calibrate(Altered(sequence, frame=late, truth=lambda _: truth, camera=lambda _: camera))
    readout, delay, factor = other.quantities
    assert other.camera.readout_s == readout.written == pytest.approx(0.026, abs=0.003)
    assert other.camera.depth_delay_s == delay.written == pytest.approx(1 / FPS, abs=0.003)
    assert factor.low < 2500 < factor.high
    assert other.measured


def test_a_camera_file_keeps_the_delay_and_pairs_by_it(tmp_path):
    folder, _, raw = make_folder(tmp_path / "own")
    file = folder / "camera.toml"
    write_camera(file, replace(read_camera(file).camera(), depth_delay_s=1 / 30), fps=30.0)
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    np.testing.assert_array_equal(sequence[0].depth, raw[0].astype(np.float32) / np.float32(5000))
    for part in (sequence, open_sequence(folder, frames="1:")):
        np.testing.assert_allclose(part.depth_timestamps, part.timestamps, atol=1e-6)


@pytest.fixture
def still(tmp_path):
    """A camera at rest before a textured wall."""
    folder, *_ = make_folder(tmp_path / "still", frames=18, width=320, height=240)
    (folder / "groundtruth.txt").unlink()
    write_camera(folder / "camera.toml", PINHOLE, fps=FPS)
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    fill(folder, "rgb", cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))
    fill(folder, "depth", np.full((240, 320), 10000, np.uint16))
    return folder


@pytest.mark.slow
def test_a_camera_at_rest_tells_nothing(still):
    found = calibrate(open_sequence(still))
    assert not any(each.observable for each in found.quantities)
    assert all(each.reason for each in found.quantities)
    assert found.camera == PINHOLE


@pytest.mark.parametrize(
    ("kind", "image", "frames", "words"),
    [
        ("rgb", np.zeros((240, 320, 3), np.uint8), ":", "points"),
        ("depth", np.zeros((240, 320), np.uint16), ":", "depth"),
        ("depth", np.full((240, 320), 10000, np.uint16), "0:1", "1 frame"),
    ],
)
def test_recordings_that_cannot_be_used_are_one_clear_line(still, kind, image, frames, words):
    fill(still, kind, image)
    with pytest.raises(SequenceError, match=words) as error:
        calibrate(open_sequence(still, frames=frames))
    assert error.value.hint


ROOM_CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5, depth_factor=5000.0)


class Room:
    """A wall of noise at some distance; a box of another colour walks before it if `walker` says so."""

    fps = 30.0
    license = ""
    citation = ""
    masks = None

    def __init__(self, id, frames=10, *, wall_m=3.0, walker=False, moving=False, seed=0):
        rng = np.random.default_rng(seed)
        self.id = id
        self.camera = ROOM_CAMERA
        self.walker = walker
        self.wall_m = wall_m
        self.wall = rng.integers(60, 200, (120, 160, 3)).astype(np.uint8)
        self.timestamps = 1000 + np.arange(frames) / 30
        poses = np.tile(np.eye(4), (frames, 1, 1))
        poses[:, 0, 3] = 0.005 * np.arange(frames) * moving
        self.ground_truth = Trajectory(self.timestamps, poses)

    def __len__(self):
        return len(self.timestamps)

    def __getitem__(self, index):
        rgb = self.wall.copy()
        depth = np.full((120, 160), self.wall_m, np.float32)
        if self.walker and 2 <= index < len(self) - 2:
            left = 20 + 6 * index
            rgb[20:110, left : left + 25] = (200, 40, 40)
            depth[20:110, left : left + 25] = 2.0
        return Frame(index, float(self.timestamps[index]), rgb, depth)


class Watched(Wrapped):
    """A wrapped sequence whose `most` is the largest number of its images that existed at once."""

    def __init__(self, base):
        self.base = base
        self.images = []
        self.most = 0

    def __len__(self):
        return len(self.base)

    def __getitem__(self, index):
        frame = self.base[index]
        self.images.append(ref(frame.rgb))
        self.most = max(self.most, sum(image() is not None for image in self.images))
        return frame


@pytest.fixture(scope="module", autouse=True)
def few_places():
    """Three places are tried for each person, not twelve."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(composing, "_PLACES", 3)
        patch.setattr(composing, "Cutouts", cache(composing.Cutouts))  # of one recording once
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Host, people and the composite of instance 0, as folders."""
    folder = tmp_path_factory.mktemp("composites")
    host = write_sequence(folder / "host", Room("host", 4, moving=True, seed=1))
    people = write_sequence(folder / "people", Room("people", 10, walker=True))
    compose(open_sequence(str(host)), open_sequence(str(people)), folder / "made", 0)
    return folder


@pytest.fixture(scope="module")
def host(folder):
    return open_sequence(folder / "host")


@pytest.fixture(scope="module")
def people(folder):
    return open_sequence(folder / "people")


@pytest.mark.slow
def test_only_people_and_their_shadow_differ_from_the_host(host, folder):
    composed = open_sequence(str(folder / "made"))
    assert len(composed) == 4
    assert np.array_equal(composed.ground_truth.T_world_cam, host.ground_truth.T_world_cam)
    shares = []
    for before, after in zip(
        (host[i] for i in range(4)), (composed[i] for i in range(4)), strict=True
    ):
        masks = composed.masks[after.index]
        person = masks.instances > 0
        assert masks.moving == set(np.unique(masks.instances)) - {0}
        assert set(masks.class_names.values()) <= {"person"}
        around = cv2.dilate(person.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert np.array_equal(after.rgb[~around], before.rgb[~around])
        core = cv2.erode(person.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        assert (after.rgb[core][:, 0] > after.rgb[core][:, 1] + 20).all(), "the walker is red"
        shadow = ~person & (after.depth == 0)
        assert np.array_equal(after.depth[~person & ~shadow], before.depth[~person & ~shadow])
        assert (after.depth[person] < before.depth[person]).all(), "people hide what is behind them"
        assert shadow.sum() < 0.3 * max(person.sum(), 1)
        shares.append(person.mean())
    assert np.mean(shares) > 0.03


@pytest.mark.slow
def test_an_instance_repeats_and_another_one_differs(host, people, folder, tmp_path):
    again = compose(host, people, tmp_path / "made", 0)
    other = compose(host, people, tmp_path / "other" / "made", 1)
    digests = [
        open_sequence(str(place)).digest()
        for place in (folder / "made", again.folder, other.folder)
    ]
    assert digests[0] == digests[1] != digests[2]
    assert again.share == np.mean(
        [np.mean(open_sequence(str(again.folder)).masks[i].instances > 0) for i in range(4)]
    )


@pytest.mark.slow
def test_images_are_not_held(host, tmp_path):
    people = Watched(Room("people", 22, walker=True))
    compose(host, people, tmp_path / "made", 0)
    assert people.most < 20


@pytest.mark.slow
def test_masks_count_as_content_and_have_to_be_there(folder, tmp_path):
    made = shutil.copytree(folder / "made", tmp_path / "made")
    before = open_sequence(str(made)).digest()
    path = min((made / "people").iterdir())
    cv2.imwrite(str(path), np.zeros((120, 160), np.uint8))
    assert open_sequence(str(made)).digest() != before
    path.unlink()
    with pytest.raises(SequenceError, match="1 of 4 mask images"):
        open_sequence(str(made))
    rewrite(made / "people.txt", lambda lines: lines[1:])
    with pytest.raises(SequenceError, match="1 of 4 frames"):
        open_sequence(str(made))


def rolled(frame, _):
    """What a camera that turns sees: each image lies 4 px further to the right."""
    return (np.roll(image, 4 * frame.index, axis=1) for image in (frame.rgb, frame.depth))


MOVING = of_poses(lambda poses: se3.exp(0.01 * np.arange(len(poses))[:, None] * np.eye(6)[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda host, people: (Altered(host, truth=lambda _: None), people), "no ground truth"),
        (lambda host, people: (Altered(host, truth=apart), people), "4 of 4 frames .* lie outside"),
        (lambda host, people: (Room("dark", 4, wall_m=0.0), people), "nobody can be seen"),
        (
            lambda host, people: (open_sequence(host.folder.parent / "made"), people),
            "has people already",
        ),
        (lambda host, people: (host, Altered(people, truth=MOVING)), "moves"),
        (
            lambda host, people: (host, Altered(people, truth=lambda _: None, frame=rolled)),
            r"moves: its images shift by \d",
        ),
        (lambda host, people: (host, Room("empty")), "nobody walks"),
    ],
)
def test_what_cannot_be_composed_is_said(host, people, tmp_path, change, message):
    with pytest.raises(SequenceError, match=message):
        compose(*change(host, people), tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_a_folder_that_exists_is_left_alone(host, people, tmp_path):
    (tmp_path / "thesis.tex").write_text("work")
    with pytest.raises(SequenceError, match="exists already"):
        compose(host, people, tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "work"


@pytest.mark.slow
@needs_shared
def test_a_real_person_is_pasted_into_a_real_recording(tmp_path):
    host = open_sequence(str(SHARED / "data/tum/rgbd_dataset_freiburg1_rpy"), frames="0:3")
    people = open_sequence(str(SHARED / "data/fixed_camera/man_130"), frames="0:60", stride=3)
    made = compose(host, people, tmp_path / "made", 3)
    composed = open_sequence(str(tmp_path / "made"))
    assert 0.1 < made.share < 0.7
    assert composed.camera == host.camera
    person = composed.masks[2].instances > 0
    assert np.median(composed[2].depth[person]) < np.median(
        host[2].depth[person & (host[2].depth > 0)]
    )


LENS = Camera(160, 120, 130.0, 131.0, 80.5, 58.0, (0.26, -0.95, -0.005, 0.003, 1.16))


class Memory(list):
    """Frames in memory, with masks."""

    id = "memory"
    license = ""
    citation = ""
    fps = 30.0
    ground_truth = None
    camera = LENS

    def digest(self):
        return "d"


def preprocessed(rgb, depth, **settings):
    """One frame with masks, preprocessed."""
    memory = Memory([Frame(0, 1.0, rgb, depth)])
    memory.masks = [FrameMasks((depth > 2).astype(np.int32), {1: "person"}, frozenset({1}))]
    return Preprocessed(memory, PreprocessingSettings(**settings))


def dots(points):
    """A black image with soft white dots at float pixel positions."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    image = np.zeros(u.shape)
    for x, y in points:
        image += np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.5**2))
    return np.repeat((255 * image.clip(0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def centroid(image, near, radius=5):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = image[..., 0] * (np.hypot(u - near[0], v - near[1]) <= radius)
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def test_undistortion_moves_points_where_the_camera_model_says():
    ideal = np.array([[30.0, 25.0], [120.0, 30.0], [40.0, 95.0], [125.0, 90.0], [80.0, 60.0]])
    distorted = LENS.distort_points(ideal)
    assert np.abs(distorted - ideal).max() > 1  # the lens matters here
    sequence = preprocessed(dots(distorted), np.ones((120, 160), np.float32), undistort=True)
    assert not sequence.camera.is_distorted
    assert sequence.camera.fx == LENS.fx
    for point in ideal:
        assert np.abs(centroid(sequence[0].rgb, point) - point).max() < 0.1


@pytest.mark.parametrize(("width", "height"), [(80, 60), (320, 240), (100, 90)])
def test_resize_scales_the_intrinsics_along(width, height):
    points = np.array([[30.0, 25.0], [121.0, 31.0], [40.0, 95.0]])
    sequence = preprocessed(
        dots(points), np.full((120, 160), 2.0, np.float32), width=width, height=height
    )
    frame = sequence[0]
    camera = sequence.camera
    assert frame.rgb.shape == (height, width, 3)
    assert frame.depth.shape == (height, width)
    for point in points:
        ray = LENS.unproject(point, np.array(2.0))
        assert (
            np.abs(centroid(frame.rgb, camera.project(ray), 6) - camera.project(ray)).max() < 0.12
        )


def test_depth_and_masks_are_never_averaged():
    depth = np.where(np.mgrid[:120, :160][1] < 77, 1.0, 4.0).astype(np.float32)
    depth[10:20, 10:20] = 0
    sequence = preprocessed(dots([]), depth, width=100, height=70, undistort=True)
    frame = sequence[0]
    masks = sequence.masks[0]
    assert set(np.unique(frame.depth)) == {0.0, 1.0, 4.0}
    assert (masks.instances.shape, masks.instances.dtype, masks.moving) == (
        (70, 100),
        np.int32,
        {1},
    )
    assert ((masks.instances == 1) == (frame.depth > 2)).all()


def test_mean_std_reaches_its_target():
    grey = np.repeat(
        np.random.default_rng(0).normal(60, 12, (120, 160, 1)).clip(0, 255).astype(np.uint8),
        3,
        axis=2,
    )
    settings = PreprocessingSettings(normalisation="mean-std", target_mean=0.5, target_std=0.2)
    result = cv2.cvtColor(normalise(grey, settings), cv2.COLOR_RGB2GRAY) / 255
    assert result.mean() == pytest.approx(0.5, abs=0.005)
    assert result.std() == pytest.approx(0.2, abs=0.01)
    flat = normalise(np.full((8, 8, 3), 200, np.uint8), settings)
    assert flat.std() == 0
    assert flat.mean() == pytest.approx(127, abs=1)


def test_equalisation_spreads_a_dark_image_and_keeps_the_hue():
    dark = np.random.default_rng(1).integers(0, 40, (120, 160, 3), dtype=np.uint8)
    for name in ("equalise", "clahe"):
        result = normalise(dark, PreprocessingSettings(normalisation=name))
        assert result.dtype == np.uint8
        assert result.shape == dark.shape
        after, before = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).std() for image in (result, dark))
        assert after > 1.5 * before
    gray = np.repeat(dark[..., :1], 3, axis=2)
    balanced = normalise(gray, PreprocessingSettings(normalisation="equalise"))
    assert (np.ptp(balanced.astype(int), axis=2) <= 1).all()
    assert (balanced[..., 0] == cv2.equalizeHist(gray[..., 0])).mean() > 0.99


# What part of which sequence is seen: one identity for every spelling, and for repeats of one
# problem instance.


WALK = "synthetic/walking_xyz"


def part(name: object, offset: int = 0, **how: object) -> SequencePart:
    return sequence_part_of(open_sequence(str(name), **how), offset)


def test_all_spellings_of_the_same_frames_are_one_part() -> None:
    first = part(f"{WALK}?frames=60")
    spellings = [
        (WALK, "0:60"), (f"{WALK}?scene=0", (0, 60)), (f"{WALK}?scene=000&frames=60", None),
        (f"{WALK}?frames=100", ":60"), (f"{WALK}?frames=60", "0:90"), (f"{WALK}?frames=60", "0:"),
    ]  # fmt: skip
    assert all(part(name, frames=frames) == first for name, frames in spellings)
    assert first.id == f"{WALK}?scene=0"
    assert part(WALK) == part(f"{WALK}?frames=600")


def test_other_frames_scenes_strides_and_cameras_are_other_problem_instances() -> None:
    others = [
        part(WALK),
        part(WALK, frames="0:60"),
        part(WALK, frames="1:60"),
        part(WALK, frames="0:60", stride=2),
        part(f"{WALK}?scene=1", frames="0:60"),
        part("synthetic/walking_rpy", frames="0:60"),
    ]
    assert len({each.block for each in others}) == len(others)


def test_offset_and_noise_are_repeats_of_one_problem_instance() -> None:
    plain = part(WALK, frames="0:60")
    noisy = part(f"{WALK}?noise=7", frames="0:60")
    assert plain.block == part(WALK, frames="3:60", offset=3).block == noisy.block
    assert part(WALK, frames="3:60").block != plain.block, (
        "without an offset these are other frames"
    )
    assert noisy.content != plain.content
    assert noisy.noise == 7
    assert noisy.id != plain.id
    assert noisy.content != part(f"{WALK}?noise=8").content


def test_recorded_folders_by_any_path_and_preprocessing(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")[0]
    first = part(folder)
    assert part(f"{tmp_path}/./a", frames="0:4") == first
    small = part(folder, preprocessing=PreprocessingSettings(width=24, height=18))
    assert small.block == first.block, "preprocessing is a tracker's setting, not another recording"
    shutil.copytree(folder, tmp_path / "else" / "a")
    assert part(tmp_path / "else" / "a") == first, "a copy is the same recording"
    assert part(folder, camera=replace(open_sequence(folder).camera, fx=31.0)).block != first.block
    other = make_folder(tmp_path / "b" / "a", start=200.0)[0]
    assert part(other).block != first.block, "another recording in a folder of the same name is not"


@pytest.mark.slow
def test_a_noise_seed_changes_the_noise_and_nothing_else(tmp_path: Path) -> None:
    ids = [f"{WALK}?scene=3&frames=2{noise}" for noise in ("", "&noise=1", "&noise=2")]
    plain, one, two = (open_synthetic(name, tmp_path) for name in ids)
    assert frame_hash(plain[1])[:16] == "8ed2db9ef4f896d1", "scenes keep their bytes"
    assert len({frame_hash(each[1]) for each in (plain, one, two)}) == 3
    assert frame_hash(one[1]) == frame_hash(
        open_synthetic(f"{WALK}?scene=3&frames=2&noise=1", None)[1]
    )
    assert frame_hash(one[1]) == frame_hash(one[1]), "read back from a folder of its own"
    assert np.array_equal(plain.exact_depth(1), one.exact_depth(1))
    assert np.array_equal(plain.masks[1].instances, one.masks[1].instances)
    assert np.array_equal(plain.ground_truth.T_world_cam, one.ground_truth.T_world_cam)
    difference = np.abs(plain[1].rgb.astype(int) - one[1].rgb.astype(int))
    assert 0.3 < difference.mean() < 5, "grey levels: noise, no other picture"
    assert difference.max() < 40, "grey levels: noise, no other picture"
