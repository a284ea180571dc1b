"""Scores of keyframes by the 16-bit substrings of binary descriptors that they share with a frame.

Two descriptors of one point differ in few bits, so that some of their substrings are equal; those of different points
seldom share one (multi-index hashing: Norouzi, Punjani and Fleet, 2012).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

VALUES = 1 << 16
"""Values of a substring."""
STRIDE = 4
"""Every fourth substring is used: the others change the ranking little and cost as much again."""
CHANGED = 0.25
"""A keyframe is indexed again when it has gained or lost this share of its points."""

Substrings = NDArray[np.uint16]
Slots = NDArray[np.int64]


class DescriptorIndex:
    """Sorted substrings of the keyframes' features that observe a point."""

    def __init__(self) -> None:
        self._ids: dict[int, int] = {}
        self._substrings: dict[int, Substrings] = {}

    def update(self, alive: NDArray[np.bool_], ids: Slots, kf_point: NDArray[np.int32], words: NDArray[Any]) -> None:
        """Index new and changed keyframes.

        Args:
            alive: Of each slot, whether it holds a keyframe ``[S]``.
            ids: Of each slot, its keyframe's id ``[S]``.
            kf_point: Of each slot and feature the point that it observes ``[S, F]``; those with -1 do not count.
            words: Descriptors ``[S, F, W]``.
        """
        observed = np.count_nonzero(kf_point >= 0, axis=1)
        for slot in np.flatnonzero(alive).tolist():
            count = self._substrings[slot].shape[1] if self._ids.get(slot) == ids[slot] else -1
            if count < 0 or abs(observed[slot] - count) > CHANGED * count:
                substrings = words[slot, kf_point[slot] >= 0].view(np.uint16)[:, ::STRIDE]
                self._ids[slot], self._substrings[slot] = int(ids[slot]), np.sort(np.ascontiguousarray(substrings.T))

    def score(self, slots: Slots, words: NDArray[Any]) -> tuple[NDArray[np.float64], Slots]:
        """For each of the keyframes ``[K]`` the sum of the weights of the shared substrings, and its number of points.

        The weight is the logarithm of how much rarer a substring is than all of the frame's together.

        Args:
            slots: Of the keyframes.
            words: The frame's descriptors ``[N, W]``.
        """
        query = np.ascontiguousarray(words).view(np.uint16)[:, ::STRIDE].T
        counts = np.full((len(query), VALUES), -1, np.int64)
        for position, values in enumerate(query):
            counts[position, values] = 0
        keyframes = [self._substrings[slot] for slot in slots.tolist()]
        for substrings in keyframes:
            _count(substrings, counts)
        total = np.maximum(counts, 0).sum()
        weight = np.where(counts > 0, np.log(max(total, 1) / np.maximum(counts, 1)), 0.0)
        scores = [_sum(substrings, counts, weight) for substrings in keyframes]
        return np.array(scores), np.array([substrings.shape[1] for substrings in keyframes], np.int64)


@kernel
def _count(substrings: Substrings, counts: NDArray[np.int64]) -> None:
    """Count the substrings ``[P, F]`` of a keyframe that are in the frame; those that are not have -1."""
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            if counts[position, value] >= 0:
                counts[position, value] += 1


@kernel
def _sum(substrings: Substrings, counts: NDArray[np.int64], weight: NDArray[np.float64]) -> float:
    score = 0.0
    for position in range(substrings.shape[0]):
        for value in substrings[position]:
            if counts[position, value] > 0:
                score += weight[position, value]
    return score
