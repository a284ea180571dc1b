"""Preprocessing: geometry checked through the camera model, photometry through its definition."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_folders import frame_hash, make_folder

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences import Frame, FrameMasks, PreprocessingSettings, Sequence
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.preprocessing import Preprocessed, intensity, normalise
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.view import Part, part_of

CAMERA = Camera(160, 120, 130.0, 131.0, 80.5, 58.0, (0.26, -0.95, -0.005, 0.003, 1.16))


class Memory:
    """One frame in memory, with masks."""

    id, license, citation, fps, ground_truth = "memory", "", "", 30.0, None
    camera = CAMERA

    def __init__(self, rgb, depth):
        self._frame = Frame(0, 1.0, rgb, depth)
        self.timestamps = np.array([1.0])
        self.masks = [FrameMasks((depth > 2).astype(np.int32), {1: "person"}, frozenset({1}))]

    def digest(self):
        return "d"

    def __len__(self):
        return 1

    def __getitem__(self, index):
        return self._frame


def dots(points):
    """A black image with soft white dots at float pixel positions."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
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
    distorted = CAMERA.distort_points(ideal)
    assert np.abs(distorted - ideal).max() > 1  # the lens matters here
    sequence = Preprocessed(
        Memory(dots(distorted), np.ones((120, 160), np.float32)), PreprocessingSettings(undistort=True)
    )
    assert not sequence.camera.is_distorted and sequence.camera.fx == CAMERA.fx
    for point in ideal:
        assert np.abs(centroid(sequence[0].rgb, point) - point).max() < 0.1


@pytest.mark.parametrize(("width", "height"), [(80, 60), (320, 240), (100, 90)])
def test_resize_scales_the_intrinsics_along(width, height):
    points = np.array([[30.0, 25.0], [121.0, 31.0], [40.0, 95.0]])
    settings = PreprocessingSettings(width=width, height=height)
    sequence = Preprocessed(Memory(dots(points), np.full((120, 160), 2.0, np.float32)), settings)
    frame, camera = sequence[0], sequence.camera
    assert frame.rgb.shape == (height, width, 3) and frame.depth.shape == (height, width)
    for point in points:
        ray = CAMERA.unproject(point, np.array(2.0))
        assert np.abs(centroid(frame.rgb, camera.project(ray), 6) - camera.project(ray)).max() < 0.12


def test_depth_and_masks_are_never_averaged():
    depth = np.where(np.mgrid[:120, :160][1] < 77, 1.0, 4.0).astype(np.float32)
    depth[10:20, 10:20] = 0
    settings = PreprocessingSettings(width=100, height=70, undistort=True)
    sequence = Preprocessed(Memory(dots([]), depth), settings)
    frame, masks = sequence[0], sequence.masks[0]
    assert set(np.unique(frame.depth)) == {0.0, 1.0, 4.0}
    assert masks.instances.shape == (70, 100) and masks.instances.dtype == np.int32
    assert ((masks.instances == 1) == (frame.depth > 2)).all()
    assert masks.moving == {1}


def test_digest_depends_on_the_settings():
    memory = Memory(dots([]), np.ones((120, 160), np.float32))
    digests = {
        Preprocessed(memory, PreprocessingSettings(undistort=u, clahe_clip=c)).digest() for u in (0, 1) for c in (1, 2)
    }
    assert len(digests) == 4
    assert isinstance(Preprocessed(memory, PreprocessingSettings(undistort=True)), Sequence)


def test_mean_std_reaches_its_target():
    rng = np.random.default_rng(0)
    grey = np.repeat(rng.normal(60, 12, (120, 160, 1)).clip(0, 255).astype(np.uint8), 3, axis=2)
    settings = PreprocessingSettings(normalisation="mean-std", target_mean=0.5, target_std=0.2)
    result = intensity(normalise(grey, settings))
    assert result.mean() == pytest.approx(0.5, abs=0.005) and result.std() == pytest.approx(0.2, abs=0.01)
    flat = normalise(np.full((8, 8, 3), 200, np.uint8), settings)
    assert flat.std() == 0 and flat.mean() == pytest.approx(127, abs=1)


def test_equalisation_spreads_a_dark_image_and_keeps_the_hue():
    rng = np.random.default_rng(1)
    dark = rng.integers(0, 40, (120, 160, 3), dtype=np.uint8)
    for name in ("equalise", "clahe"):
        result = normalise(dark, PreprocessingSettings(normalisation=name))
        assert result.dtype == np.uint8 and result.shape == dark.shape
        assert intensity(result).std() > 1.5 * intensity(dark).std()
    gray = np.repeat(dark[..., :1], 3, axis=2)
    balanced = normalise(gray, PreprocessingSettings(normalisation="equalise"))
    assert (np.ptp(balanced.astype(int), axis=2) <= 1).all()
    assert (balanced[..., 0] == cv2.equalizeHist(gray[..., 0])).mean() > 0.99


# What part of which sequence is seen: one identity for every spelling, and for repeats of one problem instance.


WALK = "synthetic/walking_xyz"


def part(name: object, offset: int = 0, **how: object) -> Part:
    return part_of(open_sequence(str(name), **how), offset)


def test_all_spellings_of_the_same_frames_are_one_part() -> None:
    first = part(f"{WALK}?frames=60")
    spellings = [
        part(WALK, frames="0:60"),
        part(f"{WALK}?scene=0", frames=(0, 60)),
        part(f"{WALK}?scene=000&frames=60"),
        part(f"{WALK}?frames=100", frames=":60"),
        part(f"{WALK}?frames=60", frames="0:90"),
        part(f"{WALK}?frames=60", frames="0:"),
    ]
    assert all(each == first for each in spellings) and first.id == f"{WALK}?scene=0"
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
    late = part(WALK, frames="3:60", offset=3)
    noisy = part(f"{WALK}?noise=7", frames="0:60")
    assert plain.block == late.block == noisy.block
    assert part(WALK, frames="3:60").block != plain.block, "without an offset these are other frames"
    assert noisy.content != plain.content and noisy.noise == 7 and noisy.id != plain.id
    assert noisy.content != part(f"{WALK}?noise=8").content


def test_recorded_folders_by_any_path_and_preprocessing(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")[0]
    first = part(folder)
    assert part(f"{tmp_path}/./a", frames="0:4") == first
    small = part(folder, preprocessing=PreprocessingSettings(width=24, height=18))
    assert small.block == first.block, "preprocessing is a tracker's setting, not another recording"
    shutil.copytree(folder, tmp_path / "else" / "a")
    assert part(tmp_path / "else" / "a") == first, "a copy is the same recording"
    camera = (folder / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(camera.replace("fx = 30.0", "fx = 31.0"))
    assert part(folder, camera=tmp_path / "camera.toml").block != first.block
    other = make_folder(tmp_path / "b" / "a", start=200.0)[0]
    assert part(other).block != first.block, "another recording in a folder of the same name is not"


def test_a_noise_seed_changes_the_noise_and_nothing_else(tmp_path: Path) -> None:
    ids = [f"{WALK}?scene=3&frames=2{noise}" for noise in ("", "&noise=1", "&noise=2")]
    plain, one, two = (open_synthetic(name, tmp_path) for name in ids)
    assert frame_hash(plain[1])[:16] == "8ed2db9ef4f896d1", "scenes keep their bytes"
    assert len({frame_hash(each[1]) for each in (plain, one, two)}) == 3
    assert frame_hash(one[1]) == frame_hash(open_synthetic(f"{WALK}?scene=3&frames=2&noise=1", None)[1])
    assert frame_hash(one[1]) == frame_hash(one[1]), "read back from a folder of its own"
    assert np.array_equal(plain.exact_depth(1), one.exact_depth(1))
    assert np.array_equal(plain.masks[1].instances, one.masks[1].instances)
    assert np.array_equal(plain.ground_truth.T_world_cam, one.ground_truth.T_world_cam)
    difference = np.abs(plain[1].rgb.astype(int) - one[1].rgb.astype(int))
    assert 0.3 < difference.mean() < 5 and difference.max() < 40, "grey levels: noise, no other picture"
