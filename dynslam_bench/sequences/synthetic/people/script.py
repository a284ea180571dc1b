"""What people and chairs do: keyed timelines, looped over the whole length of a sequence.

Walking: two people stand near the camera and talk (long enough to enter a map), leave together to one side, come back,
pass each other, sit down on a chair that rolls, rise and leave to the other side. Sitting: two people sit at the desk,
talk and gesture.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

from dynslam_bench.core.seeding import stream

from ..scenes.plan import pick
from .bodies import Posture


@dataclass(frozen=True)
class Key:
    """Where and how a person is at one time; between keys everything eases."""

    t: float
    x: float
    y: float
    facing: float
    sit: float = 0.0
    gesture: float = 0.0


@dataclass(frozen=True)
class ChairKey:
    """Where a chair stands at one time (facing as for people)."""

    t: float
    x: float
    y: float
    facing: float


@dataclass(frozen=True)
class Script:
    """Timelines of two people and two chairs, repeated every `period` seconds."""

    period: float
    people: tuple[tuple[Key, ...], tuple[Key, ...]]
    chairs: tuple[tuple[ChairKey, ...], tuple[ChairKey, ...]]


def write_script(people: str, instance: int) -> Script:
    """The script of an instance."""
    rng = stream(instance, "synthetic", "script", people)
    flip = -1.0 if rng.random() < 0.5 else 1.0

    def j(low: float, high: float) -> float:
        return pick(rng, instance, low, high)

    script = _sitting(j) if people == "sitting" else _walking(j)
    return _mirror(script, flip)


Draw = Callable[[float, float], float]


def _sitting(j: Draw) -> Script:
    """Two people at the desk, talking with their hands."""
    ax, ay, bx, by = -j(0.5, 0.62), j(1.62, 1.74), j(0.46, 0.58), j(1.68, 1.8)
    fa, fb = 180 + j(18, 35), 180 - j(22, 40)
    first = (
        Key(0, ax, ay, fa, 1, 0.39),
        Key(4, ax, ay, fa + 1.5, 1, 0.55),
        Key(8, ax, ay, fa - 1.5, 1, 0.28),
        Key(12, ax, ay, fa, 1, 0.39),
    )
    second = (
        Key(0, bx, by, fb, 1, 0.33),
        Key(3, bx, by, fb - 1.5, 1, 0.22),
        Key(7, bx, by, fb + 1.5, 1, 0.55),
        Key(12, bx, by, fb, 1, 0.33),
    )
    chairs = (
        (ChairKey(0, ax, ay, fa), ChairKey(12, ax, ay, fa)),
        (ChairKey(0, bx, by, fb), ChairKey(12, bx, by, fb)),
    )
    return Script(12.0, (first, second), chairs)


def _walking(j: Draw) -> Script:
    """Two people who walk across the room, stand talking, and sit down."""
    ax, ay, bx, by = -j(0.28, 0.4), j(1.26, 1.38), j(0.3, 0.42), j(1.44, 1.58)
    cx, cy = -j(0.55, 0.7), j(1.62, 1.7)
    side = 1.65
    first = (
        Key(0.0, ax, ay, 200, 0, 1),
        Key(2.1, ax, ay, 220, 0, 1),
        Key(2.4, ax + 0.1, ay, 270, 0, 0.2),
        Key(4.2, side, ay + 0.1, 270),
        Key(4.6, side, ay + 0.1, 90),
        Key(6.3, -ax * 0.6, ay + 0.05, 120, 0, 0.5),
        Key(6.8, -ax * 0.6, ay + 0.05, 170, 0, 1),
        Key(8.9, -ax * 0.6, ay + 0.05, 150, 0, 1),
        Key(9.3, -ax * 0.4, ay, 90),
        Key(11.2, -side, ay + 0.1, 90),
        Key(11.7, -side, ay + 0.1, 270),
        Key(13.2, cx, cy - 0.32, 230),
        Key(13.7, cx, cy - 0.3, 180),
        Key(14.6, cx, cy, 185, 1, 0.4),
        Key(16.4, cx, cy, 200, 1, 1),
        Key(17.2, cx, cy - 0.32, 190),
        Key(18.6, ax, ay, 200, 0, 0.5),
        Key(20.0, ax, ay, 200, 0, 1),
    )
    second = (
        Key(0.0, bx, by, 160, 0, 0.8),
        Key(2.0, bx, by, 170, 0, 1),
        Key(2.3, bx, by, 270),
        Key(3.6, side - 0.1, by + 0.1, 270),
        Key(4.4, side - 0.1, by + 0.1, 90),
        Key(6.0, bx - 0.75, by, 110, 0, 0.5),
        Key(6.6, bx - 0.75, by, 190, 0, 1),
        Key(9.0, bx - 0.75, by, 200, 0, 1),
        Key(9.3, bx - 0.8, by, 90),
        Key(10.6, -side, by + 0.05, 90),
        Key(11.4, -side, by + 0.05, 270),
        Key(14.2, bx + 0.05, by + 0.05, 250, 0, 0.5),
        Key(14.8, bx + 0.05, by, 150, 0, 1),
        Key(18.0, bx, by, 150, 0, 1),
        Key(20.0, bx, by, 160, 0, 0.8),
    )
    return Script(20.0, (first, second), _chairs(cx, cy))


def _chairs(cx: float, cy: float) -> tuple[tuple[ChairKey, ...], tuple[ChairKey, ...]]:
    """A chair that rolls as somebody sits down on it and rises, and one that is pushed in passing."""
    rest_y = cy + 0.2
    first = (
        ChairKey(0, cx, rest_y, 100),
        ChairKey(13.2, cx, rest_y, 100),
        ChairKey(14.3, cx, cy, 185),
        ChairKey(14.9, cx, cy, 185),
        ChairKey(16.2, cx, cy, 205),
        ChairKey(16.6, cx, cy, 195),
        ChairKey(17.5, cx, rest_y, 110),
        ChairKey(20, cx, rest_y, 100),
    )
    second = (
        ChairKey(0, 0.85, 1.88, 20),
        ChairKey(2.6, 0.85, 1.88, 20),
        ChairKey(3.2, 0.9, 2.0, 45),
        ChairKey(4.9, 0.9, 2.0, 45),
        ChairKey(5.5, 0.84, 1.93, 5),
        ChairKey(13.0, 0.84, 1.93, 5),
        ChairKey(13.8, 0.85, 1.88, 20),
        ChairKey(20, 0.85, 1.88, 20),
    )
    return first, second


def _mirror(script: Script, sign: float) -> Script:
    """The script with left and right exchanged if `sign` is negative."""
    if sign > 0:
        return script
    people = tuple(tuple(Key(k.t, -k.x, k.y, -k.facing, k.sit, k.gesture) for k in person) for person in script.people)
    chairs = tuple(tuple(ChairKey(k.t, -k.x, k.y, -k.facing) for k in chair) for chair in script.chairs)
    return Script(script.period, (people[0], people[1]), (chairs[0], chairs[1]))


def _ease(x: float) -> float:
    return x * x * (3 - 2 * x)


def _angle(a: float, b: float, s: float) -> float:
    """From a to b degrees the short way round."""
    return a + s * ((b - a + 180.0) % 360.0 - 180.0)


def posture(keys: tuple[Key, ...], period: float, t: float) -> Posture:
    """The posture of a person at time t (seconds)."""
    local = t % period
    stride = 0.0
    for a, b in itertools.pairwise(keys):
        dx, dy = b.x - a.x, b.y - a.y
        distance = math.sqrt(dx * dx + dy * dy)
        if local >= b.t:
            stride += distance
            continue
        span = b.t - a.t
        s = (local - a.t) / span
        e = _ease(s)
        speed = distance / span * 6 * s * (1 - s)
        stride += distance * e
        return Posture(
            a.x + e * dx,
            a.y + e * dy,
            _angle(a.facing, b.facing, _ease(min(s * 1.5, 1.0))),
            stride * 2 * math.pi / 1.35,
            min(speed / 0.9, 1.0),
            a.sit + e * (b.sit - a.sit),
            a.gesture + e * (b.gesture - a.gesture),
            t,
        )
    k = keys[-1]
    return Posture(k.x, k.y, k.facing, stride * 2 * math.pi / 1.35, 0.0, k.sit, k.gesture, t)


def chair_place(keys: tuple[ChairKey, ...], period: float, t: float) -> tuple[float, float, float]:
    """x, y (metres) and facing (degrees) of a chair at time t."""
    local = t % period
    for a, b in itertools.pairwise(keys):
        if local < b.t:
            e = _ease((local - a.t) / (b.t - a.t))
            return a.x + e * (b.x - a.x), a.y + e * (b.y - a.y), _angle(a.facing, b.facing, e)
    k = keys[-1]
    return k.x, k.y, k.facing
