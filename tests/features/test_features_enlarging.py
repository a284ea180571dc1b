"""Narrow images are enlarged before features are extracted; keypoints are those of the image that was given."""

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts import Keypoints
from dynslam_bench.features.enlarging import enlarged, enlarged_mask, in_given_image
from dynslam_bench.features.orb import OrbExtractor
from dynslam_bench.geometry import feature_scale


@pytest.mark.parametrize(
    ("width", "scale"), [(160, 0.25), (320, 0.5), (480, 0.75), (640, 1), (641, 1), (1280, 1)]
)
def test_only_narrow_images_have_smaller_pixels_of_features(width, scale):
    assert feature_scale(width) == scale


@pytest.mark.parametrize("shape", [(480, 640), (3, 640), (720, 1280)])
def test_an_image_of_vga_s_width_stays_as_it_is(shape):
    gray = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    mask = gray > 100
    keypoints = OrbExtractor().extract(gray)
    assert enlarged(gray) is gray
    assert enlarged_mask(mask) is mask
    assert in_given_image(keypoints, gray) is keypoints


@pytest.mark.parametrize(
    "shape", [(240, 320), (120, 160), (270, 480), (241, 427), (320, 240), (1, 7)]
)
def test_the_image_and_its_mask_are_enlarged_alike(shape):
    gray = np.zeros(shape, np.uint8)
    gray[:, : shape[1] // 2] = 255
    image = enlarged(gray)
    mask = enlarged_mask(gray > 0)
    assert image.shape[1] == 640
    assert image.shape[0] == pytest.approx(640 * shape[0] / shape[1], abs=0.5)
    assert mask.shape == image.shape
    assert mask.mean() == pytest.approx((gray > 0).mean(), abs=2 / shape[1])


@pytest.mark.parametrize("shape", [(240, 320), (120, 160), (270, 480), (241, 427)])
@pytest.mark.parametrize("place", [(0.5, 0.5), (0.3, 0.6)])
def test_a_square_s_corners_lie_around_its_middle(shape, place):
    height, width = shape
    # twenty pixels on each side, the first at `left` and `top`
    left = round(place[0] * width)
    top = round(place[1] * height)
    gray = np.full(shape, 60, np.uint8)
    gray[top : top + 20, left : left + 20] = 200
    gray = cv2.GaussianBlur(gray, (3, 3), 0.8)
    keypoints = in_given_image(OrbExtractor().extract(enlarged(gray)), gray)
    finest = keypoints.xy[keypoints.octave == 0]
    assert len(finest) >= 4
    middle = (finest.min(axis=0) + finest.max(axis=0)) / 2
    assert middle == pytest.approx([left + 9.5, top + 9.5], abs=0.3)


def test_the_corners_of_the_enlarged_image_are_those_of_the_given_one():
    gray = np.zeros((241, 427), np.uint8)
    height, width = enlarged(gray).shape
    # edges of the image: half a pixel beyond the centres of the outermost pixels
    xy = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]], np.float32)
    zeros = np.zeros(2, np.float32)
    keypoints = Keypoints(xy, np.zeros(2, np.int32), zeros, zeros, np.zeros((2, 32), np.uint8))
    given = in_given_image(keypoints, gray).xy
    assert given == pytest.approx(np.array([[-0.5, -0.5], [426.5, 240.5]]), abs=1e-3)
