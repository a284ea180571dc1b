"""Sequences of things without a known class that move, after Bonn's balloon, box and kidnapping sequences.

Each thing has an id of its own in the masks. What is moved with hands outside of the picture has no
person; a carrier is there where Bonn has one.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import cos
from dynslam_bench.sequences.synthetic.camera_paths import camera_poses
from dynslam_bench.sequences.synthetic.parts import At, Key, Primitives, box, copies, on_track
from dynslam_bench.sequences.synthetic.people import Draw, draw_person, posture
from dynslam_bench.sequences.synthetic.rooms import (
    RoomPlan,
    balloon,
    build_room,
    door_leaf,
    glare_window,
    office_chair,
    partition,
    pick,
    plan_room,
    printed_box,
    trolley,
)
from dynslam_bench.sequences.synthetic.scene import Actor, Body, Variant, World

PERIOD_S = 20.0
"""After this a motion begins again."""
_CARRIER_ID = 9
"""Id of the carrier in the masks."""


class Script(NamedTuple):
    """The things that move, and the timeline of the person who carries them.

    Attributes:
        bodies: The things.
        carrier: The person's timeline; empty for none.
    """

    bodies: tuple[Body, ...]
    carrier: tuple[Key, ...] = ()


def build_objects(variant: str, scene: int) -> World:
    """The office, what moves in it, and the xyz camera path of TUM's replicas."""
    # the office, what moves in it, and who carries it
    plan = plan_room(scene)
    rng = stream(scene, "synthetic", "objects", variant)
    room = build_room(scene, plan)
    if variant == "door":
        room += _doorway(plan)
    script = _SCRIPTS[variant](partial(pick, rng, scene), scene, plan)
    actors: tuple[Actor, ...] = ()
    if script.carrier:
        person = replace(draw_person(scene, 0), instance=_CARRIER_ID)
        actors = ((person, partial(posture, script.carrier, PERIOD_S)),)
    camera = partial(camera_poses, "xyz", "objects", scene)
    return World(room, camera, glare_window(plan), script.bodies, actors)


def _body(
    id: int, name: str, parts: Primitives, keys: tuple[At, ...], period: float | None = PERIOD_S
) -> Body:
    """A thing that moves along a timeline."""
    return Body(id, name, parts, partial(on_track, keys, period))


# The scripts. Their keys are times in seconds, places in metres and degrees about the vertical.


def _balloon(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A person walks to and fro and plays with a balloon in front of the camera."""
    # distance from the camera, half the way from side to side, and height of a throw, metres
    y = draw(0.95, 1.05)
    reach = draw(0.32, 0.42)
    high = draw(1.45, 1.55)

    # eight throws from side to side: up in the middle, then down again.
    keys = [At(0.0, reach, y, high - 0.3)]
    for k in range(8):
        side = -1 if k % 2 == 0 else 1
        up = At(2.5 * k + 0.9, 0.3 * side * reach, y - 0.1, high + 0.12, 60.0 * k)
        down = At(2.5 * k + 2.5, side * reach, y, high - 0.3, 60.0 * k + 30.0)
        keys += [up, down]
    # the person follows the balloon, behind it
    walker = [Key(k.t, 1.1 * k.x, y + 0.55, 180.0 - 15.0 * np.sign(k.x), 0, 1) for k in keys[::2]]
    toy = balloon(1, draw(0.17, 0.2))
    return Script((_body(1, "sports ball", toy, tuple(keys)),), tuple(walker))


def _box_obstructing(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A large carton is moved close across the view, held before it, and moved away again."""
    y = draw(1.15, 1.25)
    z = draw(1.06, 1.14)
    yaw = draw(10, 25)
    box = printed_box(1, (draw(0.34, 0.4), draw(0.18, 0.24), draw(0.28, 0.34)))
    keys = (
        At(0, -1.7, y, z),
        At(2.0, -1.7, y, z),
        At(4.0, -0.25, y, z, yaw),
        At(7.0, 0.25, y, z + 0.05, -yaw),
        At(9.0, 1.7, y, z),
        At(11.5, 1.7, y, z),
        At(14.0, 0.1, y - 0.08, z, yaw),
        At(16.5, -0.2, y, z, 0.0),
        At(18.5, -1.7, y, z),
        At(20.0, -1.7, y, z),
    )
    return Script((_body(1, "box", box, keys),))


def _box_aside(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A person carries a carton through the room; it never hides most of the view."""
    y = draw(1.3, 1.4)
    z = draw(0.95, 1.05)
    box = printed_box(1, (draw(0.21, 0.25), draw(0.15, 0.19), draw(0.17, 0.21)))
    times = (
        (0, -1.6),
        (1.5, -1.6),
        (5.5, 0.35),
        (7.5, 0.2),
        (10.0, 1.6),
        (12.0, 1.6),
        (16.0, -0.3),
        (18.5, -1.6),
        (20, -1.6),
    )
    keys = tuple(At(t, x, y, z, 8.0 * k) for k, (t, x) in enumerate(times))
    walker = tuple(Key(k.t, k.x, y + 0.38, 180) for k in keys)
    return Script((_body(1, "box", box, keys),), walker)


def _carried(came: bool, draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A carton is brought and put down before the desk, where it stays; or it stands there and is taken away."""
    # time, x, and share of the carrying height at each station.
    if came:
        stations = [(1.0, -1.7, 1.1), (3.5, -0.1, 1.0), (5.0, -0.05, 0.0)]
    else:
        stations = [(6.0, -0.05, 0.0), (7.5, -0.1, 1.0), (10.0, -1.7, 1.1)]
    y = draw(1.3, 1.4)
    half = (draw(0.3, 0.35), draw(0.22, 0.27), draw(0.32, 0.38))
    low = half[2] + 0.35
    lift = draw(0.35, 0.42)
    shift = draw(-0.1, 0.1)
    keys = tuple(
        At(t, x + shift, y, low + lift * min(share, 1.0), 4.0 * k)
        for k, (t, x, share) in enumerate(stations)
    )
    carton = _body(1, "box", printed_box(1, half), keys, None)

    # what the carton is put down on
    pedestal = printed_box(2, (half[0] * 0.9, half[1] * 0.9, 0.175))
    stand = _body(2, "box", pedestal, (At(0.0, -0.05 + shift, y, 0.175),), None)

    # the carrier leaves after bringing the carton, or comes to fetch it.
    walker = [Key(k.t, k.x, y + 0.45, 180) for k in keys]
    away = -1.75
    if came:
        start = replace(walker[0], t=0.0)
        leaving = [
            Key(7.0, walker[-1].x, y + 0.45, 90),
            Key(9.5, away, y + 0.5, 90),
            Key(20, away, y + 0.5, 90),
        ]
        return Script((carton, stand), (start, *walker, *leaving))
    coming = [Key(0, away, y + 0.5, 270), Key(3.5, away, y + 0.5, 270)]
    return Script((carton, stand), (*coming, *walker, Key(20, away, y + 0.5, 90)))


def _kidnapped(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A very large carton comes before the camera, fills the image while it moves, and leaves."""
    y = draw(1.0, 1.1)
    z = draw(1.1, 1.2)
    box = printed_box(1, (draw(1.15, 1.25), 0.12, draw(0.8, 0.9)))
    keys = (
        At(0, -2.6, y, z),
        At(3.0, -2.6, y, z),
        At(5.0, -0.3, y, z),
        At(7.5, 0.3, y - 0.06, z + 0.05),
        At(9.5, 2.7, y, z),
        At(13.0, 2.7, y, z),
        At(15.0, 0.25, y, z),
        At(17.0, -0.3, y - 0.05, z - 0.04),
        At(19.0, -2.6, y, z),
        At(20.0, -2.6, y, z),
    )
    return Script((_body(1, "box", box, keys),))


def _trolley(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A person pushes a loaded trolley to and fro before the desk."""
    y = draw(1.3, 1.4)
    stops = (
        (0, -2.0, 0),
        (1.5, -2.0, 0),
        (6.0, 0.15, 0),
        (8.0, 0.2, 6),
        (11.5, 2.3, 0),
        (12.5, 2.3, 180),
        (15.5, 0.1, 180),
        (16.5, 0.05, 174),
        (19.5, -2.0, 180),
        (20.0, -2.0, 360),
    )
    keys = tuple(At(t, x, y, 0.0, yaw) for t, x, yaw in stops)
    walker = tuple(Key(k.t, k.x - 0.75 * cos(np.radians(k.yaw)), y, k.yaw - 90.0) for k in keys)
    return Script((_body(1, "trolley", trolley(1, scene, plan), keys),), walker)


def _chair(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A chair with a carton on it is turned and rolled; no person is in view."""
    x = draw(-0.2, 0.2)
    y = draw(1.15, 1.25)
    turned = draw(150, 210)
    parts = [
        *office_chair(plan, 1),
        *copies(printed_box(1, (0.2, 0.17, 0.2)), 15.0, (0.0, -0.02, 0.69)),
    ]
    keys = (
        At(0, x, y),
        At(1.5, x, y),
        At(5, x + 0.1, y, 0, turned),
        At(7, x, y, 0, turned),
        At(9.5, x - 0.5, y + 0.2),
        At(11, x - 0.5, y + 0.2),
        At(14, x + 0.45, y + 0.1, 0, -turned),
        At(16, x + 0.45, y + 0.1, 0, -turned),
        At(19, x, y),
        At(20, x, y),
    )
    return Script((_body(1, "chair", parts, keys),))


_DOOR = (-0.5, 1.55, 1.0)
"""Hinge x and y, and the width of the door, metres."""


def _door(draw: Draw, scene: int, plan: RoomPlan) -> Script:
    """A door in a partition opens towards the camera and falls shut, twice in a period."""
    x, y, width = _DOOR
    wide = draw(72, 80)
    ajar = draw(20, 30)
    angles = (
        (0, 0),
        (1.5, 0),
        (4.0, -wide),
        (6.5, -wide),
        (9.0, -ajar),
        (10.5, -ajar),
        (13.0, -wide),
        (15.0, -wide),
        (18.0, 0),
        (20, 0),
    )
    keys = tuple(At(t, x, y, 0.0, yaw) for t, yaw in angles)
    return Script((_body(1, "door", door_leaf(1, plan, width), keys),))


def _doorway(plan: RoomPlan) -> Primitives:
    """A wall before the desk, with a doorway, and posters on it."""
    x, y, width = _DOOR
    # walls on either side of the door
    parts = partition((plan.left_x, y + 0.05), (x - 0.02, y + 0.05), plan)
    parts += partition((x + width + 0.02, y + 0.05), (plan.right_x, y + 0.05), plan)
    # two posters above each other at four places
    for k, at in enumerate((x - 0.28, x - 0.75, x + width + 0.28, x + width + 0.75)):
        for z in (1.0, 1.62):
            name = f"poster:{(k + int(2 * z)) % 4}"
            place = (at, y - 0.006, z)
            parts.append(box(np.eye(3), place, (0.19, 0.005, 0.26), texture=name, fit=(2,)))
    return parts


_SCRIPTS: dict[str, Callable[[Draw, int, RoomPlan], Script]] = {
    "balloon": _balloon,
    "box_obstructing": _box_obstructing,
    "box_aside": _box_aside,
    "placed": partial(_carried, True),
    "removed": partial(_carried, False),
    "kidnapped": _kidnapped,
    "trolley": _trolley,
    "chair": _chair,
    "door": _door,
}
"""The scripts by the name of their sequence."""

OBJECTS = {
    f"objects_{name}": Variant(partial(build_objects, name), "unknown-objects") for name in _SCRIPTS
}
