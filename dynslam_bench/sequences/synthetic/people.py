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
    Primitive,
    Primitives,
    along,
    angle_between,
    between,
    cone,
    ease,
    rotation_about_z,
)
from dynslam_bench.sequences.synthetic.rooms import pick, pick_one

_X, _Y, _Z = np.eye(3)

# Colours of people, factors of red, green and blue.
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
# Texture of a shirt, each as likely as the others.
_SHIRTS = ("print", "print", "plaid:1", "plaid:1", "stripes", "stripes")


@dataclass(frozen=True)
class Person:
    """Appearance of a person, which does not change: size, build, colours and clothes.

    Attributes:
        instance: Id in the masks.
        height: Metres.
        build: Relative width of the limbs.
        skin: Factors of red, green and blue; so are the other colours.
        hair: Colour.
        trousers: Colour.
        shoes: Colour.
        shirt: Name of its texture.
        shirt_tint: Colour.
        long_hair: Whether the hair falls to the shoulders.
        long_sleeves: Whether the shirt covers the forearms.
        cap: Whether they wear one.
    """

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
    """Place, direction and activity of a person at one time.

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
    """About the vertical; positive turns to the left."""
    return rotation_about_z(math.degrees(angle))


def _in(frame: Array, x: float, y: float, z: float) -> Array:
    """A vector that is given in the axes of a part of the body."""
    return product(frame, np.array([x, y, z]))


class _Figure:
    """A person in a posture: joint angles and axes by forward kinematics, and how their limbs are made.

    Axes are rotations 3x3 to the world: x points to the person's right, y forward, z up.

    Attributes:
        size: Height relative to 1.75 m.
        build: Relative width of the limbs.
        hip_angles: Flexion of the left and the right hip, radians.
        knee_angles: Flexion of the left and the right knee, radians.
        pelvis: The middle of the pelvis in the world, metres.
        trunk: Axes of the trunk.
        hips: Axes of the pelvis.
        neck: Where the neck begins, world coordinates in metres.
    """

    def __init__(self, who: Person, how: Posture) -> None:
        self.who = who
        self.how = how
        self.size = who.height / 1.75
        self.build = who.build
        # joints, from the legs upwards
        body = rotation_about_z(how.facing)
        self._bend_legs()
        self.pelvis = self._pelvis_position(body)
        self._twist_trunk(body)
        rise = _in(self.trunk, 0.0, -0.005, 0.46 * self.size + 0.05 * self.size)
        self.neck = self.pelvis + rise

        # what trousers, shirt and skin look like
        self.jeans = self.style("denim", who.trousers, repeat=(2.0, 3.0))
        self.shirt = self.style(who.shirt, who.shirt_tint)
        self.bare = self.style("plain", who.skin)

    def _bend_legs(self) -> None:
        """Angles of hips and knees: a walking cycle, blended with the angles of a seated person."""
        gait = self.how.gait
        sit = self.how.sit
        self.hip_angles = []
        self.knee_angles = []
        for side in (-1, 1):
            # the legs are half a stride apart
            phase = self.how.stride + (0.0 if side < 0 else math.pi)
            walking_hip = gait * (0.08 + 0.46 * sin(phase)) * (1 - sit)
            seated_hip = sit * (1.45 + 0.03 * side)
            self.hip_angles.append(walking_hip + seated_hip)
            # the knee bends while the leg swings forward
            swing = max(0.0, cos(phase))
            walking_knee = gait * (0.12 + 0.85 * swing * swing) + 0.03
            self.knee_angles.append(walking_knee * (1 - sit) + sit * (1.35 + 0.12 * side))

    def _pelvis_position(self, body: Array) -> Array:
        """Position of the pelvis: above the lower foot or on the seat, and swaying where the person stands."""
        how = self.how
        k = self.size
        # height over the foot of each leg, by the lengths of thigh and shin
        heights = []
        for hip, knee in zip(self.hip_angles, self.knee_angles, strict=True):
            heights.append(0.43 * k * cos(hip) + 0.41 * k * cos(hip - knee))

        # blend of standing and sitting
        standing = max(heights) + 0.085 * k
        seated = 0.485 + 0.085 * self.build
        height = standing * (1 - how.sit) + how.sit * seated

        # who stands sways a little
        sway = (1 - how.gait) * (1 - 0.85 * how.sit)
        sway_right = 0.012 * sway * self.wave(0.31, 0.0)
        sway_forward = 0.012 * sway * self.wave(0.23, 2.0)
        return np.array([how.x, how.y, height]) + _in(body, sway_right, sway_forward, 0.0)

    def _twist_trunk(self, body: Array) -> None:
        """Axes of trunk and pelvis, which twist against each other.

        Who sits leans back: arms and head go on, the trunk hardly moves.
        """
        # shares of walking, sitting and gesturing, 0 to 1, weigh the movements; angles in radians
        gait = self.how.gait
        sit = self.how.sit
        gesture = self.how.gesture
        wave = self.wave
        supple = 1 - 0.8 * sit
        twist = gait * 0.1 * sin(self.how.stride) + supple * gesture * 0.12 * wave(0.27, 0.4)
        lean = (
            0.05 * gait
            + sit * 0.06
            + supple * (0.02 * wave(0.19, 1.0) + gesture * 0.04 * wave(0.43, 0.2))
        )
        tilt = 0.02 * supple * wave(0.17, 0.7)

        # pelvis and trunk turn against each other
        self.trunk = product(body, _yaw(twist), _pitch(-lean), _roll(tilt))
        self.hips = product(body, _yaw(-twist))

    def style(self, texture: str, tint: Array, **more: Any) -> dict[str, Any]:
        """Arguments of `primitive` for a limb of this person: its look and its instance."""
        return {"instance": self.who.instance, "texture": texture, "tint": tint, **more}

    def wave(self, frequency: float, phase: float) -> float:
        """Idle movement: a sine of a frequency in Hz and a phase in radians, shifted for each person."""
        angle = 2 * math.pi * frequency * self.how.clock + phase
        return sin(angle + 1.7 * self.who.instance)

    def limb(
        self,
        start: Array,
        end: Array,
        radii: tuple[float, float],
        side: Array,
        depth: float = 1.0,
        **style: Any,
    ) -> Primitive:
        """A round cone between two points.

        Args:
            start: World position, metres.
            end: World position, metres.
            radii: At the start and at the end, along `side`.
            side: World direction of the section's first axis.
            depth: Width of the section across `side`, relative to that along it.
            **style: See `style`.
        """
        rotation, length = along(start, end, side)
        return cone(rotation, start, (length, *radii), scale=(1.0, depth, 1.0), **style)

    def ball(
        self, centre: Array, rotation: Array, radii: tuple[float, float, float], **style: Any
    ) -> Primitive:
        """An ellipsoid."""
        return cone(rotation, centre, (0.0, 1.0, 1.0), scale=radii, **style)


def build_person(who: Person, how: Posture) -> Primitives:
    """The person's primitives, always as many and in the same order."""
    figure = _Figure(who, how)
    parts = [*_trunk(figure), *_head(figure)]
    for index, side in enumerate((-1, 1)):
        parts += _arm(figure, side)
        parts += _leg(figure, side, index)
    return parts


# Sizes of limbs are metres of a person of 1.75 m; k scales them by the person's height, and b the
# widths by their build.


def _trunk(figure: _Figure) -> Primitives:
    """Pelvis, belly and chest, shoulders; wider than deep."""
    # factors on lengths and widths of a person of 1.75 m, for this one's height and build
    k = figure.size
    b = figure.build
    trunk = figure.trunk
    across = product(trunk, _X)
    waist = figure.pelvis + _in(trunk, 0.0, 0.0, 0.08 * k)
    chest = figure.pelvis + _in(trunk, 0.0, 0.005, 0.36 * k)

    # hip and shoulder joints
    left_hip, right_hip = (
        figure.pelvis + _in(figure.hips, side * 0.055 * k, 0, 0.01) for side in (-1, 1)
    )
    shoulder_rise = _in(trunk, 0, 0, 0.05 * k)
    left_shoulder, right_shoulder = (
        chest + side * across * 0.11 * k * b + shoulder_rise for side in (-1, 1)
    )

    # widths at both ends of each part
    pelvis_radii = (0.115 * k * b, 0.115 * k * b)
    belly_radii = (0.148 * k * b, 0.168 * k * b)
    shoulder_radii = (0.088 * k * b, 0.088 * k * b)
    up = product(figure.hips, _Z)
    forward = product(trunk, _Y)
    return [
        figure.limb(left_hip, right_hip, pelvis_radii, up, 0.95, **figure.jeans),
        figure.limb(waist, chest, belly_radii, across, 0.68, repeat=(5.0, 6.0), **figure.shirt),
        figure.limb(
            left_shoulder,
            right_shoulder,
            shoulder_radii,
            forward,
            repeat=(3.0, 6.0),
            **figure.shirt,
        ),
    ]


def _head(figure: _Figure) -> Primitives:
    """Neck and head, which looks about, with its hair and cap."""
    # factor on lengths of a person of 1.75 m, and where the skull is
    k = figure.size
    trunk = figure.trunk
    neck = figure.neck
    skull = neck + _in(trunk, 0.0, 0.015 * k, 0.15 * k)

    # axes of the head: it looks about less while walking, and nods.
    look = 0.3 * figure.wave(0.13, 0.9) * (1 - figure.how.gait)
    look = look + 0.1 * figure.how.gesture * figure.wave(0.4, 0.1)
    nod = 0.06 * figure.wave(0.29, 0.3) - 0.03
    head = product(trunk, _yaw(look), _pitch(nod))

    # neck, skull, nose, ears
    neck_low = neck - _in(trunk, 0, 0, 0.04 * k)
    neck_high = skull - _in(trunk, 0, 0.01, 0.03 * k)
    neck_radii = (0.058 * k, 0.052 * k)
    nose = skull + _in(head, 0, 0.092 * k, -0.012 * k)
    nose_radii = (0.015 * k, 0.022 * k, 0.026 * k)
    face = figure.style("face", figure.who.skin, repeat=(1.0, 0.5), shift=(0.5, 0.5))
    parts = [
        figure.limb(neck_low, neck_high, neck_radii, product(trunk, _X), **figure.bare),
        figure.ball(skull, head, (0.077 * k, 0.098 * k, 0.122 * k), **face),
        figure.ball(nose, head, nose_radii, **figure.bare),
    ]
    for side in (-1, 1):
        ear = skull + _in(head, side * 0.077 * k, -0.005, -0.01)
        parts.append(figure.ball(ear, head, (0.012 * k, 0.024 * k, 0.033 * k), **figure.bare))
    return parts + _hair(figure, skull, head)


def _hair(figure: _Figure, skull: Array, head: Array) -> Primitives:
    """Hair and cap: what covers the head.

    Args:
        figure: The person.
        skull: Middle of the skull in the world, metres.
        head: Axes of the head.
    """
    k = figure.size
    who = figure.who
    hair = figure.style("hair", who.hair, repeat=(3.0, 0.5))
    # a cap of hair on the skull
    crown = skull + _in(head, 0, -0.018 * k, 0.03 * k)
    crown_radii = (0.086 * k, 0.101 * k, 0.108 * k)
    parts = [figure.ball(crown, product(head, _pitch(0.35)), crown_radii, **hair)]
    if who.long_hair:
        high = skull + _in(head, 0, -0.06, 0.0)
        low = skull + _in(head, 0, -0.075, -0.15 * k)
        strands = hair | {"repeat": (4.0, 2.0)}
        across = product(head, _X)
        parts.append(figure.limb(high, low, (0.075 * k, 0.055 * k), across, 0.6, **strands))
    if who.cap:
        cap = hair | {"tint": who.trousers}
        top = skull + _in(head, 0, 0.01, 0.075 * k)
        top_radii = (0.088 * k, 0.108 * k, 0.065 * k)
        peak = skull + _in(head, 0, 0.12 * k, 0.06 * k)
        peak_radii = (0.07 * k, 0.06 * k, 0.008 * k)
        parts.append(figure.ball(top, product(head, _pitch(0.15)), top_radii, **cap))
        parts.append(figure.ball(peak, head, peak_radii, **cap))
    return parts


def _arm_angles(figure: _Figure, side: int) -> tuple[float, float, float]:
    """Pitch and abduction of the upper arm, and bend of the elbow, radians.

    Counter-swing of the gait, gestures with the hands before the chest, hands on the lap when
    sitting.
    """
    gait = figure.how.gait
    sit = figure.how.sit
    wave = figure.wave
    # the arms swing against the legs
    phase = figure.how.stride + (math.pi if side < 0 else 0.0)
    # how much of a gesture there is just now
    talk = figure.how.gesture * power(0.5 + 0.5 * wave(0.11, 1.5 * side), 0.7)
    pitch = (
        gait * 0.42 * sin(phase)
        + sit * (1 - talk) * 0.35
        + talk * (0.45 + 0.35 * wave(0.47 + 0.06 * side, side))
    )
    abduction = side * (0.14 + 0.05 * (1 - gait) + talk * (0.12 + 0.15 * wave(0.33, 2.0 * side)))
    bend = (
        0.2
        + gait * (0.25 + 0.15 * sin(phase))
        + sit * (1 - talk) * 0.95
        + talk * (1.35 + 0.5 * wave(0.61, 1.1 * side))
    )
    return pitch, abduction, bend


def _arm(figure: _Figure, side: int) -> Primitives:
    """Upper arm, forearm, hand and thumb of the left (-1) or right (1) side."""
    # factors on lengths and widths of a person of 1.75 m, for this one's height and build
    k = figure.size
    b = figure.build
    pitch, abduction, bend = _arm_angles(figure, side)

    # forward kinematics from the shoulder to the hand
    shoulder = figure.neck + _in(figure.trunk, side * 0.185 * k * b, 0.0, -0.055 * k)
    upper = product(figure.trunk, _roll(-abduction), _pitch(pitch))
    lower = product(upper, _roll(side * 0.35 * min(bend, 1.0)), _pitch(bend))
    elbow = shoulder + _in(upper, 0, 0, -(0.29 * k))
    wrist = elbow + _in(lower, 0, 0, -(0.26 * k))
    hand = product(lower, _pitch(0.25 * figure.wave(0.7, side)))
    palm = wrist + _in(hand, 0, 0.005, -0.055 * k)
    thumb = wrist + _in(hand, 0.0, 0.035 * k, -0.035 * k)

    # the arm in its sleeve, and the hand
    forward = product(upper, _Y)
    lower_forward = product(lower, _Y)
    sleeve = figure.shirt | {"repeat": (2.0, 6.0)}
    upper_arm = figure.limb(shoulder, elbow, (0.062 * k * b, 0.046 * k * b), forward, **sleeve)
    if figure.who.long_sleeves:
        radii = (0.045 * k * b, 0.034 * k * b)
        forearm = figure.limb(elbow, wrist, radii, lower_forward, **sleeve)
    else:
        radii = (0.041 * k * b, 0.028 * k * b)
        forearm = figure.limb(elbow, wrist, radii, lower_forward, **figure.bare)
    palm_radii = (0.022 * k, 0.038 * k, 0.058 * k)
    thumb_radii = (0.011 * k, 0.013 * k, 0.034 * k)
    return [
        upper_arm,
        forearm,
        figure.ball(palm, hand, palm_radii, **figure.bare),
        figure.ball(thumb, product(hand, _pitch(0.6)), thumb_radii, **figure.bare),
    ]


def _leg(figure: _Figure, side: int, index: int) -> Primitives:
    """Thigh, shin and shoe of the left (-1, index 0) or right (1, index 1) side."""
    # factors on lengths and widths, and the leg's angles in radians
    k = figure.size
    b = figure.build
    sit = figure.how.sit
    hip_angle = figure.hip_angles[index]
    knee_angle = figure.knee_angles[index]

    # forward kinematics from the hip to the foot
    upper = product(figure.hips, _roll(-side * (0.02 + 0.1 * sit)), _pitch(hip_angle))
    lower = product(upper, _pitch(-knee_angle))
    hip = figure.pelvis + _in(figure.hips, side * 0.095 * k * b, 0.0, -0.01)
    knee = hip + _in(upper, 0, 0, -(0.43 * k))
    ankle = knee + _in(lower, 0, 0, -(0.41 * k))
    foot = product(figure.hips, _pitch((hip_angle - knee_angle) * 0.6 * (1 - sit)))
    heel = ankle + _in(foot, 0, -0.03, -0.035 * k)
    toe = ankle + _in(foot, 0, 0.15 * k, -0.05 * k)

    # thigh, shin and shoe
    thigh_radii = (0.088 * k * b, 0.061 * k * b)
    shin_radii = (0.06 * k * b, 0.045 * k * b)
    shoe_radii = (0.045 * k, 0.034 * k)
    shoe = figure.style("plain", figure.who.shoes)
    return [
        figure.limb(hip, knee, thigh_radii, product(upper, _Y), **figure.jeans),
        figure.limb(knee, ankle, shin_radii, product(lower, _Y), **figure.jeans),
        figure.limb(heel, toe, shoe_radii, product(foot, _X), 0.95, **shoe),
    ]


# What people and chairs do: keyed timelines, looped over the whole length of a sequence.

Draw = Callable[[float, float], float]
"""A number between two limits, drawn from a scene's stream."""
STRIDE_M = 1.35
"""Path of two steps, in which the gait's phase advances by 2 pi."""
FULL_GAIT_M_S = 0.9
"""Speed from which a person walks at full stride."""


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
    write = _sitting if people == "sitting" else _walking
    script = write(partial(pick, rng, scene))
    if not mirrored:
        return script
    # left and right exchanged
    people_keys = [_mirrored(keys) for keys in script.people]
    chair_keys = [_mirrored(keys) for keys in script.chairs]
    return Script(script.period, people_keys, chair_keys)


def _mirrored(keys: tuple[Key, ...]) -> tuple[Key, ...]:
    """A timeline with left and right exchanged."""
    return tuple(replace(key, x=-key.x, facing=-key.facing) for key in keys)


def _sitting(draw: Draw) -> Script:
    """Two people at the desk, talking with their hands."""
    # where both sit (ax, ay and bx, by) and face (fa, fb): metres, degrees.
    ax = -draw(0.5, 0.62)
    ay = draw(1.62, 1.74)
    bx = draw(0.46, 0.58)
    by = draw(1.68, 1.8)
    fa = 180 + draw(18, 35)
    fb = 180 - draw(22, 40)
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
    # their chairs stand still
    chairs = [(Key(0, ax, ay, fa), Key(12, ax, ay, fa)), (Key(0, bx, by, fb), Key(12, bx, by, fb))]
    return Script(12.0, [first, second], chairs)


def _walking(draw: Draw) -> Script:
    """Two people who walk across the room, stand talking, and sit down."""
    # where they stand talking (ax, ay and bx, by) and where the first one sits (cx, cy), metres.
    ax = -draw(0.28, 0.4)
    ay = draw(1.26, 1.38)
    bx = draw(0.3, 0.42)
    by = draw(1.44, 1.58)
    cx = -draw(0.55, 0.7)
    cy = draw(1.62, 1.7)
    first = _first_walker(ax, ay, cx, cy)
    second = _second_walker(bx, by)
    return Script(20.0, [first, second], [_used_chair(cx, cy), _PUSHED_CHAIR])


_OUT_OF_VIEW_M = 1.65
"""People who walk across the room turn round this far to the side."""


def _first_walker(ax: float, ay: float, cx: float, cy: float) -> tuple[Key, ...]:
    """Talks at (ax, ay), walks to the right, back and to the left, sits down at (cx, cy), and returns."""
    side = _OUT_OF_VIEW_M
    return (
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


def _second_walker(bx: float, by: float) -> tuple[Key, ...]:
    """Talks at (bx, by), walks to the right, talks further left, walks to the left, and returns."""
    side = _OUT_OF_VIEW_M
    return (
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


def _used_chair(cx: float, cy: float) -> tuple[Key, ...]:
    """A chair at (cx, cy) that rolls when the first walker sits down on it and rises.

    Its times are those of `_first_walker`, who sits there from 13.7 to 17.2 s.
    """
    # it stands 0.2 m further back while nobody sits on it
    rest_y = cy + 0.2
    return (
        Key(0, cx, rest_y, 100),
        Key(13.2, cx, rest_y, 100),
        Key(14.3, cx, cy, 185),
        Key(14.9, cx, cy, 185),
        Key(16.2, cx, cy, 205),
        Key(16.6, cx, cy, 195),
        Key(17.5, cx, rest_y, 110),
        Key(20, cx, rest_y, 100),
    )


_PUSHED_CHAIR = (
    Key(0, 0.85, 1.88, 20),
    Key(2.6, 0.85, 1.88, 20),
    Key(3.2, 0.9, 2.0, 45),
    Key(4.9, 0.9, 2.0, 45),
    Key(5.5, 0.84, 1.93, 5),
    Key(13.0, 0.84, 1.93, 5),
    Key(13.8, 0.85, 1.88, 20),
    Key(20, 0.85, 1.88, 20),
)
"""A chair that is pushed in passing."""


def posture(keys: tuple[Key, ...], period: float, t: float) -> Posture:
    """The posture of a person at time t (seconds)."""
    # the keys around the time, of a timeline that repeats
    local = t % period
    before, after, share = between(keys, local)

    # path that was walked since the beginning of the timeline, for the phase of the gait.
    walked = 0.0
    for start, end in itertools.pairwise(keys):
        walked += _distance(start, end) if local >= end.t else 0.0
    distance = _distance(before, after)

    # speed by the derivative of `ease`, for how fully the person walks
    eased = ease(share)
    speed = distance / (after.t - before.t) * 6 * share * (1 - share)
    # people turn in the first two thirds of a way
    facing = angle_between(before.facing, after.facing, ease(min(share * 1.5, 1.0)))
    return Posture(
        x=before.x + eased * (after.x - before.x),
        y=before.y + eased * (after.y - before.y),
        facing=facing,
        stride=(walked + distance * eased) * 2 * math.pi / STRIDE_M,
        gait=min(speed / FULL_GAIT_M_S, 1.0),
        sit=before.sit + eased * (after.sit - before.sit),
        gesture=before.gesture + eased * (after.gesture - before.gesture),
        clock=t,
    )


def _distance(a: Key, b: Key) -> float:
    """Metres between two places."""
    dx = b.x - a.x
    dy = b.y - a.y
    return math.sqrt(dx * dx + dy * dy)
