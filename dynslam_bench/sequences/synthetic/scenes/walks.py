"""Long ways of a hand-held camera: closed walks along way points, at walking pace, exact at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream

from ..arithmetic import arctan2, norm, product, sin
from .camera_paths import EYE_HEIGHT_M, TILT_RAD, camera_axes, hand, rotations

Array = NDArray[np.float64]
_STEP_M = 0.4
"""Distance of the spline's control points."""


@dataclass(frozen=True)
class Walk:
    """A closed walk, lap after lap.

    Its ground plan is the uniform cubic B-spline on points that stand `_STEP_M` apart along a polygon: it cuts corners
    and slows down there, and has continuous speed and acceleration.

    Attributes:
        control: Control points ``[N, 2]``, metres.
        lap_s: Seconds a lap.
    """

    control: Array
    lap_s: float

    def at(self, times: Array) -> Array:
        """Places ``[N, 2]`` at times (seconds)."""
        s = np.asarray(times, dtype=np.float64) * (len(self.control) / self.lap_s)
        i = np.floor(s).astype(np.int64)
        f = (s - i)[:, None]
        g, n = 1 - f, len(self.control)
        before, here, after, beyond = (self.control[(i + k) % n] for k in (-1, 0, 1, 2))
        return np.asarray(
            g * g * g / 6 * before
            + (3 * f * f * f - 6 * f * f + 4) / 6 * here
            + (-3 * f * f * f + 3 * f * f + 3 * f + 1) / 6 * after
            + f * f * f / 6 * beyond
        )

    def time_nearest(self, place: tuple[float, float]) -> float:
        """When, in the first lap, the walk is nearest to a place."""
        times = np.linspace(0.0, self.lap_s, 4 * len(self.control), endpoint=False)
        return float(times[norm(self.at(times) - place).argmin()])


def walk_along(corners: list[tuple[float, float]], speed: float) -> Walk:
    """The closed walk around a polygon, at `speed` m/s where it is straight."""
    ends = np.array([*corners, corners[0]], dtype=np.float64)
    reach = np.concatenate([[0.0], np.cumsum(norm(np.diff(ends, axis=0)))])
    n = round(reach[-1] / _STEP_M)
    s = np.arange(n) * reach[-1] / n
    return Walk(np.stack([np.interp(s, reach, ends[:, k]) for k in range(2)], axis=1), float(reach[-1]) / speed)


def walking_camera(walk: Walk, instance: int, name: str, aside_deg: float, times: Array) -> Array:
    """Poses ``[N, 4, 4]`` of a camera that is carried along a walk.

    Args:
        walk: The way.
        instance: Seeds the hand's jitter and how each lap strays from the others.
        name: Names that seed.
        aside_deg: How far the camera looks to the left of where it goes; it looks around by 12 degrees more.
        times: Seconds from the start.
    """
    rng = stream(instance, "synthetic", "walk", name)
    t = np.asarray(times, dtype=np.float64)
    step_s = walk.lap_s / len(walk.control)
    ahead = walk.at(t + 2.3 * step_s) - walk.at(t - 0.8 * step_s)
    forward = arctan2(ahead[:, 1], ahead[:, 0])
    stray = 0.12 * _slow(rng, t, 2)
    steps = 0.012 * sin(2 * math.pi * 1.7 * t)[:, None] * np.array([0.0, 0.0, 1.0])
    heading = forward + math.radians(aside_deg) + math.radians(12.0) * _slow(rng, t, 1)[:, 0]
    turned = np.zeros((len(t), 3))
    turned[:, 2] = heading - math.pi / 2  # about the world's z axis; the camera at rest looks along +y
    angles = hand(rng, t, math.radians(0.7), 3)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = product(rotations(turned), camera_axes(TILT_RAD), rotations(angles))
    poses[:, :2, 3] = walk.at(t) + stray
    poses[:, 2, 3] = EYE_HEIGHT_M
    poses[:, :3, 3] += steps + hand(rng, t, 0.006, 3)
    return poses


def _slow(rng: np.random.Generator, t: Array, axes: int) -> Array:
    """Smooth wandering within about [-1, 1] that does not repeat from lap to lap."""
    total = np.zeros((len(t), axes))
    for period in (17.3, 7.1):
        total += 0.5 * sin(2 * math.pi * (t[:, None] / (period * (0.9 + 0.2 * rng.random(axes))) + rng.random(axes)))
    return total
