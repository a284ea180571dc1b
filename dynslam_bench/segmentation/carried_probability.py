"""Probability maps carried from frame to frame, so that a person whom a network misses for a frame stays masked."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.segmentation.schedule import dense_flow

FLOW_SIDE = 120
"""Shorter side of the images that flow is computed on: people are large, and it takes about a millisecond."""
LEAST_WEIGHT = 0.01
"""Maps that count for less are not carried: no threshold is so low."""

Maps = NDArray[np.float32]


class CarriedProbability:
    """Joins a network's probability maps with those of the frames before, ``max(p, decay * warped)``.

    The maps of the frame before are read where dense flow (DIS) says that each pixel came from.
    Over a gap of k frames they count ``decay ** k``.

    Args:
        decay: Weight of the map of the frame before, 0 (nothing is carried) to 1 (nothing is forgotten).
    """

    def __init__(self, decay: float) -> None:
        self.decay = decay
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        self._index = -1
        self._gray: NDArray[np.uint8] | None = None
        self._maps: Maps | None = None

    def join(self, maps: Maps, gray: NDArray[np.uint8], index: int) -> Maps:
        """The maps of a frame, joined with those of the frames before.

        Args:
            maps: float32 ``[K, h, w]``, probabilities by the network.
            gray: uint8 ``[H, W]``, the frame's intensities.
            index: The frame's index; one that is not larger than the last begins a new sequence.
        """
        joined = maps
        gap = index - self._index
        if self._maps is not None and self._gray is not None and gap > 0:
            weight = self.decay**gap
            if weight >= LEAST_WEIGHT and self._gray.shape == gray.shape:
                warped = _warped(self._maps, dense_flow(gray, self._gray, FLOW_SIDE))
                joined = np.maximum(maps, np.float32(weight) * warped)
        self._index = index
        self._gray = gray
        self._maps = joined
        return joined


def _warped(maps: Maps, flow: NDArray[np.float32]) -> Maps:
    """Maps ``[K, h, w]`` read where a flow to their image points to, of any resolution ``[a, b, 2]``; 0 outside."""
    height, width = maps.shape[1:]
    # the flow at the maps' size, in their pixels
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    resized = np.asarray(cv2.resize(flow, (width, height)), np.float32) * scale
    x = np.arange(width, dtype=np.float32)[None] + resized[:, :, 0]
    y = np.arange(height, dtype=np.float32)[:, None] + resized[:, :, 1]
    return np.stack([np.asarray(cv2.remap(plane, x, y, cv2.INTER_LINEAR)) for plane in maps])
