"""Long paths that return: a room circled (20 m), a ring of corridors (60 m), six rooms along a corridor (120 m).

`moved`: chairs and cartons stand elsewhere whenever the camera comes by again; each is moved while the camera is half a
lap away, at a sixth of it. `repeated`: every stretch of wall is the same, down to its textures.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import atan2, cos, norm, product, sin
from dynslam_bench.sequences.synthetic.camera_paths import (
    EYE_HEIGHT_M,
    TILT_RAD,
    Walk,
    camera_axes,
    hand,
    poses_of,
    rotations,
    walk_along,
    walking_camera,
)
from dynslam_bench.sequences.synthetic.parts import BOX, Parts, turn
from dynslam_bench.sequences.synthetic.people import Posture, draw_person
from dynslam_bench.sequences.synthetic.replicas import build_replica
from dynslam_bench.sequences.synthetic.rooms import (
    Point,
    add_floor,
    add_wall,
    cartons,
    corridor_bay,
    notices,
    office_bay,
    office_chair,
    pick,
    plan_room,
)
from dynslam_bench.sequences.synthetic.scene import Array, Body, Optics, Placement, Variant, World

_SHAPES = ("room", "corridor", "rooms")
_ASIDE = {"room": -32.0, "corridor": -14.0, "rooms": 0.0}
_FRAMES = {"room": 2400, "corridor": 3900, "rooms": 6600}


@dataclass
class _Building:
    """What is built so far; every stretch of wall and every loose piece has its number."""

    scene: int
    repeated: bool
    parts: Parts = field(default_factory=Parts)
    loose: list[tuple[str, Parts, float, Point]] = field(default_factory=list)
    bays: int = 0

    def bay(self, make: Callable[[int, int], Parts], yaw: float, at: Point, alike: int = 0) -> None:
        """Furnish a stretch of wall; where walls are repeated, all that are `alike` are the same."""
        number = alike if self.repeated else self.bays
        self.parts.add_copies(make(self.scene, number), yaw, (*at, 0.0), f"/{number}")
        self.bays += 1

    def piece(self, kind: str, yaw: float, at: Point) -> None:
        """Put a piece that may be moved on the floor: a ``chair`` or a ``box``."""
        number, id, piece = 0 if self.repeated else len(self.loose), len(self.loose) + 1, Parts()
        chair = kind == "chair"
        plain = office_chair(plan_room(self.scene, number), id) if chair else cartons(self.scene, number, id)
        piece.add_copies(plain, 0.0, (0.0, 0.0, 0.0), f"/{number}")
        self.loose.append((kind, piece, yaw, at))


def build_loop(variant: str, scene: int) -> World:
    """The building, its loose pieces, and a camera that is carried around in it."""
    shape, _, change = variant.partition("_")
    building = _Building(scene, change == "repeated")
    walk = {"room": _room, "corridor": _corridor, "rooms": _rooms}[shape](building)
    bodies = tuple(
        Body(k + 1, kind, parts, _moves(building, walk, change == "moved", k))
        for k, (kind, parts, _, _) in enumerate(building.loose)
    )
    return World(building.parts, partial(walking_camera, walk, scene, shape, _ASIDE[shape]), (0.0, 3.0, 2.15), bodies)


def _moves(building: _Building, walk: Walk, moved: bool, number: int) -> Placement:
    """The place of a loose piece, by lap."""
    rng, (_, _, yaw, at) = stream(building.scene, "synthetic", "moved", number), building.loose[number]
    places = [(turn(yaw), np.array([*at, 0.0]))]
    for _ in range(2 if moved else 0):
        angle = np.radians(pick(rng, building.scene, 0.0, 360.0))
        away = pick(rng, building.scene, 0.3, 0.55) * np.array([cos(angle), sin(angle), 0.0])
        places.append((turn(yaw + pick(rng, building.scene, 40.0, 320.0)), np.array([*at, 0.0]) + away))
    return partial(_stand, places, walk.time_nearest(at), walk.lap_s)


def _stand(places: list[tuple[Array, Array]], near_s: float, lap_s: float, time: float) -> tuple[Array, Array]:
    return places[int(np.floor((time - near_s) / lap_s + 0.5)) % len(places)]


def _room(b: _Building) -> Walk:
    """A hall with desks along its walls and a partition in the middle."""
    rng, plan = stream(b.scene, "synthetic", "hall"), plan_room(b.scene, 0)
    x, y = pick(rng, b.scene, 5.2, 5.5), pick(rng, b.scene, 4.2, 4.4)
    add_floor(b.parts, (-x, -y), (x, y), plan)
    for start, end in _around(x, y):
        add_wall(b.parts, start, end, plan)
    for yaw, side, along in ((0, y, 2.4), (0, y, -2.4), (180, -y, 2.4), (180, -y, -2.4)):
        b.bay(office_bay, yaw, (along, side - np.sign(side) * 0.05))
        b.piece("chair", yaw, (along + 0.3, side - np.sign(side) * 1.55))
    for yaw, side in ((-90, x), (90, -x)):
        b.bay(office_bay, yaw, (side - np.sign(side) * 0.05, 0.0))
        b.piece("box", yaw, (side - np.sign(side) * 1.3, 0.9))
    names, block = (*(f"poster:{face % 4}" for face in range(4)), "plain", "plain"), Parts()
    block.add(BOX, np.eye(3), np.array([0.0, 0.0, 1.0]), (1.2, 0.35, 1.0), texture=names, fit=(0, 1, 2, 3))
    b.parts.add_copies(block, 0.0, (0.0, 0.0, 0.0), "/partition")
    b.piece("box", 20.0, (0.3, 0.75))
    return walk_along([(-x + 2.2, -y + 2.1), (x - 2.2, -y + 2.1), (x - 2.2, y - 2.1), (-x + 2.2, y - 2.1)], 0.45)


def _around(x: float, y: float) -> list[tuple[Point, Point]]:
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    return list(zip(corners, [*corners[1:], corners[0]], strict=True))


def _corridor(b: _Building) -> Walk:
    """A ring of four corridors, 2.4 m wide, around a core."""
    rng, plan = stream(b.scene, "synthetic", "ring"), plan_room(b.scene, 0)
    x, y, width = pick(rng, b.scene, 9.6, 10.2), pick(rng, b.scene, 5.6, 6.0), 1.2
    add_floor(b.parts, (-x - width, -y - width), (x + width, y + width), plan)
    for sign in (1, -1):
        for start, end in _around(x + sign * width, y + sign * width):
            add_wall(b.parts, start, end, plan)
            wall = np.array(end) - start
            length = float(norm(wall))
            yaw = float(np.degrees(atan2(wall[1], wall[0]))) + (0 if sign < 0 else 180)
            inward = sign * np.array([-wall[1], wall[0]]) / length * 0.05
            count = int(length / 2.3)
            for k in range(count):
                at = np.array(start) + wall * (k + 0.5) / count + inward
                b.bay(corridor_bay, yaw, (float(at[0]), float(at[1])), alike=b.bays % 4)
                if k % 3 == 1:
                    out = at + inward / 0.05 * 0.35
                    b.piece(("chair", "box")[k % 2], yaw, (float(out[0]), float(out[1])))
    return walk_along([(-x, -y), (x, -y), (x, y), (-x, y)], 0.6)


def _rooms(b: _Building) -> Walk:
    """A corridor with three rooms on either side; the path runs once around in each and returns."""
    rng, plan = stream(b.scene, "synthetic", "floor"), plan_room(b.scene, 0)
    wide, deep, half = pick(rng, b.scene, 6.6, 7.0), pick(rng, b.scene, 5.8, 6.2), 1.2
    ends = 1.5 * wide
    add_floor(b.parts, (-ends, -half - deep), (ends, half + deep), plan)
    for start, end in _around(ends, half + deep):
        add_wall(b.parts, start, end, plan)
    doors = (0.5 * wide, 1.5 * wide, 2.5 * wide)
    corners: list[Point] = []
    for side in (1, -1):
        add_wall(b.parts, (-ends, side * half), (ends, side * half), plan, doors)
        for k in range(3):
            x = side * (k - 1) * wide
            if k:
                edge = x - side * wide / 2
                add_wall(b.parts, (edge, side * half), (edge, side * (half + deep)), plan)
            _furnish(b, x, side, wide, half, half + deep)
            corners += [
                (x + side * u, side * v)
                for u, v in ((-0.2, 0.3), (-0.2, 2.2), (-1.9, 3.1), (-1.9, 5.0), (1.9, 5.0), (1.9, 3.1), (0.2, 2.2),
                             (0.2, 0.3))
            ]  # fmt: skip
            if k < 2:
                at = (x + side * wide / 2, side * (half - 0.05))
                b.bay(corridor_bay, 180.0 if side < 0 else 0.0, at)
        b.bay(notices, -90.0 * side, (side * (ends - 0.05), 0.0), alike=7)
        corners += [(side * u, side * v) for u, v in ((ends - 1.7, 0.6), (ends - 0.9, 0.1), (ends - 1.7, -0.6))]
    return walk_along(corners, 0.7)


def _furnish(b: _Building, x: float, side: int, wide: float, front: float, back: float) -> None:
    """One room: an office along its back wall, furniture and notices along all others, loose pieces.

    The wall with the door, at `front`, has notices on both of its faces: those on the outer one hang in the corridor.
    """
    yaw = 0.0 if side > 0 else 180.0
    b.bay(office_bay, yaw, (x, side * (back - 0.05)))
    for end in (1, -1):
        beside = x + end * (wide / 2 - 0.05)
        b.bay(corridor_bay, -90.0 * end, (beside, side * (back - 2.6)), alike=1 if end > 0 else 2)
        b.bay(notices, -90.0 * end, (beside, side * (front + 1.5)), alike=3)
        b.bay(notices, yaw + 180.0, (x + end * 1.75, side * (front + 0.05)), alike=4)
        b.bay(notices, yaw, (x + end * 1.55, side * (front - 0.05)), alike=5)
    b.piece("chair", yaw, (x + 0.4, side * (back - 1.55)))
    b.piece("box", yaw, (x - 0.1 * wide, side * 3.9))


LOOPS = {
    f"loop_{shape}{change}": Variant(
        partial(build_loop, shape + change),
        "low-dynamic" if change == "_moved" else "static",
        _FRAMES[shape],
        version=2 if shape == "rooms" else 1,
    )
    for change in ("", "_moved", "_repeated")
    for shape in _SHAPES
}


# The camera follows a person around a room, as in Bonn's person tracking.


def build_tracking(scene: int) -> World:
    """The hall of the loops, walked by a person and, two metres behind, the camera."""
    hall, rng = build_loop("room", scene), stream(scene, "synthetic", "tracking")
    walk: Walk = hall.camera.args[0]  # type: ignore[attr-defined]  # a partial of `walking_camera`
    lead_s = pick(rng, scene, 1.7, 2.0) / 0.45
    person = replace(draw_person(scene, 0), instance=len(hall.bodies) + 1)
    camera = partial(walking_camera, walk, scene, "tracking", 6.0)
    return replace(hall, camera=camera, actors=((person, partial(_walking, walk, lead_s)),))


def _walking(walk: Walk, lead_s: float, time: float) -> Posture:
    place, ahead = walk.at(np.array([time + lead_s, time + lead_s + 0.3]))
    direction = ahead - place
    facing = math.degrees(atan2(direction[1], direction[0])) - 90.0
    stride = 0.45 * (time + lead_s) * 2 * math.pi / 1.0
    return Posture(float(place[0]), float(place[1]), facing, stride, 0.6, 0.0, 0.0, time)


TRACKING = {"tracking": Variant(build_tracking, "high-dynamic", 1200)}


# The tempo of TUM's fr1: turns of 1-3 rad/s, motion blur, a rolling shutter and automatic exposure.

OPTICS = Optics(readout_s=0.026, auto_exposure=0.7, color={"shutter": 0.3})
"""26 ms from the first row to the last, as in the first Kinect."""

SWINGS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "desk": ((0.17, 0.12, 0.14), (0.26, 0.46, 0.26)),
    "rpy": ((0.03, 0.03, 0.03), (0.3, 0.52, 0.38)),
    "spin": ((0.14, 0.08, 0.14), (0.12, 0.25, 0.12)),
    "walking": ((0.15, 0.1, 0.1), (0.24, 0.44, 0.26)),
}
"""Amplitudes of each variant: right, down, forward in metres; pitch, yaw, roll in radians."""


def build_fast(variant: str, scene: int) -> World:
    """The office, without people or with the walking ones, or the hall of the loops."""
    if variant == "spin":
        world = build_loop("room", scene)
    else:
        world = build_replica("walking", "xyz", scene)
        world = world if variant == "walking" else replace(world, bodies=(), actors=())
    return replace(world, camera=partial(fast_camera, variant, scene), optics=OPTICS)


def fast_camera(variant: str, scene: int, times: Array) -> Array:
    """Poses ``[N, 4, 4]``: sines of several frequencies along and about all axes; `spin` also turns round and round."""
    rng, t = stream(scene, "synthetic", "camera", "fast", variant), times
    shifts, turns = SWINGS[variant]
    offset, angles = hand(rng, t, 0.006, 3), hand(rng, t, math.radians(0.8), 3)
    for amplitudes, values in ((shifts, offset), (turns, angles)):
        for axis, amplitude in enumerate(amplitudes):
            main, second = pick(rng, scene, 0.45, 0.7), pick(rng, scene, 0.8, 1.1)
            values[:, axis] += 0.75 * amplitude * sin(2 * math.pi * (main * t + rng.random()))
            values[:, axis] += 0.4 * amplitude * sin(2 * math.pi * (second * t + rng.random()))
    yaw, place = np.zeros((len(t), 3)), np.array([0.0, 0.0, EYE_HEIGHT_M])
    if variant == "spin":
        yaw[:, 2] = pick(rng, scene, 1.3, 1.6) * t
        place = np.array([2.7, 0.2, EYE_HEIGHT_M])
    base = product(rotations(yaw), camera_axes(TILT_RAD))
    return poses_of(product(base, rotations(angles)), place + product(base, offset[..., None])[..., 0])


FAST = {
    f"fast_{name}": Variant(partial(build_fast, name), "high-dynamic" if name == "walking" else "static")
    for name in SWINGS
}
