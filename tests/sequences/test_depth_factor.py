"""The depth factor by a truth, its interval, and what the doctor says where the data cannot tell."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.sequence_folders import SHARED, Altered, needs_shared

from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, in_camera_axes, nearest_rotation
from dynslam_bench.sequences import SequenceView, open_sequence
from dynslam_bench.sequences.calibration import CalibrationEstimate, Window, _readout_quantity
from dynslam_bench.sequences.depth_scale import DepthScale, depth_scale
from dynslam_bench.sequences.doctor import Diagnosis, Finding, examine, truth_findings
from dynslam_bench.sequences.rgbd_motion import RgbdPair, TruthMotion

pytestmark = pytest.mark.slow

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, depth_factor=5000.0)
STEP = 4
"""Frames from the first image of a pair to the second."""


class Recording:
    """Pairs of frames of a hand-held camera in a cloud of points, and their truth.

    Args:
        seed: Seed of the path, the points and the noise.
        frames: Frames at 30 Hz.
        speed: Metres a second, about.
        scale: By which the depth is too large.
        readout_s: Readout time of the rolling shutter, seconds.
        people: Part of the points that walk.
        turning: Standard deviation of the people's turn from image to image, rad.
        lever_m: Position of the camera on the body whose poses the truth holds, metres.
        late_s: By which the truth is late.
        noise_px: Standard deviation of the corners.
        followed: Whether the measured motions are those relative to the people: most corners lie on
            them.
    """

    def __init__(
        self,
        seed,
        frames=120,
        *,
        speed=0.3,
        scale=1.0,
        readout_s=0.0,
        people=0.0,
        turning=0.0,
        lever_m=0.0,
        late_s=0.0,
        noise_px=0.4,
        followed=False,
    ):
        rng = np.random.default_rng(seed)
        frequency = rng.uniform(0.2, 0.9, 6)
        phase = rng.uniform(0, 2 * np.pi, 6)
        size = np.array([speed] * 3 + [0.6] * 3) / frequency / 5

        def pose(stamps):
            return se3.exp(
                size * np.sin(2 * np.pi * frequency * np.asarray(stamps)[..., None] + phase)
            )

        self.stamps = np.arange(frames) / 30
        body = np.eye(4)
        body[0, 3] = lever_m
        truth_stamps = np.arange(-20, frames * 4) / 120
        self.truth = Trajectory(truth_stamps + late_s, pose(truth_stamps) @ body)
        self.camera = replace(CAMERA, readout_s=0.0)
        self.pairs = []
        for first in range(0, frames - STEP, STEP):
            pixels = rng.uniform((20, 20), (620, 460), (200, 2))
            depth = rng.uniform(1.0, 4.0, 200)
            world = self._seen(pose, self.stamps[first], pixels, depth, readout_s)
            walking = rng.random(200) < people
            walk = se3.exp(np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, turning, 3)]))
            world[walking] = world[walking] @ walk[:3, :3].T + walk[:3, 3]
            second = self._shown(pose, self.stamps[first + STEP], world, readout_s) + rng.normal(
                0, noise_px, (200, 2)
            )
            measured = scale * depth * (1 + rng.normal(0, 0.01, 200))
            walked = se3.inverse(walk) if followed else np.eye(4)
            motion = (
                se3.inverse(pose(self.stamps[first])) @ walked @ pose(self.stamps[first + STEP])
            )
            motion[:3, 3] *= scale
            moved = float(np.median(np.linalg.norm(second - pixels, axis=1)))
            self.pairs.append(
                RgbdPair(
                    first,
                    first + STEP,
                    pixels,
                    measured,
                    second,
                    walking == followed,
                    motion,
                    moved,
                    0.9,
                )
            )

    def _late(self, pixels, readout_s):
        return ((pixels[:, 1] + 0.5) / CAMERA.height - 0.5) * readout_s

    def _seen(self, pose, stamp, pixels, depth, readout_s):
        """The points in the world that a camera with a rolling shutter sees."""
        points = CAMERA.unproject(pixels, depth)
        T = pose(stamp + self._late(pixels, readout_s))
        return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]

    def _shown(self, pose, stamp, world, readout_s):
        """Their pixels at another time."""
        pixels = np.full((len(world), 2), CAMERA.height / 2)
        for _ in range(4):  # the row decides when, and when decides the row
            T = se3.inverse(pose(stamp + self._late(pixels, readout_s)))
            pixels = CAMERA.project(np.einsum("nij,nj->ni", T[:, :3, :3], world) + T[:, :3, 3])
        return pixels

    def measured(self):
        first = self.stamps[[pair.first for pair in self.pairs]]
        second = self.stamps[[pair.second for pair in self.pairs]]
        return depth_scale(self.pairs, TruthMotion(self.truth), first, second, self.camera, 1.0)


CONDITIONS = {
    "plain": {},
    "a rolling shutter": {"readout_s": 0.026},
    "a lever arm": {"lever_m": 0.03},
    "a late truth": {"late_s": 0.01},
    "people": {"people": 0.35},
    "slow": {"speed": 0.03},
    "short": {"frames": 50},
    "all of it": {"readout_s": 0.03, "lever_m": 0.02, "late_s": 0.008, "people": 0.3, "speed": 0.1},
}


@pytest.mark.parametrize("condition", CONDITIONS.values(), ids=CONDITIONS)
def test_the_interval_holds_the_right_scale(condition):
    scales = [(0.2, seed) for seed in range(3)] + [(1.0, seed) for seed in range(3, 6)]
    found = [
        (scale, Recording(seed, scale=scale, **condition).measured()) for scale, seed in scales
    ]
    within = [each.low <= scale <= each.high for scale, each in found]
    assert sum(within) >= 5, "95 % of many"
    assert all(each.high - each.low >= 0.11 * scale for scale, each in found), (
        "what all pairs share is in it"
    )


def test_the_interval_widens_with_what_is_not_known():
    """By a factor of ten slower, the same noise counts ten times as much."""
    fast, slow = (Recording(3, speed=speed, noise_px=3.0).measured() for speed in (0.4, 0.02))
    assert fast.high - fast.low < 0.25
    assert slow.high - slow.low > 0.4


def test_a_camera_at_rest_gives_no_scale():
    still = Recording(0, frames=50)
    still.truth = Trajectory(still.truth.timestamps, np.tile(np.eye(4), (len(still.truth), 1, 1)))
    assert still.measured() is None
    still.pairs = still.pairs[:5]
    assert still.measured() is None, "too few pairs"


@pytest.mark.parametrize(
    ("low", "high", "excluded"),
    [(1.05, 1.4, False), (1.11, 1.4, True), (0.5, 0.92, False), (0.5, 0.9, True)],
)
def test_a_scale_is_excluded_beyond_a_tenth(low, high, excluded):
    assert DepthScale(1.0, low, high).excludes(0.1) == excluded


def found_in(recording, **camera):
    """The findings, by id."""
    stated = replace(recording.camera, **camera)
    found = truth_findings(recording.stamps, recording.truth, stated, recording.pairs)
    return {finding.id: finding for finding in found}


@pytest.mark.parametrize(
    ("scale", "right", "seed"),
    [(0.2, 1000, 0), (5.0, 25000, 1), (1.3, 6500, 0), (0.02, 100, 1), (1 / 3.3, 1515, 0)],
)
def test_a_wrong_factor_is_named_with_an_interval_that_holds_the_right_one(scale, right, seed):
    found = found_in(Recording(seed, scale=scale))
    text = found["depth-factor"].text
    cure = found["depth-factor"].cure
    low, high = map(float, re.search(r"95 % interval ([\d.]+) to ([\d.]+)", text).groups())
    assert low < right < high < 1.2 * low
    assert found["depth-factor"].value == pytest.approx(1 / scale, rel=0.08)
    proposed = float(re.search(r"depth_factor = ([\d.]+)", cure).group(1))
    assert proposed == (right if right in (100, 1000) else pytest.approx(right, rel=0.08)), (
        "a usual one is taken"
    )


@pytest.mark.parametrize("scale", [1.0, 0.95, 1.06])
def test_a_factor_that_is_right_is_not_reported(scale):
    assert found_in(Recording(2, scale=scale)) == {}


def test_a_factor_that_the_data_cannot_tell_is_a_note():
    slow = Recording(4, speed=0.01, noise_px=3.0)
    (finding,) = found_in(slow).values()
    assert (finding.id, finding.severity) == ("depth-factor-unmeasured", "note")
    verdict = Diagnosis("x", 120, (finding,)).verdict
    assert verdict == "no fault found, but the depth factor could not be compared: ready"


@pytest.mark.parametrize(
    ("scale", "id", "severity"),
    [(1.0, "depth-factor-unmeasured", "note"), (0.2, "depth-factor", "fault")],
)
def test_with_little_depth_there_is_no_interval(scale, id, severity):
    """All corners may lie on one person then."""
    little = Recording(0, scale=scale)
    little.pairs = [replace(pair, depth_share=0.3) for pair in little.pairs]
    (finding,) = found_in(little).values()
    assert (finding.id, finding.severity) == (id, severity)
    assert "30 % of the image has depth" in finding.text
    assert "interval " not in finding.text


def of_markers(truth):
    """A truth in the camera's axes as the poses of Bonn's markers."""
    R = nearest_rotation(BONN_R_BODY_CAM)
    markers = truth.with_poses(
        se3.with_rotation(truth.T_world_cam, truth.T_world_cam[:, :3, :3] @ R.T)
    )
    np.testing.assert_allclose(
        in_camera_axes(markers.T_world_cam, BONN_R_BODY_CAM), truth.T_world_cam, atol=1e-9
    )
    return markers


@pytest.mark.parametrize("seed", [0, 1])
def test_the_truth_of_published_markers_is_no_fault_and_hides_none(seed):
    sound = Recording(seed)
    wrong = Recording(seed, scale=0.2)
    for each in (sound, wrong):
        each.truth = of_markers(each.truth)
    (finding,) = found_in(sound).values()
    assert (finding.id, finding.severity) == ("truth-markers", "note")
    assert finding.value == pytest.approx(172.7, abs=0.5)
    assert "bonn" in finding.cure
    assert set(found_in(wrong)) == {"truth-markers", "depth-factor"}


@pytest.mark.parametrize(
    "turn", [np.array([0, 0, np.pi / 2]), np.array([2.0, 0, 0]), np.array([0.5, -1, 1])]
)
def test_other_axes_are_a_fault(turn):
    """Axes that nobody publishes; the recordings' rotations tell them."""
    recording = Recording(1)
    poses = recording.truth.T_world_cam @ se3.exp(np.concatenate([np.zeros(3), turn]))
    recording.truth = recording.truth.with_poses(poses)
    (finding,) = found_in(recording).values()
    assert (finding.id, finding.severity) == ("truth-axes", "fault")
    assert np.radians(finding.value) == pytest.approx(np.linalg.norm(turn), abs=0.03)


@pytest.mark.parametrize(
    ("severities", "ids", "end"),
    [
        ((), (), ": ready"),
        (("note",), ("truth-markers",), "found: ready"),
        (("note",), ("no-truth",), ": ready"),
        (("fault",), ("depth-factor",), "1 fault: not ready"),
        (
            ("fault", "note", "fault"),
            ("depth-factor", "no-truth", "unreadable"),
            "2 faults: not ready",
        ),
    ],
)
def test_the_verdict_ends_with_whether_the_recording_is_ready(severities, ids, end):
    found = [
        Finding(id, severity, None, "", "t", "c")
        for id, severity in zip(ids, severities, strict=True)
    ]
    diagnosis = Diagnosis("x", 40, tuple(found))
    assert diagnosis.verdict.endswith(end)
    assert diagnosis.ok == (not diagnosis.verdict.endswith("not ready"))


@pytest.mark.parametrize("people", [0.55, 0.7, 0.8])
def test_people_who_turn_and_fill_the_view_make_no_fault_of_the_truth(people):
    """The motions that most corners agree on are the people's; the truth explains the other corners."""
    for scale in (1.0, 0.2):
        recording = Recording(0, people=people, turning=0.2, followed=True, scale=scale)
        (finding,) = found_in(recording).values()
        assert (finding.id, finding.severity) == ("truth-unclear", "note")
        assert "it is of this recording" in finding.text


@pytest.mark.parametrize("people", [0.55, 0.7])
@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_people_who_walk_and_fill_the_view_make_no_fault_of_the_depth(people, speed):
    sound = Recording(0, people=people, followed=True, speed=speed)
    assert all(finding.severity == "note" for finding in found_in(sound).values())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("people", [0.0, 0.7])
def test_the_truth_of_another_recording_is_not_taken_for_one_with_people(seed, people):
    recording = Recording(0, people=people, followed=people > 0)
    recording.truth = Recording(seed).truth
    findings = found_in(recording)
    assert set(findings) <= {"truth-other-sequence", "truth-unclear", "truth-axes"}
    assert all("it is of this recording" not in finding.text for finding in findings.values())


PARTS = [
    ("bonn/rgbd_bonn_crowd", 75, 195),
    ("bonn/rgbd_bonn_crowd", 0, 100),
    ("tum/rgbd_dataset_freiburg1_xyz", 0, 60),
]


@needs_shared
@pytest.mark.parametrize(("name", "start", "stop"), PARTS)
def test_real_depth_in_millimetres(name, start, stop):
    """Crowd's colour frames 300-419 were said to have 833.53 +- 7.9 %, or a truth turned by 172 degrees."""
    part = SequenceView(open_sequence(SHARED / "data" / name), start, stop)
    right = examine(Altered(part, camera=lambda camera: replace(camera, depth_factor=1000.0)))
    assert right.ok, right.findings
    assert right.verdict.endswith(": ready"), right.findings
    wrong = examine(Altered(part, frame=lambda frame, _: (frame.rgb, frame.depth / 5)))
    (fault,) = (finding for finding in wrong.findings if finding.severity == "fault")
    assert fault.id == "depth-factor"
    assert "depth_factor = 1000 " in fault.cure
    low, high = map(float, re.search(r"95 % interval ([\d.]+) to ([\d.]+)", fault.text).groups())
    assert low < 1000 < high


# Calibrated readout times.


def windows_at(fps):
    """Windows of which only the stamps count."""
    window = object.__new__(Window)
    window.stamps = np.arange(16) / fps
    window.R = np.tile(np.eye(3), (16, 1, 1))
    return [window] * 3


@pytest.mark.parametrize(
    ("fps", "stated_s", "value_s", "half_s", "written"),
    [
        (30, 0.0, 0.026, 0.002, 0.026),
        (30, 0.0, 0.0345, 0.002, 0.0333),
        (30, 0.0, 0.0333, 0.0001, 0.0333),
        (60, 0.0, 0.0180, 0.002, 0.0166),
        (30, 0.0, 0.0362, 0.001, None),
        (30, 0.0, 0.042, 0.010, None),
        (30, 0.0, 0.042, 0.013, None),
        (30, 0.05, 0.026, 0.002, 0.026),
        (30, 0.05, 0.042, 0.013, 0.0),
        (30, 0.05, 0.001, 0.003, 0.0),
        (30, 0.034, 0.033, 0.002, 0.033),
        (30, 0.026, 0.025, 0.002, None),
    ],
)
def test_no_readout_is_longer_than_the_time_between_frames(fps, stated_s, value_s, half_s, written):
    camera = replace(CAMERA, readout_s=stated_s)
    found = _readout_quantity(CalibrationEstimate(value_s, half_s), windows_at(fps), camera)
    assert found.written == written
    assert found.reason
    kept = camera.readout_s if found.written is None else found.written
    assert kept <= 1 / fps
