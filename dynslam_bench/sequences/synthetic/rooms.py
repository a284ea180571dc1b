"""Rooms and furniture of a scene: plans, walls, desks, shelves, posters, chairs, and things that move.

Scenes for tuning and held-out ones share no size and no place: each is drawn from the half of its
pool that belongs to the scene's split.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dynslam_bench.core.seeding import stream
from dynslam_bench.sequences.synthetic.arithmetic import Array, atan2, norm, product
from dynslam_bench.sequences.synthetic.parts import (
    Primitives,
    box,
    cone,
    quad,
    rotation_about_z,
    wall,
)
from dynslam_bench.sequences.synthetic.settings import TUNE_SCENES


@dataclass(frozen=True)
class RoomPlan:
    """Sizes, places and colours of the room of a scene.

    Attributes:
        back_y: Distance of the back wall.
        left_x: Left wall.
        right_x: Right wall.
        desk_y: Front edge of the main desk.
        desk_x: Middle of the main desk.
        monitors: How many stand on a desk.
        shelf_side: 1 puts the shelf to the right and the cabinet to the left, -1 the other way.
        posters: How many hang on the back wall.
        mirrored: Whether a desk's drawers are on its right.
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


Style = dict[str, Any]
"""Arguments of `primitive` that several primitives share."""


def pick(rng: np.random.Generator, scene: int, low: float, high: float, steps: int = 64) -> float:
    """A value of [low, high] from the even points of a grid for tuning scenes, the odd ones for held-out ones."""
    odd = scene not in TUNE_SCENES
    return low + (high - low) * (2 * int(rng.integers(steps)) + odd) / (2 * steps - 1)


def pick_one(rng: np.random.Generator, scene: int, pool: list[int]) -> int:
    """A member of the split's half of the pool."""
    half = pool[::2] if scene in TUNE_SCENES else pool[1::2]
    return half[int(rng.integers(len(half)))]


def plan_room(scene: int, number: int | None = None) -> RoomPlan:
    """Draw the plan of a scene's room, or of one of its several rooms."""
    # the stream of draws; a scene's only room and its first of several are different rooms
    one_of_several = () if number is None else (number,)
    rng = stream(scene, "synthetic", "room", *one_of_several)

    def color(low: float, high: float, spread: float) -> Array:
        """A grey within bounds, and a deviation of each channel from it."""
        base = pick(rng, scene, low, high)
        return np.clip(base + spread * (rng.random(3) - 0.5), 0.03, 1.0)

    # colours of the materials, red, green and blue from 0 to 1
    wood = pick(rng, scene, 0.55, 0.95) * np.array([1.0, 0.84, 0.66])
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
    # sizes and places, in this order of draws
    return RoomPlan(
        back_y=pick(rng, scene, 3.35, 3.75),
        left_x=-pick(rng, scene, 1.9, 2.4),
        right_x=pick(rng, scene, 1.9, 2.4),
        desk_y=pick(rng, scene, 2.0, 2.2),
        desk_x=pick(rng, scene, -0.15, 0.15),
        monitors=pick_one(rng, scene, [2, 3, 2, 3]),
        shelf_side=int(rng.integers(2)) * 2 - 1,
        posters=int(rng.integers(2, 5)),
        mirrored=bool(rng.integers(2)),
        tints=tints,
    )


def glare_window(plan: RoomPlan) -> tuple[float, float, float]:
    """The place beside the back wall where glare comes from, metres."""
    return plan.left_x * 0.55, plan.back_y, 2.15


# The office's furniture: desk with monitors and clutter, shelf, posters, cabinet with a plant,
# office chairs. Places are world positions in metres, x to the right, y away from the camera, z up.
# `x, y` of a desk are the middle and the front edge of its top, `half` is half its length.

TOP = 0.74
"""Height of a desk, metres."""
_EYE = np.eye(3)
"""Rotation of what stands along the world's axes."""


def desk(rng: np.random.Generator, plan: RoomPlan, x: float, y: float, half: float) -> Primitives:
    """A desk (0.8 m deep, 0.74 m high) with drawers, monitors, keyboards, books, papers, mugs and a lamp."""
    return [
        *_table(plan, x, y, half),
        *_monitors(rng, plan, x, y, half),
        *_papers(rng, x, y, half),
        *_book_piles(rng, x, y, half),
        *_mugs(rng, x, y),
        *_lamp(plan, x, y, half),
    ]


def _table(plan: RoomPlan, x: float, y: float, half: float) -> Primitives:
    """The top of a desk, its sides and back, and a unit of three drawers."""
    tint = plan.tints
    wood: Style = {"texture": "wood", "tint": tint["desk"]}
    darker: Style = wood | {"tint": tint["desk"] * 0.9}
    darkest: Style = wood | {"tint": tint["desk"] * 0.85}
    # half the height of a side; where the unit of drawers stands
    leg = (TOP - 0.036) / 2
    side = 1 if plan.mirrored else -1
    unit = np.array([x + side * (half - 0.3), y + 0.38, 0.3])

    # top, sides, back and drawers' unit
    parts = [box(_EYE, (x, y + 0.4, TOP - 0.018), (half, 0.4, 0.018), repeat=(1.2, 1.6), **wood)]
    for end in (-1, 1):
        parts.append(
            box(_EYE, (x + end * (half - 0.04), y + 0.4, leg), (0.02, 0.36, leg), **darker)
        )
    parts += [
        box(_EYE, (x, y + 0.74, 0.45), (half - 0.06, 0.01, 0.25), **darkest),
        box(_EYE, unit, (0.21, 0.3, 0.29), tint=tint["cabinet"]),
    ]

    # fronts and handles of the drawers
    for k in range(3):
        front = unit + np.array([0, -0.305, 0.19 - 0.19 * k])
        handle = unit + np.array([0, -0.32, 0.22 - 0.19 * k])
        parts += [
            box(_EYE, front, (0.195, 0.008, 0.085), tint=tint["cabinet"] * 0.92),
            box(_EYE, handle, (0.05, 0.008, 0.008), tint=tint["metal"]),
        ]
    return parts


def _papers(rng: np.random.Generator, x: float, y: float, half: float) -> Primitives:
    """Five sheets, each lying a little higher than the one before."""
    parts: Primitives = []
    for k in range(5):
        px = x + (rng.random() - 0.5) * 2 * (half - 0.15)
        turned = rotation_about_z(rng.random() * 50 - 25)
        at = (px, y + 0.1 + 0.2 * rng.random(), TOP + 0.002 + 0.001 * k)
        style: Style = {"texture": f"poster:{k % 4}", "fit": (5,), "tint": (0.95,) * 3}
        parts.append(box(turned, at, (0.105, 0.148, 0.001), **style))
    return parts


def _book_piles(rng: np.random.Generator, x: float, y: float, half: float) -> Primitives:
    """A pile of books at either end."""
    parts: Primitives = []
    for k in range(2):
        # two to four books, each turned a little on the one below
        bx = x + (-1 if k else 1) * (half - 0.2 - 0.1 * rng.random())
        for level in range(int(rng.integers(2, 5))):
            shade = 0.25 + 0.7 * rng.random(3)
            turned = rotation_about_z(rng.random() * 30 - 15)
            at = (bx, y + 0.3 + 0.1 * k, TOP + 0.018 + 0.036 * level)
            style: Style = {
                "texture": (*["books"] * 4, "plain", f"poster:{level % 4}"),
                "fit": (5,),
                "tint": shade,
                "repeat": (0.4, 3.0),
            }
            parts.append(box(turned, at, (0.12, 0.085, 0.017), **style))
    return parts


def _mugs(rng: np.random.Generator, x: float, y: float) -> Primitives:
    """A plain mug and one with stripes."""
    parts: Primitives = []
    for k in range(2):
        at = (x + (rng.random() - 0.5) * 1.4, y + 0.12 + 0.12 * rng.random(), TOP + 0.012)
        style: Style = {
            "texture": "stripes" if k else "plain",
            "repeat": (1.0, 4.0),
            "tint": 0.35 + 0.6 * rng.random(3),
        }
        parts.append(cone(_EYE, at, (0.085, 0.04, 0.042), **style))
    return parts


def _lamp(plan: RoomPlan, x: float, y: float, half: float) -> Primitives:
    """Foot, rod and shade of a lamp, at the end without drawers."""
    tint = plan.tints
    side = 1 if plan.mirrored else -1
    foot = np.array([x + side * (0.55 - half), y + 0.62, TOP])
    return [
        cone(_EYE, foot, (0.02, 0.07, 0.06), tint=tint["metal"], scale=(1, 1, 0.4)),
        cone(_EYE, foot, (0.42, 0.012, 0.012), tint=tint["metal"]),
        cone(_EYE, foot + np.array([0.0, -0.1, 0.4]), (0.08, 0.085, 0.035), tint=tint["bin"]),
    ]


_FRAME = (
    (0, 0.18, 0.285, 0.013),
    (0, -0.18, 0.285, 0.013),
    (-0.277, 0, 0.013, 0.19),
    (0.277, 0, 0.013, 0.19),
)
"""Bars around a monitor's picture: middle and half extents along both of its sides, metres."""


def _monitors(
    rng: np.random.Generator, plan: RoomPlan, x: float, y: float, half: float
) -> Primitives:
    """Monitors, each with its foot, a keyboard and a mouse."""
    plastic = plan.tints["plastic"]
    spacing = 2 * half / (plan.monitors + 0.6)
    parts: Primitives = []
    for k in range(plan.monitors):
        mx = x + (k - (plan.monitors - 1) / 2) * spacing + 0.06 * (rng.random() - 0.5)
        facing = rotation_about_z((rng.random() - 0.5) * 24)
        my = y + 0.52 + 0.08 * rng.random()
        middle = np.array([mx, my, TOP + 0.3])
        faces = ("plain", "plain", f"screen:{k}", "plain", "plain", "plain")
        turned = rotation_about_z(6 * (rng.random() - 0.5))

        # the screen and the bars around it
        parts.append(box(facing, middle, (0.27, 0.02, 0.175), texture=faces, fit=(2,)))
        for dx, dz, hx, hz in _FRAME:
            bar = middle + product(facing, np.array([dx, -0.012, dz]))
            parts.append(box(facing, bar, (hx, 0.024, hz), tint=plastic))

        # foot, keyboard and mouse
        keys: Style = {"texture": "keyboard", "fit": (5,)}
        mouse: Style = {"scale": (0.032, 0.055, 0.025), "tint": plastic}
        parts += [
            box(facing, (mx, my + 0.03, TOP + 0.09), (0.03, 0.02, 0.09), tint=plastic),
            box(facing, (mx, my + 0.01, TOP + 0.008), (0.12, 0.09, 0.008), tint=plastic),
            box(turned, (mx - 0.03, my - 0.3, TOP + 0.012), (0.22, 0.075, 0.012), **keys),
            cone(rotation_about_z(20), (mx + 0.27, my - 0.3, TOP + 0.005), (0, 1, 1), **mouse),
        ]
    return parts


def shelf(rng: np.random.Generator, plan: RoomPlan, side: int) -> Primitives:
    """A bookcase against the back wall with rows of books and boxes."""
    wood: Style = {"texture": "wood", "tint": plan.tints["shelf"]}
    darker: Style = wood | {"tint": plan.tints["shelf"] * 0.8}
    x = (plan.right_x - 0.5 if side > 0 else plan.left_x + 0.5) - side * 0.25 * rng.random()
    y = plan.back_y - 0.17
    half = 0.42
    height = 1.95
    # sides and back
    parts = [
        box(_EYE, (x - half, y, height / 2), (0.015, 0.15, height / 2), **wood),
        box(_EYE, (x + half, y, height / 2), (0.015, 0.15, height / 2), **wood),
        box(_EYE, (x, y + 0.145, height / 2), (half, 0.008, height / 2), **darker),
    ]

    # six boards, and on all but the top one a row of books and, where there is room, a box
    for k in range(6):
        z = 0.06 + k * (height - 0.08) / 5
        parts.append(box(_EYE, (x, y, z), (half, 0.15, 0.014), **wood))
        if k == 5:
            break
        width = half * (0.45 + 0.5 * rng.random())
        tall = 0.12 + 0.03 * rng.random()
        offset = (half - width - 0.02) * (1 if rng.random() < 0.5 else -1)
        books: Style = {
            "texture": "books",
            "repeat": (0.9, 0.5 / tall),
            "shift": (float(rng.random()), 0.5),
            "tint": (0.9,) * 3,
        }
        at = (x + offset, y - 0.01, z + 0.014 + tall)
        parts.append(box(_EYE, at, (width, 0.1, tall), **books))
        if width < half * 0.75:
            at = (x - offset * 1.9, y, z + 0.1)
            parts.append(box(_EYE, at, (0.1, 0.1, 0.085), tint=0.3 + 0.6 * rng.random(3)))
    return parts


def posters(rng: np.random.Generator, plan: RoomPlan) -> Primitives:
    """Posters on the back wall."""
    parts = []
    span = plan.right_x - plan.left_x - 1.6
    for k in range(plan.posters):
        x = plan.left_x + 0.8 + span * (k + 0.3 + 0.4 * rng.random()) / plan.posters
        half_x, half_z = ((0.3, 0.42), (0.42, 0.3), (0.21, 0.3))[int(rng.integers(3))]
        at = (x, plan.back_y - 0.006, 1.55 + 0.25 * rng.random())
        parts.append(box(_EYE, at, (half_x, 0.006, half_z), texture=f"poster:{k % 4}", fit=(2,)))
    return parts


def cabinet(rng: np.random.Generator, plan: RoomPlan, side: int) -> Primitives:
    """A low cabinet with a plant and boxes on it, at the other end of the back wall; a waste bin."""
    tint = plan.tints
    y = plan.back_y - 0.25
    x = plan.right_x - 0.5 if side > 0 else plan.left_x + 0.5
    parts = [box(_EYE, (x, y, 0.42), (0.45, 0.22, 0.42), tint=tint["cabinet"])]
    # doors and handles
    for dx in (-0.225, 0.225):
        parts += [
            box(_EYE, (x + dx, y - 0.226, 0.42), (0.215, 0.008, 0.39), tint=tint["cabinet"] * 0.9),
            box(_EYE, (x + dx * 0.3, y - 0.24, 0.6), (0.008, 0.01, 0.06), tint=tint["metal"]),
        ]
    parts += _plant(rng, np.array([x - 0.2 * side, y, 0.85]))
    # boxes on it
    for k in range(2):
        s = 0.1 + 0.05 * rng.random()
        faces = ("plain", "plain", f"poster:{k}", "plain", "plain", "plain")
        style: Style = {"texture": faces, "fit": (2,), "tint": (0.85, 0.72, 0.55)}
        turned = rotation_about_z(rng.random() * 30)
        at = (x + side * (0.1 + 0.2 * k), y, 0.84 + s)
        parts.append(box(turned, at, (s, s * 0.8, s), **style))
    bin_at = (plan.desk_x + side * 1.35, plan.desk_y + 0.2, 0.13)
    return [*parts, cone(_EYE, bin_at, (0.16, 0.12, 0.14), tint=tint["bin"])]


def _plant(rng: np.random.Generator, pot: Array) -> Primitives:
    """A pot and nine leaves that lean outwards from its middle."""
    parts = [cone(_EYE, pot + np.array([0, 0, 0.06]), (0.1, 0.08, 0.1), tint=(0.7, 0.38, 0.25))]
    stem = pot + np.array([0, 0, 0.14])
    for _ in range(9):
        around = rotation_about_z(rng.random() * 360)
        lean = 0.3 + 0.7 * rng.random()
        outwards = np.array([0.24 * lean, 0, 0.3 + 0.3 * (1 - lean) + 0.1 * rng.random()])
        tip = pot + product(around, outwards)
        length = norm(tip - stem)
        green = np.array([0.2, 0.45, 0.16]) * (0.7 + 0.6 * rng.random())
        # the leaf's axes: z along it, x across its flat side
        z = (tip - stem) / length
        u = np.cross(z, product(around, np.array([0.0, 1.0, 0.0])))
        axes = np.stack([u / norm(u), np.cross(z, u / norm(u)), z], 1)
        shape = (float(length), 0.012, 0.04)
        parts.append(cone(axes, stem, shape, scale=(0.25, 1.0, 1.0), tint=green))
    return parts


def build_room(scene: int, plan: RoomPlan) -> Primitives:
    """All fixed primitives of the office: walls, floor and ceiling, and its furniture."""
    # extents of the room
    rng = stream(scene, "synthetic", "furniture")
    tint = plan.tints
    back = plan.back_y
    front = -2.5
    mid_y = (back + front) / 2
    half_y = (back - front) / 2
    mid_x = (plan.left_x + plan.right_x) / 2
    half_x = (plan.right_x - plan.left_x) / 2
    across = (half_x, HEIGHT_M / 2, 0)
    along = (half_y, HEIGHT_M / 2, 0)

    # floor, ceiling and four walls: local x axis, middle, half extents, colour
    sides = (
        ((0, -1, 0), plan.left_x, mid_y, along, "side"),
        ((0, 1, 0), plan.right_x, mid_y, along, "side"),
        ((1, 0, 0), mid_x, back, across, "wall"),
        ((-1, 0, 0), mid_x, front, across, "wall"),
    )
    plaster: Style = {"texture": "plaster", "repeat": (0.5, 0.5)}
    carpet_shift = (float(rng.random()), float(rng.random()))
    parts = floor((plan.left_x, front), (plan.right_x, back), plan, carpet_shift)
    for right, x, y, half, name in sides:
        facing = wall(right, (0, 0, 1))
        parts.append(quad(facing, (x, y, HEIGHT_M / 2), half, tint=tint[name], **plaster))
    # skirting board, cable duct
    parts += [
        box(_EYE, (mid_x, back - 0.01, 0.05), (half_x, 0.01, 0.05), tint=tint["shelf"]),
        box(_EYE, (mid_x, back - 0.02, 0.95), (half_x, 0.02, 0.04), tint=(0.82,) * 3),
    ]
    # furniture
    parts += desk(rng, plan, plan.desk_x, plan.desk_y, half=1.15)
    parts += shelf(rng, plan, plan.shelf_side)
    parts += posters(rng, plan)
    # a poster on either side wall
    for x, sign, k in ((plan.left_x, 1.0, 2), (plan.right_x, -1.0, 3)):
        at = (x + sign * 0.006, 1.6 + 1.2 * rng.random(), 1.55)
        style: Style = {"texture": f"poster:{k}", "fit": (2, 3)}
        parts.append(box(rotation_about_z(90), at, (0.36, 0.006, 0.26), **style))
    return parts + cabinet(rng, plan, -plan.shelf_side)


# Larger interiors: floors, walls with doorways, furnished stretches of wall, and pieces that may be
# moved.

HEIGHT_M = 2.8
"""Height of the rooms."""
DOOR_M = 1.3
"""Width of a doorway in a partition."""
_LINTEL_M = 2.1
"""Height of a doorway."""
Point = tuple[float, float]


def floor(low: Point, high: Point, plan: RoomPlan, shift: Point = (0.0, 0.0)) -> Primitives:
    """Floor and ceiling of a rectangle; `shift` is that of the carpet's texture."""
    middle = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
    half = ((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, 0.0)
    tint = plan.tints["floor"]
    up = wall((1, 0, 0), (0, 1, 0))
    down = wall((1, 0, 0), (0, -1, 0))
    return [
        quad(up, (*middle, 0.0), half, texture="carpet", tint=tint, shift=shift),
        quad(down, (*middle, HEIGHT_M), half, tint=(0.95,) * 3),
    ]


def partition(
    start: Point, end: Point, plan: RoomPlan, doors: tuple[float, ...] = ()
) -> Primitives:
    """A wall 0.1 m thick with doorways.

    Args:
        start: One end, metres.
        end: Other end, metres.
        plan: Its colour.
        doors: Middles of the doorways, metres from `start`, in order.
    """
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    length = math.sqrt(dx * dx + dy * dy)
    facing = rotation_about_z(math.degrees(atan2(dy, dx)))
    direction = np.array([dx, dy, 0.0]) / length

    # pieces between the doorways, and above them: first and last metre, and lower edge
    edges = [0.0, *(door + side * DOOR_M / 2 for door in doors for side in (-1, 1)), length]
    pieces = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    pieces += [(door - DOOR_M / 2, door + DOOR_M / 2, _LINTEL_M) for door in doors]

    # a box each
    style: Style = {"texture": "plaster", "repeat": (0.5, 0.5), "tint": plan.tints["wall"]}
    parts = []
    for a, b, bottom in pieces:
        along = np.array([*start, 0.0]) + (a + b) / 2 * direction
        middle = along + np.array([0.0, 0.0, (HEIGHT_M + bottom) / 2])
        half = ((b - a) / 2, 0.05, (HEIGHT_M - bottom) / 2)
        parts.append(box(facing, middle, half, **style))
    return parts


def _stretch(scene: int, number: int, half: float) -> tuple[RoomPlan, np.random.Generator]:
    """The plan of a stretch of wall along y = 0, from x = -half to half, and the stream of its draws.

    Args:
        scene: The scene.
        number: Which of its stretches.
        half: Half the length, metres.
    """
    plan = replace(
        plan_room(scene, number), back_y=0.0, left_x=-half, right_x=half, desk_x=0.0, desk_y=-1.0
    )
    return plan, stream(scene, "synthetic", "bay", number)


def office_bay(scene: int, number: int) -> Primitives:
    """Four metres of an office's wall: desk, shelf, cabinet, posters."""
    plan, rng = _stretch(scene, number, 2.0)
    return [
        *desk(rng, plan, plan.desk_x, plan.desk_y, half=0.92),
        *shelf(rng, plan, plan.shelf_side),
        *posters(rng, plan),
        *cabinet(rng, replace(plan, desk_x=9e3), -plan.shelf_side),
    ]


def corridor_bay(scene: int, number: int) -> Primitives:
    """Two metres of a corridor's wall: posters, a shelf, a closed door or a notice board."""
    plan, rng = _stretch(scene, number, 0.7)
    kind = number % 4
    tint = plan.tints
    if kind == 0:
        return posters(rng, replace(plan, left_x=-1.5, right_x=1.5))
    if kind == 1:
        return shelf(rng, plan, 1)
    if kind == 2:
        return [
            box(_EYE, (0, -0.02, 1.03), (0.5, 0.02, 1.03), tint=tint["shelf"]),
            box(_EYE, (0, -0.04, 1.0), (0.44, 0.02, 1.0), texture="wood", tint=tint["door"]),
            box(_EYE, (0.36, -0.09, 1.02), (0.05, 0.012, 0.012), tint=tint["metal"]),
            box(_EYE, (0.0, -0.062, 1.5), (0.12, 0.003, 0.16), texture="poster:1", fit=(2,)),
        ]
    # a notice board: three sheets above three others
    parts = []
    for k in range(6):
        turned = rotation_about_z(8 * rng.random() - 4)
        at = (-0.6 + 0.6 * (k % 3), -0.006, 1.35 + 0.5 * (k // 3))
        parts.append(box(turned, at, (0.15, 0.005, 0.21), texture=f"poster:{k % 4}", fit=(2,)))
    return parts


def notice_bay(scene: int, number: int) -> Primitives:
    """Two metres of wall along y = 0 with four sheets, 1.15 to 1.75 m high; `number` seeds the draw."""
    rng = stream(scene, "synthetic", "notices", number)
    parts = []
    for k in range(4):
        # upright or lying, metres
        half_extents = ((0.21, 0.005, 0.3), (0.3, 0.005, 0.21))[int(rng.integers(2))]
        at = (-0.69 + 0.46 * k, -0.006 - 0.002 * k, 1.15 + 0.6 * rng.random())
        parts.append(box(_EYE, at, half_extents, texture=f"poster:{k}", fit=(2,)))
    return parts


# Things that are moved, each about its own origin: chair, cartons, box, balloon, trolley, door.

# a print on every face
_PRINT: Style = {
    "texture": tuple(f"poster:{face}" for face in range(6)),
    "fit": tuple(range(6)),
    "tint": (0.95, 0.86, 0.74),
}


def office_chair(plan: RoomPlan, instance: int, shade: float = 1.0) -> Primitives:
    """An office chair facing -y: seat, back, column, five-pointed base; the origin lies on the floor."""
    metal = plan.tints["metal"]
    hub = np.array([0, 0, 0.09])
    lean = np.array([[1.0, 0, 0], [0, 0.985, -0.17], [0, 0.17, 0.985]])
    cloth: Style = {
        "instance": instance,
        "texture": "denim",
        "repeat": (3, 3),
        "tint": plan.tints["chair"] * shade,
    }
    frame: Style = {"instance": instance, "tint": metal}
    # seat, back, the bar between them, column
    parts = [
        box(_EYE, (0, 0, 0.45), (0.23, 0.22, 0.035), **cloth),
        box(lean, (0, 0.26, 0.76), (0.21, 0.028, 0.25), **cloth),
        box(lean, (0, 0.255, 0.47), (0.035, 0.012, 0.1), **frame),
        cone(_EYE, (0, 0, 0.1), (0.32, 0.03, 0.028), **frame),
    ]
    # the base's five points, each with its castor
    for k in range(5):
        around = rotation_about_z(72 * k + 18)
        tip = product(around, np.array([0.28, 0, 0.05]))
        u = product(around, np.array([0.0, 1.0, 0.0]))
        z = (tip - hub) / norm(tip - hub)
        parts += [
            cone(np.stack([u, np.cross(z, u), z], 1), hub, (0.28, 0.024, 0.02), **frame),
            cone(_EYE, tip - (0, 0, 0.015), (0, 0.032, 0.032), **frame | {"tint": metal * 0.7}),
        ]
    # the armrests
    darker = frame | {"tint": metal * 0.8}
    for side in (-1, 1):
        parts += [
            box(_EYE, (side * 0.27, 0.03, 0.66), (0.025, 0.13, 0.015), **darker),
            box(_EYE, (side * 0.27, 0.05, 0.55), (0.015, 0.02, 0.1), **frame),
        ]
    return parts


def cartons(scene: int, number: int, id: int) -> Primitives:
    """Two printed cartons on each other."""
    parts = []
    rng = stream(scene, "synthetic", "cartons", number)
    bottom = 0.0
    for k in range(2):
        half = (0.19 + 0.08 * rng.random(), 0.16 + 0.06 * rng.random(), 0.14 + 0.05 * rng.random())
        names = (*(f"poster:{(face + k) % 4}" for face in range(4)), "plain", "plain")
        style: Style = {
            "instance": id,
            "texture": names,
            "fit": (0, 1, 2, 3),
            "tint": (0.9, 0.8, 0.66),
        }
        parts.append(
            box(rotation_about_z(30 * rng.random()), (0.0, 0.0, bottom + half[2]), half, **style)
        )
        bottom += 2 * half[2]
    return parts


def printed_box(id: int, half: tuple[float, float, float]) -> Primitives:
    """A carton with a print on every side; its origin is its middle."""
    return [box(_EYE, np.zeros(3), half, instance=id, **_PRINT)]


def balloon(id: int, radius: float) -> Primitives:
    """A printed balloon with its knot; the origin is its middle."""
    skin: Style = {"texture": "print:balloon", "repeat": (2.0, 2.0), "scale": (1.0, 1.0, 1.15)}
    knot = (0.0, 0.0, -1.2 * radius)
    return [
        cone(_EYE, np.zeros(3), (0.0, radius, radius), instance=id, **skin),
        cone(_EYE, knot, (0.05, 0.02, 0.01), instance=id, tint=(0.8, 0.3, 0.3)),
    ]


def trolley(id: int, scene: int, plan: RoomPlan) -> Primitives:
    """A platform on wheels with a handle and three cartons; the origin lies on the floor."""
    rng = stream(scene, "synthetic", "trolley")
    bottom = 0.18
    metal: Style = {"instance": id, "tint": plan.tints["metal"]}
    wheels = ((-0.38, -0.24), (-0.38, 0.24), (0.38, -0.24), (0.38, 0.24))
    # platform, wheels and handle
    parts = [box(_EYE, (0, 0, 0.16), (0.45, 0.3, 0.02), **metal)]
    for x, y in wheels:
        parts.append(cone(_EYE, (x, y, 0.07), (0, 0.07, 0.07), instance=id, tint=(0.15,) * 3))
    for y in (-0.26, 0.26):
        parts.append(cone(_EYE, (-0.43, y, 0.16), (0.85, 0.015, 0.015), **metal))
    parts.append(box(_EYE, (-0.43, 0, 1.01), (0.015, 0.27, 0.015), **metal))
    # the cartons, one on another
    for _ in range(3):
        half = (0.26 + 0.12 * rng.random(), 0.2 + 0.08 * rng.random(), 0.15 + 0.06 * rng.random())
        parts.append(
            box(_EYE, np.array([0.02, 0.0, bottom + half[2]]), half, instance=id, **_PRINT)
        )
        bottom += 2 * half[2]
    return parts


def door_leaf(id: int, plan: RoomPlan, width: float) -> Primitives:
    """A door leaf whose hinge stands at the origin and which runs along +x; posters on both sides."""
    wood: Style = {"instance": id, "texture": "wood", "tint": plan.tints["door"]}
    metal: Style = {"instance": id, "tint": plan.tints["metal"]}
    parts = [box(_EYE, (width / 2, 0.0, 1.03), (width / 2, 0.02, 1.02), **wood)]
    for k, (x, z) in enumerate(((0.3, 1.55), (0.7, 1.5), (0.3, 1.0), (0.68, 0.95))):
        faces = ("plain", "plain", f"poster:{k}", f"poster:{(k + 1) % 4}", "plain", "plain")
        poster: Style = {"instance": id, "texture": faces, "fit": (2, 3)}
        parts.append(box(_EYE, (x * width, 0.0, z), (0.15, 0.024, 0.2), **poster))
    parts.append(box(_EYE, (width - 0.08, 0.0, 1.03), (0.06, 0.05, 0.012), **metal))
    return parts
