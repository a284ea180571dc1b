"""Paths of rigid things: places at a few times, eased in between."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .parts import turn

Array = NDArray[np.float64]


@dataclass(frozen=True)
class At:
    """Where a thing is at one time: seconds, metres, degrees about the vertical (not reduced to a turn)."""

    t: float
    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0


def on_track(keys: tuple[At, ...], period: float | None, time: float) -> tuple[Array, Array]:
    """Rotation 3x3 and origin of a thing at a time.

    Args:
        keys: In order of time.
        period: After this it begins again, seconds; None lets it stay at the last place.
        time: Seconds from the start.
    """
    local = time if period is None else time % period
    for a, b in itertools.pairwise(keys):
        if local < b.t:
            s = max(local - a.t, 0.0) / (b.t - a.t)
            e = s * s * (3 - 2 * s)
            place = np.array([a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), a.z + e * (b.z - a.z)])
            return turn(a.yaw + e * (b.yaw - a.yaw)), place
    k = keys[-1]
    return turn(k.yaw), np.array([k.x, k.y, k.z])
