"""People of a fixed camera's recording, pasted into another one: exact masks, the host's pixels and poses elsewhere."""

import shutil
from weakref import finalize

import cv2
import numpy as np
import pytest
from envs_toys import write_sequence
from sequence_folders import SHARED, needs_shared

from dynslam_bench.contracts import Frame
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.compose import compose
from dynslam_bench.sequences.view import Wrapped

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


class Room:
    """A wall of noise at some distance; a box of another colour walks before it if `walker` says so."""

    fps, license, citation, masks = 30.0, "", "", None

    def __init__(self, id, frames=10, *, wall_m=3.0, walker=False, moving=False, seed=0):
        rng = np.random.default_rng(seed)
        self.id, self.camera, self.walker, self.wall_m = id, CAMERA, walker, wall_m
        self.wall = rng.integers(60, 200, (120, 160, 3)).astype(np.uint8)
        self.timestamps = 1000 + np.arange(frames) / 30
        poses = np.tile(np.eye(4), (frames, 1, 1))
        poses[:, 0, 3] = 0.005 * np.arange(frames) * moving
        self.ground_truth = Trajectory(self.timestamps, poses)

    def __len__(self):
        return len(self.timestamps)

    def __getitem__(self, index):
        rgb, depth = self.wall.copy(), np.full((120, 160), self.wall_m, np.float32)
        if self.walker and 2 <= index < len(self) - 2:
            left = 20 + 6 * index
            rgb[20:110, left : left + 25] = (200, 40, 40)
            depth[20:110, left : left + 25] = 2.0
        return Frame(index, float(self.timestamps[index]), rgb, depth)


class Watched(Wrapped):
    """The same; `most` counts the largest number of its images that existed at once."""

    def __init__(self, base):
        self.base, self.now, self.most = base, 0, 0

    def __len__(self):
        return len(self.base)

    def __getitem__(self, index):
        frame = self.base[index]
        self.now += 1
        self.most = max(self.most, self.now)
        finalize(frame.rgb, self.released)
        return frame

    def released(self):
        self.now -= 1


class Shifted(Wrapped):
    """The same seen by a camera that turns: each image lies 4 px further to the right."""

    ground_truth = None

    def __init__(self, base):
        self.base = base

    def __len__(self):
        return len(self.base)

    def __getitem__(self, index):
        frame = self.base[index]
        rgb, depth = (np.roll(image, 4 * index, axis=1) for image in (frame.rgb, frame.depth))
        return Frame(index, frame.timestamp, rgb, depth)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Host, people and the composite of instance 0, as folders."""
    folder = tmp_path_factory.mktemp("composites")
    host = write_sequence(folder / "host", Room("host", 4, moving=True, seed=1))
    people = write_sequence(folder / "people", Room("people", 10, walker=True))
    compose(open_sequence(str(host)), open_sequence(str(people)), folder / "made", 0)
    return folder


@pytest.fixture
def host(folder):
    return open_sequence(str(folder / "host"))


@pytest.fixture
def people(folder):
    return open_sequence(str(folder / "people"))


def test_only_people_and_their_shadow_differ_from_the_host(host, folder):
    composed = open_sequence(str(folder / "made"))
    assert len(composed) == 4
    assert np.array_equal(composed.ground_truth.T_world_cam, host.ground_truth.T_world_cam)
    shares = []
    for before, after in zip((host[i] for i in range(4)), (composed[i] for i in range(4)), strict=True):
        masks = composed.masks[after.index]
        person = masks.instances > 0
        assert masks.moving == set(np.unique(masks.instances)) - {0} and set(masks.class_names.values()) <= {"person"}
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


def test_an_instance_repeats_and_another_one_differs(host, people, folder, tmp_path):
    again, other = compose(host, people, tmp_path / "made", 0), compose(host, people, tmp_path / "other" / "made", 1)
    digests = [open_sequence(str(place)).digest() for place in (folder / "made", again.folder, other.folder)]
    assert digests[0] == digests[1] != digests[2]
    assert again.share == np.mean([np.mean(open_sequence(str(again.folder)).masks[i].instances > 0) for i in range(4)])


def test_images_are_not_held(host, tmp_path):
    people = Watched(Room("people", 60, walker=True))
    compose(host, people, tmp_path / "made", 2)
    assert people.most < 20


def test_masks_count_as_content_and_have_to_be_there(folder, tmp_path):
    made = shutil.copytree(folder / "made", tmp_path / "made")
    before, path = open_sequence(str(made)).digest(), min((made / "people").iterdir())
    cv2.imwrite(str(path), np.zeros((120, 160), np.uint8))
    assert open_sequence(str(made)).digest() != before
    path.unlink()
    with pytest.raises(SequenceError, match="1 of 4 mask images"):
        open_sequence(str(made))
    (made / "people.txt").write_text("\n".join((made / "people.txt").read_text().splitlines()[1:]))
    with pytest.raises(SequenceError, match="1 of 4 frames"):
        open_sequence(str(made))


@pytest.mark.parametrize(
    "fault, message",
    [
        ("no truth", "no ground truth"),
        ("truth elsewhere", "4 of 4 frames .* lie outside"),
        ("no depth", "nobody can be seen"),
        ("people already", "has people already"),
        ("moving", "moves"),
        ("moving without truth", r"moves: its images shift by \d"),
        ("nobody", "nobody walks"),
        ("folder", "exists already"),
    ],
)
def test_what_cannot_be_composed_is_said(host, people, folder, tmp_path, fault, message):
    truth, made = host.ground_truth, tmp_path / "made"
    if fault == "no truth":
        host.ground_truth = None
    elif fault == "truth elsewhere":
        host.ground_truth = Trajectory(truth.timestamps + 1000, truth.T_world_cam)
    elif fault == "no depth":
        host = Room("dark", 4, wall_m=0.0)
    elif fault == "people already":
        host = open_sequence(str(folder / "made"))
    elif fault == "moving":
        people.ground_truth = Trajectory(people.timestamps, se3.exp(0.01 * np.arange(10)[:, None] * np.eye(6)[0]))
    elif fault == "moving without truth":
        people = Shifted(people)
    elif fault == "folder":
        made.mkdir()
        (made / "thesis.tex").write_text("work")
    else:
        people = Room("empty")
    with pytest.raises(SequenceError, match=message):
        compose(host, people, made)
    assert not made.exists() or (made / "thesis.tex").read_text() == "work"


@needs_shared
def test_a_real_person_is_pasted_into_a_real_recording(tmp_path):
    host = open_sequence(str(SHARED / "data/tum/rgbd_dataset_freiburg1_rpy"), frames="0:4")
    made = compose(host, open_sequence(str(SHARED / "data/fixed_camera/man_130")), tmp_path / "made", 5)
    composed = open_sequence(str(tmp_path / "made"))
    assert 0.1 < made.share < 0.7 and composed.camera == host.camera
    person = composed.masks[2].instances > 0
    assert np.median(composed[2].depth[person]) < np.median(host[2].depth[person & (host[2].depth > 0)])
