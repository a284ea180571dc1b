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
BLOCK = 8
"""Numbers in a block of a list: the block that goes on, and keyframes. It is half a line of the processor's cache, so
that a list is read in as few places of the memory as can be."""
CHANGED = 0.25
"""A keyframe that has gained or lost this share of its points is taken up anew."""

Pieces = NDArray[np.uint16]
Ints = NDArray[np.int32]
Slots = NDArray[np.int64]


class DescriptorIndex:
    """Lists of keyframes by the pieces of their descriptors: once for each feature that observes a point.

    Keyframes that came and went, and those whose points are others by now, are seen to when it is asked.
    """

    def __init__(self) -> None:
        self._begin(0, 0, 0)

    def _begin(self, slots: int, features: int, places: int) -> None:
        self._ids = np.full(slots, -1, np.int64)
        self._counts = np.zeros(slots, np.int64)
        self._pieces = np.full((slots, features, places), 0, np.uint16)  # in memory from now on: it does not grow
        self._first = np.full((places, VALUES), -1, np.int32)
        self._blocks = np.full((2 * places * VALUES, BLOCK), -1, np.int32)
        self._free = np.arange(len(self._blocks), dtype=np.int32)
        self._freed = len(self._free)

    def renew(self, alive: NDArray[np.bool_], ids: Slots, kf_point: Ints, pieces: Pieces) -> None:
        """Take up the keyframes of now.

        Args:
            alive: Of each slot, whether a keyframe is there ``[S]``.
            ids: Of each slot, its keyframe's ``[S]``.
            kf_point: Of each slot and feature the point that it observes ``[S, F]``; those with -1 do not count.
            pieces: Pieces of their descriptors ``[S, F, P]``.
        """
        slots, features, places = pieces.shape
        if slots > len(self._ids) or features > self._pieces.shape[1] or places != self._pieces.shape[2]:
            self._begin(max(slots, SLOTS), -(-features // ROOM) * ROOM, places)
        known = np.full(len(self._ids), -1, np.int64)
        known[:slots] = np.where(alive, ids, -1)
        changed = known != self._ids
        changed[:slots] |= np.abs(_observed(kf_point, alive) - self._counts[:slots]) > CHANGED * self._counts[:slots]
        for slot in np.flatnonzero(changed).tolist():
            old = self._pieces[slot, : self._counts[slot]]
            self._freed = _take_out(self._first, self._blocks, self._free, self._freed, old, slot)
            rows = np.flatnonzero(kf_point[slot] >= 0) if known[slot] >= 0 else np.zeros(0, np.int64)
            self._ids[slot], self._counts[slot] = known[slot], len(rows)
            if not len(rows):
                continue
            self._pieces[slot, : len(rows)] = pieces[slot, rows]
            self._make_room(len(rows) * places)
            new = self._pieces[slot, : len(rows)]
            self._freed = _put_in(self._first, self._blocks, self._free, self._freed, new, slot)

    def _make_room(self, blocks: int) -> None:
        """See that so many blocks are free; there are a quarter more then, if not more are asked for."""
        if self._freed >= blocks:
            return
        had, more = len(self._blocks), max(len(self._blocks) // 4, blocks)
        self._blocks = np.concatenate([self._blocks, np.full((more, BLOCK), -1, np.int32)])
        free = np.zeros(had + more, np.int32)
        free[: self._freed] = self._free[: self._freed]
        free[self._freed : self._freed + more] = np.arange(had, had + more)
        self._free, self._freed = free, self._freed + more

    def score(self, slots: Slots, own: Pieces) -> tuple[NDArray[np.float64], Slots]:
        """For each of the keyframes ``[K]`` the sum of the weights of what it shares with a frame, and its points.

        A piece weighs the logarithm of how much rarer it is than all of the frame's pieces together.

        Args:
            slots: Of the keyframes.
            own: The frame's pieces ``[N, P]``.
        """
        values = [np.unique(own[:, place]) for place in range(own.shape[1])]
        place = np.repeat(np.arange(len(values)), [len(each) for each in values])
        row = np.full(len(self._ids), -1, np.int32)
        row[slots] = np.arange(len(slots), dtype=np.int32)
        lists = self._first, self._blocks, place, np.concatenate(values)
        return _score(*lists, row, len(slots)), self._counts[slots]


@kernel
def _observed(kf_point: Ints, alive: NDArray[np.bool_]) -> Slots:
    """How many points the keyframe of each slot observes."""
    count = np.zeros(len(alive), np.int64)
    for slot in range(len(alive)):
        if alive[slot]:
            for feature in range(kf_point.shape[1]):
                count[slot] += kf_point[slot, feature] >= 0
    return count


@kernel
def _put_in(first: Ints, blocks: Ints, free: Ints, freed: int, pieces: Pieces, slot: int) -> int:
    """List a keyframe; how many blocks are free then. A list begins with the block that has room, if one has."""
    for place in range(pieces.shape[1]):
        for feature in range(pieces.shape[0]):
            value = pieces[feature, place]
            head = first[place, value]
            if head < 0 or blocks[head, BLOCK - 1] >= 0:
                freed -= 1
                blocks[free[freed], 0] = head
                head = first[place, value] = free[freed]
            at = 1
            while blocks[head, at] >= 0:
                at += 1
            blocks[head, at] = slot
    return freed


@kernel
def _take_out(first: Ints, blocks: Ints, free: Ints, freed: int, pieces: Pieces, slot: int) -> int:
    """Take a keyframe from the lists; how many blocks are free then. The last in the first block fills the gap."""
    for place in range(pieces.shape[1]):
        for feature in range(pieces.shape[0]):
            value = pieces[feature, place]
            head = first[place, value]
            last = BLOCK - 1
            while blocks[head, last] < 0:
                last -= 1
            block, found = head, False
            while not found:
                for at in range(1, BLOCK):
                    if blocks[block, at] == slot:
                        blocks[block, at] = blocks[head, last]
                        found = True
                        break
                block = blocks[block, 0]
            blocks[head, last] = -1
            if last == 1:
                first[place, value] = blocks[head, 0]
                free[freed] = head
                freed += 1
    return freed


@kernel
def _score(first: Ints, blocks: Ints, places: Slots, values: Pieces, row: Ints, rows: int) -> NDArray[np.float64]:
    score, own, shared = np.zeros(rows), np.zeros(len(values), np.int64), 0
    for k in range(len(values)):
        block = first[places[k], values[k]]
        while block >= 0:
            for at in range(1, BLOCK):
                slot = blocks[block, at]
                own[k] += slot >= 0 and row[slot] >= 0
            block = blocks[block, 0]
        shared += own[k]
    for k in range(len(values)):
        block = first[places[k], values[k]] if own[k] else -1
        weight = np.log(shared / max(own[k], 1))
        while block >= 0:
            for at in range(1, BLOCK):
                slot = blocks[block, at]
                if slot >= 0 and row[slot] >= 0:
                    score[row[slot]] += weight
            block = blocks[block, 0]
    return score
