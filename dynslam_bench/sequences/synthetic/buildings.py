"""Sequences of long paths that return: a room circled (20 m), a ring of corridors (60 m), six rooms along a corridor.

The last path has 120 m. `moved`: chairs and cartons stand elsewhere whenever the camera comes by
again; each is moved while the camera is half a lap away. `repeated`: every stretch of wall is the
same, down to its textures.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import Array, atan2, cos, norm, sin
from dynslam_bench.sequences.synthetic.camera_paths import Walk, walk_along, walking_camera
from dynslam_bench.sequences.synthetic.parts import Primitives, box, copies, rotation_about_z
from dynslam_bench.sequences.synthetic.rooms import (
    Point,
    cartons,
    corridor_bay,
    floor,
    notice_bay,
    office_bay,
    office_chair,
    partition,
    pick,
    plan_room,
)
from dynslam_bench.sequences.synthetic.scene import Body, Placement, Variant, World

HALL_SPEED = 0.45
"""Speed of the walk around the hall, m/s."""


class _Shape(NamedTuple):
    """Values in which the buildings differ.

    Attributes:
        aside_deg: How far the camera looks aside from where it walks, degrees.
        frames: Frames of a sequence.
        version: Version of the variants, part of their digests.
    """

    aside_deg: float
    frames: int
    version: int


_SHAPES = {
    "room": _Shape(-32.0, 2400, 1),
    "corridor": _Shape(-14.0, 3900, 1),
    "rooms": _Shape(0.0, 6600, 2),
}
"""The buildings by name."""


class _LoosePiece(NamedTuple):
    """A piece that may be moved.

    Attributes:
        kind: Its class.
        parts: Primitives about their own origin.
        yaw: Direction about the vertical, degrees.
        at: Place on the floor, metres.
    """

    kind: str
    parts: Primitives
    yaw: float
    at: Point


@dataclass
class _Building:
    """The parts that are built so far; every stretch of wall and every loose piece has its number.

    Attributes:
        scene: The scene.
        repeated: Whether all stretches of wall and all pieces are alike.
        parts: Primitives that never move.
        loose: Pieces that may be moved.
        bays: Stretches of wall so far.
    """

    scene: int
    repeated: bool
    parts: Primitives = field(default_factory=list)
    loose: list[_LoosePiece] = field(default_factory=list)
    bays: int = 0

    def bay(
        self, make: Callable[[int, int], Primitives], yaw: float, at: Point, alike: int = 0
    ) -> None:
        """Furnish a stretch of wall; where walls are repeated, all that are `alike` are the same."""
        number = alike if self.repeated else self.bays
        self.parts += copies(make(self.scene, number), yaw, (*at, 0.0), f"/{number}")
        self.bays += 1

    def piece(self, kind: str, yaw: float, at: Point) -> None:
        """Put a piece that may be moved on the floor: a ``chair`` or a ``box``."""
        number = 0 if self.repeated else len(self.loose)
        id = len(self.loose) + 1
        if kind == "chair":
            plain = office_chair(plan_room(self.scene, number), id)
        else:
            plain = cartons(self.scene, number, id)
        parts = copies(plain, 0.0, (0.0, 0.0, 0.0), f"/{number}")
        self.loose.append(_LoosePiece(kind, parts, yaw, at))


def build_loop(variant: str, scene: int) -> World:
    """The building, its loose pieces, and a camera that is carried around in it."""
    return build_walk(variant, scene)[0]


def build_walk(variant: str, scene: int) -> tuple[World, Walk]:
    """The world of `build_loop`, and the path of its camera."""
    # build it, then place the loose pieces
    shape, _, change = variant.partition("_")
    building = _Building(scene, change == "repeated")
    walk = _BUILDERS[shape](building)
    bodies = tuple(
        Body(k + 1, piece.kind, piece.parts, _placement(building, walk, change == "moved", k))
        for k, piece in enumerate(building.loose)
    )
    camera = partial(walking_camera, walk, scene, shape, _SHAPES[shape].aside_deg)
    return World(building.parts, camera, (0.0, 3.0, 2.15), bodies), walk


def _placement(building: _Building, walk: Walk, moved: bool, number: int) -> Placement:
    """The place of a loose piece, by lap: the first one and, if it is `moved`, two others in turn."""
    # where it was built
    rng = stream(building.scene, "synthetic", "moved", number)
    piece = building.loose[number]
    first = np.array([*piece.at, 0.0])
    places = [(rotation_about_z(piece.yaw), first)]

    # two other places nearby, turned
    for _ in range(2 if moved else 0):
        angle = np.radians(pick(rng, building.scene, 0.0, 360.0))
        away = pick(rng, building.scene, 0.3, 0.55) * np.array([cos(angle), sin(angle), 0.0])
        turned = rotation_about_z(piece.yaw + pick(rng, building.scene, 40.0, 320.0))
        places.append((turned, first + away))
    return partial(_place_by_lap, places, walk.time_nearest(piece.at), walk.lap_s)


def _place_by_lap(
    places: list[tuple[Array, Array]], near_s: float, lap_s: float, time: float
) -> tuple[Array, Array]:
    """Rotation and origin at a time; they change half a lap after the camera was nearest, at `near_s`."""
    return places[int(np.floor((time - near_s) / lap_s + 0.5)) % len(places)]


# The buildings. Each function furnishes one and returns the path through it.


def _room(building: _Building) -> Walk:
    """A hall with desks along its walls and a partition in the middle."""
    rng = stream(building.scene, "synthetic", "hall")
    plan = plan_room(building.scene, 0)
    x = pick(rng, building.scene, 5.2, 5.5)
    y = pick(rng, building.scene, 4.2, 4.4)

    # floor and walls
    building.parts += floor((-x, -y), (x, y), plan)
    for start, end in _around(x, y):
        building.parts += partition(start, end, plan)

    # two desks along either long wall with chairs, one along either short wall with a box
    for yaw, side, along in ((0, y, 2.4), (0, y, -2.4), (180, -y, 2.4), (180, -y, -2.4)):
        building.bay(office_bay, yaw, (along, side - np.sign(side) * 0.05))
        building.piece("chair", yaw, (along + 0.3, side - np.sign(side) * 1.55))
    for yaw, side in ((-90, x), (90, -x)):
        building.bay(office_bay, yaw, (side - np.sign(side) * 0.05, 0.0))
        building.piece("box", yaw, (side - np.sign(side) * 1.3, 0.9))

    # the partition in the middle
    names = (*(f"poster:{face % 4}" for face in range(4)), "plain", "plain")
    block = box(np.eye(3), (0.0, 0.0, 1.0), (1.2, 0.35, 1.0), texture=names, fit=(0, 1, 2, 3))
    building.parts += copies([block], 0.0, (0.0, 0.0, 0.0), "/partition")
    building.piece("box", 20.0, (0.3, 0.75))
    return walk_along(
        [(-x + 2.2, -y + 2.1), (x - 2.2, -y + 2.1), (x - 2.2, y - 2.1), (-x + 2.2, y - 2.1)],
        HALL_SPEED,
    )


def _around(x: float, y: float) -> list[tuple[Point, Point]]:
    """The four sides of a rectangle about the origin, counter-clockwise."""
    return list(itertools.pairwise([(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]))


def _corridor(building: _Building) -> Walk:
    """A ring of four corridors, 2.4 m wide, around a core."""
    rng = stream(building.scene, "synthetic", "ring")
    plan = plan_room(building.scene, 0)
    # half sides of the rectangle along the middle of the corridors, and half their width, metres
    x = pick(rng, building.scene, 9.6, 10.2)
    y = pick(rng, building.scene, 5.6, 6.0)
    half_width = 1.2
    building.parts += floor(
        (-x - half_width, -y - half_width), (x + half_width, y + half_width), plan
    )

    # the outer walls, then those of the core; both are furnished towards the corridor.
    for sign in (1, -1):
        for start, end in _around(x + sign * half_width, y + sign * half_width):
            building.parts += partition(start, end, plan)
            wall = np.array(end) - start

            # bays every 2.3 m, and before every third one a loose piece.
            length = float(norm(wall))
            yaw = float(np.degrees(atan2(wall[1], wall[0]))) + (0 if sign < 0 else 180)
            # 5 cm into the corridor: from the wall's middle to its face
            inward = sign * np.array([-wall[1], wall[0]]) / length * 0.05
            count = int(length / 2.3)
            for k in range(count):
                # repeated walls: the four kinds of bay in turn
                at = np.array(start) + wall * (k + 0.5) / count + inward
                building.bay(
                    corridor_bay, yaw, (float(at[0]), float(at[1])), alike=building.bays % 4
                )
                if k % 3 == 1:
                    out = at + inward / 0.05 * 0.35
                    building.piece(("chair", "box")[k % 2], yaw, (float(out[0]), float(out[1])))
    return walk_along([(-x, -y), (x, -y), (x, y), (-x, y)], 0.6)


_AROUND_ROOM = (
    (-0.2, 0.3),
    (-0.2, 2.2),
    (-1.9, 3.1),
    (-1.9, 5.0),
    (1.9, 5.0),
    (1.9, 3.1),
    (0.2, 2.2),
    (0.2, 0.3),
)
"""Corners of the path around a room: metres along the corridor from its door, and into the room."""


def _rooms(building: _Building) -> Walk:
    """A corridor with three rooms on either side; the path runs once around in each and returns."""
    # width and depth of the rooms, half the width of the corridor, half its length, metres
    rng = stream(building.scene, "synthetic", "floor")
    plan = plan_room(building.scene, 0)
    wide = pick(rng, building.scene, 6.6, 7.0)
    deep = pick(rng, building.scene, 5.8, 6.2)
    half = 1.2
    ends = 1.5 * wide
    building.parts += floor((-ends, -half - deep), (ends, half + deep), plan)
    for start, end in _around(ends, half + deep):
        building.parts += partition(start, end, plan)

    # the walls of the corridor, the walls between the rooms, and the path into each room and back.
    doors = (0.5 * wide, 1.5 * wide, 2.5 * wide)
    corners: list[Point] = []
    for side in (1, -1):
        building.parts += partition((-ends, side * half), (ends, side * half), plan, doors)
        for k in range(3):
            x = side * (k - 1) * wide
            if k:
                edge = x - side * wide / 2
                building.parts += partition((edge, side * half), (edge, side * (half + deep)), plan)
            # the room, the path around it, and a stretch of the corridor beside its door
            _furnish(building, x, side, wide, half, half + deep)
            corners += [(x + side * u, side * v) for u, v in _AROUND_ROOM]
            if k < 2:
                at = (x + side * wide / 2, side * (half - 0.05))
                building.bay(corridor_bay, 180.0 if side < 0 else 0.0, at)
        building.bay(notice_bay, -90.0 * side, (side * (ends - 0.05), 0.0), alike=7)
        # turn round at the end of the corridor
        turning = ((ends - 1.7, 0.6), (ends - 0.9, 0.1), (ends - 1.7, -0.6))
        corners += [(side * u, side * v) for u, v in turning]
    return walk_along(corners, 0.7)


def _furnish(
    building: _Building, x: float, side: int, wide: float, front: float, back: float
) -> None:
    """One room: an office along its back wall, furniture and notices along all others, loose pieces.

    The wall with the door, at `front`, has notices on both of its faces: those on the outer one
    hang in the corridor.
    """
    # the back wall
    yaw = 0.0 if side > 0 else 180.0
    building.bay(office_bay, yaw, (x, side * (back - 0.05)))

    # the side walls, and the wall with the door on either side of it
    for end in (1, -1):
        beside = x + end * (wide / 2 - 0.05)
        building.bay(
            corridor_bay, -90.0 * end, (beside, side * (back - 2.6)), alike=1 if end > 0 else 2
        )
        building.bay(notice_bay, -90.0 * end, (beside, side * (front + 1.5)), alike=3)
        building.bay(notice_bay, yaw + 180.0, (x + end * 1.75, side * (front + 0.05)), alike=4)
        building.bay(notice_bay, yaw, (x + end * 1.55, side * (front - 0.05)), alike=5)
    building.piece("chair", yaw, (x + 0.4, side * (back - 1.55)))
    building.piece("box", yaw, (x - 0.1 * wide, side * 3.9))


_BUILDERS: dict[str, Callable[[_Building], Walk]] = {
    "room": _room,
    "corridor": _corridor,
    "rooms": _rooms,
}
"""Function that furnishes each building, by the building's name."""

LOOPS = {
    f"loop_{name}{change}": Variant(
        partial(build_loop, name + change),
        "low-dynamic" if change == "_moved" else "static",
        shape.frames,
        shape.version,
    )
    for change in ("", "_moved", "_repeated")
    for name, shape in _SHAPES.items()
}
