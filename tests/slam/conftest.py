"""Fixtures of the back end's tests."""

import cv2
import numpy as np
import pytest
from point_world import PointWorld, track_all


@pytest.fixture
def room():
    return PointWorld()


@pytest.fixture
def tracked():
    return track_all


@pytest.fixture
def textured_gray():
    rng = np.random.default_rng(0)
    image = sum(
        cv2.resize(rng.normal(size=(-(-480 // s), -(-640 // s))), (640, 480), interpolation=cv2.INTER_CUBIC) * s**0.5
        for s in (4, 12, 40)
    )
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
