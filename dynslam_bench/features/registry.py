"""Feature extractors: by id (built in, or plug-ins of the entry-point group ``dynslam_bench.features``), and cached."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FeatureExtractor, FeatureSpec, Keypoints, MaskedExtractor
from dynslam_bench.core import PluginError
from dynslam_bench.core.fingerprint import content_digest, machine_digest, named_digests
from dynslam_bench.core.plugins import Registry, build_plugin
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import Reconfigurable, Settings
from dynslam_bench.core.stage_cache import ReadsSoFar, StageCache, stage_code
from dynslam_bench.features.settings import FeatureSettings

__all__ = ["FEATURES", "ORB", "FeatureSpec"]

ORB = FeatureSpec(
    id="orb",
    entry_point="dynslam_bench.features.orb:OrbExtractor",
    summary="oriented FAST corners with rotated BRIEF, spread evenly over image and scales",
    license="MIT",
)
"""The extractor that comes with the package."""

FEATURES: Registry[FeatureSpec] = Registry("features", FeatureSpec, lambda: [ORB])
"""Extractors by id, built in and of plug-ins."""


def build_extractor(settings: FeatureSettings | None = None) -> FeatureExtractor:
    """Load and construct the extractor that the settings name.

    Args:
        settings: Which extractor, and its settings; None for the defaults.

    Raises:
        PluginError: No such extractor, or it cannot be built or is no `FeatureExtractor`.
        SettingsError: The extractor refuses the settings.
    """
    settings = settings or FeatureSettings()
    spec = FEATURES.get(settings.extractor)
    return build_plugin(
        "extractor",
        spec,
        FeatureExtractor,  # type: ignore[type-abstract]
        PluginError,
        lambda build: build(settings),
    )


# Keypoints from the stage cache.


class CachedExtractor:
    """An extractor whose results are stored, addressed by the image, the extractor's code and the settings.

    Args:
        extractor: The extractor that the settings name.
        settings: Its settings.
        cache: Where results are stored.
        threads: Threads of the extractor, part of the cost.
        code: Gives the digest of its code, see `stage_code`.

    Attributes:
        hit: Whether the last call's result was stored.
        saved_s: Difference in seconds between the last call's cost without the cache and its wall
            time: the stored cost less the look-up, or minus the time of storing.
    """

    def __init__(
        self,
        extractor: FeatureExtractor,
        settings: Settings,
        cache: StageCache,
        threads: int,
        code: ReadsSoFar,
    ) -> None:
        self._extractor = extractor
        self._cache = cache
        self._threads = threads
        self._code = code
        self._address(settings)
        self.hit = False
        self.saved_s = 0.0

    def configure(self, settings: Settings) -> None:
        """Use other settings, in the extractor too."""
        if isinstance(self._extractor, Reconfigurable):
            self._extractor.configure(settings)
        self._address(settings)

    def _address(self, settings: Settings) -> None:
        """Note what the keypoints depend on beside the image and the code."""
        weights = named_digests(settings)
        self._prefix = digest(
            [weights, settings.model_dump(mode="json"), machine_digest(), self._threads]
        )

    def extract(self, gray: NDArray[np.uint8]) -> Keypoints:
        """The keypoints of a uint8 ``[H, W]`` image."""
        return self._answer([content_digest(gray)], lambda: self._extractor.extract(gray))

    def _answer(self, inputs: list[Any], compute: Callable[[], Keypoints]) -> Keypoints:
        """The stored keypoints, or those that are computed now.

        Args:
            inputs: Digests of the images and numbers that the keypoints depend on.
            compute: Extracts them.
        """
        begin = time.perf_counter()
        # look the inputs up
        code = self._code()
        key = digest([code, self._prefix, *inputs], 32)
        entry = self._cache.get("features", key)
        self.hit = entry is not None
        if entry is not None:
            # stored: the time that the cache saves is the cost less the look-up
            keypoints = Keypoints(**entry.arrays)
            cost = entry.cost_s
        else:
            # not stored: extract and time them
            start = time.perf_counter()
            keypoints = compute()
            cost = time.perf_counter() - start
            # store them, unless the extractor read further code while it ran
            if self._code() == code:
                self._cache.put("features", key, vars(keypoints), cost)
        self.saved_s = cost - (time.perf_counter() - begin)
        return keypoints


class CachedMaskedExtractor(CachedExtractor):
    """A `CachedExtractor` of an extractor with masked extraction."""

    _extractor: MaskedExtractor

    def extract_masked(
        self, gray: NDArray[np.uint8], mask: NDArray[np.bool_], share: float
    ) -> Keypoints:
        """The keypoints of a uint8 ``[H, W]`` image with a mask; see `MaskedExtractor`."""
        inputs = [content_digest(gray), content_digest(mask), share]
        return self._answer(inputs, lambda: self._extractor.extract_masked(gray, mask, share))


def cached_extractor(
    extractor: FeatureExtractor, settings: Settings, cache: StageCache, threads: int
) -> CachedExtractor | None:
    """The extractor with a cache, with masked extraction if it has that; None for one that cannot be cached.

    Raises:
        PluginError: No such extractor.
    """
    code = stage_code(FEATURES.get(str(getattr(settings, "extractor", "orb"))).entry_point)
    if code is None:
        return None
    kind = CachedMaskedExtractor if isinstance(extractor, MaskedExtractor) else CachedExtractor
    return kind(extractor, settings, cache, threads, code)
