"""Copies of a recording before a fixed camera are told by small pictures of its frames."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dynslam_bench.geometry import Trajectory
from dynslam_bench.sequences.thumbnails import COUNT, same_frames, thumbnails

N_FRAMES = 40


def still(count=N_FRAMES):
    """The true path of a camera that stands."""
    return Trajectory(np.arange(count) / 30, np.tile(np.eye(4), (count, 1, 1)))


@dataclass
class Filmed:
    """A bright square that crosses a textured wall; `change` is what copying did to the images."""

    change: object = staticmethod(lambda image: image)
    seed: int = 0
    first: int = 0
    count: int = N_FRAMES
    ground_truth: Trajectory | None = field(default_factory=still)

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        rng = np.random.default_rng(self.seed)
        wall = cv2.resize(rng.integers(40, 200, (12, 16, 3), dtype=np.uint8), (160, 120))
        left = 3 * (self.first + index)
        wall[40:90, left : left + 30] = 255
        return SimpleNamespace(rgb=self.change(wall))


def with_one_pixel_changed(image):
    changed = image.copy()
    changed[5, 5] = 255
    return changed


def as_jpeg(image):
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], 1)


def at_half_size(image):
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("change", [with_one_pixel_changed, as_jpeg, at_half_size])
def test_a_copy_with_other_pixels_shows_the_same_frames(change):
    original = thumbnails(Filmed())
    assert len(original) == COUNT
    assert same_frames(original, thumbnails(Filmed(change)))


def test_a_copy_without_its_last_frame_shows_the_same_frames():
    short = Filmed(count=N_FRAMES - 1, ground_truth=still(N_FRAMES - 1))
    assert same_frames(thumbnails(Filmed()), thumbnails(short))


@pytest.mark.parametrize("other", [Filmed(seed=1), Filmed(first=N_FRAMES // 2)])
def test_another_wall_and_a_later_part_show_other_frames(other):
    assert not same_frames(thumbnails(Filmed()), thumbnails(other))


def test_moving_cameras_and_rendered_scenes_have_no_thumbnails():
    moving = still()
    moving.T_world_cam[:, 0, 3] = np.linspace(0, 1, N_FRAMES)
    rendered = Filmed()
    rendered.scene_digest = "0" * 16
    assert thumbnails(Filmed(ground_truth=moving)) == []
    assert thumbnails(Filmed(ground_truth=None)) == []
    assert thumbnails(rendered) == []
    assert not same_frames([], [])
