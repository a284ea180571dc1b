"""People of articulated volumes: a skeleton by forward kinematics, clothed with round cones and ellipsoids."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import cos, power, product, sin
from dynslam_bench.sequences.synthetic.parts import ROUND_CONE, Parts, along, turn
from dynslam_bench.sequences.synthetic.rooms import pick, pick_one

Array = NDArray[np.float64]
_X = np.array([1.0, 0.0, 0.0])
_Y = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Person:
    """What does not change about a person: size, build, colours and clothes."""

    instance: int
    height: float
    build: float
    skin: Array
    hair: Array
    trousers: Array
    shoes: Array
    shirt: str
    shirt_tint: Array
    long_hair: bool
    long_sleeves: bool
    cap: bool


@dataclass(frozen=True)
class Posture:
    """What a person does at one time.

    Attributes:
        x: Place on the floor, metres.
        y: Place on the floor, metres.
        facing: Direction of the body in degrees; 0 looks along +y, counter-clockwise.
        stride: Phase of the gait in radians.
        gait: 0 stands, 1 walks at full stride.
        sit: 0 stands, 1 sits.
        gesture: 0 arms at rest, 1 lively.
        clock: Seconds, drives gestures, breathing and sway.
    """

    x: float
    y: float
    facing: float
    stride: float
    gait: float
    sit: float
    gesture: float
    clock: float


def draw_person(scene: int, index: int) -> Person:
    """The `index`-th person (0 or 1) of a scene; the first always wears plaid, the other any pattern."""
    rng = stream(scene, "synthetic", "person", index)
    skins = np.array(
        [
            [1.0, 0.84, 0.74],
            [0.93, 0.74, 0.6],
            [0.8, 0.6, 0.46],
            [0.6, 0.42, 0.31],
            [0.98, 0.8, 0.68],
            [0.45, 0.31, 0.23],
        ]
    )
    hairs = np.array(
        [
            [0.1, 0.08, 0.07],
            [0.3, 0.19, 0.11],
            [0.52, 0.36, 0.2],
            [0.16, 0.11, 0.08],
            [0.62, 0.5, 0.3],
            [0.45, 0.43, 0.42],
        ]
    )
    shirt = (
        ("plaid:0", "plaid:1")[index]
        if index == 0
        else ("print", "print", "plaid:1", "plaid:1", "stripes", "stripes")[pick_one(rng, scene, list(range(6)))]
    )
    return Person(
        instance=index + 1,
        height=pick(rng, scene, 1.62, 1.88),
        build=pick(rng, scene, 0.92, 1.12),
        skin=skins[pick_one(rng, scene, list(range(6)))],
        hair=hairs[pick_one(rng, scene, list(range(6)))] * (0.8 + 0.4 * rng.random()),
        trousers=np.array([[0.25, 0.32, 0.5], [0.2, 0.21, 0.25], [0.55, 0.48, 0.37], [0.32, 0.34, 0.3]])[
            pick_one(rng, scene, list(range(4)))
        ]
        * (0.85 + 0.3 * rng.random()),
        shoes=0.12 + 0.3 * rng.random() * np.ones(3),
        shirt=shirt,
        shirt_tint=np.clip(1.0 - 0.1 * rng.random(3), 0, 1),
        long_hair=bool(rng.random() < 0.4),
        long_sleeves=bool(rng.random() < 0.6),
        cap=bool(rng.random() < 0.15),
    )


def _pitch(angle: float) -> Array:
    """About the person's right-hand axis; positive swings a hanging limb forward."""
    c, s = cos(angle), sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _roll(angle: float) -> Array:
    """About the person's forward axis; positive swings a hanging limb to the left (-x)."""
    c, s = cos(angle), sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _yaw(angle: float) -> Array:
    return turn(math.degrees(angle))


Style = dict[str, Any]
"""Instance, texture, tint and so on of `Parts.add`."""


class _Figure:
    """A person in a posture: the joints that everything hangs on, and how to add a primitive.

    Who sits leans back: arms and head go on, the trunk hardly moves.
    """

    def __init__(self, parts: Parts, who: Person, how: Posture) -> None:
        self.parts, self.who, self.how = parts, who, how
        self.k, self.b = who.height / 1.75, who.build
        self.seed = 1.7 * who.instance
        k, gait, sit, lively, wave = self.k, how.gait, how.sit, how.gesture, self.wave
        pelvis_z = self._stand()
        body = turn(how.facing)
        sway = (1 - gait) * (1 - 0.85 * sit)
        supple = 1 - 0.8 * sit
        swaying = np.array([0.012 * sway * wave(0.31, 0.0), 0.012 * sway * wave(0.23, 2.0), 0.0])
        self.root = np.array([how.x, how.y, pelvis_z]) + product(body, swaying)
        twist = gait * 0.1 * sin(how.stride) + supple * lively * 0.12 * wave(0.27, 0.4)
        lean = 0.05 * gait + sit * 0.06 + supple * (0.02 * wave(0.19, 1.0) + lively * 0.04 * wave(0.43, 0.2))
        self.trunk = product(body, _yaw(twist), _pitch(-lean), _roll(0.02 * supple * wave(0.17, 0.7)))
        self.hipline = product(body, _yaw(-twist))
        self.neck = self.root + product(self.trunk, np.array([0.0, -0.005, 0.46 * k + 0.05 * k]))
        self.jeans: Style = self._style("denim", who.trousers, repeat=(2.0, 3.0))
        self.shirt: Style = self._style(who.shirt, who.shirt_tint)
        self.bare: Style = self._style("plain", who.skin)

    def _style(self, texture: str, tint: Any, **more: Any) -> Style:
        return {"instance": self.who.instance, "texture": texture, "tint": tint, **more}

    def _stand(self) -> float:
        """Hip and knee angles of the gait, blended with sitting; the pelvis rests on the lower foot or on the seat."""
        how, k = self.how, self.k
        thigh, shin, foot = 0.43 * k, 0.41 * k, 0.085 * k
        phase, gait, sit = how.stride, how.gait, how.sit
        self.hips: list[float] = []
        self.knees: list[float] = []
        for side in (-1, 1):
            swing = phase + (0.0 if side < 0 else math.pi)
            hip = gait * (0.08 + 0.46 * sin(swing))
            knee = gait * (0.12 + 0.85 * max(0.0, cos(swing)) * max(0.0, cos(swing))) + 0.03
            self.hips.append(hip * (1 - sit) + sit * (1.45 + 0.03 * side))
            self.knees.append(knee * (1 - sit) + sit * (1.35 + 0.12 * side))
        bent = zip(self.hips, self.knees, strict=True)
        standing = max(thigh * cos(h) + shin * cos(h - n) for h, n in bent) + foot
        seat = 0.485 + 0.085 * self.b
        return standing * (1 - sit) + sit * seat

    def wave(self, f: float, p: float) -> float:
        """Idle movement: a sine of frequency f in Hz and phase p."""
        return sin(2 * math.pi * f * self.how.clock + p + self.seed)

    def limb(self, a: Array, c: Array, ra: float, rc: float, side: Array, flat: float = 1.0, **style: Any) -> None:
        """A round cone from a to c; its section is `flat` times as wide across `side`'s normal."""
        rotation, length = along(a, c, side)
        self.parts.add(ROUND_CONE, rotation, a, (length, ra, rc), scale=(1.0, flat, 1.0), **style)

    def ball(self, centre: Array, rotation: Array, radii: tuple[float, float, float], **style: Any) -> None:
        """An ellipsoid."""
        self.parts.add(ROUND_CONE, rotation, centre, (0.0, 1.0, 1.0), scale=radii, **style)


def add_person(parts: Parts, who: Person, how: Posture) -> None:
    """Add the person's primitives, always as many and in the same order."""
    figure = _Figure(parts, who, how)
    _add_trunk(figure)
    _add_head(figure)
    for index, side in enumerate((-1, 1)):
        _add_arm(figure, side)
        _add_leg(figure, side, index)


def _add_trunk(f: _Figure) -> None:
    """Pelvis, belly, chest, shoulders; wider than deep."""
    k, b, root, trunk, hipline = f.k, f.b, f.root, f.trunk, f.hipline
    right = product(trunk, _X)
    f.limb(
        root + product(hipline, np.array([-0.055 * k, 0, 0.01])),
        root + product(hipline, np.array([0.055 * k, 0, 0.01])),
        0.115 * k * b,
        0.115 * k * b,
        product(hipline, np.array([0.0, 0.0, 1.0])),
        0.95,
        **f.jeans,
    )
    waist = root + product(trunk, np.array([0.0, 0.0, 0.08 * k]))
    chest = root + product(trunk, np.array([0.0, 0.005, 0.36 * k]))
    f.limb(waist, chest, 0.148 * k * b, 0.168 * k * b, right, 0.68, repeat=(5.0, 6.0), **f.shirt)
    f.limb(
        chest - right * 0.11 * k * b + product(trunk, np.array([0, 0, 0.05 * k])),
        chest + right * 0.11 * k * b + product(trunk, np.array([0, 0, 0.05 * k])),
        0.088 * k * b,
        0.088 * k * b,
        product(trunk, _Y),
        1.0,
        repeat=(3.0, 6.0),
        **f.shirt,
    )


def _add_head(f: _Figure) -> None:
    """Neck and head, which looks about."""
    k, who, trunk, neck, gait, lively = f.k, f.who, f.trunk, f.neck, f.how.gait, f.how.gesture
    right = product(trunk, _X)
    skull = neck + product(trunk, np.array([0.0, 0.015 * k, 0.15 * k]))
    head = product(
        trunk,
        _yaw(0.3 * f.wave(0.13, 0.9) * (1 - gait) + 0.1 * lively * f.wave(0.4, 0.1)),
        _pitch(0.06 * f.wave(0.29, 0.3) - 0.03),
    )
    f.limb(
        neck - product(trunk, np.array([0, 0, 0.04 * k])),
        skull - product(trunk, np.array([0, 0.01, 0.03 * k])),
        0.058 * k,
        0.052 * k,
        right,
        **f.bare,
    )
    f.ball(
        skull,
        head,
        (0.077 * k, 0.098 * k, 0.122 * k),
        instance=who.instance,
        texture="face",
        tint=who.skin,
        repeat=(1.0, 0.5),
        shift=(0.5, 0.5),
    )
    f.ball(
        skull + product(head, np.array([0, 0.092 * k, -0.012 * k])), head, (0.015 * k, 0.022 * k, 0.026 * k), **f.bare
    )
    for side in (-1, 1):
        f.ball(
            skull + product(head, np.array([side * 0.077 * k, -0.005, -0.01])),
            head,
            (0.012 * k, 0.024 * k, 0.033 * k),
            **f.bare,
        )
    _add_hair(f, skull, head)


def _add_hair(f: _Figure, skull: Array, head: Array) -> None:
    k, who = f.k, f.who
    mane: Style = {"instance": who.instance, "texture": "hair", "repeat": (3.0, 0.5), "tint": who.hair}
    f.ball(
        skull + product(head, np.array([0, -0.018 * k, 0.03 * k])),
        product(head, _pitch(0.35)),
        (0.086 * k, 0.101 * k, 0.108 * k),
        **mane,
    )
    if who.long_hair:
        f.limb(
            skull + product(head, np.array([0, -0.06, 0.0])),
            skull + product(head, np.array([0, -0.075, -0.15 * k])),
            0.075 * k,
            0.055 * k,
            product(head, _X),
            0.6,
            **{**mane, "repeat": (4.0, 2.0)},
        )
    if who.cap:
        f.ball(
            skull + product(head, np.array([0, 0.01, 0.075 * k])),
            product(head, _pitch(0.15)),
            (0.088 * k, 0.108 * k, 0.065 * k),
            **{**mane, "tint": who.trousers},
        )
        f.ball(
            skull + product(head, np.array([0, 0.12 * k, 0.06 * k])),
            head,
            (0.07 * k, 0.06 * k, 0.008 * k),
            **{**mane, "tint": who.trousers},
        )


def _add_arm(f: _Figure, side: int) -> None:
    """Counter-swing of the gait, gestures with the hands before the chest, hands on the lap when sitting."""
    k, b, who, trunk, neck = f.k, f.b, f.who, f.trunk, f.neck
    gait, sit, lively, upper, fore = f.how.gait, f.how.sit, f.how.gesture, 0.29 * k, 0.26 * k
    swing = f.how.stride + (math.pi if side < 0 else 0.0)
    talk = lively * power(0.5 + 0.5 * f.wave(0.11, 1.5 * side), 0.7)
    pitch = gait * 0.42 * sin(swing) + sit * (1 - talk) * 0.35 + talk * (0.45 + 0.35 * f.wave(0.47 + 0.06 * side, side))
    abduct = side * (0.14 + 0.05 * (1 - gait) + talk * (0.12 + 0.15 * f.wave(0.33, 2.0 * side)))
    bend = (
        0.2
        + gait * (0.25 + 0.15 * sin(swing))
        + sit * (1 - talk) * 0.95
        + talk * (1.35 + 0.5 * f.wave(0.61, 1.1 * side))
    )
    shoulder = neck + product(trunk, np.array([side * 0.185 * k * b, 0.0, -0.055 * k]))
    arm = product(trunk, _roll(-abduct), _pitch(pitch))
    elbow = shoulder + product(arm, np.array([0, 0, -upper]))
    lower = product(arm, _roll(side * 0.35 * min(bend, 1.0)), _pitch(bend))
    wrist = elbow + product(lower, np.array([0, 0, -fore]))
    f.limb(shoulder, elbow, 0.062 * k * b, 0.046 * k * b, product(arm, _Y), repeat=(2.0, 6.0), **f.shirt)
    if who.long_sleeves:
        f.limb(elbow, wrist, 0.045 * k * b, 0.034 * k * b, product(lower, _Y), repeat=(2.0, 6.0), **f.shirt)
    else:
        f.limb(elbow, wrist, 0.041 * k * b, 0.028 * k * b, product(lower, _Y), **f.bare)
    hand = product(lower, _pitch(0.25 * f.wave(0.7, side)))
    f.ball(wrist + product(hand, np.array([0, 0.005, -0.055 * k])), hand, (0.022 * k, 0.038 * k, 0.058 * k), **f.bare)
    f.ball(
        wrist + product(hand, np.array([0.0, 0.035 * k, -0.035 * k])),
        product(hand, _pitch(0.6)),
        (0.011 * k, 0.013 * k, 0.034 * k),
        **f.bare,
    )


def _add_leg(f: _Figure, side: int, index: int) -> None:
    k, b, who, root, hipline, sit = f.k, f.b, f.who, f.root, f.hipline, f.how.sit
    thigh, shin, hip, knee = 0.43 * k, 0.41 * k, f.hips[index], f.knees[index]
    joint = root + product(hipline, np.array([side * 0.095 * k * b, 0.0, -0.01]))
    upper_leg = product(hipline, _roll(-side * (0.02 + 0.1 * sit)), _pitch(hip))
    knee_at = joint + product(upper_leg, np.array([0, 0, -thigh]))
    lower_leg = product(upper_leg, _pitch(-knee))
    ankle = knee_at + product(lower_leg, np.array([0, 0, -shin]))
    f.limb(joint, knee_at, 0.088 * k * b, 0.061 * k * b, product(upper_leg, _Y), **f.jeans)
    f.limb(knee_at, ankle, 0.06 * k * b, 0.045 * k * b, product(lower_leg, _Y), **f.jeans)
    ground = product(hipline, _pitch((hip - knee) * 0.6 * (1 - sit)))
    heel, toe = (
        ankle + product(ground, np.array([0, -0.03, -0.035 * k])),
        ankle + product(ground, np.array([0, 0.15 * k, -0.05 * k])),
    )
    f.limb(
        heel,
        toe,
        0.045 * k,
        0.034 * k,
        product(ground, _X),
        0.95,
        instance=who.instance,
        texture="plain",
        tint=who.shoes,
    )


# What people and chairs do: keyed timelines, looped over the whole length of a sequence.


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
    """The place of a chair at one time (facing as for people)."""

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


def write_script(people: str, scene: int) -> Script:
    """The script of a scene."""
    rng = stream(scene, "synthetic", "script", people)
    flip = -1.0 if rng.random() < 0.5 else 1.0

    def j(low: float, high: float) -> float:
        return pick(rng, scene, low, high)

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
    """A chair that rolls when a person sits down on it and rises, and one that is pushed in passing."""
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
    """From a to b degrees through the smaller angle."""
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
