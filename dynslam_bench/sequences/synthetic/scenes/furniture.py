"""The room's furniture: desk with monitors and clutter, shelf, posters, cabinet with a plant, office chairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arithmetic import norm, product
from .parts import BOX, ROUND_CONE, Parts, turn
from .plan import Plan

Array = NDArray[np.float64]
TOP = 0.74
"""Height of a desk, metres."""


def add_desk(parts: Parts, rng: np.random.Generator, plan: Plan, x: float, y: float, half: float) -> None:
    """A desk (0.8 m deep, 0.74 m high) with monitors, keyboards, books, papers, mugs and a lamp."""
    _add_table(parts, plan, x, y, half)
    _add_monitors(parts, rng, plan, x, y, half)
    _add_papers(parts, rng, x, y, half)
    _add_books(parts, rng, x, y, half)
    _add_mugs(parts, rng, x, y)
    side = 1 if plan.mirrored else -1
    eye, lamp = np.eye(3), np.array([x + side * (0.55 - half), y + 0.62, TOP])
    parts.add(ROUND_CONE, eye, lamp, (0.02, 0.07, 0.06), tint=plan.tints["metal"], scale=(1, 1, 0.4))
    parts.add(ROUND_CONE, eye, lamp, (0.42, 0.012, 0.012), tint=plan.tints["metal"])
    parts.add(ROUND_CONE, eye, lamp + np.array([0.0, -0.1, 0.4]), (0.08, 0.085, 0.035), tint=plan.tints["bin"])


def _add_table(parts: Parts, plan: Plan, x: float, y: float, half: float) -> None:
    """The table, and a drawer unit under one end."""
    eye, tint, top = np.eye(3), plan.tints, TOP
    parts.add(
        BOX,
        eye,
        np.array([x, y + 0.4, top - 0.018]),
        (half, 0.4, 0.018),
        texture="wood",
        repeat=(1.2, 1.6),
        tint=tint["desk"],
    )
    for side in (-1, 1):
        parts.add(
            BOX,
            eye,
            np.array([x + side * (half - 0.04), y + 0.4, (top - 0.036) / 2]),
            (0.02, 0.36, (top - 0.036) / 2),
            texture="wood",
            tint=tint["desk"] * 0.9,
        )
    parts.add(
        BOX, eye, np.array([x, y + 0.74, 0.45]), (half - 0.06, 0.01, 0.25), texture="wood", tint=tint["desk"] * 0.85
    )
    side = 1 if plan.mirrored else -1
    unit = np.array([x + side * (half - 0.3), y + 0.38, 0.3])
    parts.add(BOX, eye, unit, (0.21, 0.3, 0.29), tint=tint["cabinet"])
    for k in range(3):
        parts.add(
            BOX, eye, unit + np.array([0, -0.305, 0.19 - 0.19 * k]), (0.195, 0.008, 0.085), tint=tint["cabinet"] * 0.92
        )
        parts.add(BOX, eye, unit + np.array([0, -0.32, 0.22 - 0.19 * k]), (0.05, 0.008, 0.008), tint=tint["metal"])


def _add_monitors(parts: Parts, rng: np.random.Generator, plan: Plan, x: float, y: float, half: float) -> None:
    """Monitors, each with its foot, a keyboard and a mouse."""
    tint, top = plan.tints, TOP
    spacing = 2 * half / (plan.monitors + 0.6)
    for k in range(plan.monitors):
        mx = x + (k - (plan.monitors - 1) / 2) * spacing + 0.06 * (rng.random() - 0.5)
        facing = turn((rng.random() - 0.5) * 24)
        my = y + 0.52 + 0.08 * rng.random()
        parts.add(
            BOX,
            facing,
            np.array([mx, my, top + 0.3]),
            (0.27, 0.02, 0.175),
            texture=("plain", "plain", f"screen:{k}", "plain", "plain", "plain"),
            tint=(1.0, 1.0, 1.0),
            fit=(2,),
        )
        for dx, dz, hx, hz in (
            (0, 0.18, 0.285, 0.013),
            (0, -0.18, 0.285, 0.013),
            (-0.277, 0, 0.013, 0.19),
            (0.277, 0, 0.013, 0.19),
        ):
            parts.add(
                BOX,
                facing,
                np.array([mx, my, top + 0.3]) + product(facing, np.array([dx, -0.012, dz])),
                (hx, 0.024, hz),
                tint=tint["plastic"],
            )
        parts.add(BOX, facing, np.array([mx, my + 0.03, top + 0.09]), (0.03, 0.02, 0.09), tint=tint["plastic"])
        parts.add(BOX, facing, np.array([mx, my + 0.01, top + 0.008]), (0.12, 0.09, 0.008), tint=tint["plastic"])
        parts.add(
            BOX,
            turn(6 * (rng.random() - 0.5)),
            np.array([mx - 0.03, my - 0.3, top + 0.012]),
            (0.22, 0.075, 0.012),
            texture="keyboard",
            fit=(5,),
        )
        parts.add(
            ROUND_CONE,
            turn(20),
            np.array([mx + 0.27, my - 0.3, top + 0.005]),
            (0, 1, 1),
            scale=(0.032, 0.055, 0.025),
            tint=tint["plastic"],
        )


def _add_papers(parts: Parts, rng: np.random.Generator, x: float, y: float, half: float) -> None:
    top = TOP
    for k in range(5):
        px = x + (rng.random() - 0.5) * 2 * (half - 0.15)
        parts.add(
            BOX,
            turn(rng.random() * 50 - 25),
            np.array([px, y + 0.1 + 0.2 * rng.random(), top + 0.002 + 0.001 * k]),
            (0.105, 0.148, 0.001),
            texture=f"poster:{k % 4}",
            fit=(5,),
            tint=(0.95,) * 3,
        )


def _add_books(parts: Parts, rng: np.random.Generator, x: float, y: float, half: float) -> None:
    """A pile of books at either end."""
    top = TOP
    for k in range(2):
        bx = x + (-1 if k else 1) * (half - 0.2 - 0.1 * rng.random())
        for level in range(int(rng.integers(2, 5))):
            shade = 0.25 + 0.7 * rng.random(3)
            parts.add(
                BOX,
                turn(rng.random() * 30 - 15),
                np.array([bx, y + 0.3 + 0.1 * k, top + 0.018 + 0.036 * level]),
                (0.12, 0.085, 0.017),
                texture=("books",) * 4 + ("plain", f"poster:{level % 4}"),
                fit=(5,),
                tint=shade,
                repeat=(0.4, 3.0),
            )


def _add_mugs(parts: Parts, rng: np.random.Generator, x: float, y: float) -> None:
    eye, top = np.eye(3), TOP
    for k in range(2):
        mug = np.array([x + (rng.random() - 0.5) * 1.4, y + 0.12 + 0.12 * rng.random(), top + 0.012])
        parts.add(
            ROUND_CONE,
            eye,
            mug,
            (0.085, 0.04, 0.042),
            texture="stripes" if k else "plain",
            repeat=(1.0, 4.0),
            tint=0.35 + 0.6 * rng.random(3),
        )


def add_shelf(parts: Parts, rng: np.random.Generator, plan: Plan, side: int) -> None:
    """A bookcase against the back wall with rows of books and boxes."""
    eye, tint = np.eye(3), plan.tints
    x = (plan.right_x - 0.5 if side > 0 else plan.left_x + 0.5) - side * 0.25 * rng.random()
    y, half, height = plan.back_y - 0.17, 0.42, 1.95
    for dx in (-half, half):
        parts.add(
            BOX, eye, np.array([x + dx, y, height / 2]), (0.015, 0.15, height / 2), texture="wood", tint=tint["shelf"]
        )
    parts.add(
        BOX,
        eye,
        np.array([x, y + 0.145, height / 2]),
        (half, 0.008, height / 2),
        texture="wood",
        tint=tint["shelf"] * 0.8,
    )
    for k in range(6):
        z = 0.06 + k * (height - 0.08) / 5
        parts.add(BOX, eye, np.array([x, y, z]), (half, 0.15, 0.014), texture="wood", tint=tint["shelf"])
        if k == 5:
            continue
        width = half * (0.45 + 0.5 * rng.random())
        tall = 0.12 + 0.03 * rng.random()
        offset = (half - width - 0.02) * (1 if rng.random() < 0.5 else -1)
        parts.add(
            BOX,
            eye,
            np.array([x + offset, y - 0.01, z + 0.014 + tall]),
            (width, 0.1, tall),
            texture="books",
            repeat=(0.9, 0.5 / tall),
            shift=(float(rng.random()), 0.5),
            tint=(0.9,) * 3,
        )
        if width < half * 0.75:
            parts.add(
                BOX,
                eye,
                np.array([x - offset * 1.9, y, z + 0.1]),
                (0.1, 0.1, 0.085),
                texture="plain",
                tint=0.3 + 0.6 * rng.random(3),
            )


def add_posters(parts: Parts, rng: np.random.Generator, plan: Plan) -> None:
    """Posters on the back wall."""
    for k in range(plan.posters):
        span = plan.right_x - plan.left_x - 1.6
        x = plan.left_x + 0.8 + span * (k + 0.3 + 0.4 * rng.random()) / plan.posters
        half_x, half_z = ((0.3, 0.42), (0.42, 0.3), (0.21, 0.3))[int(rng.integers(3))]
        z = 1.55 + 0.25 * rng.random()
        parts.add(
            BOX,
            np.eye(3),
            np.array([x, plan.back_y - 0.006, z]),
            (half_x, 0.006, half_z),
            texture=f"poster:{k % 4}",
            fit=(2,),
        )


def add_side_posters(parts: Parts, rng: np.random.Generator, plan: Plan) -> None:
    """A poster on each side wall."""
    for x, sign, k in ((plan.left_x, 1.0, 2), (plan.right_x, -1.0, 3)):
        y = 1.6 + 1.2 * rng.random()
        parts.add(
            BOX, turn(90), np.array([x + sign * 0.006, y, 1.55]), (0.36, 0.006, 0.26), texture=f"poster:{k}", fit=(2, 3)
        )


def add_cabinet(parts: Parts, rng: np.random.Generator, plan: Plan, side: int) -> None:
    """A low cabinet with a plant and boxes on it, at the other end of the back wall; a waste bin."""
    eye, tint = np.eye(3), plan.tints
    x = plan.right_x - 0.5 if side > 0 else plan.left_x + 0.5
    y = plan.back_y - 0.25
    parts.add(BOX, eye, np.array([x, y, 0.42]), (0.45, 0.22, 0.42), tint=tint["cabinet"])
    for dx in (-0.225, 0.225):
        parts.add(BOX, eye, np.array([x + dx, y - 0.226, 0.42]), (0.215, 0.008, 0.39), tint=tint["cabinet"] * 0.9)
        parts.add(BOX, eye, np.array([x + dx * 0.3, y - 0.24, 0.6]), (0.008, 0.01, 0.06), tint=tint["metal"])
    pot = np.array([x - 0.2 * side, y, 0.85])
    parts.add(ROUND_CONE, eye, pot + np.array([0, 0, 0.06]), (0.1, 0.08, 0.1), tint=(0.7, 0.38, 0.25))
    for _ in range(9):
        a, lean = rng.random() * 360, 0.3 + 0.7 * rng.random()
        tip = pot + product(turn(a), np.array([0.24 * lean, 0, 0.3 + 0.3 * (1 - lean) + 0.1 * rng.random()]))
        base = pot + np.array([0, 0, 0.14])
        z = (tip - base) / norm(tip - base)
        u = np.cross(z, product(turn(a), np.array([0.0, 1.0, 0.0])))
        u = u / norm(u)
        parts.add(
            ROUND_CONE,
            np.stack([u, np.cross(z, u), z], 1),
            base,
            (float(norm(tip - base)), 0.012, 0.04),
            scale=(0.25, 1.0, 1.0),
            tint=np.array([0.2, 0.45, 0.16]) * (0.7 + 0.6 * rng.random()),
        )
    for k in range(2):
        s = 0.1 + 0.05 * rng.random()
        parts.add(
            BOX,
            turn(rng.random() * 30),
            np.array([x + side * (0.1 + 0.2 * k), y, 0.84 + s]),
            (s, s * 0.8, s),
            texture=("plain",) * 2 + (f"poster:{k}",) + ("plain",) * 3,
            fit=(2,),
            tint=(0.85, 0.72, 0.55),
        )
    parts.add(
        ROUND_CONE,
        eye,
        np.array([plan.desk_x + side * 1.35, plan.desk_y + 0.2, 0.13]),
        (0.16, 0.12, 0.14),
        tint=tint["bin"],
    )


def add_chair(parts: Parts, instance: int, tint: Array, metal: Array) -> None:
    """An office chair around its own origin on the floor, facing -y: seat, back, column, five-pointed base."""
    eye = np.eye(3)
    parts.add(
        BOX,
        eye,
        np.array([0, 0, 0.45]),
        (0.23, 0.22, 0.035),
        instance=instance,
        texture="denim",
        repeat=(3, 3),
        tint=tint,
    )
    lean = np.array([[1.0, 0, 0], [0, 0.985, -0.17], [0, 0.17, 0.985]])
    parts.add(
        BOX,
        lean,
        np.array([0, 0.26, 0.76]),
        (0.21, 0.028, 0.25),
        instance=instance,
        texture="denim",
        repeat=(3, 3),
        tint=tint,
    )
    parts.add(BOX, lean, np.array([0, 0.255, 0.47]), (0.035, 0.012, 0.1), instance=instance, tint=metal)
    parts.add(ROUND_CONE, eye, np.array([0, 0, 0.1]), (0.32, 0.03, 0.028), instance=instance, tint=metal)
    for k in range(5):
        a = turn(72 * k + 18)
        tip = product(a, np.array([0.28, 0, 0.05]))
        z = (tip - (0, 0, 0.09)) / norm(tip - (0, 0, 0.09))
        u = product(a, np.array([0.0, 1.0, 0.0]))
        parts.add(
            ROUND_CONE,
            np.stack([u, np.cross(z, u), z], 1),
            np.array([0, 0, 0.09]),
            (0.28, 0.024, 0.02),
            instance=instance,
            tint=metal,
        )
        parts.add(ROUND_CONE, eye, tip - (0, 0, 0.015), (0, 0.032, 0.032), instance=instance, tint=metal * 0.7)
    for side in (-1, 1):
        parts.add(
            BOX, eye, np.array([side * 0.27, 0.03, 0.66]), (0.025, 0.13, 0.015), instance=instance, tint=metal * 0.8
        )
        parts.add(BOX, eye, np.array([side * 0.27, 0.05, 0.55]), (0.015, 0.02, 0.1), instance=instance, tint=metal)
