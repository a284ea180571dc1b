"""People of articulated volumes: a skeleton by forward kinematics, clothed with round cones and ellipsoids."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import Array, cos, power, product, sin
from dynslam_bench.sequences.synthetic.parts import (
    Key,
    Parts,
    Primitive,
    along,
    angle_between,
    between,
    cone,
    ease,
    turn,
)
from dynslam_bench.sequences.synthetic.rooms import pick, pick_one

_X, _Y, _Z = np.eye(3)

_SKINS = np.array(
    [
        [1.0, 0.84, 0.74],
        [0.93, 0.74, 0.6],
        [0.8, 0.6, 0.46],
        [0.6, 0.42, 0.31],
        [0.98, 0.8, 0.68],
        [0.45, 0.31, 0.23],
    ]
)
_HAIRS = np.array(
    [
        [0.1, 0.08, 0.07],
        [0.3, 0.19, 0.11],
        [0.52, 0.36, 0.2],
        [0.16, 0.11, 0.08],
        [0.62, 0.5, 0.3],
        [0.45, 0.43, 0.42],
    ]
)
_TROUSERS = np.array([[0.25, 0.32, 0.5], [0.2, 0.21, 0.25], [0.55, 0.48, 0.37], [0.32, 0.34, 0.3]])
_SHIRTS = ("print", "print", "plaid:1", "plaid:1", "stripes", "stripes")


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
    """The `index`-th person of a scene; the first always wears plaid, the others any pattern."""
    rng = stream(scene, "synthetic", "person", index)
    shirt = "plaid:0" if index == 0 else _SHIRTS[pick_one(rng, scene, list(range(6)))]
    return Person(
        instance=index + 1,
        height=pick(rng, scene, 1.62, 1.88),
        build=pick(rng, scene, 0.92, 1.12),
        skin=_SKINS[pick_one(rng, scene, list(range(6)))],
        hair=_HAIRS[pick_one(rng, scene, list(range(6)))] * (0.8 + 0.4 * rng.random()),
        trousers=_TROUSERS[pick_one(rng, scene, list(range(4)))] * (0.85 + 0.3 * rng.random()),
        shoes=0.12 + 0.3 * rng.random() * np.ones(3),
        shirt=shirt,
        shirt_tint=np.clip(1.0 - 0.1 * rng.random(3), 0, 1),
        long_hair=bool(rng.random() < 0.4),
        long_sleeves=bool(rng.random() < 0.6),
        cap=bool(rng.random() < 0.15),
    )


def _pitch(angle: float) -> Array:
    """About the person's right-hand axis; positive swings a hanging limb forward."""
    c = cos(angle)
    s = sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _roll(angle: float) -> Array:
    """About the person's forward axis; positive swings a hanging limb to the left (-x)."""
    c = cos(angle)
    s = sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _yaw(angle: float) -> Array:
    return turn(math.degrees(angle))


def _in(frame: Array, x: float, y: float, z: float) -> Array:
    """A vector that is given in the axes of a part of the body."""
    return product(frame, np.array([x, y, z]))


class _Figure:
    """A person in a posture, and how limbs of theirs are made.

    Attributes:
        k: Size relative to a height of 1.75 m.
        b: Build, relative width of the limbs.
        hips: Angle of the left and the right hip, radians.
        knees: Angle of the left and the right knee, radians.
        root: The middle of the pelvis, metres.
        trunk: Axes of the trunk. Who sits leans back: arms and head go on, the trunk hardly moves.
        hipline: Axes of the pelvis.
        neck: Where the neck begins.
    """

    def __init__(self, who: Person, how: Posture) -> None:
        self.who = who
        self.how = how
        self.k = k = who.height / 1.75
        self.b = who.build
        gait = how.gait
        sit = how.sit
        lively = how.gesture
        wave = self.wave
        body = turn(how.facing)
        self.hips = []
        self.knees = []
        for side in (-1, 1):
            swing = how.stride + (0.0 if side < 0 else math.pi)
            bent = max(0.0, cos(swing))
            self.hips.append(
                gait * (0.08 + 0.46 * sin(swing)) * (1 - sit) + sit * (1.45 + 0.03 * side)
            )
            knee = gait * (0.12 + 0.85 * bent * bent) + 0.03
            self.knees.append(knee * (1 - sit) + sit * (1.35 + 0.12 * side))
        legs = zip(self.hips, self.knees, strict=True)
        standing = (
            max(0.43 * k * cos(hip) + 0.41 * k * cos(hip - knee) for hip, knee in legs) + 0.085 * k
        )
        # on the lower foot, or on the seat
        pelvis_z = standing * (1 - sit) + sit * (0.485 + 0.085 * self.b)
        sway = (1 - gait) * (1 - 0.85 * sit)
        supple = 1 - 0.8 * sit
        swaying = _in(body, 0.012 * sway * wave(0.31, 0.0), 0.012 * sway * wave(0.23, 2.0), 0.0)
        self.root = np.array([how.x, how.y, pelvis_z]) + swaying
        twist = gait * 0.1 * sin(how.stride) + supple * lively * 0.12 * wave(0.27, 0.4)
        lean = (
            0.05 * gait
            + sit * 0.06
            + supple * (0.02 * wave(0.19, 1.0) + lively * 0.04 * wave(0.43, 0.2))
        )
        self.trunk = product(
            body, _yaw(twist), _pitch(-lean), _roll(0.02 * supple * wave(0.17, 0.7))
        )
        self.hipline = product(body, _yaw(-twist))
        self.neck = self.root + _in(self.trunk, 0.0, -0.005, 0.46 * k + 0.05 * k)
        self.jeans = self.style("denim", who.trousers, repeat=(2.0, 3.0))
        self.shirt, self.bare = self.style(who.shirt, who.shirt_tint), self.style("plain", who.skin)

    def style(self, texture: str, tint: Array, **more: Any) -> dict[str, Any]:
        """How a limb of this person looks."""
        return {"instance": self.who.instance, "texture": texture, "tint": tint, **more}

    def wave(self, f: float, p: float) -> float:
        """Idle movement: a sine of frequency f in Hz and phase p."""
        return sin(2 * math.pi * f * self.how.clock + p + 1.7 * self.who.instance)

    def limb(
        self, a: Array, c: Array, ra: float, rc: float, side: Array, flat: float = 1.0, **style: Any
    ) -> Primitive:
        """A round cone from a to c; its section is `flat` times as wide across `side`'s normal."""
        rotation, length = along(a, c, side)
        return cone(rotation, a, (length, ra, rc), scale=(1.0, flat, 1.0), **style)

    def ball(
        self, centre: Array, rotation: Array, radii: tuple[float, float, float], **style: Any
    ) -> Primitive:
        """An ellipsoid."""
        return cone(rotation, centre, (0.0, 1.0, 1.0), scale=radii, **style)


def build_person(who: Person, how: Posture) -> Parts:
    """The person's primitives, always as many and in the same order."""
    f = _Figure(who, how)
    limbs = ((*_arm(f, side), *_leg(f, side, index)) for index, side in enumerate((-1, 1)))
    return [*_trunk(f), *_head(f), *itertools.chain(*limbs)]


def _trunk(f: _Figure) -> Parts:
    """Pelvis, belly, chest, shoulders; wider than deep."""
    k = f.k
    root = f.root
    trunk = f.trunk
    hipline = f.hipline
    left, right = (root + _in(hipline, side * 0.055 * k, 0, 0.01) for side in (-1, 1))
    waist = root + _in(trunk, 0.0, 0.0, 0.08 * k)
    chest = root + _in(trunk, 0.0, 0.005, 0.36 * k)
    across = product(trunk, _X)
    up = _in(trunk, 0, 0, 0.05 * k)
    one, other = (chest + side * across * 0.11 * k * f.b + up for side in (-1, 1))
    return [
        f.limb(
            left, right, 0.115 * k * f.b, 0.115 * k * f.b, product(hipline, _Z), 0.95, **f.jeans
        ),
        f.limb(
            waist,
            chest,
            0.148 * k * f.b,
            0.168 * k * f.b,
            across,
            0.68,
            repeat=(5.0, 6.0),
            **f.shirt,
        ),
        f.limb(
            one,
            other,
            0.088 * k * f.b,
            0.088 * k * f.b,
            product(trunk, _Y),
            repeat=(3.0, 6.0),
            **f.shirt,
        ),
    ]


def _head(f: _Figure) -> Parts:
    """Neck and head, which looks about, with its hair."""
    k = f.k
    who = f.who
    trunk = f.trunk
    neck = f.neck
    skull = neck + _in(trunk, 0.0, 0.015 * k, 0.15 * k)
    looking = _yaw(
        0.3 * f.wave(0.13, 0.9) * (1 - f.how.gait) + 0.1 * f.how.gesture * f.wave(0.4, 0.1)
    )
    head = product(trunk, looking, _pitch(0.06 * f.wave(0.29, 0.3) - 0.03))
    low = neck - _in(trunk, 0, 0, 0.04 * k)
    high = skull - _in(trunk, 0, 0.01, 0.03 * k)
    face = f.style("face", who.skin, repeat=(1.0, 0.5), shift=(0.5, 0.5))
    hair = f.style("hair", who.hair, repeat=(3.0, 0.5))
    ears = [skull + _in(head, side * 0.077 * k, -0.005, -0.01) for side in (-1, 1)]
    crown = skull + _in(head, 0, -0.018 * k, 0.03 * k)
    parts = [
        f.limb(low, high, 0.058 * k, 0.052 * k, product(trunk, _X), **f.bare),
        f.ball(skull, head, (0.077 * k, 0.098 * k, 0.122 * k), **face),
        f.ball(
            skull + _in(head, 0, 0.092 * k, -0.012 * k),
            head,
            (0.015 * k, 0.022 * k, 0.026 * k),
            **f.bare,
        ),
        *(f.ball(ear, head, (0.012 * k, 0.024 * k, 0.033 * k), **f.bare) for ear in ears),
        f.ball(crown, product(head, _pitch(0.35)), (0.086 * k, 0.101 * k, 0.108 * k), **hair),
    ]
    if who.long_hair:
        high = skull + _in(head, 0, -0.06, 0.0)
        low = skull + _in(head, 0, -0.075, -0.15 * k)
        parts.append(
            f.limb(
                high,
                low,
                0.075 * k,
                0.055 * k,
                product(head, _X),
                0.6,
                **hair | {"repeat": (4.0, 2.0)},
            )
        )
    if who.cap:
        cap = hair | {"tint": who.trousers}
        top = skull + _in(head, 0, 0.01, 0.075 * k)
        parts += [
            f.ball(top, product(head, _pitch(0.15)), (0.088 * k, 0.108 * k, 0.065 * k), **cap),
            f.ball(
                skull + _in(head, 0, 0.12 * k, 0.06 * k),
                head,
                (0.07 * k, 0.06 * k, 0.008 * k),
                **cap,
            ),
        ]
    return parts


def _arm(f: _Figure, side: int) -> Parts:
    """Counter-swing of the gait, gestures with the hands before the chest, hands on the lap when sitting."""
    k = f.k
    b = f.b
    gait = f.how.gait
    sit = f.how.sit
    swing = f.how.stride + (math.pi if side < 0 else 0.0)
    talk = f.how.gesture * power(0.5 + 0.5 * f.wave(0.11, 1.5 * side), 0.7)
    pitch = (
        gait * 0.42 * sin(swing)
        + sit * (1 - talk) * 0.35
        + talk * (0.45 + 0.35 * f.wave(0.47 + 0.06 * side, side))
    )
    abduct = side * (0.14 + 0.05 * (1 - gait) + talk * (0.12 + 0.15 * f.wave(0.33, 2.0 * side)))
    bend = (
        0.2
        + gait * (0.25 + 0.15 * sin(swing))
        + sit * (1 - talk) * 0.95
        + talk * (1.35 + 0.5 * f.wave(0.61, 1.1 * side))
    )
    shoulder = f.neck + _in(f.trunk, side * 0.185 * k * b, 0.0, -0.055 * k)
    arm = product(f.trunk, _roll(-abduct), _pitch(pitch))
    lower = product(arm, _roll(side * 0.35 * min(bend, 1.0)), _pitch(bend))
    elbow = shoulder + _in(arm, 0, 0, -(0.29 * k))
    wrist = elbow + _in(lower, 0, 0, -(0.26 * k))
    across = product(lower, _Y)
    hand = product(lower, _pitch(0.25 * f.wave(0.7, side)))
    thumb = wrist + _in(hand, 0.0, 0.035 * k, -0.035 * k)
    return [
        f.limb(
            shoulder,
            elbow,
            0.062 * k * b,
            0.046 * k * b,
            product(arm, _Y),
            repeat=(2.0, 6.0),
            **f.shirt,
        ),
        f.limb(elbow, wrist, 0.045 * k * b, 0.034 * k * b, across, repeat=(2.0, 6.0), **f.shirt)
        if f.who.long_sleeves
        else f.limb(elbow, wrist, 0.041 * k * b, 0.028 * k * b, across, **f.bare),
        f.ball(
            wrist + _in(hand, 0, 0.005, -0.055 * k),
            hand,
            (0.022 * k, 0.038 * k, 0.058 * k),
            **f.bare,
        ),
        f.ball(thumb, product(hand, _pitch(0.6)), (0.011 * k, 0.013 * k, 0.034 * k), **f.bare),
    ]


def _leg(f: _Figure, side: int, index: int) -> Parts:
    k = f.k
    b = f.b
    sit = f.how.sit
    hip = f.hips[index]
    knee = f.knees[index]
    upper = product(f.hipline, _roll(-side * (0.02 + 0.1 * sit)), _pitch(hip))
    lower = product(upper, _pitch(-knee))
    joint = f.root + _in(f.hipline, side * 0.095 * k * b, 0.0, -0.01)
    knee_at = joint + _in(upper, 0, 0, -(0.43 * k))
    ankle = knee_at + _in(lower, 0, 0, -(0.41 * k))
    ground = product(f.hipline, _pitch((hip - knee) * 0.6 * (1 - sit)))
    heel = ankle + _in(ground, 0, -0.03, -0.035 * k)
    toe = ankle + _in(ground, 0, 0.15 * k, -0.05 * k)
    return [
        f.limb(joint, knee_at, 0.088 * k * b, 0.061 * k * b, product(upper, _Y), **f.jeans),
        f.limb(knee_at, ankle, 0.06 * k * b, 0.045 * k * b, product(lower, _Y), **f.jeans),
        f.limb(
            heel,
            toe,
            0.045 * k,
            0.034 * k,
            product(ground, _X),
            0.95,
            **f.style("plain", f.who.shoes),
        ),
    ]


# What people and chairs do: keyed timelines, looped over the whole length of a sequence.

Draw = Callable[[float, float], float]
"""A number between two limits, drawn from a scene's stream."""


@dataclass(frozen=True)
class Script:
    """Timelines of two people and of their two chairs, repeated every `period` seconds."""

    period: float
    people: Sequence[tuple[Key, ...]]
    chairs: Sequence[tuple[Key, ...]]


def write_script(people: str, scene: int) -> Script:
    """The script of a scene; half of the scenes have it with left and right exchanged."""
    rng = stream(scene, "synthetic", "script", people)
    mirrored = rng.random() < 0.5
    script = (_sitting if people == "sitting" else _walking)(partial(pick, rng, scene))
    if not mirrored:
        return script
    walkers, chairs = (
        [tuple(replace(key, x=-key.x, facing=-key.facing) for key in keys) for keys in timelines]
        for timelines in (script.people, script.chairs)
    )
    return Script(script.period, walkers, chairs)


def _sitting(j: Draw) -> Script:
    """Two people at the desk, talking with their hands."""
    ax = -j(0.5, 0.62)
    ay = j(1.62, 1.74)
    bx = j(0.46, 0.58)
    by = j(1.68, 1.8)
    fa = 180 + j(18, 35)
    fb = 180 - j(22, 40)
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
    chairs = [(Key(0, ax, ay, fa), Key(12, ax, ay, fa)), (Key(0, bx, by, fb), Key(12, bx, by, fb))]
    return Script(12.0, [first, second], chairs)


def _walking(j: Draw) -> Script:
    """Two people who walk across the room, stand talking, and sit down."""
    ax = -j(0.28, 0.4)
    ay = j(1.26, 1.38)
    bx = j(0.3, 0.42)
    by = j(1.44, 1.58)
    cx = -j(0.55, 0.7)
    cy = j(1.62, 1.7)
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
    # A chair rolls when a person sits down on it and rises; another one is pushed in passing.
    rest_y = cy + 0.2
    own_chair = (
        Key(0, cx, rest_y, 100),
        Key(13.2, cx, rest_y, 100),
        Key(14.3, cx, cy, 185),
        Key(14.9, cx, cy, 185),
        Key(16.2, cx, cy, 205),
        Key(16.6, cx, cy, 195),
        Key(17.5, cx, rest_y, 110),
        Key(20, cx, rest_y, 100),
    )
    other_chair = (
        Key(0, 0.85, 1.88, 20),
        Key(2.6, 0.85, 1.88, 20),
        Key(3.2, 0.9, 2.0, 45),
        Key(4.9, 0.9, 2.0, 45),
        Key(5.5, 0.84, 1.93, 5),
        Key(13.0, 0.84, 1.93, 5),
        Key(13.8, 0.85, 1.88, 20),
        Key(20, 0.85, 1.88, 20),
    )
    return Script(20.0, [first, second], [own_chair, other_chair])


def posture(keys: tuple[Key, ...], period: float, t: float) -> Posture:
    """The posture of a person at time t (seconds)."""
    local = t % period
    a, b, share = between(keys, local)
    walked = 0.0
    for before, after in itertools.pairwise(keys):
        walked += _distance(before, after) if local >= after.t else 0.0
    distance = _distance(a, b)
    e = ease(share)
    speed = distance / (b.t - a.t) * 6 * share * (1 - share)
    return Posture(
        a.x + e * (b.x - a.x),
        a.y + e * (b.y - a.y),
        angle_between(a.facing, b.facing, ease(min(share * 1.5, 1.0))),
        (walked + distance * e) * 2 * math.pi / 1.35,
        min(speed / 0.9, 1.0),
        a.sit + e * (b.sit - a.sit),
        a.gesture + e * (b.gesture - a.gesture),
        t,
    )


def _distance(a: Key, b: Key) -> float:
    dx = b.x - a.x
    dy = b.y - a.y
    return math.sqrt(dx * dx + dy * dy)
