"""Which keyframes look like this frame? A cheap ranking, so that only a few are matched feature by feature.

Each binary descriptor is read as a row of 16-bit pieces (multi-index hashing: Norouzi, Punjani and Fleet, 2012). Two
descriptors of one point differ in few bits, so that some of their pieces are equal; those of different points seldom
share one. A keyframe scores for every piece that its map points share with the frame, the more the rarer the piece is
among the keyframes. Nothing is trained, stored or downloaded: the pieces are the descriptors themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .localisation.observation import Observations
from .mapping.map import Map
from .mapping.piece_index import EVERY


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
    """How much each of the keyframes ``[S]`` looks like a frame; comparable within one call alone.

    The weights of what it shares with the frame, over the root of its points: a crowd has more in common by chance.
    """
    world.pieces.renew(world.kf_alive, world.kf_id, world.kf_point, world.kf_words.view(np.uint16)[:, :, ::EVERY])
    own = np.ascontiguousarray(seen.words).view(np.uint16)[:, ::EVERY]
    score, points = world.pieces.score(keyframes, own)
    world.space.rest("kf_words", "kf_point")
    return np.asarray(score / np.sqrt(np.maximum(points, 1)))
