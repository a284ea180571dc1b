"""Larger interiors: floors, walls with doorways, furnished stretches of wall, and pieces that may be moved.

A stretch of wall is built about its own origin, on the floor in the middle of the wall, which runs along x; the room
lies towards -y. `Parts.extend` puts it where it belongs.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dynslam_bench.core.seeding import stream

from ..arithmetic import atan2
from .furniture import add_cabinet, add_chair, add_desk, add_posters, add_shelf
from .parts import BOX, QUAD, Parts, turn, wall
from .plan import Plan, plan_room

HEIGHT_M = 2.8
DOOR_M = 1.3
_LINTEL_M = 2.1
Point = tuple[float, float]


def add_floor(parts: Parts, low: Point, high: Point, plan: Plan) -> None:
    """Floor and ceiling of a rectangle."""
    middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2]
    half = ((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, 0.0)
    parts.add(
        QUAD, wall((1, 0, 0), (0, 1, 0)), np.array([*middle, 0.0]), half, texture="carpet", tint=plan.tints["floor"]
    )
    parts.add(QUAD, wall((1, 0, 0), (0, -1, 0)), np.array([*middle, HEIGHT_M]), half, tint=(0.95,) * 3)


def add_wall(parts: Parts, start: Point, end: Point, plan: Plan, doors: tuple[float, ...] = ()) -> None:
    """A wall 0.1 m thick with doorways.

    Args:
        parts: Where to.
        start: One end, metres.
        end: The other.
        plan: Its colour.
        doors: Middles of the doorways, metres from `start`.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.sqrt(dx * dx + dy * dy)
    facing, way = turn(math.degrees(atan2(dy, dx))), np.array([dx, dy, 0.0]) / length

    def piece(a: float, b: float, bottom: float) -> None:
        half = ((b - a) / 2, 0.05, (HEIGHT_M - bottom) / 2)
        at = np.array([*start, 0.0]) + (a + b) / 2 * way + np.array([0.0, 0.0, (HEIGHT_M + bottom) / 2])
        parts.add(BOX, facing, at, half, texture="plaster", repeat=(0.5, 0.5), tint=plan.tints["wall"])

    edges = [0.0] + [door + side * DOOR_M / 2 for door in sorted(doors) for side in (-1, 1)] + [length]
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        piece(a, b, 0.0)
    for door in doors:
        piece(door - DOOR_M / 2, door + DOOR_M / 2, _LINTEL_M)


def office_bay(instance: int, number: int) -> Parts:
    """Four metres of an office's wall: desk, shelf, cabinet, posters."""
    plan = _wall_plan(instance, number, 2.0)
    rng, parts = stream(instance, "synthetic", "bay", number), Parts()
    add_desk(parts, rng, plan, plan.desk_x, plan.desk_y, half=0.92)
    add_shelf(parts, rng, plan, plan.shelf_side)
    add_posters(parts, rng, plan)
    add_cabinet(parts, rng, replace(plan, desk_x=9e3), -plan.shelf_side)
    return parts


def corridor_bay(instance: int, number: int) -> Parts:
    """Two metres of a corridor's wall: posters, a shelf, a closed door or a notice board."""
    plan = _wall_plan(instance, number, 0.7)
    rng, parts = stream(instance, "synthetic", "bay", number), Parts()
    kind = number % 4
    if kind == 0:
        add_posters(parts, rng, replace(plan, left_x=-1.5, right_x=1.5))
    elif kind == 1:
        add_shelf(parts, rng, plan, 1)
    elif kind == 2:
        _add_closed_door(parts, plan)
    else:
        for k in range(6):
            at = np.array([-0.6 + 0.6 * (k % 3), -0.006, 1.35 + 0.5 * (k // 3)])
            parts.add(BOX, turn(8 * rng.random() - 4), at, (0.15, 0.005, 0.21), texture=f"poster:{k % 4}", fit=(2,))
    return parts


def notices(instance: int, number: int) -> Parts:
    """Nearly two metres of wall with four sheets on it at different heights."""
    rng, parts = stream(instance, "synthetic", "notices", number), Parts()
    for k in range(4):
        half = ((0.21, 0.005, 0.3), (0.3, 0.005, 0.21))[int(rng.integers(2))]
        at = np.array([-0.69 + 0.46 * k, -0.006 - 0.002 * k, 1.15 + 0.6 * rng.random()])
        parts.add(BOX, np.eye(3), at, half, texture=f"poster:{k}", fit=(2,))
    return parts


def _add_closed_door(parts: Parts, plan: Plan) -> None:
    eye, tint = np.eye(3), plan.tints
    parts.add(BOX, eye, np.array([0, -0.02, 1.03]), (0.5, 0.02, 1.03), tint=tint["shelf"])
    parts.add(BOX, eye, np.array([0, -0.04, 1.0]), (0.44, 0.02, 1.0), texture="wood", tint=tint["door"])
    parts.add(BOX, eye, np.array([0.36, -0.09, 1.02]), (0.05, 0.012, 0.012), tint=tint["metal"])
    parts.add(BOX, eye, np.array([0.0, -0.062, 1.5]), (0.12, 0.003, 0.16), texture="poster:1", fit=(2,))


def _wall_plan(instance: int, number: int, half: float) -> Plan:
    """The plan of a stretch of wall about its own origin."""
    return replace(
        plan_room(instance, number), back_y=0.0, left_x=-half, right_x=half, desk_x=0.0, desk_y=-1.0
    )  # fmt: skip


def office_chair(instance: int, number: int, id: int) -> Parts:
    """An office chair about its own origin on the floor."""
    parts, tints = Parts(), plan_room(instance, number).tints
    add_chair(parts, id, tints["chair"], tints["metal"])
    return parts


def cartons(instance: int, number: int, id: int) -> Parts:
    """Two printed cartons on each other."""
    parts, rng = Parts(), stream(instance, "synthetic", "cartons", number)
    bottom = 0.0
    for k in range(2):
        half = (0.19 + 0.08 * rng.random(), 0.16 + 0.06 * rng.random(), 0.14 + 0.05 * rng.random())
        names = (*(f"poster:{(face + k) % 4}" for face in range(4)), "plain", "plain")
        at = np.array([0.0, 0.0, bottom + half[2]])
        tint = (0.9, 0.8, 0.66)
        parts.add(BOX, turn(30 * rng.random()), at, half, instance=id, texture=names, fit=(0, 1, 2, 3), tint=tint)
        bottom += 2 * half[2]
    return parts
