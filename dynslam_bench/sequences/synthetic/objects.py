"""Things without a known class that move, after Bonn's balloon, box and kidnapping sequences.

Everything that moves beside persons has an id of its own in the masks. What is moved with hands that stay outside of
the picture has no person at all; a carrier is there where Bonn has one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import cos
from dynslam_bench.sequences.synthetic.camera_paths import camera_poses
from dynslam_bench.sequences.synthetic.parts import BOX, At, Key, Parts, on_track
from dynslam_bench.sequences.synthetic.people import Draw, draw_person, posture
from dynslam_bench.sequences.synthetic.replicas import window_of
from dynslam_bench.sequences.synthetic.rooms import (
    Plan,
    add_wall,
    balloon,
    build_room,
    door_leaf,
    office_chair,
    pick,
    plan_room,
    printed_box,
    trolley,
)
from dynslam_bench.sequences.synthetic.scene import Body, Variant, World

PERIOD_S = 20.0
Cast = tuple[tuple[Body, ...], tuple[Key, ...]]
"""Bodies and, where a person carries them, the carrier's timeline."""


def build_objects(variant: str, scene: int) -> World:
    """The office, what moves in it, and the xyz camera path of TUM's replicas."""
    plan, rng = plan_room(scene), stream(scene, "synthetic", "objects", variant)
    room = build_room(scene, plan)
    if variant == "door":
        _add_partition(room, plan)
    bodies, keys = _SCRIPTS[variant](partial(pick, rng, scene), scene, plan)
    person = replace(draw_person(scene, 0), instance=9)
    actors = ((person, partial(posture, keys, PERIOD_S)),) if keys else ()
    return World(room, partial(camera_poses, "xyz", "objects", scene), window_of(plan), bodies, actors)


def _body(id: int, name: str, parts: Parts, keys: tuple[At, ...], period: float | None = PERIOD_S) -> Body:
    return Body(id, name, parts, partial(on_track, keys, period))


def _balloon(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person walks to and fro and plays with a balloon in front of the camera."""
    y, reach, high = j(0.95, 1.05), j(0.32, 0.42), j(1.45, 1.55)
    keys = [At(0.0, reach, y, high - 0.3)]
    for k in range(8):
        side = -1 if k % 2 == 0 else 1
        keys += [At(2.5 * k + 0.9, 0.3 * side * reach, y - 0.1, high + 0.12, 60.0 * k)]
        keys += [At(2.5 * k + 2.5, side * reach, y, high - 0.3, 60.0 * k + 30.0)]
    walker = [Key(k.t, 1.1 * k.x, y + 0.55, 180.0 - 15.0 * np.sign(k.x), 0, 1) for k in keys[::2]]
    return (_body(1, "sports ball", balloon(1, j(0.17, 0.2)), tuple(keys)),), tuple(walker)


def _box_obstructing(j: Draw, scene: int, plan: Plan) -> Cast:
    """A large carton is moved close across the view, held before it, and moved away again."""
    y, z, yaw = j(1.15, 1.25), j(1.06, 1.14), j(10, 25)
    box = printed_box(1, (j(0.34, 0.4), j(0.18, 0.24), j(0.28, 0.34)))
    keys = [At(0, -1.7, y, z), At(2.0, -1.7, y, z), At(4.0, -0.25, y, z, yaw), At(7.0, 0.25, y, z + 0.05, -yaw)]
    keys += [At(9.0, 1.7, y, z), At(11.5, 1.7, y, z), At(14.0, 0.1, y - 0.08, z, yaw), At(16.5, -0.2, y, z, 0.0)]
    keys += [At(18.5, -1.7, y, z), At(20.0, -1.7, y, z)]
    return (_body(1, "box", box, tuple(keys)),), ()


def _box_aside(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person carries a carton through the room; it never hides most of the view."""
    y, z = j(1.3, 1.4), j(0.95, 1.05)
    box = printed_box(1, (j(0.21, 0.25), j(0.15, 0.19), j(0.17, 0.21)))
    times = ((0, -1.6), (1.5, -1.6), (5.5, 0.35), (7.5, 0.2), (10.0, 1.6), (12.0, 1.6), (16.0, -0.3), (18.5, -1.6),
             (20, -1.6))  # fmt: skip
    keys = tuple(At(t, x, y, z, 8.0 * k) for k, (t, x) in enumerate(times))
    walker = tuple(Key(k.t, k.x, y + 0.38, 180) for k in keys)
    return (_body(1, "box", box, keys),), walker


def _placed(j: Draw, scene: int, plan: Plan) -> Cast:
    """A carton is brought and put down before the desk, where it stays."""
    return _stand(j, [(1.0, -1.7, 1.1), (3.5, -0.1, 1.0), (5.0, -0.05, 0.0)], came=True)


def _removed(j: Draw, scene: int, plan: Plan) -> Cast:
    """A carton stands before the desk and is taken away."""
    return _stand(j, [(6.0, -0.05, 0.0), (7.5, -0.1, 1.0), (10.0, -1.7, 1.1)], came=False)


def _stand(j: Draw, stations: list[tuple[float, float, float]], came: bool) -> Cast:
    """A carton and its carrier who pass through (time, x, share of the carrying height) once."""
    y, half = j(1.3, 1.4), (j(0.3, 0.35), j(0.22, 0.27), j(0.32, 0.38))
    low, lift, shift = half[2] + 0.35, j(0.35, 0.42), j(-0.1, 0.1)
    keys = tuple(At(t, x + shift, y, low + lift * min(share, 1.0), 4.0 * k) for k, (t, x, share) in enumerate(stations))
    pedestal = printed_box(2, (half[0] * 0.9, half[1] * 0.9, 0.175))
    floor = Body(2, "box", pedestal, partial(on_track, (At(0.0, -0.05 + shift, y, 0.175),), None))
    walker = [Key(k.t, k.x, y + 0.45, 180) for k in keys]
    away = -1.75
    if came:
        walker = [
            *walker,
            Key(7.0, walker[-1].x, y + 0.45, 90),
            Key(9.5, away, y + 0.5, 90),
            Key(20, away, y + 0.5, 90),
        ]
    else:
        walker = [Key(0, away, y + 0.5, 270), Key(3.5, away, y + 0.5, 270), *walker, Key(20, away, y + 0.5, 90)]
    first = [] if walker[0].t == 0 else [replace(walker[0], t=0.0)]
    return (_body(1, "box", printed_box(1, half), keys, None), floor), (*first, *walker)


def _kidnapped(j: Draw, scene: int, plan: Plan) -> Cast:
    """A very large carton comes before the camera, fills the image while it moves, and leaves."""
    y, z = j(1.0, 1.1), j(1.1, 1.2)
    box = printed_box(1, (j(1.15, 1.25), 0.12, j(0.8, 0.9)))
    keys = [At(0, -2.6, y, z), At(3.0, -2.6, y, z), At(5.0, -0.3, y, z), At(7.5, 0.3, y - 0.06, z + 0.05)]
    keys += [At(9.5, 2.7, y, z), At(13.0, 2.7, y, z), At(15.0, 0.25, y, z), At(17.0, -0.3, y - 0.05, z - 0.04)]
    keys += [At(19.0, -2.6, y, z), At(20.0, -2.6, y, z)]
    return (_body(1, "box", box, tuple(keys)),), ()


def _trolley(j: Draw, scene: int, plan: Plan) -> Cast:
    """A person pushes a loaded trolley to and fro before the desk."""
    y = j(1.3, 1.4)
    stops = ((0, -2.0, 0), (1.5, -2.0, 0), (6.0, 0.15, 0), (8.0, 0.2, 6), (11.5, 2.3, 0), (12.5, 2.3, 180),
             (15.5, 0.1, 180), (16.5, 0.05, 174), (19.5, -2.0, 180), (20.0, -2.0, 360))  # fmt: skip
    keys = tuple(At(t, x, y, 0.0, yaw) for t, x, yaw in stops)
    walker = tuple(Key(k.t, k.x - 0.75 * cos(np.radians(k.yaw)), y, k.yaw - 90.0) for k in keys)
    return (_body(1, "trolley", trolley(1, scene, plan), keys),), walker


def _chair(j: Draw, scene: int, plan: Plan) -> Cast:
    """A chair with a carton on it is turned and rolled; no person is in view."""
    x, y, turned = j(-0.2, 0.2), j(1.15, 1.25), j(150, 210)
    parts = office_chair(plan, 1)
    parts.add_copies(printed_box(1, (0.2, 0.17, 0.2)), 15.0, (0.0, -0.02, 0.69))
    keys = [At(0, x, y), At(1.5, x, y), At(5, x + 0.1, y, 0, turned), At(7, x, y, 0, turned), At(9.5, x - 0.5, y + 0.2)]
    keys += [At(11, x - 0.5, y + 0.2), At(14, x + 0.45, y + 0.1, 0, -turned), At(16, x + 0.45, y + 0.1, 0, -turned)]
    keys += [At(19, x, y), At(20, x, y)]
    return (_body(1, "chair", parts, tuple(keys)),), ()


_DOOR = (-0.5, 1.55, 1.0)
"""Hinge x and y, and the width of the door, metres."""


def _door(j: Draw, scene: int, plan: Plan) -> Cast:
    """A door in a partition opens towards the camera and falls shut, twice in a period."""
    x, y, width = _DOOR
    wide, ajar = j(72, 80), j(20, 30)
    angles = ((0, 0), (1.5, 0), (4.0, -wide), (6.5, -wide), (9.0, -ajar), (10.5, -ajar), (13.0, -wide), (15.0, -wide),
              (18.0, 0), (20, 0))  # fmt: skip
    keys = tuple(At(t, x, y, 0.0, yaw) for t, yaw in angles)
    return (_body(1, "door", door_leaf(1, plan, width), keys),), ()


def _add_partition(room: Parts, plan: Plan) -> None:
    """A wall before the desk, with a doorway, and posters on it."""
    x, y, width = _DOOR
    for start, end in ((plan.left_x, x - 0.02), (x + width + 0.02, plan.right_x)):
        add_wall(room, (start, y + 0.05), (end, y + 0.05), plan)
    for k, at in enumerate((x - 0.28, x - 0.75, x + width + 0.28, x + width + 0.75)):
        for z in (1.0, 1.62):
            sheet = np.array([at, y - 0.006, z])
            room.add(BOX, np.eye(3), sheet, (0.19, 0.005, 0.26), texture=f"poster:{(k + int(2 * z)) % 4}", fit=(2,))


_SCRIPTS: dict[str, Callable[[Draw, int, Plan], Cast]] = {
    "balloon": _balloon, "box_obstructing": _box_obstructing, "box_aside": _box_aside, "placed": _placed,
    "removed": _removed, "kidnapped": _kidnapped, "trolley": _trolley, "chair": _chair, "door": _door,
}  # fmt: skip

OBJECTS = {f"objects_{name}": Variant(partial(build_objects, name), "high-dynamic") for name in _SCRIPTS}
