"""Small pictures of a recording before a fixed camera: they tell copies of it, where equal true poses tell nothing."""

import base64
from itertools import starmap

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Sequence
from dynslam_bench.geometry import se3

COUNT = 6
"""So many frames are kept, spread evenly."""
ENOUGH = 3
"""Pictures that are equal in copies: where a few frames are left out, the others are of neighbouring frames."""
_SIZE = (16, 12)
"""Width and height of a picture, in pixels: noise and compression average out, a moving arm does not."""
_GREY_LEVELS = 8.0
"""No pixel of two pictures of one frame differs by more levels (of 255): compression and another size change up to 5,
people who move between two frames 10 to 150."""


def thumbnails(sequence: Sequence) -> list[str]:
    """Small grey pictures of a few frames of a recording whose camera never moves: copies of it are found by them.

    Args:
        sequence: With its ground truth, cut to what a run shows.

    Returns:
        Up to `COUNT` pictures of 16 x 12 pixels, a byte each, in base 64. Empty for rendered scenes,
        which have digests, for cameras that move, whose true poses tell copies apart, and without
        ground truth.
    """
    truth = sequence.ground_truth
    is_rendered = hasattr(sequence, "scene_digest")
    if is_rendered or truth is None or not se3.is_static(truth.T_world_cam):
        return []
    chosen = sorted(set(np.linspace(0, len(sequence) - 1, COUNT).round().astype(int).tolist()))
    return [_encode(sequence[index].rgb) for index in chosen]


def same_frames(one: list[str], other: list[str]) -> bool:
    """Whether two recordings' pictures show the same frames, in the same order; False where one has none."""
    if not one or len(one) != len(other):
        return False
    equal = sum(starmap(_same_picture, zip(one, other, strict=True)))
    return equal >= min(ENOUGH, len(one))


def _encode(rgb: NDArray[np.uint8]) -> str:
    """A colour image ``[H, W, 3]``, reduced to grey."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, _SIZE, interpolation=cv2.INTER_AREA)
    return base64.b64encode(small.tobytes()).decode()


def _same_picture(one: str, other: str) -> bool:
    """Whether two encoded pictures are equal up to what copying does to them."""
    first, second = (
        np.frombuffer(base64.b64decode(text), np.uint8).astype(np.float64) for text in (one, other)
    )
    return bool(np.abs(first - second).max() <= _GREY_LEVELS)
