"""Preprocessing: geometry checked through the camera model, photometry through its definition."""

import cv2
import numpy as np
import pytest

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences import Frame, FrameMasks, PreprocessingSettings, Sequence
from dynslam_bench.sequences.preprocessing import Preprocessed, intensity, normalise

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
