"""What an instance decides about its room, drawn so that tuning and held-out instances share nothing.

Every choice of size or place is drawn from the half of its pool that belongs to the instance's split.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream

from ..settings import HELD_OUT_INSTANCES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """What the instance decides about the room.

    Attributes:
        back_y: Distance of the back wall.
        left_x: Left wall.
        right_x: Right wall.
        desk_y: Front edge of the main desk.
        desk_x: Middle of the main desk.
        tints: Colours by thing.
    """

    back_y: float
    left_x: float
    right_x: float
    desk_y: float
    desk_x: float
    monitors: int
    shelf_side: int
    posters: int
    mirrored: bool
    tints: dict[str, Array]


def pick(rng: np.random.Generator, instance: int, low: float, high: float, steps: int = 64) -> float:
    """A value of [low, high] from the even points of a grid for tuning instances, the odd ones for held-out ones."""
    odd = instance in HELD_OUT_INSTANCES
    return low + (high - low) * (2 * int(rng.integers(steps)) + odd) / (2 * steps - 1)


def pick_one(rng: np.random.Generator, instance: int, pool: list[int]) -> int:
    """A member of the split's half of the pool."""
    half = pool[1::2] if instance in HELD_OUT_INSTANCES else pool[::2]
    return half[int(rng.integers(len(half)))]


def plan_room(instance: int, number: int | None = None) -> Plan:
    """Draw the plan of an instance's room, or of one of its several rooms."""
    rng = stream(instance, "synthetic", "room", *(() if number is None else (number,)))

    def color(low: float, high: float, spread: float) -> Array:
        base = pick(rng, instance, low, high)
        return np.clip(base + spread * (rng.random(3) - 0.5), 0.03, 1.0)

    wood = pick(rng, instance, 0.55, 0.95) * np.array([1.0, 0.84, 0.66])
    tints = {
        "wall": color(0.72, 0.92, 0.08),
        "side": color(0.66, 0.9, 0.12),
        "floor": color(0.4, 0.65, 0.1),
        "desk": wood,
        "shelf": color(0.35, 0.8, 0.1),
        "metal": color(0.3, 0.6, 0.04),
        "plastic": color(0.14, 0.3, 0.02),
        "chair": color(0.15, 0.5, 0.35),
        "cabinet": color(0.5, 0.85, 0.15),
        "door": color(0.45, 0.8, 0.2),
        "bin": color(0.2, 0.6, 0.4),
    }
    return Plan(
        back_y=pick(rng, instance, 3.35, 3.75),
        left_x=-pick(rng, instance, 1.9, 2.4),
        right_x=pick(rng, instance, 1.9, 2.4),
        desk_y=pick(rng, instance, 2.0, 2.2),
        desk_x=pick(rng, instance, -0.15, 0.15),
        monitors=pick_one(rng, instance, [2, 3, 2, 3]),
        shelf_side=int(rng.integers(2)) * 2 - 1,
        posters=int(rng.integers(2, 5)),
        mirrored=bool(rng.integers(2)),
        tints=tints,
    )
