"""Whether two recordings show the same: by what was filmed and how the camera moved, never by names or stamps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.sequence import Sequence

_AROUND_S = np.array([-0.1, -0.05, 0.05, 0.1])
"""The camera's distances from where it was and will be so long before and after a frame are the shape of its way."""
_PAIRS = 6
"""So many pairs of frames with the likest shapes, and as many with equal stamps, are compared by what they show."""
_LEAST_M = 1e-3
"""Of a way shorter than this the shape is the ground truth's rounding."""
_THUMB = (32, 24)
_GREY_LEVELS = 1.5
_DEPTH_SHARE = 0.002
_ENOUGH = 3
"""Pairs that are alike; fewer may be a chance, as two ways may cross."""


def same_recording(one: Sequence, other: Sequence) -> bool:
    """Whether frames of one recording are frames of the other.

    Frames are paired where the ground truths have the same shape around them (in whatever frame of reference, at
    whatever stamps), where stamps are equal, and in order from the first and from the last frame; of a few pairs the
    decoded images are compared, reduced to `_THUMB` pixels. Other names, shifted stamps, other image files, frames left
    out and a smaller size leave a copy a copy.
    """
    thumbs = tuple(cache(lambda index, of=of: _thumbnail(of, index)) for of in (one, other))
    pairs = dict.fromkeys(_likely_pairs(one, other))
    alike = ((here, there) for here, there in pairs if _alike(thumbs[0](here), thumbs[1](there)))
    return len(list(islice(alike, _ENOUGH))) == min(_ENOUGH, len(one), len(other))


def _likely_pairs(one: Sequence, other: Sequence) -> Iterator[tuple[int, int]]:
    shapes = [_shapes(each) for each in (one, other)]
    if len(shapes[0]) and len(shapes[1]):
        found = cKDTree(shapes[1]).query(shapes[0])
        likest = np.asarray(found[1], np.intp)
        apart = np.asarray(found[0], np.float64) / (np.linalg.norm(shapes[0], axis=1) + _LEAST_M)
        yield from ((int(here), int(likest[here])) for here in np.argsort(apart, kind="stable")[:_PAIRS])
    if is_rendered(one) or is_rendered(other):
        return  # its frames are computed one by one, and its ground truth is exact: the shape is enough
    stamps: NDArray[np.float64] = np.round(one.timestamps, 6)
    twins: NDArray[np.float64] = np.round(other.timestamps, 6)
    _, here, there = np.intersect1d(stamps, twins, assume_unique=True, return_indices=True)
    spread = np.unique(np.linspace(0, len(here) - 1, min(_PAIRS, len(here))).astype(np.intp))
    yield from ((int(here[k]), int(there[k])) for k in spread)
    yield from ((0, 0), (len(one) - 1, len(other) - 1))


def is_rendered(sequence: Sequence) -> bool:
    """Whether the frames of a sequence are computed and its content is known by its parameters."""
    return hasattr(sequence, "scene_digest")


def _shapes(sequence: Sequence) -> NDArray[np.float64]:
    """Distances in metres ``[N, 4]`` of the camera at every frame from itself `_AROUND_S` earlier and later.

    They depend neither on the frame of reference nor on a shift of the stamps. Empty without ground truth.
    """
    truth = sequence.ground_truth
    if truth is None or len(truth) < 2:
        return np.empty((0, len(_AROUND_S)))

    def positions(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        axes = [np.interp(stamps, truth.timestamps, truth.positions[:, axis]) for axis in range(3)]
        return np.stack(axes, axis=-1)

    stamps = sequence.timestamps
    around = positions(stamps[:, None] + _AROUND_S)
    return np.asarray(np.linalg.norm(around - positions(stamps)[:, None], axis=2), np.float64)


def _thumbnail(sequence: Sequence, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour ``[24, 32, 3]`` and depth ``[24, 32]`` of a frame, depth in the numbers that its file holds."""
    frame = sequence[index]
    raw = (frame.depth * sequence.camera.depth_factor).astype(np.float32)  # as stored, whatever the camera says
    colour = cv2.resize(frame.rgb.astype(np.float32), _THUMB, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(raw, _THUMB, interpolation=cv2.INTER_NEAREST)
    return np.asarray(colour, np.float32), np.asarray(depth, np.float32)


def _alike(
    one: tuple[NDArray[np.float32], NDArray[np.float32]], other: tuple[NDArray[np.float32], NDArray[np.float32]]
) -> bool:
    if np.abs(one[0] - other[0]).mean() > _GREY_LEVELS:
        return False
    allowed = _DEPTH_SHARE * float(np.median(one[1])) + 0.5
    return bool(np.median(np.abs(one[1] - other[1])) <= allowed)
