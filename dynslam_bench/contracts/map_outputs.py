"""What a tracker's map looks like from outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class KeyframeRecord:
    """One keyframe.

    Attributes:
        id: Number in order of creation.
        frame: Index of its frame; -1 for one of an earlier run, in whose map this one began.
        timestamp: Seconds; NaN for one of an earlier run.
        T_world_cam: Camera-to-world pose ``[4, 4]``.
        features: Features it holds.
        observations: Map points it observes.
        map: 0 for the map that the trajectory is in; another number for one that began after a loss and never met it.
    """

    id: int
    frame: int
    timestamp: float
    T_world_cam: NDArray[np.float64]
    features: int
    observations: int
    map: int = 0


@dataclass(frozen=True, eq=False)
class MapOutputs:
    """Keyframes, oldest first, and map points.

    Attributes:
        keyframes: All keyframes.
        ids: int64 ``[M]`` ids of the points; of maps that never met the first one none: where they lie is unknown.
        positions: float64 ``[M, 3]`` world coordinates, metres.
        colours: uint8 ``[M, 3]`` red, green, blue.
        observations: int64 ``[M]``, keyframes that observe each point.
    """

    keyframes: tuple[KeyframeRecord, ...]
    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observations: NDArray[np.int64]
