"""An inverted index of the keyframes' descriptors: which features have a piece of theirs in common with a frame's.

Looking at every feature of every keyframe takes as long as there are keyframes; the index goes to those alone that
share something (Sivic and Zisserman, Video Google, ICCV 2003, with words for pieces).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

VALUES = 1 << 16
"""Values of a piece."""
EVERY = 4
"""Only every so many-th piece is looked at: the others change the ranking little and cost as much again."""
ROOM = 256
"""Features are given room in steps of so many."""
SLOTS = 640
"""Keyframes that there is room for at once: as many as are kept by default, and some that come and go."""

Pieces = NDArray[np.uint16]
Ints = NDArray[np.int32]


class PieceIndex:
    """Lists of features by their descriptors' pieces; keyframes that came and went are seen to when it is asked."""

    def __init__(self) -> None:
        self._begin(0, 0, 0)

    def _begin(self, slots: int, features: int, places: int) -> None:
        self._ids = np.full(slots, -1, np.int64)
        self._counts = np.zeros(slots, np.int64)
        self._pieces = np.full((slots, features, places), 0, np.uint16)  # in memory from now on: it does not grow
        self._first = np.full((places, VALUES), -1, np.int32)
        self._next = np.full((slots, features, places), -1, np.int32)

    def renew(
        self, alive: NDArray[np.bool_], ids: NDArray[np.int64], counts: NDArray[np.int64], pieces: Pieces
    ) -> None:
        """Take up the keyframes of now.

        Args:
            alive: Of each slot, whether a keyframe is there ``[S]``.
            ids: Of each slot, its keyframe's ``[S]``.
            counts: Features of each ``[S]``.
            pieces: Pieces of their descriptors ``[S, F, P]``.
        """
        slots, features, places = pieces.shape
        if slots > len(self._ids) or features > self._pieces.shape[1] or places != self._pieces.shape[2]:
            self._begin(max(slots, SLOTS), -(-features // ROOM) * ROOM, places)
        known = np.full(len(self._ids), -1, np.int64)
        known[:slots] = np.where(alive, ids, -1)
        for slot in np.flatnonzero(known != self._ids).tolist():
            if self._ids[slot] >= 0:
                _take_out(self._first, self._next, self._pieces, slot, int(self._counts[slot]))
            self._ids[slot] = known[slot]
            if known[slot] >= 0:
                count = self._counts[slot] = counts[slot]
                self._pieces[slot, :count] = pieces[slot, :count]
                _put_in(self._first, self._next, self._pieces, slot, int(count))

    def score(
        self, kf_point: Ints, slots: NDArray[np.int64], own: Pieces
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """For each of the keyframes ``[K]`` the sum of the weights of what it shares with a frame, and its points.

        A piece weighs the logarithm of how much rarer it is than all of the frame's pieces together.

        Args:
            kf_point: Of each slot and feature the point that it observes ``[S, F]``; those with -1 do not count.
            slots: Of the keyframes.
            own: The frame's pieces ``[N, P]``.
        """
        values = [np.unique(own[:, place]) for place in range(own.shape[1])]
        place = np.repeat(np.arange(len(values)), [len(each) for each in values])
        row, points = _rows(kf_point, slots, self._counts, self._next.shape[1])
        lists = self._first, self._next.reshape(-1, self._next.shape[2])
        return _score(*lists, row, place, np.concatenate(values), len(slots)), points


@kernel
def _put_in(first: Ints, after: Ints, pieces: Pieces, slot: int, count: int) -> None:
    features, places = pieces.shape[1], pieces.shape[2]
    for feature in range(count):
        for place in range(places):
            value = pieces[slot, feature, place]
            after[slot, feature, place] = first[place, value]
            first[place, value] = slot * features + feature


@kernel
def _take_out(first: Ints, after: Ints, pieces: Pieces, slot: int, count: int) -> None:
    features, places = pieces.shape[1], pieces.shape[2]
    for feature in range(count):
        gone = slot * features + feature
        for place in range(places):
            value = pieces[slot, feature, place]
            node = first[place, value]
            if node == gone:
                first[place, value] = after[slot, feature, place]
                continue
            while node >= 0:
                following = after[node // features, node % features, place]
                if following == gone:
                    after[node // features, node % features, place] = after[slot, feature, place]
                    break
                node = following


@kernel
def _rows(
    kf_point: Ints, slots: NDArray[np.int64], counts: NDArray[np.int64], room: int
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Of each feature of the index the row of its keyframe among those asked for, -1 without a point; their points."""
    row, points = np.full(len(counts) * room, -1, np.int32), np.zeros(len(slots), np.int64)
    for number in range(len(slots)):
        slot = slots[number]
        for feature in range(counts[slot]):
            if kf_point[slot, feature] >= 0:
                row[slot * room + feature] = number
                points[number] += 1
    return row, points


@kernel
def _score(
    first: Ints, after: Ints, row: NDArray[np.int32], places: NDArray[np.int64], values: Pieces, rows: int
) -> NDArray[np.float64]:
    ends, found, shared = np.zeros(len(values), np.int64), np.zeros(1 << 12, np.int32), 0
    for k in range(len(values)):
        place = places[k]
        node = first[place, values[k]]
        while node >= 0:
            if row[node] >= 0:
                if shared == len(found):
                    found = np.concatenate((found, np.zeros(shared, np.int32)))
                found[shared] = row[node]
                shared += 1
            node = after[node, place]
        ends[k] = shared
    score, begin = np.zeros(rows), 0
    for k in range(len(values)):
        if ends[k] > begin:
            weight = np.log(shared / (ends[k] - begin))
            for at in range(begin, ends[k]):
                score[found[at]] += weight
        begin = ends[k]
    return score
