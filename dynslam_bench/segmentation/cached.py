"""Masks from the stage cache."""

from __future__ import annotations

import time

import numpy as np

from dynslam_bench.core.cache import StageCache, content_digest, machine_digest
from dynslam_bench.core.records import digest
from dynslam_bench.sequences.frame import Frame

from .instances import Instances, Segmenter

VERSION = 1
"""Raise it when a change of a segmenter changes its masks."""


class CachedSegmenter:
    """A segmenter whose results are stored, addressed by the image and by what the segmenter is.

    Args:
        segmenter: Who segments.
        identity: JSON-able description of network, weights and settings that change its masks.
        cache: Where results are stored.
        threads: Threads of the network, part of the cost.

    Attributes:
        cost_s: What the last call cost when it was computed, seconds; None if it was computed just now.
    """

    def __init__(self, segmenter: Segmenter, identity: object, cache: StageCache, threads: int) -> None:
        self._segmenter = segmenter
        self._cache = cache
        self._prefix = digest([VERSION, identity, machine_digest(), threads])
        self.cost_s: float | None = None

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame."""
        key = digest([self._prefix, content_digest(frame.rgb)], 32)
        entry = self._cache.get("masks", key)
        if entry is not None:
            self.cost_s = entry.cost_s
            stored = entry.arrays
            shape = tuple(stored["shape"].tolist())
            masks = np.unpackbits(stored["masks"], count=int(np.prod(shape))).astype(bool).reshape(shape)
            names = tuple(stored["class_names"].tolist())
            moving = stored.get("moving")
            return Instances(masks, stored["boxes"], names, stored["scores"], moving)
        start = time.perf_counter()
        found = self._segmenter.segment(frame)
        cost = time.perf_counter() - start
        arrays = {
            "masks": np.packbits(found.masks), "shape": np.array(found.masks.shape), "boxes": found.boxes,
            "class_names": np.array(found.class_names, dtype=np.str_), "scores": found.scores,
        }  # fmt: skip
        if found.moving is not None:
            arrays["moving"] = found.moving
        self._cache.put("masks", key, arrays, cost)
        self.cost_s = None
        return found
