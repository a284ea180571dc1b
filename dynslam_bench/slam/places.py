"""Which keyframes look like this frame? A cheap ranking, so that only a few are matched feature by feature.

Each binary descriptor is read as a row of 16-bit pieces (multi-index hashing: Norouzi, Punjani and Fleet, 2012). Two
descriptors of one point differ in few bits, so that some of their pieces are equal; those of different points seldom
share one. A keyframe scores for every piece that its map points share with the frame, the more the rarer the piece is
among the keyframes. Nothing is trained, stored or downloaded: the pieces are the descriptors themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

from .localisation.observation import Observations
from .mapping.map import Map

VALUES = 1 << 16
"""Values of a piece."""
EVERY = 4
"""Only every so many-th piece is looked at: the others change the ranking little and cost as much again."""
AT_ONCE = 128
"""Keyframes that are looked at before the map may rest: a large one does not have to fit into memory."""

Pieces = NDArray[np.uint16]


def most_alike(world: Map, keyframes: NDArray[np.int64], seen: Observations, count: int) -> list[int]:
    """The keyframes that look most like a frame.

    Args:
        world: The map.
        keyframes: Slots to choose from, ``[S]``.
        seen: The frame's features.
        count: How many to choose at most.

    Returns:
        Slots, most alike first; equal scores go to the newer keyframe. All of them, in the order given, where there
        are no more than `count`.
    """
    if len(keyframes) <= count or not len(seen):
        return [int(slot) for slot in keyframes[:count]]
    order = np.lexsort((-world.kf_id[keyframes], -likeness(world, keyframes, seen)))
    return [int(slot) for slot in keyframes[order[:count]]]


def likeness(world: Map, keyframes: NDArray[np.int64], seen: Observations) -> NDArray[np.float64]:
    """How much each of the keyframes ``[S]`` looks like a frame; comparable within one call alone."""
    pieces = world.kf_words.view(np.uint16)[:, :, ::EVERY]
    own = np.ascontiguousarray(seen.words).view(np.uint16)[:, ::EVERY]
    wanted = np.full((own.shape[1], VALUES), -1, np.int32)
    wanted[np.arange(own.shape[1])[None, :], own] = 0
    some = [keyframes[at : at + AT_ONCE] for at in range(0, len(keyframes), AT_ONCE)]
    frequency = 0
    for slots in some:
        frequency += _count(pieces, world.kf_point, world.kf_count, slots, wanted)
        world.space.rest("kf_words", "kf_point")
    weight = np.where(wanted > 0, np.log(max(frequency, 1) / np.maximum(wanted, 1)), 0.0).astype(np.float32)
    scores = []
    for slots in some:
        scores.append(_scores(pieces, world.kf_point, world.kf_count, slots, weight))
        world.space.rest("kf_words", "kf_point")
    return np.concatenate(scores)


@kernel
def _count(
    pieces: Pieces,
    kf_point: NDArray[np.int32],
    kf_count: NDArray[np.int64],
    keyframes: NDArray[np.int64],
    wanted: NDArray[np.int32],
) -> int:
    """Add up in `wanted` ``[P, VALUES]`` how often each piece that is not -1 occurs; the sum of all."""
    total = 0
    for keyframe in keyframes:
        for feature in range(kf_count[keyframe]):
            if kf_point[keyframe, feature] < 0:
                continue
            for place in range(pieces.shape[2]):
                value = pieces[keyframe, feature, place]
                if wanted[place, value] >= 0:
                    wanted[place, value] += 1
                    total += 1
    return total


@kernel
def _scores(
    pieces: Pieces,
    kf_point: NDArray[np.int32],
    kf_count: NDArray[np.int64],
    keyframes: NDArray[np.int64],
    weight: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Sum ``[S]`` of the weights of each keyframe's pieces, over the root of its points: a crowd has more by chance."""
    score = np.zeros(keyframes.shape[0])
    for row in range(keyframes.shape[0]):
        keyframe = keyframes[row]
        points = 0
        total = 0.0
        for feature in range(kf_count[keyframe]):
            if kf_point[keyframe, feature] < 0:
                continue
            points += 1
            for place in range(pieces.shape[2]):
                total += weight[place, pieces[keyframe, feature, place]]
        score[row] = total / np.sqrt(max(points, 1))
    return score
