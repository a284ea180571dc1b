"""The room: walls, floor and ceiling, and where its furniture stands.

World frame as in motion.py: the camera stands near x = y = 0 and looks along +y.
"""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.seeding import stream

from .furniture import add_cabinet, add_desk, add_posters, add_shelf, add_side_posters
from .parts import BOX, QUAD, Parts, wall
from .plan import Plan


def build_room(instance: int, plan: Plan) -> Parts:
    """All fixed primitives."""
    rng = stream(instance, "synthetic", "furniture")
    parts, tint = Parts(), plan.tints
    height = 2.8
    back, front = plan.back_y, -2.5
    mid_y, half_y = (back + front) / 2, (back - front) / 2
    mid_x, half_x = (plan.left_x + plan.right_x) / 2, (plan.right_x - plan.left_x) / 2
    quad = {"shift": (float(rng.random()), float(rng.random()))}
    parts.add(
        QUAD,
        wall((1, 0, 0), (0, 1, 0)),
        np.array([mid_x, mid_y, 0.0]),
        (half_x, half_y, 0),
        texture="carpet",
        repeat=(1.0, 1.0),
        tint=tint["floor"],
        shift=quad["shift"],
    )
    parts.add(
        QUAD, wall((1, 0, 0), (0, -1, 0)), np.array([mid_x, mid_y, height]), (half_x, half_y, 0), tint=(0.95,) * 3
    )
    for x, sign in ((plan.left_x, 1.0), (plan.right_x, -1.0)):
        parts.add(
            QUAD,
            wall((0, -sign, 0), (0, 0, 1)),
            np.array([x, mid_y, height / 2]),
            (half_y, height / 2, 0),
            texture="plaster",
            repeat=(0.5, 0.5),
            tint=tint["side"],
        )
    parts.add(
        QUAD,
        wall((1, 0, 0), (0, 0, 1)),
        np.array([mid_x, back, height / 2]),
        (half_x, height / 2, 0),
        texture="plaster",
        repeat=(0.5, 0.5),
        tint=tint["wall"],
    )
    parts.add(
        QUAD,
        wall((-1, 0, 0), (0, 0, 1)),
        np.array([mid_x, front, height / 2]),
        (half_x, height / 2, 0),
        texture="plaster",
        repeat=(0.5, 0.5),
        tint=tint["wall"],
    )
    eye = np.eye(3)
    # Skirting board and a cable duct along the back wall.
    parts.add(BOX, eye, np.array([mid_x, back - 0.01, 0.05]), (half_x, 0.01, 0.05), tint=tint["shelf"])
    parts.add(BOX, eye, np.array([mid_x, back - 0.02, 0.95]), (half_x, 0.02, 0.04), tint=(0.82,) * 3)
    add_desk(parts, rng, plan, plan.desk_x, plan.desk_y, half=1.15)
    add_shelf(parts, rng, plan, plan.shelf_side)
    add_posters(parts, rng, plan)
    add_side_posters(parts, rng, plan)
    add_cabinet(parts, rng, plan, -plan.shelf_side)
    return parts
