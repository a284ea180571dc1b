"""Inverted index of binary descriptors by their 16-bit substrings (multi-index hashing: Norouzi, Punjani, Fleet 2012).

Scoring every feature of every keyframe takes as long as there are keyframes; the index visits those alone that share a
substring with the frame (inverted files: Sivic and Zisserman, Video Google, ICCV 2003).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

VALUES = 1 << 16
"""Values of a substring."""
STRIDE = 4
"""Every fourth substring is indexed: the others change the ranking little and cost as much again."""
FEATURE_STEP = 256
"""The capacity for features grows in steps of so many."""
SLOTS = 640
"""Initial capacity for keyframes: as many as are kept by default, and some more."""
BLOCK = 8
"""Numbers in a block of a list: the next block, then keyframes. Half a cache line, so that a list is read fast."""
CHANGED = 0.25
"""A keyframe is indexed again when it has gained or lost this share of its points."""

Substrings = NDArray[np.uint16]
Ints = NDArray[np.int32]
Slots = NDArray[np.int64]


class DescriptorIndex:
    """Lists of keyframes by descriptor substring, one entry for each feature that observes a point."""

    def __init__(self) -> None:
        self._reset(0, 0, 0)

    def _reset(self, slots: int, features: int, positions: int) -> None:
        self._ids = np.full(slots, -1, np.int64)
        self._counts = np.zeros(slots, np.int64)
        self._substrings = np.full((slots, features, positions), 0, np.uint16)
        self._first = np.full((positions, VALUES), -1, np.int32)
        self._blocks = np.full((2 * positions * VALUES, BLOCK), -1, np.int32)
        self._free = np.arange(len(self._blocks), dtype=np.int32)
        self._freed = len(self._free)

    def update(self, alive: NDArray[np.bool_], ids: Slots, kf_point: Ints, words: NDArray[np.uint64]) -> None:
        """Index new and changed keyframes, and remove the culled ones.

        Args:
            alive: Of each slot, whether it holds a keyframe ``[S]``.
            ids: Of each slot, its keyframe's id ``[S]``.
            kf_point: Of each slot and feature the point that it observes ``[S, F]``; those with -1 do not count.
            words: Descriptors ``[S, F, W]``.
        """
        substrings = words.view(np.uint16)[:, :, ::STRIDE]
        slots, features, positions = substrings.shape
        if slots > len(self._ids) or features > self._substrings.shape[1] or positions != self._substrings.shape[2]:
            self._reset(max(slots, SLOTS), -(-features // FEATURE_STEP) * FEATURE_STEP, positions)
        current = np.full(len(self._ids), -1, np.int64)
        current[:slots] = np.where(alive, ids, -1)
        changed = current != self._ids
        changed[:slots] |= np.abs(_observed(kf_point, alive) - self._counts[:slots]) > CHANGED * self._counts[:slots]
        for slot in np.flatnonzero(changed).tolist():
            old = self._substrings[slot, : self._counts[slot]]
            self._freed = _remove(self._first, self._blocks, self._free, self._freed, old, slot)
            rows = np.flatnonzero(kf_point[slot] >= 0) if current[slot] >= 0 else np.zeros(0, np.int64)
            self._ids[slot], self._counts[slot] = current[slot], len(rows)
            if not len(rows):
                continue
            self._substrings[slot, : len(rows)] = substrings[slot, rows]
            self._reserve(len(rows) * positions)
            new = self._substrings[slot, : len(rows)]
            self._freed = _insert(self._first, self._blocks, self._free, self._freed, new, slot)

    def _reserve(self, blocks: int) -> None:
        """See that so many blocks are free; adds at least a quarter of the capacity."""
        if self._freed >= blocks:
            return
        before, more = len(self._blocks), max(len(self._blocks) // 4, blocks)
        self._blocks = np.concatenate([self._blocks, np.full((more, BLOCK), -1, np.int32)])
        self._free = np.concatenate([self._free[: self._freed], np.arange(before, before + more, dtype=np.int32)])
        self._free = np.concatenate([self._free, np.zeros(before - self._freed, np.int32)])
        self._freed += more

    def score(self, slots: Slots, words: NDArray[np.uint64]) -> tuple[NDArray[np.float64], Slots]:
        """For each of the keyframes ``[K]`` the sum of the weights of the shared substrings, and its number of points.

        The weight is the logarithm of how much rarer a substring is than all of the frame's together.

        Args:
            slots: Of the keyframes.
            words: The frame's descriptors ``[N, W]``.
        """
        substrings = np.ascontiguousarray(words).view(np.uint16)[:, ::STRIDE]
        values = [np.unique(column) for column in substrings.T]
        position = np.repeat(np.arange(len(values)), [len(column) for column in values])
        row = np.full(len(self._ids), -1, np.int32)
        row[slots] = np.arange(len(slots), dtype=np.int32)
        score = _score(self._first, self._blocks, position, np.concatenate(values), row, len(slots))
        return score, self._counts[slots]


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
def _insert(first: Ints, blocks: Ints, free: Ints, freed: int, substrings: Substrings, slot: int) -> int:
    """Insert a keyframe; returns how many blocks are free then. The first block of a list is the one with room."""
    for position in range(substrings.shape[1]):
        for feature in range(substrings.shape[0]):
            value = substrings[feature, position]
            head = first[position, value]
            if head < 0 or blocks[head, BLOCK - 1] >= 0:
                freed -= 1
                blocks[free[freed], 0] = head
                head = first[position, value] = free[freed]
            at = 1
            while blocks[head, at] >= 0:
                at += 1
            blocks[head, at] = slot
    return freed


@kernel
def _remove(first: Ints, blocks: Ints, free: Ints, freed: int, substrings: Substrings, slot: int) -> int:
    """Remove a keyframe; returns how many blocks are free then. The last entry of the first block fills the gap."""
    for position in range(substrings.shape[1]):
        for feature in range(substrings.shape[0]):
            value = substrings[feature, position]
            head = first[position, value]
            last = BLOCK - 1
            while blocks[head, last] < 0:
                last -= 1
            block, removed = head, False
            while not removed:
                for at in range(1, BLOCK):
                    if blocks[block, at] == slot:
                        blocks[block, at] = blocks[head, last]
                        removed = True
                        break
                block = blocks[block, 0]
            blocks[head, last] = -1
            if last == 1:
                first[position, value] = blocks[head, 0]
                free[freed] = head
                freed += 1
    return freed


@kernel
def _score(
    first: Ints, blocks: Ints, positions: Slots, values: Substrings, row: Ints, rows: int
) -> NDArray[np.float64]:
    score, counts, total = np.zeros(rows), np.zeros(len(values), np.int64), 0
    for k in range(len(values)):
        block = first[positions[k], values[k]]
        while block >= 0:
            for at in range(1, BLOCK):
                slot = blocks[block, at]
                counts[k] += slot >= 0 and row[slot] >= 0
            block = blocks[block, 0]
        total += counts[k]
    for k in range(len(values)):
        block = first[positions[k], values[k]] if counts[k] else -1
        weight = np.log(total / max(counts[k], 1))
        while block >= 0:
            for at in range(1, BLOCK):
                slot = blocks[block, at]
                if slot >= 0 and row[slot] >= 0:
                    score[row[slot]] += weight
            block = blocks[block, 0]
    return score
