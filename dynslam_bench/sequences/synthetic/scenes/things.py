"""Things that are carried, rolled and opened, each about its own origin: box, balloon, trolley, door."""

from __future__ import annotations

import numpy as np

from dynslam_bench.core.seeding import stream

from .parts import BOX, ROUND_CONE, Parts
from .plan import Plan

CARDBOARD = (0.95, 0.86, 0.74)
_PRINT = {"texture": tuple(f"poster:{face}" for face in range(6)), "fit": tuple(range(6)), "tint": CARDBOARD}


def printed_box(id: int, half: tuple[float, float, float]) -> Parts:
    """A carton with a print on every side; its origin is its middle."""
    parts = Parts()
    parts.add(BOX, np.eye(3), np.zeros(3), half, instance=id, **_PRINT)  # type: ignore[arg-type]  # a style
    return parts


def balloon(id: int, radius: float) -> Parts:
    """A printed balloon with its knot; the origin is its middle."""
    parts, eye = Parts(), np.eye(3)
    style = {"instance": id, "texture": "print:balloon", "repeat": (2.0, 2.0)}
    parts.add(ROUND_CONE, eye, np.zeros(3), (0.0, radius, radius), scale=(1.0, 1.0, 1.15), **style)  # type: ignore[arg-type]
    low = np.array([0.0, 0.0, -1.2 * radius])
    parts.add(ROUND_CONE, eye, low, (0.05, 0.02, 0.01), instance=id, tint=(0.8, 0.3, 0.3))
    return parts


def trolley(id: int, instance: int, plan: Plan) -> Parts:
    """A platform on wheels with a handle and three cartons; the origin lies on the floor."""
    parts, eye, rng = Parts(), np.eye(3), stream(instance, "synthetic", "trolley")
    parts.add(BOX, eye, np.array([0, 0, 0.16]), (0.45, 0.3, 0.02), instance=id, tint=plan.tints["metal"])
    for x in (-0.38, 0.38):
        for y in (-0.24, 0.24):
            parts.add(ROUND_CONE, eye, np.array([x, y, 0.07]), (0, 0.07, 0.07), instance=id, tint=(0.15,) * 3)
    for y in (-0.26, 0.26):
        bar = np.array([-0.43, y, 0.16])
        parts.add(ROUND_CONE, eye, bar, (0.85, 0.015, 0.015), instance=id, tint=plan.tints["metal"])
    parts.add(BOX, eye, np.array([-0.43, 0, 1.01]), (0.015, 0.27, 0.015), instance=id, tint=plan.tints["metal"])
    bottom = 0.18
    for _ in range(3):
        half = (0.26 + 0.12 * rng.random(), 0.2 + 0.08 * rng.random(), 0.15 + 0.06 * rng.random())
        at = np.array([0.02, 0.0, bottom + half[2]])
        parts.add(BOX, eye, at, half, instance=id, **_PRINT)  # type: ignore[arg-type]  # a style
        bottom += 2 * half[2]
    return parts


def door_leaf(id: int, plan: Plan, width: float) -> Parts:
    """A door leaf whose hinge stands at the origin and which runs along +x; posters on both sides."""
    parts, eye = Parts(), np.eye(3)
    at, half = np.array([width / 2, 0.0, 1.03]), (width / 2, 0.02, 1.02)
    parts.add(BOX, eye, at, half, instance=id, texture="wood", tint=plan.tints["door"])
    for k, (x, z) in enumerate(((0.3, 1.55), (0.7, 1.5), (0.3, 1.0), (0.68, 0.95))):
        sheet = np.array([x * width, 0.0, z])
        names = ("plain", "plain", f"poster:{k}", f"poster:{(k + 1) % 4}", "plain", "plain")
        parts.add(BOX, eye, sheet, (0.15, 0.024, 0.2), instance=id, texture=names, fit=(2, 3))
    handle = np.array([width - 0.08, 0.0, 1.03])
    parts.add(BOX, eye, handle, (0.06, 0.05, 0.012), instance=id, tint=plan.tints["metal"])
    return parts
