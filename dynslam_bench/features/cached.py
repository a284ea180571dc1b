"""Keypoints from the stage cache."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.cache import StageCache, content_digest, machine_digest
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import Settings
from dynslam_bench.core.steering import Steerable

from .keypoints import FeatureExtractor, Keypoints

VERSION = 1
"""Raise it when a change of the extractor changes its keypoints."""


class CachedExtractor:
    """An extractor whose results are stored, addressed by the image and the settings.

    Attributes:
        hit: Whether the last call found its result stored.
        saved_s: Seconds to add to the last call's wall time for what it costs without the cache: what computing it cost
            less the look-up, or minus the time that storing it took.
    """

    def __init__(self, extractor: FeatureExtractor, settings: Settings, cache: StageCache, threads: int) -> None:
        self._extractor = extractor
        self._cache = cache
        self._threads = threads
        self._address(settings)
        self.hit = False
        self.saved_s = 0.0

    def configure(self, settings: Settings) -> None:
        """Put other settings into force, the extractor's too."""
        if isinstance(self._extractor, Steerable):
            self._extractor.configure(settings)
        self._address(settings)

    def _address(self, settings: Settings) -> None:
        self._prefix = digest([VERSION, settings.model_dump(mode="json"), machine_digest(), self._threads])

    def extract(self, gray: NDArray[np.uint8]) -> Keypoints:
        """The keypoints of a uint8 ``[H, W]`` image."""
        begin = time.perf_counter()
        key = digest([self._prefix, content_digest(gray)], 32)
        entry = self._cache.get("features", key)
        self.hit = entry is not None
        if entry is not None:
            stored = entry.arrays
            found = Keypoints(*(stored[name] for name in ("xy", "octave", "angle", "response", "descriptors")))
            self.saved_s = entry.cost_s - (time.perf_counter() - begin)
            return found
        start = time.perf_counter()
        found = self._extractor.extract(gray)
        cost = time.perf_counter() - start
        self._cache.put("features", key, vars(found), cost)
        self.saved_s = cost - (time.perf_counter() - begin)
        return found
