"""Masks in the stage cache, addressed by the image and by the identity of the segmenter."""

from __future__ import annotations

import time
from functools import cache

import numpy as np

from dynslam_bench.contracts.segmenter import Instances, Segmenter
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.fingerprint import code_digest, content_digest, machine_digest
from dynslam_bench.core.records import digest
from dynslam_bench.core.stage_cache import Arrays, StageCache
from dynslam_bench.segmentation.build_segmenter import (
    LOWEST_CONFIDENCE,
    SEGMENTERS,
    ConfiguredSegmenter,
    DeferredSegmenter,
    weights_digest,
)
from dynslam_bench.segmentation.schedule import MaskScheduler

NETWORKS = frozenset({"embedded", "coco", "onnx", "weights", "plugin"})
"""Sources whose masks depend on the colour image alone."""
_PACKAGES = ("core", "contracts", "sequences", "segmentation")
"""The packages whose code decides what a network finds."""


class CachedSegmenter:
    """A segmenter whose results are stored.

    Args:
        segmenter: The segmenter.
        identity: JSON-able description of code, network, weights and settings that change its masks.
        cache: Where results are stored.
        threads: Threads of the network, part of the cost.

    Attributes:
        hit: Whether the result of the last call came from the cache.
        saved_s: Seconds to add to the last call's wall time to get its cost without the cache.
    """

    def __init__(self, segmenter: Segmenter, identity: object, cache: StageCache, threads: int) -> None:
        self._segmenter = segmenter
        self._cache = cache
        self._prefix = digest([identity, machine_digest(), threads])
        self.hit = False
        self.saved_s = 0.0

    def segment(self, frame: Frame) -> Instances:
        """The objects in the frame."""
        begin = time.perf_counter()
        key = digest([self._prefix, content_digest(frame.rgb)], 32)
        entry = self._cache.get("masks", key)
        self.hit = entry is not None
        if entry is not None:
            instances, cost = _unpack(entry.arrays), entry.cost_s
        else:
            segmenter = self._segmenter
            if isinstance(segmenter, DeferredSegmenter):
                segmenter = segmenter.segmenter  # loading is no part of the frame's cost
            start = time.perf_counter()
            instances = segmenter.segment(frame)
            cost = time.perf_counter() - start
            self._cache.put("masks", key, _pack(instances), cost)
        self.saved_s = cost - (time.perf_counter() - begin)
        return instances


def _pack(instances: Instances) -> Arrays:
    arrays: Arrays = {
        "masks": np.packbits(instances.masks),
        "shape": np.array(instances.masks.shape),
        "boxes": instances.boxes,
        "class_names": np.array(instances.class_names, dtype=np.str_),
        "scores": instances.scores,
    }
    return arrays if instances.moving is None else {**arrays, "moving": instances.moving}


def _unpack(stored: Arrays) -> Instances:
    shape = tuple(stored["shape"].tolist())
    masks = np.unpackbits(stored["masks"], count=int(np.prod(shape))).astype(bool).reshape(shape)
    names = tuple(stored["class_names"].tolist())
    return Instances(masks, stored["boxes"], names, stored["scores"], stored.get("moving"))


def cache_segmenter(
    stage: MaskScheduler, cache: StageCache, sequence_id: str, device: str, threads: int
) -> CachedSegmenter | None:
    """Put the cache between a segmentation stage and its network; None for sources that are no network.

    Selection by class and confidence comes after the cache, so that studies over them share its entries.
    """
    configured = stage.segmenter
    if not isinstance(configured, ConfiguredSegmenter) or configured.source.partition(":")[0] not in NETWORKS:
        return None
    settings = configured.settings
    identity = {
        "code": code_of(configured.source),
        "source": configured.source,
        "weights": weights_digest(settings, sequence_id),
        "confidence": min(LOWEST_CONFIDENCE, settings.confidence),
        "settings": {
            name: getattr(settings, name)
            for name in ("mask_threshold", "classes", "network_side", "onnx_normalisation")
        },
        "device": device,
    }
    cached = CachedSegmenter(configured.inner, identity, cache, threads)
    configured.inner = cached
    return cached


@cache
def code_of(source: str) -> str:
    """Digest of the code of a source: this package's, and a plug-in's own.

    It is read once a process, when the plug-in is loaded: later edits of its file do not act in this process.

    Raises:
        PluginError: No such segmenter, or its code cannot be read.
    """
    prefix, _, argument = source.partition(":")
    return code_digest(SEGMENTERS.get(argument if prefix == "plugin" else prefix).entry_point, _PACKAGES)
